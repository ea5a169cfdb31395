"""Things that lie where things lie, and a stereo camera: nothing of nextview's own simulation.

Things fall by the physics of MuJoCo and are seen along its rays. ``STAGES`` holds a function for
each place, which returns a scene in which a thing may come to rest there; ``staged`` lets it fall,
and ``looked`` takes a view of it.

The same seed shows the same on every x86-64 processor. Matrix products, decompositions and
exponentials differ in their last bits between processors, by the kernels that BLAS and NumPy choose
there, and physics makes millimetres of them: what MuJoCo is given, and what it returns, is
``rounded``, and ties are broken by rounded values. OpenGL is not used: its drivers differ by more.

Convex things collide as their hulls, others as the hulls of up to 20 pieces of their surface, so
that a thing on a spoon or in a bowl touches what is seen. All lengths are in metres. The floor is
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
Place = Literal["alone", "shelf", "stack", "bin", "bowl", "leaning", "held"]
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
CONVEX_SHARE = 0.7  # of the hull that a scan fills, above which the hull is its shape
FLOOR_DEPTH = 0.72  # metres from the table's top to the floor
CARRIED = 0.02  # least share of the weight that carries what leans
# whose tops are flat when they lie on their largest side
FLAT_TOPS = (
    "cracker_box",
    "foam_brick",
    "gelatin_box",
    "master_chef_can",
    "potted_meat_can",
    "pudding_box",
    "rubiks_cube",
    "sugar_box",
    "tuna_fish_can",
    "wood_block",
)
# degrees: azimuths from the +x axis, elevations
WHERE_CAMERAS_STAND: dict[Place, tuple[float, float, float, float]] = {
    "alone": (-180, 180, 25, 65),
    "shelf": (-40, 40, 5, 30),
    "stack": (-180, 180, 20, 60),
    "bin": (-180, 180, 50, 80),
    "bowl": (-180, 180, 35, 75),
    "leaning": (-65, 65, 10, 55),
    "held": (-180, 180, -10, 50),
}


def rounded(values: ArrayLike) -> Float:
    """Values without their last bits, in which processors differ, and without -0.

    Args:
        values: of any shape.

    Returns:
        Of the same shape, float64.
    """
    return np.round(np.asarray(values, float), DECIMALS) + 0.0


def quaternion(turn: Float) -> Float:
    """A rotation as MuJoCo is given it.

    Args:
        turn: (3, 3).

    Returns:
        Quaternion w, x, y, z, (4,).
    """
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
    stays: Callable[[Any, Any], bool]


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
def pieces_of(folder: str, name: str, most: int = 20) -> tuple[Float, ...]:
    """Convex pieces that cover a scan.

    Args:
        folder: of the scans.
        name: of the thing.
        most: pieces.

    Returns:
        Corners of each piece, (N, 3), metres.
    """
    scan = scan_of(folder, name)
    hull = scan.convex_hull
    if abs(scan.volume) > CONVEX_SHARE * hull.volume:
        return (np.asarray(hull.vertices),)

    middles = scan.triangles_center
    open_parts = [(hull, np.arange(len(scan.faces)))]
    whole: list[tuple[trimesh.Trimesh, NDArray[np.int64]]] = []
    while open_parts and len(open_parts) + len(whole) < most:
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


def add_scan(
    spec: Any,
    body_name: str,
    pieces: Sequence[Float],
    scan: trimesh.Trimesh,
    pose: tuple[Float, Float] | None = None,
    scale: float = 1.0,
) -> None:
    """Add a scan to a scene.

    Args:
        spec: the scene.
        body_name: of the new body.
        pieces: corners of convex pieces, (N, 3) each, metres: what collides.
        scan: what is seen, metres.
        pose: place, (3,), metres, and rotation, (3, 3); without one it is free to fall.
        scale: of scan and pieces.
    """
    body = spec.worldbody.add_body(name=body_name)
    if pose is None:
        body.add_freejoint()
    else:
        body.pos = rounded(pose[0])
        body.quat = quaternion(pose[1])

    shell = spec.add_mesh(name=f"{body_name} seen")
    shell.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    shell.uservert = (scale * scan.vertices).ravel()
    shell.userface = scan.faces.ravel()
    seen = body.add_geom(name=f"{body_name} seen", meshname=shell.name, mass=0)
    seen.type = mujoco.mjtGeom.mjGEOM_MESH
    seen.contype = seen.conaffinity = 0

    for number, corners in enumerate(pieces):
        piece = spec.add_mesh(name=f"{body_name} {number}")
        piece.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        piece.uservert = (scale * corners).ravel()
        solid = body.add_geom(meshname=piece.name, density=400, group=COLLIDES)
        solid.type = mujoco.mjtGeom.mjGEOM_MESH


def add_box(
    body: Any, low: Sequence[float], high: Sequence[float], turn: Float | None = None
) -> None:
    """Add a box to a body.

    Args:
        body: of MuJoCo.
        low: its lowest corner, (3,), metres.
        high: its highest corner, (3,), metres.
        turn: its rotation about its middle, (3, 3); None without one.
    """
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
    scale: float = 1.0,
) -> tuple[Float, Float]:
    """Put a scan at a spot.

    Args:
        scan: metres.
        turn: its rotation, (3, 3).
        spot: x and y of its middle, (2,), metres.
        lowest: height of its lowest point, metres.
        scale: of the scan.

    Returns:
        Place, (3,), metres, and rotation, (3, 3).
    """
    points = scale * scan.vertices @ turn.T
    middle = (points.min(0) + points.max(0)) / 2
    return np.array([*spot, lowest]) - (*middle[:2], points[:, 2].min()), turn


def turned(rng: np.random.Generator) -> Float:
    """A random rotation, (3, 3)."""
    return Rotation.random(rng=rng).as_matrix()


def with_up(up: Float, rng: np.random.Generator) -> Float:
    """Draw a rotation that turns a direction upwards.

    Args:
        up: the direction, (3,).
        rng: draws.

    Returns:
        Rotation, (3, 3).
    """
    tilt, _ = Rotation.align_vectors([[0, 0, 1.0]], [up])
    spin = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi))
    return (spin * tilt).as_matrix()


def stable_ups(scan: trimesh.Trimesh) -> tuple[Float, Float]:
    """How a scan can rest on a side of its hull.

    Args:
        scan: metres.

    Returns:
        Directions that are upwards then, (N, 3), none within 10 degrees of another, and the areas
        of these sides, (N,), square metres, largest first.
    """
    hull = scan.convex_hull
    normals = hull.face_normals
    heights = ((hull.triangles[:, 0] - hull.center_mass) * normals).sum(1)
    feet = hull.center_mass + heights[:, None] * normals

    weights = trimesh.triangles.points_to_barycentric(hull.triangles, feet)
    stable = (weights >= 0).all(1)

    level = normals[stable] @ normals.T > np.cos(np.radians(2))
    areas = level @ hull.area_faces

    kept: list[int] = []
    for one in np.argsort(-np.round(areas, 12), kind="stable"):
        others = normals[stable][kept]
        if not (others @ normals[stable][one] > np.cos(np.radians(10))).any():
            kept.append(int(one))
    return -normals[stable][kept], areas[kept]


def touching(model: Any, data: Any) -> dict[str, float]:
    """What the thing touches, by names of bodies, and the normal force of each, newtons."""
    forces: dict[str, float] = {}
    for number, contact in enumerate(data.contact):
        names = [
            model.body(model.geom_bodyid[geom]).name
            for geom in (contact.geom1, contact.geom2)
        ]
        if "thing" in names:
            other = names[1 - names.index("thing")]
            force = np.zeros(6)
            mujoco.mj_contactForce(model, data, number, force)
            forces[other] = forces.get(other, 0) + float(force[0])
    return forces


def near(data: Any, *reach: float) -> bool:
    """Whether the thing's centre of mass is within so many metres of 0 along x, y and z."""
    return bool((np.abs(data.body("thing").xipos) < reach).all())


