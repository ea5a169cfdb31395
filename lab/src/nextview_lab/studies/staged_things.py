"""Things that lie where things lie, and a stereo camera: nothing of nextview's own simulation.

Things fall by the physics of MuJoCo and are seen along its rays. ``STAGES`` holds a function for
each place, which returns a scene in which a thing may come to rest there; ``staged`` lets it fall,
and ``looked`` takes a view of it.

The same seed shows the same on every x86-64 processor. Matrix products, decompositions and
exponentials differ in their last bits between processors, by the kernels that BLAS and NumPy choose
there, and physics makes millimetres of them: what MuJoCo is given, and what it returns, is
``rounded``, and ties are broken by rounded values. OpenGL is not used: its drivers differ by more.

Convex things collide as their hulls, others as the hulls of up to 20 pieces of their surface, so
that a thing on a spoon touches what is seen. All lengths are in metres. The floor is
level, a table of uneven planks has its top near a height of 0, and things are near the z axis.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.spatial import QhullError
from scipy.spatial.transform import Rotation

from nextview_lab.extras import extras

with extras():
    import mujoco

Float = NDArray[np.float64]
Bools = NDArray[np.bool_]
Place = Literal["alone", "shelf", "bin"]
PLACES: tuple[Place, ...] = get_args(Place)

FOCAL = 610.0  # pixels
IMAGE = 480, 640  # rows, columns
STEREO_BASE = 0.055  # metres between the two cameras
CAMERA_MATRIX = np.array([[FOCAL, 0, 319.5], [0, FOCAL, 239.5], [0, 0, 1]])
STEPS_PER_METRE = 10_000  # of the depth images: 0.1 mm
FARTHEST = 10.0  # metres that a ray goes
DECIMALS = 7  # of what is rounded, metres and parts of directions
COLLIDES = 3  # group of the geoms that are not seen
STAGINGS_TRIED = 12  # of a thing in a place
ENOUGH_PIXELS = 350  # of a thing, below which a view is not judged
MOST_PIECES = 20  # of a scan
CONVEX_SHARE = 0.7  # of the hull that a scan fills, above which the hull is its shape
FLOOR_DEPTH = 0.72  # metres from the table's top to the floor
# degrees: azimuths from the +x axis, elevations
WHERE_CAMERAS_STAND: dict[Place, tuple[float, float, float, float]] = {
    "alone": (-180, 180, 25, 65),
    "shelf": (-40, 40, 5, 30),
    "bin": (-180, 180, 50, 80),
}


def rounded(values: ArrayLike) -> Float:
    """Values without their last bits, in which processors differ, and without -0."""
    return np.round(np.asarray(values, float), DECIMALS) + 0.0


def quaternion(turn: Float) -> Float:
    """A rotation, (3, 3), as MuJoCo is given it: w, x, y, z."""
    return rounded(
        Rotation.from_matrix(turn).as_quat(canonical=True, scalar_first=True)
    )


@dataclass(frozen=True, eq=False)
class Staging:
    """A scene before anything falls.

    Attributes:
        spec: what is in it; the thing that is looked at is the body ``thing``.
        starts: place, (3,), metres, and rotation, (3, 3), of each body that falls.
        stays: whether the thing is where it should be, once all are at rest.
    """

    spec: Any
    starts: dict[str, tuple[Float, Float]]
    stays: Callable[[Any], bool]


@cache
def scan_of(folder: str, name: str) -> trimesh.Trimesh:
    """The scan of a thing, metres."""
    return trimesh.load(Path(folder) / f"{name}.ply", force="mesh")


def hull_or_none(points: Float) -> trimesh.Trimesh | None:
    """The hull of points, (N, 3); None for what is flat."""
    try:
        hull = trimesh.convex.convex_hull(points)
    except (QhullError, ValueError):
        return None
    return hull if hull.volume > 1e-10 and len(hull.vertices) > 3 else None


@cache
def pieces_of(folder: str, name: str) -> tuple[Float, ...]:
    """Corners of convex pieces that cover a scan, (N, 3) each, metres."""
    scan = scan_of(folder, name)
    hull = scan.convex_hull
    if abs(scan.volume) > CONVEX_SHARE * hull.volume:
        return (np.asarray(hull.vertices),)

    middles = scan.triangles_center
    open_parts = [(hull, np.arange(len(scan.faces)))]
    whole: list[tuple[trimesh.Trimesh, NDArray[np.int64]]] = []
    while open_parts and len(open_parts) + len(whole) < MOST_PIECES:
        open_parts.sort(key=lambda part: round(part[0].volume, 15))
        hull, faces = open_parts.pop()
        axis = int(np.ptp(middles[faces], axis=0).argmax())
        low = middles[faces, axis] < np.median(middles[faces, axis])
        halves = [faces[low], faces[~low]]
        hulls = [hull_or_none(scan.triangles[half].reshape(-1, 3)) for half in halves]
        if None in hulls:
            whole.append((hull, faces))
        else:
            open_parts += zip(hulls, halves, strict=True)
    return tuple(np.asarray(hull.vertices) for hull, _ in [*open_parts, *whole])


def add_scan(spec: Any, body_name: str, folder: str, name: str) -> None:
    """Add a scan to a scene, free to fall."""
    scan = scan_of(folder, name)
    body = spec.worldbody.add_body(name=body_name)
    body.add_freejoint()

    shell = spec.add_mesh(name=f"{body_name} seen")
    shell.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    shell.uservert = scan.vertices.ravel()
    shell.userface = scan.faces.ravel()
    seen = body.add_geom(name=f"{body_name} seen", meshname=shell.name, mass=0)
    seen.type = mujoco.mjtGeom.mjGEOM_MESH
    seen.contype = seen.conaffinity = 0

    for number, corners in enumerate(pieces_of(folder, name)):
        piece = spec.add_mesh(name=f"{body_name} {number}")
        piece.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        piece.uservert = corners.ravel()
        solid = body.add_geom(meshname=piece.name, density=400, group=COLLIDES)
        solid.type = mujoco.mjtGeom.mjGEOM_MESH


def add_box(
    body: Any, low: Sequence[float], high: Sequence[float], turn: Float | None = None
) -> None:
    """Add a box to a body by two opposite corners, (3,), metres, and its rotation, (3, 3)."""
    corners = rounded([low, high])
    box = body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX)
    box.pos = corners.mean(0)
    box.size = np.ptp(corners, axis=0) / 2
    if turn is not None:
        box.quat = quaternion(turn)


def room(rng: np.random.Generator, table: bool = True) -> Any:
    """A floor and four walls, with a table of uneven planks whose top is near 0."""
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.002
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    geom = spec.default.geom
    geom.friction = [0.7, 0.005, 0.002]
    geom.condim = 6
    geom.solref = [0.006, 1]

    floor = -FLOOR_DEPTH
    world = spec.worldbody
    add_box(world, (-2.1, -2.1, floor - 0.1), (2.1, 2.1, floor))
    for wall in (-2.05, 2.05):
        add_box(world, (wall - 0.05, -2.1, floor), (wall + 0.05, 2.1, 2))
        add_box(world, (-2.1, wall - 0.05, floor), (2.1, wall + 0.05, 2))
    if table:
        edges = np.linspace(-0.55, 0.55, 9)
        for left, right in pairwise(edges):
            tilt = Rotation.from_euler("xy", rng.normal(0, 0.15, 2), degrees=True)
            rise = rng.normal(0, 0.0006)
            under = (left - 0.001, -0.4, rise - 0.03)
            add_box(world, under, (right + 0.001, 0.4, rise), tilt.as_matrix())
        for x, y in np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)]) * (0.5, 0.35):
            add_box(world, (x - 0.03, y - 0.03, floor), (x + 0.03, y + 0.03, -0.025))
    return spec


def placed(
    scan: trimesh.Trimesh,
    turn: Float,
    spot: Float,
    lowest: float,
) -> tuple[Float, Float]:
    """Place and rotation with the middle of a turned scan at a spot, (2,), and its lowest point at
    a height.
    """
    points = scan.vertices @ turn.T
    middle = (points.min(0) + points.max(0)) / 2
    return np.array([*spot, lowest]) - (*middle[:2], points[:, 2].min()), turn


def turned(rng: np.random.Generator) -> Float:
    """A random rotation, (3, 3)."""
    return Rotation.random(rng=rng).as_matrix()


def near(data: Any, *reach: float) -> bool:
    """Whether the thing's centre of mass is within so many metres of 0 along x, y and z."""
    return bool((np.abs(data.body("thing").xipos) < reach).all())


