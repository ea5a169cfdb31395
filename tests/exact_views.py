"""Things of a few boxes, exact views of one thing alone, and which thing explains the views."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from nextview.geometry.mesh import Mesh, make_mesh
from nextview.geometry.resting import rotated
from nextview.geometry.viewsphere import look_at_origin
from nextview.sensing.frame import Frame
from nextview.sensing.object_frame import ObjectFrame
from nextview.sensing.observation import Observation
from nextview.sensing.planes import Plane
from nextview.sensing.sighting import sighting_of
from nextview.session.target import view_of
from nextview.simulation.simulated import SimulatedCamera
from nextview.things.library import Library, near_turns
from nextview.things.naming import named
from nextview.things.surface import Surface
from nextview.things.symmetry import find_near_symmetries
from nextview.things.world import World, corrected

VIEWS = ((25.0, 20.0), (50.0, 140.0), (35.0, 260.0))  # elevation and azimuth, degrees


def mesh_of(*boxes, origin=(0.0, 0.0, 0.0)) -> Mesh:
    """A mesh of boxes, each by its extents and its middle, metres, and where its origin lies."""
    parts = [trimesh.creation.box(extents) for extents, _ in boxes]
    for part, (_, middle) in zip(parts, boxes, strict=True):
        part.apply_translation(np.add(middle, origin))
    whole = trimesh.util.concatenate(parts)
    return make_mesh(whole.vertices, whole.faces, unit="m")


def l_block() -> Mesh:
    """Two arms of different length, 4 cm high; the scan's origin is 30 cm off."""
    long_arm = ((0.16, 0.04, 0.04), (0.0, 0.0, 0.0))
    short_arm = ((0.04, 0.08, 0.04), (-0.06, 0.06, 0.0))
    return mesh_of(long_arm, short_arm, origin=(0.3, -0.1, 0.2))


def cup(handle: bool) -> Mesh:
    body = ((0.08, 0.08, 0.1), (0.0, 0.0, 0.0))
    grip = ((0.05, 0.015, 0.06), (0.06, 0.0, 0.0))
    return mesh_of(body, grip) if handle else mesh_of(body)


def turned_views(
    mesh: Mesh, turn: np.ndarray, directions=VIEWS
) -> tuple[list[Observation], np.ndarray]:
    """Exact views of a turned mesh, and the pose of its scan in the object frame, metres."""
    shown = rotated(mesh, turn)
    camera = SimulatedCamera(shown)
    views = [
        camera.observe(look_at_origin(np.radians(up), np.radians(around)))
        for up, around in directions
    ]
    pose = np.eye(4)
    pose[:3, :3] = turn
    pose[:3, 3] = -(turn @ mesh.centre + shown.centre)
    return views, pose


def standing_view(
    mesh: Mesh, turn: np.ndarray, noise: float = 0.0
) -> tuple[Observation, np.ndarray]:
    """A view of a turned mesh on a level table, noise as inverse depth, 1/m; and its pose."""
    shown = rotated(mesh, turn)
    seen = SimulatedCamera(shown).observe(look_at_origin(np.radians(35.0), 0.4))
    rows, columns = np.indices(seen.depth.shape)
    k = seen.intrinsics
    x, y = (columns + 0.5 - k[0, 2]) / k[0, 0], (rows + 0.5 - k[1, 2]) / k[1, 1]
    rays = np.stack([x, y, np.ones(x.shape)], -1) @ seen.pose[:3, :3].T
    bottom = shown.vertices[:, 2].min()
    table = (bottom - seen.pose[2, 3]) / rays[..., 2]
    target = seen.depth > 0
    depth = 1 / np.where(target, seen.depth, table)
    depth += noise * seen.radius * np.random.default_rng(0).normal(size=depth.shape)
    table = Plane(np.array([0.0, 0.0, 1.0]), -bottom * seen.radius)
    pose = np.eye(4)
    pose[:3, :3] = turn
    pose[:3, 3] = -(turn @ mesh.centre + shown.centre)
    return framed(seen, (1 / depth).astype(np.float32), target, table), pose


def before_a_wall(observation: Observation) -> Observation:
    """The same view with a wall five radii away behind the thing."""
    return framed(observation, *wall_behind(observation))


def wall_behind(observation: Observation) -> tuple[np.ndarray, np.ndarray]:
    """Depth with a wall five radii away behind the thing, radii; and the pixels of the thing."""
    target = observation.depth > 0
    return np.where(target, observation.depth, 5.0).astype(np.float32), target


def framed(
    observation: Observation,
    depth: np.ndarray,
    target: np.ndarray,
    plane: Plane | None = None,
) -> Observation:
    """The same view in a frame of which some pixels show the object; depth in radii."""
    object_frame = ObjectFrame(np.zeros(3), observation.radius, np.eye(3))
    frame = Frame(
        depth * np.float32(observation.radius),
        observation.intrinsics,
        object_frame.pose_in_world(observation.pose),
        pixel_centre=0.5,
    )
    sighting = sighting_of(frame, target, plane, frame.noise, denoise=False)
    return replace(observation, sighting=sighting, object_frame=object_frame)


def off_by(found: np.ndarray, true: np.ndarray, at: np.ndarray) -> tuple[float, float]:
    """Degrees and millimetres between two poses, at a point of the scan."""
    turn = Rotation.from_matrix(found[:3, :3] @ true[:3, :3].T).magnitude()
    moved = (found - true) @ np.append(at, 1)
    return float(np.degrees(turn)), float(1000 * np.linalg.norm(moved[:3]))


_NEAR: dict[tuple[bytes, bytes], np.ndarray] = {}


def near_of(surface: Surface) -> np.ndarray:
    """The turns after which a surface nearly looks alike, found once for all libraries."""
    key = surface.vertices.tobytes(), surface.faces.tobytes()
    if key not in _NEAR:
        _NEAR[key] = near_turns(find_near_symmetries(surface), ())
    return _NEAR[key]


def library_of(*meshes: Mesh) -> Library:
    """What is taught of meshes: their surfaces, and the turns after which they look alike."""
    surfaces = [Surface.from_mesh(mesh, str(k)) for k, mesh in enumerate(meshes)]
    return Library(surfaces, near={one.name: near_of(one) for one in surfaces})


@dataclass(frozen=True, eq=False)
class Explained:
    """The thing that explains views best, its pose, and how likely its name is right."""

    thing: int
    pose: np.ndarray
    right: float


def explained(
    library: Library, observations: Sequence[Observation]
) -> Explained | None:
    """The thing of a library that explains views of one object best; None for none."""
    world = World(library)
    for observation in observations:
        view = corrected(world, view_of(observation))
        world = world.with_view(view).searched(np.ones(len(library), bool)).numbered()
    things = [one for one in world.things if one.row >= 0]
    if not things:
        return None
    best = max(things, key=lambda one: one.gain)
    found = named(world, best, ())
    row = int(found.rows[0])
    return Explained(
        int(world.hypotheses.things[row]),
        world.hypotheses.pose(row, library),
        min(found.right, max(found.beliefs(world).values())),
    )