@dataclass(frozen=True, eq=False)
class Actor:
    """The thing of an episode.

    Attributes:
        folder: of the scans.
        name: of the thing.
        tries: how often it was staged in vain.
    """

    folder: str
    name: str
    tries: int

    @property
    def scan(self) -> trimesh.Trimesh:
        """Its scan, metres."""
        return scan_of(self.folder, self.name)

    def enters(self, spec: Any, pose: tuple[Float, Float] | None = None) -> None:
        """Join a scene.

        Args:
            spec: the scene.
            pose: place, (3,), metres, and rotation, (3, 3); without one it is free to fall.
        """
        add_scan(spec, "thing", pieces_of(self.folder, self.name), self.scan, pose)


def alone(actor: Actor, rng: np.random.Generator) -> Staging:
    """As it falls on a table."""
    spec = room(rng)
    actor.enters(spec)
    begin = placed(actor.scan, turned(rng), rng.uniform(-0.04, 0.04, 2), 0.03)
    return Staging(spec, {"thing": begin}, lambda m, d: near(d, 0.35, 0.3, 0.4))


def shelf(actor: Actor, rng: np.random.Generator) -> Staging:
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

    actor.enters(spec)
    spot = rng.uniform((-0.05, -0.15), (0.05, 0.15))
    begin = placed(actor.scan, turned(rng), spot, 0.02)
    return Staging(spec, {"thing": begin}, lambda m, d: near(d, 0.18, 0.35, 0.42))