def alone(folder: str, name: str, rng: np.random.Generator) -> Staging:
    """As it falls on a table."""
    spec = room(rng)
    add_scan(spec, "thing", folder, name)
    begin = placed(
        scan_of(folder, name), turned(rng), rng.uniform(-0.04, 0.04, 2), 0.03
    )
    return Staging(spec, {"thing": begin}, lambda data: near(data, 0.35, 0.3, 0.4))


def shelf(folder: str, name: str, rng: np.random.Generator) -> Staging:
    """As it falls in a compartment of 36 x 70 x 42 cm that is open towards +x."""
    spec = room(rng, table=False)
    world = spec.worldbody
    for low, high in (
        ((-0.2, -0.37, -FLOOR_DEPTH), (0.18, 0.37, 0)),
        ((-0.2, -0.37, 0.42), (0.18, 0.37, 0.44)),
        ((-0.2, -0.37, 0), (-0.18, 0.37, 0.42)),
        ((-0.18, -0.37, 0), (0.18, -0.35, 0.42)),
        ((-0.18, 0.35, 0), (0.18, 0.37, 0.42)),
    ):
        add_box(world, low, high)
    add_scan(spec, "thing", folder, name)
    spot = rng.uniform((-0.05, -0.15), (0.05, 0.15))
    begin = placed(scan_of(folder, name), turned(rng), spot, 0.02)
    return Staging(spec, {"thing": begin}, lambda data: near(data, 0.18, 0.35, 0.42))


