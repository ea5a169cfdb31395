"""Geometry of a room: a life-size object, floor, walls, furniture, and a camera in it."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from zlib import crc32

import numpy as np

from nextview.errors import DatasetError, MeshError, option
from nextview.geometry.mesh import MAX_FACES
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster, Triangles
from nextview.geometry.viewsphere import rotation_z
from nextview.sensing import Frame
from nextview.simulation.boxes import upright_boxes
from nextview.simulation.sensor import Sensor
from nextview.types import Float, Mask
from nextview_lab.worlds.room_layout import RoomLayout, Slab, Standing
from nextview_lab.worlds.scene import cached_mesh, mesh_hash

# metres, standard deviation of the height of a floor or a table top
UNEVEN_HEIGHT = 0.001
WAVES = 12  # number of waves that form an uneven surface
SHORTEST_WAVE = 0.25  # metres
LONGEST_WAVE = 2.0
# metres between the vertices of an uneven surface, with at most MOST_CORNERS per side
CORNER_SPACING = 0.1
MOST_CORNERS = 60
LOWEST_CAMERA = (
    0.06  # metres above the support surface, because of the camera's housing
)
HIGHEST_CAMERA = 1.8  # metres above the floor, reach of a mobile robot
ROOM_CLEARANCE = 0.1  # metres between a camera and walls or objects


@dataclass(frozen=True)
class Room:
    """A room with a target object. The world frame is z up, metres.

    Attributes:
        layout: from which it was built.
        target: vertices of the target, (V, 3).
        things: triangles of all visible objects; the target is the first.
    """

    layout: RoomLayout
    target: Float
    things: tuple[Triangles, ...]

    @property
    def pose(self) -> Float:
        """Pose of the first camera, camera-to-world, (4, 4)."""
        return np.reshape(np.array(self.layout.pose, np.float64), (4, 4))

    @property
    def centre(self) -> Float:
        """Centre of the target's bounding box, (3,)."""
        return (self.target.min(0) + self.target.max(0)) / 2

    @property
    def radius(self) -> float:
        """Radius of the sphere around the centre that encloses the target."""
        return float(np.linalg.norm(self.target - self.centre, axis=1).max())

    @cached_property
    def caster(self) -> RayCaster:
        """Ray caster for all objects."""
        return RayCaster(self.things)

    def reachable(self, pose: Float) -> bool:
        """Return True if a mobile robot's camera can reach a pose, (4, 4)."""
        place = np.asarray(pose)[:3, 3]
        layout = self.layout
        half = np.array([layout.width, layout.depth]) / 2 - ROOM_CLEARANCE
        ground = layout.target.z if layout.kind == "table" else 0.0

        if (np.abs(place[:2]) > half).any() or place[2] > HIGHEST_CAMERA:
            return False
        if place[2] < ground + LOWEST_CAMERA:
            return False

        in_slab = any(_inside(slab, place, ROOM_CLEARANCE) for slab in layout.slabs)
        furniture = self.things[1 : 1 + len(layout.objects)]
        return not in_slab and not any(
            (place > corners.min(0) - ROOM_CLEARANCE).all()
            and (place < corners.max(0) + ROOM_CLEARANCE).all()
            for corners, _ in furniture
        )


def build_room(
    layout: RoomLayout,
    meshes: str | Path,
    max_faces: int = MAX_FACES,
) -> Room:
    """Build a room from the mesh files below a folder.

    Args:
        layout: of the room.
        meshes: the folder.
        max_faces: largest number of triangles of all meshes together.

    Raises:
        DatasetError: a file differs from the one with which the room was created.
        MeshError: a file is not a mesh, or the meshes have more triangles.
    """
    placed = [
        stood(thing, Path(meshes), max_faces, layout.name)
        for thing in (layout.target, *layout.objects)
    ]
    if (faces := sum(len(faces) for _, faces in placed)) > max_faces:
        most = f"more than {max_faces:,}; {option('max_faces')} allows more"
        raise MeshError(
            f"room {layout.name}: its meshes have {faces:,} triangles, {most}"
        )

    rng = np.random.default_rng([layout.seed, *layout.name.encode()])
    around = [_uneven_top(layout.width, layout.depth, rng), _walls(layout)]
    for slab in layout.slabs:
        around += _slab_things(slab, rng)
    target = np.asarray(placed[0][0], np.float64)
    return Room(layout, target, (*placed, *around))


def stood(thing: Standing, meshes: Path, max_faces: int, name: str) -> Triangles:
    """Load a mesh and place it in the room.

    Args:
        thing: the mesh and its placement.
        meshes: folder of the mesh files.
        max_faces: largest number of triangles.
        name: of the room, for messages.

    Returns:
        Vertices, (V, 3), metres, and faces, (F, 3).

    Raises:
        DatasetError: the file differs from the one with which the room was created.
    """
    path = meshes / thing.mesh
    if mesh_hash(path) != thing.sha256:
        raise DatasetError(f"{path}: is not the mesh that room {name} was made with")
    mesh = cached_mesh(path, max_faces)
    return at_rest(mesh.vertices, thing), mesh.faces