def stack(actor: Actor, rng: np.random.Generator) -> Staging:
    """On another thing that lies on its largest side, and touching nothing else."""
    spec = room(rng)
    actor.enters(spec)
    name = str(rng.choice([each for each in FLAT_TOPS if each != actor.name]))
    under = Actor(actor.folder, name, 0).scan
    add_scan(spec, "under", pieces_of(actor.folder, name), under)

    flat = with_up(stable_ups(under)[0][0], rng)
    if actor.tries < 3:
        turn = turned(rng)
    else:  # on any side of its hull that it can rest on
        ups = stable_ups(actor.scan)[0]
        turn = with_up(ups[rng.integers(len(ups))], rng)

    above = 0.008 + np.ptp(under.vertices @ flat[2])
    starts = {
        "under": placed(under, flat, np.zeros(2), 0.003),
        "thing": placed(actor.scan, turn, rng.uniform(-0.01, 0.01, 2), above),
    }
    return Staging(spec, starts, lambda m, d: set(touching(m, d)) == {"under"})


def in_a_bin(actor: Actor, rng: np.random.Generator) -> Staging:
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

    all_names = sorted(path.stem for path in Path(actor.folder).glob("*.ply"))
    scans = {name: scan_of(actor.folder, name) for name in all_names}
    small = [name for name in all_names if scans[name].extents.max() < 0.2]
    small = [name for name in small if name != actor.name]
    others = rng.choice(small, 4, replace=False)

    actor.enters(spec)
    names = {"thing": actor.name}
    for number, name in enumerate(map(str, others)):
        names[f"other {number}"] = name
        pieces = pieces_of(actor.folder, name)
        add_scan(spec, f"other {number}", pieces, scans[name])

    starts = {}
    above = 0.03
    for body_name in rng.permutation(list(names)):
        scan = scans[names[str(body_name)]]
        turn = turned(rng)
        spot = rng.uniform((-0.08, -0.05), (0.08, 0.05))
        starts[str(body_name)] = placed(scan, turn, spot, above)
        above += np.ptp(scan.vertices @ turn[2]) + 0.01
    return Staging(
        spec,
        starts,
        lambda m, d: near(d, 0.2, 0.15, 0.2) and "world" not in touching(m, d),
    )


def in_a_bowl(actor: Actor, rng: np.random.Generator) -> Staging:
    """In the YCB bowl, 16 cm wide, or one that is 1.45 times as wide as the thing is long."""
    spec = room(rng)
    actor.enters(spec)
    bowl = scan_of(actor.folder, "bowl")
    scale = max(1.0, 1.45 * actor.scan.extents.max() / 0.16)
    upright = placed(bowl, np.eye(3), np.zeros(2), 0.003, scale)
    pieces = pieces_of(actor.folder, "bowl", 48)
    add_scan(spec, "bowl", pieces, bowl, upright, scale)
    begin = placed(actor.scan, turned(rng), rng.uniform(-0.01, 0.01, 2), 0.06 * scale)
    return Staging(spec, {"thing": begin}, lambda m, d: set(touching(m, d)) == {"bowl"})


def leaning(actor: Actor, rng: np.random.Generator) -> Staging:
    """Its long axis tilted against a wall or a box that carries a part of its weight."""
    spec = room(rng)
    actor.enters(spec)
    wall = spec.worldbody.add_body(name="wall")
    half, top = ((0.4, 0.5), (0.14, 0.18))[rng.integers(2)]
    add_box(wall, (-0.25, -half, 0.003), (-0.1, half, top))

    points = actor.scan.vertices - actor.scan.vertices.mean(0)
    long_axis = np.linalg.svd(points, full_matrices=False)[2][0]
    long_axis *= np.sign(long_axis[np.abs(long_axis).argmax()])
    upright = with_up(long_axis * rng.choice([-1, 1]), rng)
    tilt = Rotation.from_euler("y", -rng.uniform(8, 35), degrees=True)
    turn = tilt.as_matrix() @ upright
    spot = np.array([0, rng.uniform(-0.04, 0.04)])
    place, _ = placed(actor.scan, turn, spot, 0.004)
    place[0] = -0.098 - (actor.scan.vertices @ turn[0]).min()

    def carried(model: Any, data: Any) -> bool:
        forces = touching(model, data)
        weight = 9.81 * model.body("thing").mass[0]
        return forces.get("wall", 0) > CARRIED * weight and "world" in forces

    return Staging(spec, {"thing": (place, turn)}, carried)