def in_a_bin(folder: str, name: str, rng: np.random.Generator) -> Staging:
    """In a box of 40 x 30 x 10 cm, with four other things, poured in any order."""
    spec = room(rng)
    box = spec.worldbody.add_body(name="bin")
    for low, high in (
        ((-0.205, -0.155, 0.004), (0.205, 0.155, 0.008)),
        ((-0.205, -0.155, 0.008), (-0.2, 0.155, 0.108)),
        ((0.2, -0.155, 0.008), (0.205, 0.155, 0.108)),
        ((-0.2, -0.155, 0.008), (0.2, -0.15, 0.108)),
        ((-0.2, 0.15, 0.008), (0.2, 0.155, 0.108)),
    ):
        add_box(box, low, high)

    all_names = sorted(path.stem for path in Path(folder).glob("*.ply"))
    scans = {each: scan_of(folder, each) for each in all_names}
    small = [each for each in all_names if scans[each].extents.max() < 0.2]
    others = rng.choice([each for each in small if each != name], 4, replace=False)
    add_scan(spec, "thing", folder, name)
    names = {"thing": name}
    for number, each in enumerate(map(str, others)):
        names[f"other {number}"] = each
        add_scan(spec, f"other {number}", folder, each)

    starts = {}
    above = 0.03
    for body_name in map(str, rng.permutation(list(names))):
        scan = scans[names[body_name]]
        turn = turned(rng)
        spot = rng.uniform((-0.08, -0.05), (0.08, 0.05))
        starts[body_name] = placed(scan, turn, spot, above)
        above += np.ptp(scan.vertices @ turn[2]) + 0.01
    return Staging(spec, starts, lambda data: near(data, 0.2, 0.15, 0.2))


STAGES: dict[Place, Callable[[str, str, np.random.Generator], Staging]] = {
    "alone": alone,
    "shelf": shelf,
    "bin": in_a_bin,
}


def at_rest(staging: Staging) -> tuple[Any, Any] | None:
    """Let all things fall: MuJoCo's model and data; None if one still moves after 6 seconds."""
    model = staging.spec.compile()
    data = mujoco.MjData(model)
    for name, (place, turn) in staging.starts.items():
        joint = model.body(name).jntadr[0]
        first = model.jnt_qposadr[joint]
        data.qpos[first : first + 7] = [*rounded(place), *quaternion(turn)]
    mujoco.mj_forward(model, data)

    calm = 0
    while calm < 2:
        mujoco.mj_step(model, data, 100)
        speed = np.abs(data.qvel).reshape(-1, 6).max(0)
        still = speed[:3].max() < 0.004 and speed[3:].max() < 0.05
        calm = calm + 1 if still else 0
        if data.time > 6:
            return None
    return model, data


def staged(
    place: Place, folder: str, name: str, rng: np.random.Generator
) -> tuple[Any, Any] | None:
    """A thing at rest where it should be: MuJoCo's model and data; None after tries in vain."""
    for _ in range(STAGINGS_TRIED):
        staging = STAGES[place](folder, name, rng)
        scene = at_rest(staging)
        if scene is not None and staging.stays(scene[1]):
            model, data = scene
            data.qpos[:] = rounded(data.qpos)
            mujoco.mj_kinematics(model, data)
            return scene
    return None


def true_pose(data: Any) -> Float:
    """From the scan of the thing to the world, (4, 4), metres."""
    thing = data.body("thing")
    pose = np.eye(4)
    pose[:3, :3] = thing.xmat.reshape(3, 3)
    pose[:3, 3] = thing.xpos
    return rounded(pose)


def as_told(
    pose: Float, arm_error: tuple[float, float], rng: np.random.Generator
) -> Float:
    """What an arm says of a camera's pose, (4, 4): standard deviations of its error along and about
    each axis are in millimetres and degrees.
    """
    millimetres, degrees = arm_error
    told = pose.copy()
    error = Rotation.from_rotvec(rng.normal(0, degrees, 3), degrees=True)
    told[:3, :3] = pose[:3, :3] @ error.as_matrix()
    told[:3, 3] += rng.normal(0, millimetres / 1000, 3)
    return rounded(told)