def at_rest(vertices: Float, thing: Standing) -> Float:
    """Transform the vertices of a normalised mesh to its placement.

    Args:
        vertices: (V, 3), object radii.
        thing: the placement.

    Returns:
        Vertices, (V, 3), metres.
    """
    turn = rotation_z(thing.azimuth) @ np.reshape(thing.rotation, (3, 3))
    turned = thing.radius * vertices @ turn.T
    low = turned.min(0)
    middle = (low + turned.max(0)) / 2
    place = np.array([thing.x - middle[0], thing.y - middle[1], thing.z - low[2]])
    return turned + place


def _uneven_top(width: float, depth: float, rng: np.random.Generator) -> Triangles:
    """Return a rectangle around the origin with the unevenness of floors and table tops.

    Its heights are a sum of waves in all directions.
    """
    across, along = (
        min(MOST_CORNERS, 2 + round(side / CORNER_SPACING)) for side in (width, depth)
    )
    x, y = np.meshgrid(
        np.linspace(-width / 2, width / 2, across),
        np.linspace(-depth / 2, depth / 2, along),
        indexing="ij",
    )
    wave = 2 * np.pi / rng.uniform(SHORTEST_WAVE, LONGEST_WAVE, WAVES)
    towards, phase = rng.uniform(0, 2 * np.pi, (2, WAVES))
    angle = (
        wave * (np.cos(towards) * x[..., None] + np.sin(towards) * y[..., None]) + phase
    )
    height = UNEVEN_HEIGHT * np.sqrt(2 / WAVES) * np.sin(angle).sum(-1)

    corners = np.stack([x, y, height], -1).reshape(-1, 3)
    number = np.arange(across * along).reshape(across, along)
    near = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:]], -1)
    far = np.stack([number[:-1, :-1], number[1:, 1:], number[:-1, 1:]], -1)
    faces = np.concatenate([near.reshape(-1, 3), far.reshape(-1, 3)])
    return corners, faces.astype(np.int32)


def _walls(layout: RoomLayout) -> Triangles:
    """Return walls and ceiling: a box around the room; its bottom is below the uneven floor."""
    below = 10 * UNEVEN_HEIGHT
    size = np.array([[layout.width, layout.depth, layout.height + below]])
    box = upright_boxes(size, np.zeros(1), np.zeros((1, 2)), -below)
    return box.vertices, box.faces


def _slab_things(slab: Slab, rng: np.random.Generator) -> list[Triangles]:
    """Return a box, with an uneven surface on it if it is a table top."""
    size = np.array([[slab.width, slab.depth, slab.height]])
    box = upright_boxes(
        size,
        np.array([slab.azimuth]),
        np.array([[slab.x, slab.y]]),
        slab.z,
    )
    if slab.even:
        return [(box.vertices, box.faces)]

    lower = box.vertices - (0, 0, 5 * UNEVEN_HEIGHT)
    corners, faces = _uneven_top(slab.width, slab.depth, rng)
    top = corners @ rotation_z(slab.azimuth).T + (slab.x, slab.y, slab.z + slab.height)
    return [(lower, box.faces), (top, faces)]


def _inside(slab: Slab, place: Float, margin: float) -> bool:
    """Return True if a position, (3,), is inside a box or within a margin of it."""
    own = rotation_z(slab.azimuth).T @ (place - (slab.x, slab.y, slab.z))
    half = np.array([slab.width, slab.depth]) / 2 + margin
    return bool(
        (np.abs(own[:2]) < half).all() and -margin < own[2] < slab.height + margin
    )


class RoomCamera:
    """Delivers the frames of a sensor in a room: 16-bit millimetres, in the room's world frame.

    A pose always gives the same frame: its noise depends on the seed and the pose.

    Args:
        room: the room.
        sensor: simulated depth errors. Those of a setup, such as pose errors, are not simulated.
        seed: of the noise.
    """

    def __init__(self, room: Room, sensor: Sensor, seed: int = 0) -> None:
        self.room = room
        self.sensor = sensor
        self.seed = seed
        self._rays = PinholeCamera.of(sensor.intrinsics, sensor.shape).rays.reshape(
            -1,
            3,
        )

    def look(self, pose: Float) -> tuple[Frame, Mask]:
        """Capture a frame from a camera-to-world pose, (4, 4), OpenCV axes.

        Returns:
            The frame, and the pixels of the target, (H, W) bool.
        """
        pose = np.asarray(pose, np.float64)
        rays = self._rays @ pose[:3, :3].T.astype(np.float32)
        cast, which = self.room.caster.cast(pose[:3, 3], rays)
        depth = np.where(which < 0, np.float32(0), cast).reshape(self.sensor.shape)

        place = crc32(np.round(pose, 4).tobytes())
        rng = np.random.default_rng([self.seed, place])
        measured, source = self.sensor.measure(depth.astype(np.float32), rng)
        shown = (which == 0)[np.maximum(source, 0)] & (source >= 0) & (measured > 0)

        millimetres = np.rint(1000 * measured.clip(max=65)).astype(np.uint16)
        frame = Frame(millimetres, self.sensor.intrinsics, pose, pixel_centre=0.5)
        return frame, shown
