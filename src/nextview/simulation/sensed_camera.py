"""A simulated camera with a sensor: true depth, sensor errors, and the usual processing."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nextview.errors import ObservationError
from nextview.geometry.camera import pinhole
from nextview.geometry.mesh import Mesh
from nextview.geometry.viewsphere import CAMERA_DISTANCE
from nextview.sensing import Frame, ObjectFrame, ObservedObject
from nextview.sensing.facets import SIZE
from nextview.sensing.frame import Part, spans, within
from nextview.sensing.masks import inside_sphere
from nextview.sensing.observation import Observation
from nextview.sensing.resampling import virtual_pose
from nextview.sensing.sighting import FEWEST_OBJECT_PIXELS
from nextview.simulation.boxes import boxes_around
from nextview.simulation.sensor import Sensor, SensorMix, sensor_named, uniform_field
from nextview.simulation.simulated import SimulatedCamera
from nextview.types import Float, Float32, Mask

# default radius of the table, object radii
BARE_TABLE_RADIUS = 1.5
# radius of the search sphere, object radii, as the object exceeds its own sphere with pose errors
OBJECT_REACH = 1.3
LEFTOVER = 4.0  # size of the patches of the table that are segmented as object, pixels
# labels of pixels; empty pixels have the first one
OBJECT_SURFACE = 0
TABLE_SURFACE = 1
BOX = 2


class SensedCamera:
    """Camera that observes a normalised mesh through a sensor, as on a robot.

    The object stands on a table, among boxes if the sensor's setup has any. Each frame is processed
    by ``ObservedObject``, with an object frame that has the errors of the setup. The mask contains
    the points measured near the object, without boxes and most of the table.

    A mesh with a known unit has its true size, see ``Sensor.before``. Other meshes, and all meshes
    if the sensor is a mix, have the size defined by the sensor.

    Args:
        mesh: normalised mesh.
        sensor: the sensor. A mix of sensors, the errors of the object frame and the boxes are drawn
            once, here.
        rng: source of all random numbers.
        denoise: as for ``ObservedObject``.
        around: occluders that replace the boxes, object frame.
        table: radius of the table, object radii.
        true_size: whether to use the true size of a mesh with a known unit.
    """

    def __init__(
        self,
        mesh: Mesh,
        sensor: Sensor | SensorMix | str,
        rng: np.random.Generator,
        denoise: bool = True,
        around: Mesh | None = None,
        table: float = BARE_TABLE_RADIUS,
        true_size: bool = True,
    ) -> None:
        known = sensor_named(sensor)
        if isinstance(known, SensorMix):
            self.sensor = known.draw(rng.spawn(1)[0])
        elif true_size and mesh.metres is not None:
            self.sensor = known.before(mesh.metres)
        else:
            self.sensor = known
        self.denoise = denoise
        self._rng = rng
        self._reach = table
        self._metres = mesh.metres
        self._camera = self._looking_at(mesh)
        self._floor = float(mesh.vertices[:, 2].min())
        self._truth = ObjectFrame(np.zeros(3), self.sensor.radius, np.eye(3))
        # camera pose of the last frame, (4, 4), in the true object frame, metres
        self.true_pose: Float | None = None
        setup = self.sensor
        draws = rng.spawn(1)[0]
        centre = draws.normal(0, setup.centre * setup.radius, 3)
        radius = setup.radius * np.exp(draws.normal(0, setup.size))
        lean = Rotation.from_rotvec(
            [*draws.normal(0, setup.tilt, 2), 0],
            degrees=True,
        ).as_matrix()
        # object frame that the robot assumes
        self.object_frame = ObjectFrame(centre, float(radius), lean)
        if around is None and self.sensor.boxes:
            draws = rng.spawn(1)[0]
            if count := int(draws.poisson(self.sensor.boxes)):
                around = boxes_around(mesh.vertices, count, draws)
        self._around = None if around is None else self._looking_at(around)

    def _looking_at(self, mesh: Mesh) -> SimulatedCamera:
        return SimulatedCamera(
            mesh,
            intrinsics=self.sensor.intrinsics,
            shape=self.sensor.shape,
        )

    def observe(self, pose: Float) -> Observation:
        """Observe from the direction of a pose, (4, 4), at the sensor's own distance.

        If too little is found, the observation is empty.
        """
        try:
            thing = ObservedObject(
                known=self.object_frame,
                support=False,
                denoise=self.denoise,
                life_size=False,
            )
            # An object of a millimetre is outside the image of a camera whose position has errors
            # of millimetres.
            frame = self.frame(pose)
            if frame is None:
                raise ObservationError("nothing is seen")
            observation = thing.add(frame)
        except ObservationError:
            asked = virtual_pose(
                self.object_frame.pose_in_object(self._truth.pose_in_world(pose))
            )
            observation = Observation(
                np.zeros((SIZE, SIZE), np.float32),
                asked,
                pinhole(SIZE, CAMERA_DISTANCE),
            )
        if self._metres is None:
            return observation
        return replace(
            observation,
            radius=self._metres * self.object_frame.radius / self._truth.radius,
        )

    def frame(self, pose: Float) -> Frame | None:
        """Return the sensor's frame with mask and assumed pose; None if too little is visible.

        The world frame is the true object frame, in metres. The pose is as in ``observe``.
        """
        rng = self._rng.spawn(1)[0]
        believed = self._truth.pose_in_world(pose, self.sensor.distance)
        true = believed.copy()
        if self.sensor.turned or self.sensor.moved:
            angles = rng.normal(0, self.sensor.turned, 3)
            true[:3, :3] = (
                true[:3, :3] @ Rotation.from_rotvec(angles, degrees=True).as_matrix()
            )
            true[:3, 3] += rng.normal(0, self.sensor.moved, 3)
        self.true_pose = true
        depth, whose = self._scene(true)
        measured, source = self.sensor.measure(depth, rng)
        part = within(measured)  # all measured pixels
        shown = whose.ravel()[source[part]]
        mask = measured > 0
        other = (shown != OBJECT_SURFACE) & (source[part] >= 0)
        if self.sensor.table:
            left_in = (
                uniform_field(rng, depth.shape, LEFTOVER, part) < self.sensor.table
            )
            other &= (shown != TABLE_SURFACE) | ~left_in
        mask[part] &= ~other
        if self.sensor.crop:
            measured = self._cropped(measured, mask, rng)
        if np.count_nonzero(measured) < FEWEST_OBJECT_PIXELS:
            return None

        frame = Frame(measured, self.sensor.intrinsics, believed, pixel_centre=0.5)
        mask[part] &= inside_sphere(
            frame,
            self.object_frame.centre,
            OBJECT_REACH * self.object_frame.radius,
            part,
        )

        return (
            replace(frame, mask=mask)
            if np.count_nonzero(mask) >= FEWEST_OBJECT_PIXELS
            else None
        )

    def _scene(self, pose: Float) -> tuple[Float32, NDArray[np.uint8]]:
        """Return the true depth of object, boxes and table, metres, and the label of each pixel."""
        inside = self._truth.pose_in_object(pose)
        depth = self._camera.observe(inside).depth.copy()
        whose = np.full(depth.shape, OBJECT_SURFACE, np.uint8)
        part, table = self._table(inside)
        shown = np.isfinite(table) & (depth[part] == 0)
        depth[part][shown] = table[shown]
        whose[part][shown] = TABLE_SURFACE
        if self._around is not None:
            boxes = self._around.observe(inside).depth
            nearer = (boxes > 0) & ((depth == 0) | (boxes < depth))
            depth = np.where(nearer, boxes, depth)
            whose = np.where(nearer, np.uint8(BOX), whose)
        return depth * np.float32(self.sensor.radius), whose

    def _table(self, pose: Float) -> tuple[Part, Float]:
        """Return the depth of the table, object radii, and the part of the image that contains it.

        It is infinite outside the table and from below.
        """
        height = pose[2, 3] - self._floor
        setup = self.sensor
        corners = [
            (a * self._reach, b * self._reach, self._floor)
            for a in (-1, 1)
            for b in (-1, 1)
        ]
        seen = (np.array(corners) - pose[:3, 3]) @ pose[:3, :3]  # of a square around it
        part = slice(0, setup.height), slice(0, setup.width)
        if seen[:, 2].min() > 0:
            # row and column
            at = setup.focal * seen[:, 1::-1] / seen[:, 2:] + np.array(setup.shape) / 2
            part = spans(at.min(0) - 1, at.max(0) + 2, setup.shape)
        x = ((np.arange(setup.width) + 0.5 - setup.width / 2) / setup.focal)[part[1]]
        y = ((np.arange(setup.height) + 0.5 - setup.height / 2) / setup.focal)[
            part[0],
            None,
        ]
        falls = x * pose[2, 0] + y * pose[2, 1] + pose[2, 2]
        down = (falls < 0) & (height > 0)
        along = np.where(down, -height / np.where(down, falls, -1), np.inf)
        with np.errstate(invalid="ignore"):
            across = [
                pose[i, 3] + along * (x * pose[i, 0] + y * pose[i, 1] + pose[i, 2])
                for i in (0, 1)
            ]
            return part, np.where(
                across[0] ** 2 + across[1] ** 2 < self._reach**2,
                along,
                np.inf,
            )

    def _cropped(self, depth: Float32, mask: Mask, rng: np.random.Generator) -> Float32:
        """Return the depth image cropped along a line across the object."""
        side = int(rng.integers(4))
        share = float(rng.uniform(0, self.sensor.crop))
        lines = np.flatnonzero(mask.any(axis=1 - side // 2))
        if not len(lines):
            return depth
        hidden = round(share * (lines[-1] + 1 - lines[0]))
        kept = np.arange(mask.shape[side // 2])
        kept = kept >= lines[0] + hidden if side % 2 else kept <= lines[-1] - hidden
        return np.where(kept[:, None] if side // 2 == 0 else kept, depth, np.float32(0))