def field(rng: np.random.Generator) -> Float:
    """Normal noise of unit variance, correlated over about two pixels, of an image's shape."""
    gaussian = np.exp(-0.5 * np.arange(-4, 5) ** 2)
    weights = rounded(gaussian / np.sqrt((gaussian**2).sum()))
    noise = rng.normal(size=IMAGE)
    for axis in (0, 1):
        noise = ndimage.correlate1d(noise, weights, axis)
    return noise


def slope_along(values: Float, axis: int) -> Float:
    """Steps to the next pixel or from the last, (H, W), whichever are smaller: edges have none."""
    steps = np.diff(values, axis=axis)
    before = np.insert(steps, 0, np.inf, axis)
    after = np.insert(steps, steps.shape[axis], np.inf, axis)
    return np.where(np.abs(before) < np.abs(after), before, after)


def as_measured(depth: Float, rng: np.random.Generator) -> NDArray[np.uint16]:
    """What a stereo camera makes of depth: (H, W), metres, in; steps, 0 for holes, out."""
    true = FOCAL * STEREO_BASE / depth  # disparities, pixels
    slopes = [slope_along(true, axis) for axis in (0, 1)]
    rows, columns = np.indices(IMAGE)
    x, y = columns - CAMERA_MATRIX[0, 2], rows - CAMERA_MATRIX[1, 2]
    # The disparity of a plane is linear in the image.
    across, down = FOCAL * slopes[1], FOCAL * slopes[0]
    ahead = true - slopes[1] * x - slopes[0] * y
    lengths = np.sqrt(across**2 + down**2 + ahead**2) * np.sqrt(x**2 + y**2 + FOCAL**2)
    cosines = true * FOCAL / lengths

    steps = np.zeros(IMAGE, bool)
    steps[:, 1:] |= np.abs(np.diff(true, axis=1)) > 1
    steps[1:] |= np.abs(np.diff(true, axis=0)) > 1
    edges = ndimage.maximum_filter(steps, 4)
    near = ndimage.maximum_filter(true, 5)
    far = ndimage.minimum_filter(true, 5)
    chance = rng.random(IMAGE)
    mixed = far + rng.random(IMAGE) * (near - far)
    seen = np.where(edges & (chance < 0.4), mixed, true)
    seen = np.round(16 * (seen + 0.08 * field(rng))) / 16

    in_second = columns - true
    nearest = np.minimum.accumulate(in_second[:, ::-1], axis=1)[:, ::-1]
    shadow = np.zeros(IMAGE, bool)
    shadow[:, :-1] = nearest[:, 1:] < in_second[:, :-1] - 0.5
    grazing = ~edges & (cosines < 0.2 + 0.04 * field(rng))
    holes = shadow | grazing | (in_second < 0) | (edges & (chance > 0.8)) | (seen < 4)
    measured = np.rint(STEPS_PER_METRE * FOCAL * STEREO_BASE / np.maximum(seen, 4))
    holes |= measured > np.iinfo(np.uint16).max
    return np.where(holes, 0, measured).astype(np.uint16)


def camera_at(aim: Float, azimuth: float, elevation: float, distance: float) -> Float:
    """Pose of a camera, (4, 4), OpenCV axes, that is aimed at a point, (3,); degrees, metres."""
    turn = np.radians([azimuth, elevation])
    back = np.array(
        [np.cos(turn[1]) * np.cos(turn[0]), np.cos(turn[1]) * np.sin(turn[0]), 0]
    )
    back[2] = np.sin(turn[1])
    right = np.cross((0, 0, 1.0), back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(right, back), -back], 1)
    pose[:3, 3] = aim + distance * back
    return rounded(pose)


def looked(
    model: Any, data: Any, pose: Float, rng: np.random.Generator
) -> tuple[NDArray[np.uint16], Bools]:
    """Measured depth, (H, W), steps, and the pixels of the thing, (H, W)."""
    rows, columns = np.indices(IMAGE)
    across, down = columns - CAMERA_MATRIX[0, 2], rows - CAMERA_MATRIX[1, 2]
    right, below, ahead = pose[:3, :3].T
    # scaled to a depth of 1, so that distances in units of a ray are depths
    rays = (across[..., None] * right + down[..., None] * below) / FOCAL + ahead

    groups = np.ones(mujoco.mjNGROUP, np.uint8)
    groups[COLLIDES] = 0
    count = rows.size
    hit = np.empty(count, np.int32)
    depth = np.empty(count)
    mujoco.mj_multiRay(
        model,
        data,
        pose[:3, 3],
        rays.ravel(),
        groups,
        True,
        -1,
        hit,
        depth,
        None,
        count,
        FARTHEST,
    )
    depth[hit < 0] = FARTHEST
    thing = hit.reshape(IMAGE) == model.geom("thing seen").id
    return as_measured(depth.reshape(IMAGE), rng), thing
