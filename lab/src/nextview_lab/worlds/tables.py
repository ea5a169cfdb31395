"""Simulated tables with several objects at true size, and a depth camera above them.

Objects are in one of their resting poses, side by side with gaps of up to a few centimetres. The
camera has the errors of a sensor: those of the depth, of the camera pose, and of the robot's
vertical. All lengths are in metres.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from nextview.errors import ObservationError, UsageError
from nextview.geometry.mesh import Mesh
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster, Triangles
from nextview.geometry.resting import resting_poses
from nextview.geometry.viewsphere import look_at_origin, rotation_z
from nextview.sensing.frame import Frame
from nextview.simulation.boxes import upright_boxes
from nextview.simulation.sensor import Sensor
from nextview.types import Float, Floats

WIDEST_GAP = 0.10  # metres, largest gap between neighbours
TABLE_SIDES = (1.5, 1.1)  # metres
TABLE_THICKNESS = 0.03  # metres
TABLE_HEIGHT = 0.75  # metres above the floor
FLOOR_SIDE = 8.0  # metres
STEP_OUTWARDS = 0.005  # metres, step in which an object is moved outwards until it fits
MOST_STEPS = 200
PLACEMENTS_TRIED = 100
# margin of every footprint, metres, so that thin sheets have an area
FOOTPRINT_EDGE = 1e-3
_AROUND = FOOTPRINT_EDGE * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
TABLE_REACH = 0.36  # metres, largest distance of an object from the centre of the table


@dataclass(frozen=True, eq=False)
class PlacedThing:
    """An object on a table.

    Attributes:
        name: of the object.
        vertices: in the frame of its file, (V, 3) float64, metres.
        faces: triangles, (F, 3) int32.
        pose: from the frame of its file to the table frame, (4, 4) float64, metres.
    """

    name: str
    vertices: Float
    faces: NDArray[np.int32]
    pose: Float

    @property
    def placed(self) -> Float:
        """Vertices in the table frame, (V, 3), metres."""
        return self.vertices @ self.pose[:3, :3].T + self.pose[:3, 3]


@dataclass(frozen=True, eq=False)
class SimulatedTable:
    """Objects on a table whose top is the plane z = 0, centred at the origin.

    Attributes:
        things: the objects.
    """

    things: tuple[PlacedThing, ...]

    @classmethod
    def draw(
        cls,
        meshes: Sequence[Mesh],
        rng: np.random.Generator,
        gap: float = WIDEST_GAP,
        resting: Callable[[Mesh], Float] = resting_poses,
    ) -> SimulatedTable:
        """Place meshes on a table, each in one of its resting poses with a random azimuth.

        The first one is placed near the centre. Each further one is moved outwards from one of the
        others until its gap to all of them has the drawn size.

        Args:
            meshes: of known unit.
            rng: for poses, positions and gaps.
            gap: largest gap between neighbours, metres; at least 0.
            resting: function that returns the rotations of a mesh to its resting poses, (P, 3, 3).

        Raises:
            UsageError: the unit of a mesh is not known, or the objects do not fit on the table.
        """
        things: list[PlacedThing] = []
        outlines: list[Float] = []
        for mesh in meshes:
            if mesh.unit is None:
                raise UsageError(f"{mesh.name}: the unit of length is not known")
            metres = mesh.vertices * mesh.radius + mesh.centre
            poses = resting(mesh)
            turn = (
                rotation_z(rng.uniform(0, 2 * np.pi)) @ poses[rng.integers(len(poses))]
            )
            turned = metres @ turn.T
            middle = (turned.min(0) + turned.max(0)) / 2
            start = np.array([middle[0], middle[1], turned[:, 2].min()])

            outline = footprint(turned - start)
            place = _free_place(outline, outlines, rng, gap)
            outlines.append(outline + place)
            pose = np.eye(4)
            pose[:3, :3] = turn
            pose[:3, 3] = np.append(place, 0.0) - start
            things.append(PlacedThing(mesh.name, metres, mesh.faces, pose))
        return cls(tuple(things))


def _free_place(
    outline: Float,
    others: Sequence[Float],
    rng: np.random.Generator,
    gap: float,
) -> Float:
    """Find a position, (2,), where an outline about the origin, (K, 2), is clear of all others."""
    if not others:
        return rng.uniform(-0.05, 0.05, 2)
    for _ in range(PLACEMENTS_TRIED):
        wanted = rng.uniform(0, gap)
        beside = others[int(rng.integers(len(others)))].mean(0)
        angle = rng.uniform(0, 2 * np.pi)
        way = np.array([np.cos(angle), np.sin(angle)])
        for step in range(MOST_STEPS):
            place = beside + step * STEP_OUTWARDS * way
            if min(separation(outline + place, other) for other in others) >= wanted:
                break
        if np.linalg.norm(place) < TABLE_REACH:
            return place
    raise UsageError("the things do not fit on the table: take fewer, or smaller ones")


def footprint(vertices: Float) -> Float:
    """Return the convex hull of points in the top view, counter-clockwise, (K, 2).

    Points are (V, 3) or (V, 2).
    """
    around = (vertices[:, None, :2] + _AROUND).reshape(-1, 2)
    return around[ConvexHull(around).vertices]


def separation(a: Float, b: Float) -> float:
    """Return the distance of two convex polygons along the best separating edge normal.

    It is a lower bound of the distance between corners, and negative if the polygons overlap.

    Args:
        a: corners, counter-clockwise, (K, 2); two points are a line.
        b: corners, counter-clockwise, (L, 2).

    Returns:
        The distance.
    """
    return max(_gap(a, b), _gap(b, a))


def _gap(a: Float, b: Float) -> float:
    edges = np.roll(a, -1, axis=0) - a
    outward = (
        np.stack([edges[:, 1], -edges[:, 0]], 1)
        / np.maximum(np.linalg.norm(edges, axis=1), 1e-12)[:, None]
    )
    return float(((b @ outward.T).min(0) - (a * outward).sum(1)).max())


class TableCamera:
    """A depth camera in a robot's world, over a simulated table.

    The robot's world frame is the table frame, tilted by the error of the vertical. Requested poses
    are those that the robot assumes.

    Attributes:
        sensor: its errors.
        lean: from the table frame to the robot's world frame, (4, 4) float64.
        shown: number of pixels of each object in the last frame, (things,) int64.
        owner: object of each pixel in the last frame, -1 for none, (H, W) int64.
        true_pose: true camera pose of the last frame, in the table frame, (4, 4) float64.
    """

    def __init__(
        self,
        table: SimulatedTable,
        sensor: Sensor,
        rng: np.random.Generator,
    ) -> None:
        """Set up a camera over a table.

        Args:
            table: with the objects.
            sensor: noise model, and the errors of its setup.
            rng: for the errors.
        """
        self.sensor = sensor
        self._rng = rng
        angles = [*rng.normal(0, sensor.tilt, 2), 0]
        self.lean = np.eye(4)
        self.lean[:3, :3] = Rotation.from_rotvec(angles, degrees=True).as_matrix()
        self.change(table)
        self._rays = PinholeCamera.of(sensor.intrinsics, sensor.shape).rays.reshape(
            -1,
            3,
        )

    def change(self, table: SimulatedTable) -> None:
        """Replace the table, for example after an object was moved."""
        self.table = table
        self._count = len(table.things)
        things: list[Triangles] = [
            (thing.placed, thing.faces) for thing in table.things
        ]
        self._caster = RayCaster([*things, *table_and_floor()])

    @property
    def truth(self) -> dict[str, Float]:
        """True pose of each object's file in the robot's world, (4, 4), metres, by name."""
        return {thing.name: self.lean @ thing.pose for thing in self.table.things}

    def frame(self, pose: Float) -> Frame:
        """Capture a frame from a pose in the robot's world.

        Args:
            pose: camera-to-world, (4, 4), metres, OpenCV axes.

        Raises:
            ObservationError: nothing is visible from there.
        """
        rng = self._rng.spawn(1)[0]
        true = np.linalg.inv(self.lean) @ pose
        turn = rng.normal(0, self.sensor.turned, 3)
        true[:3, :3] = (
            true[:3, :3] @ Rotation.from_rotvec(turn, degrees=True).as_matrix()
        )
        true[:3, 3] += rng.normal(0, self.sensor.moved, 3)

        self.true_pose = true
        depth, owner = self._caster.cast(true[:3, 3], self._rays @ true[:3, :3].T)
        seen = np.isfinite(depth)
        if not seen.any():
            raise ObservationError(
                "nothing is seen: the camera looks past the table and the floor"
            )
        clean = np.where(seen, depth, 0).reshape(self.sensor.shape).astype(np.float32)
        measured, source = self.sensor.measure(clean, rng)
        owner = np.where((owner >= 0) & (owner < self._count), owner, -1)
        self.owner = np.where(source >= 0, owner[np.maximum(source, 0)], -1)
        self.owner[measured == 0] = -1
        self.shown = np.bincount(self.owner[self.owner >= 0], minlength=self._count)
        return Frame(measured, self.sensor.intrinsics, pose, pixel_centre=0.5)


def table_and_floor() -> list[Triangles]:
    """Return a table whose top is the plane z = 0, and the floor."""
    sides = (*TABLE_SIDES, TABLE_THICKNESS), (FLOOR_SIDE, FLOOR_SIDE, 0.01)
    bottoms = -TABLE_THICKNESS, -TABLE_HEIGHT
    solids: list[Triangles] = []
    for size, bottom in zip(sides, bottoms, strict=True):
        box = upright_boxes(np.array([size]), np.zeros(1), np.zeros((1, 2)), bottom)
        solids.append((box.vertices, box.faces))
    return solids


def poses_around(
    azimuths: Floats,
    elevation: float,
    distance: float,
    centre: Float,
) -> Float:
    """Return level camera poses around a point, aimed at it.

    Args:
        azimuths: radians, (V,).
        elevation: radians.
        distance: metres.
        centre: the point, (3,), metres.

    Returns:
        Camera-to-world poses, (V, 4, 4), metres, OpenCV axes.
    """
    poses = look_at_origin(
        np.full(len(azimuths), elevation),
        np.asarray(azimuths),
        distance,
    )
    poses[:, :3, 3] += centre
    return poses