def held(actor: Actor, rng: np.random.Generator) -> Staging:
    """Between two fingers where it is narrow enough, or at a suction cup."""
    spec = room(rng)
    turn = turned(rng)
    place = np.array([0, 0, 0.35]) - turn @ actor.scan.bounds.mean(0)
    actor.enters(spec, (place, turn))
    points = actor.scan.vertices @ turn.T + place

    gripper = spec.worldbody.add_body(name="gripper")
    for _ in range(60):
        # rows: across the fingers, along their width, out to the arm
        axes = turned(rng)
        along = points @ axes.T
        end = along[:, 2].max()
        tip = along[along[:, 2].argmax()]

        pinched = along[
            (np.abs(along[:, 1] - tip[1]) < 0.01) & (along[:, 2] > end - 0.03)
        ]
        low, high = pinched[:, 0].min(), pinched[:, 0].max()
        if axes[2, 2] > -0.2 and high - low < 0.08:
            break
    else:
        low = high = tip[0]

    middle = (low + high) / 2
    boxes = [
        ((-0.05, -0.03, 0.02), (0.05, 0.03, 0.1)),
        ((-0.03, -0.03, 0.1), (0.03, 0.03, 0.3)),
    ]
    if low < high:
        half = (high - low) / 2
        boxes.append(((-half - 0.008, -0.01, -0.03), (-half, 0.01, 0.02)))
        boxes.append(((half, -0.01, -0.03), (half + 0.008, 0.01, 0.02)))
    else:
        boxes.append(((-0.012, -0.012, 0), (0.012, 0.012, 0.02)))

    gripper.pos = rounded(axes.T @ (middle, tip[1], end))
    gripper.quat = quaternion(axes.T)
    for corners in boxes:
        add_box(gripper, *corners)
    return Staging(spec, {}, lambda m, d: True)


STAGES: dict[Place, Callable[[Actor, np.random.Generator], Staging]] = {
    "alone": alone,
    "shelf": shelf,
    "stack": stack,
    "bin": in_a_bin,
    "bowl": in_a_bowl,
    "leaning": leaning,
    "held": held,
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
    while staging.starts and calm < 2:
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
    for tries in range(STAGINGS_TRIED):
        staging = STAGES[place](Actor(folder, name, tries), rng)
        scene = at_rest(staging)
        if scene is not None and staging.stays(*scene):
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
    """What an arm says of a camera's pose.

    Args:
        pose: the true one, (4, 4), metres.
        arm_error: standard deviations along and about each axis, millimetres and degrees.
        rng: draws.

    Returns:
        The reported pose, (4, 4), metres.
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
    """Steps to the next pixel or from the last, whichever are smaller: edges have none.

    Args:
        values: (H, W).
        axis: 0 for down, 1 for across.

    Returns:
        The steps, (H, W).
    """
    steps = np.diff(values, axis=axis)
    before = np.insert(steps, 0, np.inf, axis)
    after = np.insert(steps, steps.shape[axis], np.inf, axis)
    return np.where(np.abs(before) < np.abs(after), before, after)


def as_measured(depth: Float, rng: np.random.Generator) -> NDArray[np.uint16]:
    """What a stereo camera makes of depth.

    Args:
        depth: without noise, (H, W), metres.
        rng: draws the noise.

    Returns:
        Measured depth, (H, W), steps of ``1 / STEPS_PER_METRE`` metres, 0 for holes.
    """
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
    """Aim a camera at a point.

    Args:
        aim: the point, (3,), metres.
        azimuth: of the camera, degrees from the +x axis.
        elevation: of the camera, degrees.
        distance: from the point, metres.

    Returns:
        Camera-to-world pose, (4, 4), OpenCV axes, metres.
    """
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
    """Take a view of a scene.

    Args:
        model: of MuJoCo.
        data: of MuJoCo.
        pose: of the camera, (4, 4), OpenCV axes, metres.
        rng: draws the noise.

    Returns:
        Measured depth, (H, W), steps, 0 for holes, and the pixels of the thing, (H, W).
    """
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
