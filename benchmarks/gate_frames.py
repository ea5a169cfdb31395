"""The frames of ``benchmarks.gate``: drawn worlds of a depth camera, and what is true of them.

Nothing here uses nextview. Worlds are triangles, at which Embree casts rays. The camera is a
stereo camera on a wrist: 640 x 480, noise that grows with the square of the depth and is shared by
neighbouring pixels, flying pixels at edges, holes at grazing angles, whole millimetres. The poses
that it tells are off by 3 mm and 0.3 degrees. Things lie in their resting poses (trimesh) and do
not enter each other; nothing else of physics is used. Frames are kept in a folder.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore import EmbreeDevice
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

Float = NDArray[np.float64]
DEVICE = EmbreeDevice()  # one, as embreex does not notice if another one fails
VERSION = 1  # of what is drawn; a change of this file that changes frames raises it

WIDTH, HEIGHT, FOCAL = 640, 480, 600.0  # pixels
INTRINSICS = np.array(
    [[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]]
)
NOISE = 0.004  # metres at one metre; 1.7 mm at 0.65 m
POSE_METRES, POSE_DEGREES = 0.003, 0.3  # error of a told pose

STRANGER = "?"  # begins the name of a thing that is not taught
CLOUD = 4000  # points on a thing
TOUCHING = 0.002  # metres between the points of two things that touch
NEARER = (0.35, 0.5)  # metres, of the camera from small parts
STEPS = np.linspace(0, 0.4, 41)  # metres, by which a thing is hidden or cut off
STEP_AZIMUTH = 40.0  # degrees from view to view
HOLDERS = {
    "in a bowl": (
        "bowl",
        ("lemon", "plum", "strawberry", "golf_ball", "dice", "apple"),
    ),
    "on a box": (
        "cracker_box",
        ("tuna_fish_can", "gelatin_box", "sponge", "rubiks_cube"),
    ),
    "leaning": ("cracker_box", ("sugar_box", "mustard_bottle", "spatula", "hammer")),
}
"""What holds others, and which others."""


@dataclass(frozen=True, eq=False)
class Case:
    """Frames of one setting, and what is true of it.

    Attributes:
        depth: (F, H, W) uint16, millimetres, 0 for nothing.
        labels: 1 + the number of the thing in each pixel, (F, H, W) uint8; 0 for none.
        told: poses of the camera as the robot tells them, camera-to-world, (F, 4, 4).
        names: of the things, (T,); that of a stranger begins with STRANGER.
        poses: scan-to-world, (F, T, 4, 4); nan where the thing is gone.
        points: on the surface of each thing, (T, CLOUD, 3), metres, in its scan.
        kind: what kind of setting it is.
    """

    depth: NDArray[np.uint16]
    labels: NDArray[np.uint8]
    told: Float
    names: NDArray[np.str_]
    poses: Float
    points: Float
    kind: NDArray[np.str_]


@dataclass(frozen=True, eq=False)
class Thing:
    """A thing in a world.

    Attributes:
        name: of it.
        mesh: in its own frame.
        pose: scan-to-world, (4, 4).
    """

    name: str
    mesh: trimesh.Trimesh
    pose: Float

    @property
    def points(self) -> Float:
        """Points on its surface in the world, (CLOUD, 3)."""
        return moved(cloud(self.mesh)[0], self.pose)

    def by(self, shift: Sequence[float] | Float) -> Thing:
        """The thing, shifted."""
        pose = self.pose.copy()
        pose[:3, 3] += shift
        return Thing(self.name, self.mesh, pose)

    def stood(self) -> Thing:
        """The thing above the origin, its lowest point at z = 0."""
        corners = moved(self.mesh.vertices, self.pose)
        low, high = corners.min(0), corners.max(0)
        return self.by((*-(low + high)[:2] / 2, -low[2]))


def moved(points: Float, pose: Float) -> Float:
    """Points after a pose, (N, 3)."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def middle(points: Float) -> Float:
    """The middle of the box around points, (3,)."""
    return np.asarray((points.min(0) + points.max(0)) / 2)


def cloud(mesh: trimesh.Trimesh) -> tuple[Float, Float]:
    """The same points on a mesh each time, (CLOUD, 3), and the normals there."""
    if "gate_cloud" not in mesh.metadata:
        points, faces = trimesh.sample.sample_surface(mesh, CLOUD, seed=0)
        mesh.metadata["gate_cloud"] = np.asarray(points), mesh.face_normals[faces]
    found: tuple[Float, Float] = mesh.metadata["gate_cloud"]
    return found


@cache
def scan(path: Path) -> trimesh.Trimesh:
    """The mesh of a file."""
    return trimesh.load(path, process=False)


def turned(vector: Sequence[float] | Float, pose: Float | None = None) -> Float:
    """A pose, turned by a rotation vector, (4, 4)."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
    return turn if pose is None else turn @ pose


def resting(name: str, mesh: trimesh.Trimesh, rng: np.random.Generator) -> Thing:
    """A thing as it may come to rest on the plane z = 0, above the origin."""
    directions = np.random.default_rng(0).normal(size=(500, 3))
    corners = mesh.vertices[np.unique((mesh.vertices @ directions.T).argmax(0))]
    hull = trimesh.Trimesh(corners).convex_hull
    poses, shares = trimesh.poses.compute_stable_poses(
        hull, center_mass=hull.center_mass, sigma=0, n_samples=1
    )
    likely = np.sqrt(shares[:6])  # rare poses more often than by chance
    pose = poses[rng.choice(len(likely), p=likely / likely.sum())]
    return Thing(name, mesh, turned((0, 0, rng.uniform(0, 2 * np.pi)), pose)).stood()


def posed(
    name: str, mesh: trimesh.Trimesh, up: int, tilt: float = 0.0, azimuth: float = 0.0
) -> Thing:
    """A thing that stands with one of its axes up, tilted towards an azimuth."""
    turns = turned((0, -np.pi / 2, 0)), turned((np.pi / 2, 0, 0)), np.eye(4)
    axis = tilt * np.array([-np.sin(azimuth), np.cos(azimuth), 0])
    return Thing(name, mesh, turned(axis, turns[up])).stood()


def together(things: Sequence[Thing]) -> Float:
    """The points of some things, (N, 3)."""
    return np.concatenate([thing.points for thing in things])


def distance(thing: Thing, points: Float) -> float:
    """How far a thing is from points, metres."""
    return float(np.min(cKDTree(points).query(thing.points)[0]))


def advanced(
    thing: Thing,
    others: Sequence[Thing],
    direction: Float,
    gap: float = TOUCHING,
) -> Thing:
    """A thing, moved in a direction until it is so near to others, or for a metre."""
    tree = cKDTree(together(others))
    points = thing.points
    way = 0.0
    while way < 1:
        left = float(np.min(tree.query(points + way * direction)[0])) - gap
        if left <= 5e-4:
            break
        way += left
    return thing.by(way * direction)


def added(thing: Thing, others: Sequence[Thing], rng: np.random.Generator) -> Thing:
    """A thing on the table beside others, 0 to 3 cm from the nearest."""
    if not others:
        return thing.by((*rng.uniform(-0.05, 0.05, 2), 0))
    while True:
        aim = others[int(rng.integers(len(others)))].points.mean(0)
        azimuth = rng.uniform(0, 2 * np.pi)
        out = np.array([np.cos(azimuth), np.sin(azimuth), 0])
        away = thing.by((*(aim + 0.6 * out)[:2], 0))
        place = advanced(away, others, -out, TOUCHING + rng.uniform(0, 0.03))
        if np.abs(place.points[:, :2]).max() < 0.36:
            return place


def stranger(number: int, rng: np.random.Generator) -> Thing:
    """Two solids that are one thing, which is not taught, as it may come to rest."""
    make = trimesh.creation
    size = rng.uniform(0.02, 0.05, 3)
    solids = [
        make.box(2 * size),
        make.cylinder(size[0], 2 * size[1], sections=40),
        make.cone(size[0], 2 * size[1], sections=40),
        make.torus(size[0], 0.4 * size[0]),
        make.capsule(2 * size[1], 0.7 * size[0]),
    ]
    first, second = rng.choice(len(solids), 2, replace=False)
    solids[second].apply_translation(size * rng.choice([-1, 1], 3) * 0.8)
    mesh = trimesh.util.concatenate([solids[first], solids[second]])
    return resting(f"{STRANGER}{number}", mesh, rng)


def machine_parts() -> dict[str, trimesh.Trimesh]:
    """Five machine parts by their names, metres."""
    make = trimesh.creation
    at = trimesh.transformations.translation_matrix
    lying = turned((np.pi / 2, 0, 0))

    def rod(radius: float, low: float, high: float, sides: int = 48) -> trimesh.Trimesh:
        ends = [(0, 0, low), (0, 0, high)]
        return make.cylinder(radius, segment=ends, sections=sides)

    parts = {
        "flange": [
            make.annulus(0.010, 0.040, 0.008, sections=64),
            make.annulus(0.010, 0.018, 0.018, sections=64, transform=at((0, 0, 0.013))),
        ],
        "bracket": [
            make.box(bounds=[(-0.035, -0.015, 0), (0.035, 0.015, 0.004)]),
            make.box(bounds=[(-0.035, -0.015, 0), (-0.031, 0.015, 0.048)]),
            make.box(bounds=[(-0.035, -0.002, 0), (0, 0.002, 0.030)]),
        ],
        "bolt": [rod(0.015, 0, 0.012, 6), rod(0.008, 0.010, 0.070)],
        "shaft": [rod(0.012, 0, 0.040), rod(0.018, 0.040, 0.055), rod(0.008, 0.055, 0.090)],
        "tee": [
            rod(0.012, 0, 0.050),
            rod(0.016, 0.041, 0.051),
            make.cylinder(0.014, 0.070, sections=48, transform=lying),
        ],
    }  # fmt: skip
    return {name: trimesh.util.concatenate(solids) for name, solids in parts.items()}


def shallow_box() -> Thing:
    """A box without a lid, 32 x 26 x 6 cm, that stands on the table."""
    x, y, wall, height = 0.16, 0.13, 0.004, 0.06
    sides = [
        [(-x, -y, 0), (x, y, wall)],
        [(-x, -y, 0), (wall - x, y, height)],
        [(x - wall, -y, 0), (x, y, height)],
        [(-x, -y, 0), (x, wall - y, height)],
        [(-x, y - wall, 0), (x, y, height)],
    ]
    solids = [trimesh.creation.box(bounds=side) for side in sides]
    return Thing(f"{STRANGER}box", trimesh.util.concatenate(solids), np.eye(4))


def room(rng: np.random.Generator) -> list[trimesh.Trimesh]:
    """A table that is not quite even, the floor, a wall, furniture."""
    box = trimesh.creation.box
    top = box((1.2, 0.9, 0)).subdivide_to_size(0.03)
    waves = rng.uniform(-40, 40, (6, 2)), rng.uniform(0, 2 * np.pi, 6)
    uneven = np.sin(top.vertices[:, :2] @ waves[0].T + waves[1]).sum(1)
    top.vertices[:, 2] = 0.0007 * uneven / uneven.std()
    lows = [(1.5 * np.cos(a), 1.5 * np.sin(a), -0.75) for a in rng.uniform(0, 6.28, 4)]
    return [
        top,
        box(bounds=[(-0.6, -0.45, -0.04), (0.6, 0.45, -0.004)]),
        box(bounds=[(-6, -6, -0.8), (6, 6, -0.75)]),
        box(bounds=[(-6, 2.2, -0.8), (6, 2.3, 3)]),
        *[
            box(bounds=[low, low + rng.uniform((0.2, 0.2, 0.4), (0.6, 0.5, 1))])
            for low in lows
        ],
    ]


class World:
    """Things on a table in a room, at which rays are cast."""

    def __init__(self, things: Sequence[Thing], around: Sequence[Any] = ()) -> None:
        solids = [one.mesh.copy().apply_transform(one.pose) for one in things]
        solids += around
        whole = trimesh.util.concatenate(solids)
        numbers = [*range(1, len(things) + 1), *[0] * len(around)]
        self.labels = np.repeat(numbers, [len(one.faces) for one in solids])
        self.normals = whole.face_normals
        self.scene = EmbreeScene(DEVICE)
        TriangleMesh(self.scene, whole.triangles.astype(np.float32))

    def cast(self, pose: Float, step: int = 1) -> tuple[Float, Any, Float]:
        """Exact depth, 0 for nothing, 1 + number of the thing and cosine of the incidence in each
        pixel, or in one of ``step`` rows and columns.
        """
        rows, columns = np.mgrid[0:HEIGHT:step, 0:WIDTH:step]
        pixels = np.stack([columns, rows, np.ones(rows.shape)], -1).reshape(-1, 3)
        rays = pixels @ np.linalg.inv(INTRINSICS).T @ pose[:3, :3].T
        starts = np.tile(pose[:3, 3], (len(rays), 1)).astype(np.float32)
        hits = self.scene.run(starts, rays.astype(np.float32), output=1)
        hit = hits["primID"] >= 0
        number = np.where(hit, hits["primID"], 0)
        along = np.abs((self.normals[number] * rays).sum(1))
        depth = np.where(hit, hits["tfar"], 0.0).reshape(rows.shape)
        label = np.where(hit, self.labels[number], 0).reshape(rows.shape)
        cosine = (along / np.linalg.norm(rays, axis=1)).reshape(rows.shape)
        return depth.astype(float), label, cosine


def shown(pose: Float, *things: Thing) -> int:
    """How many pixels of a coarse picture show the first of some things."""
    return int((World(things).cast(pose, 4)[1] == 1).sum())


def sensed(depth: Float, cosine: Float, rng: np.random.Generator) -> Any:
    """What the camera measures of exact depth, (H, W) uint16, millimetres."""
    shape = depth.shape
    error = gaussian_filter(rng.normal(size=shape), 0.9)
    measured = depth + NOISE * depth**2 * error / error.std()

    # at an edge the window of the stereo matching sees near and far
    beyond = np.where(depth > 0, depth, 9.0)
    near, far = minimum_filter(beyond, 3), maximum_filter(beyond, 3)
    edge = far - near > 0.01 + 0.03 * near
    chance = rng.random(shape)
    between = near + rng.random(shape) * (np.minimum(far, near + 1.0) - near)
    measured = np.where(edge & (chance < 0.4), between, measured)

    grazing = ~edge & (rng.random(shape) > cosine / 0.2)
    blobs = gaussian_filter(rng.normal(size=shape), 1.5)
    lost = grazing | (edge & (chance > 0.8)) | (blobs > np.quantile(blobs, 0.99))
    measured[lost | (depth == 0) | (measured < 0.2) | (measured > 8)] = 0
    return np.rint(1000 * measured).astype(np.uint16)


def looking(place: Float, at: Float) -> Float:
    """Pose of a camera at a place that looks at another, camera-to-world, (4, 4)."""
    forward = (at - place) / np.linalg.norm(at - place)
    level = np.cross(forward, (0, 0, 1))
    right = level / np.linalg.norm(level)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, place], 1)
    return pose


def views(
    things: Sequence[Thing],
    steps: Sequence[float],
    rng: np.random.Generator,
    distances: tuple[float, float] = (0.5, 0.8),
) -> list[Float]:
    """Poses of a camera on a wrist around things, so many steps of azimuth from the first."""
    at = middle(together(things))
    first = rng.uniform(0, 360)
    poses = []
    for step in steps:
        azimuth = np.radians(first + STEP_AZIMUTH * step + rng.uniform(-5, 5))
        elevation = np.radians(rng.uniform(25, 60))
        level = np.cos(elevation)
        out = level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)
        aim = at + rng.normal(size=3) * 0.02
        poses.append(looking(aim + rng.uniform(*distances) * np.array(out), aim))
    return poses


def case_of(
    shots: Sequence[tuple[Sequence[Thing | None], Float]],
    around: Sequence[Any],
    rng: np.random.Generator,
    kind: str,
) -> Case:
    """Draw the frames of a case.

    Args:
        shots: things, the same ones each time or None for one that is gone, and the true pose of
            the camera.
        around: meshes of the room.
        rng: of all noise.
        kind: of the case.
    """
    first = [thing for thing in shots[0][0] if thing is not None]
    gone = Thing("", first[0].mesh, np.full((4, 4), np.nan))
    depths, labels, told, poses = [], [], [], []
    for things, pose in shots:
        # what is gone keeps its number, and lies far below the floor
        world = World([thing or first[0].by((0, 0, -9)) for thing in things], around)
        depth, label, cosine = world.cast(pose)
        depths.append(sensed(depth, cosine, rng))
        labels.append(label.astype(np.uint8))
        turn = rng.normal(size=3) * np.radians(POSE_DEGREES) / np.sqrt(3)
        shift = rng.normal(size=3) * POSE_METRES / np.sqrt(3)
        error = turned(turn)
        error[:3, 3] = shift
        told.append(pose @ error)
        poses.append([(thing or gone).pose for thing in things])
    return Case(
        np.stack(depths),
        np.stack(labels),
        np.stack(told),
        np.array([thing.name for thing in first]),
        np.array(poses),
        np.stack([cloud(thing.mesh)[0] for thing in first]),
        np.array(kind),
    )


Scans = dict[str, Path]


def drawn(name: str, scans: Scans, rng: np.random.Generator) -> Thing:
    """A scanned thing as it may come to rest."""
    return resting(name, scan(scans[name]), rng)


def table(number: int, scans: Scans, rng: np.random.Generator) -> Case:
    """Things on a table; from the thirteenth on some are in, on or against one of them."""
    kind = "apart" if number < 12 else list(HOLDERS)[number % 3]
    things: list[Thing] = []
    if kind != "apart":
        holder, pool = HOLDERS[kind]
        mesh = scan(scans[holder])
        up = int(np.argmin(mesh.extents)) if kind == "on a box" else 2
        things = [posed(holder, mesh, up)]
        for side, name in enumerate(rng.choice(pool, 2, replace=False).tolist()):
            thing = drawn(name, scans, rng).by((0.04 * (2 * side - 1), 0, 0))
            direction = np.array([0, 0, -1.0])
            if kind == "leaning":
                azimuth = np.pi / 2 * side
                direction = np.array([np.cos(azimuth), np.sin(azimuth), 0])
                long = int(np.argmax(thing.mesh.extents))
                tilt = np.radians(rng.uniform(15, 30))
                thing = posed(name, thing.mesh, long, tilt, azimuth)
            things.append(advanced(thing.by(-0.5 * direction), things, direction))
    left = set(scans) - {thing.name for thing in things}
    names = rng.permutation(sorted(left)).tolist()
    for count in range(int(rng.integers(4, 10)) - len(things)):
        new = rng.random() < 0.15
        thing = stranger(count, rng) if new else drawn(names.pop(), scans, rng)
        things.append(added(thing, things, rng))
    shots = [(things, pose) for pose in views(things, (0, 1, 2), rng)]
    return case_of(shots, room(rng), rng, kind)


def single(number: int, scans: Scans, rng: np.random.Generator) -> Case:
    """One thing on a table: other ones than those of the numbers before."""
    order = np.random.default_rng(5).permutation(sorted(scans))
    things = [drawn(str(order[number % len(order)]), scans, rng)]
    pose = views(things, (0,), rng)[0]
    return case_of([(things, pose)], room(rng), rng, "single")


def part(number: int, scans: Scans, rng: np.random.Generator) -> Case:
    """Two of each machine part alone, then all five in a shallow box."""
    meshes = machine_parts()
    if number < 2 * len(meshes):
        name = sorted(meshes)[number % len(meshes)]
        things = [resting(name, meshes[name], rng)]
        shots = [(things, views(things, (0,), rng, NEARER)[0])]
        return case_of(shots, room(rng), rng, "alone")

    things = []
    while len(things) < len(meshes):
        name = sorted(meshes)[len(things)]
        place = (*rng.uniform((-0.13, -0.1), (0.13, 0.1)), 0.004)
        lies = resting(name, meshes[name], rng).by(place)
        inside = (np.abs(lies.points[:, :2]) < (0.152, 0.122)).all()
        if inside and (not things or distance(lies, together(things)) > 2 * TOUCHING):
            things.append(lies)
    things.append(shallow_box())
    shots = [(things, pose) for pose in views(things, (0, 1), rng, NEARER)]
    return case_of(shots, room(rng), rng, "in a box")


def move(number: int, scans: Scans, rng: np.random.Generator) -> Case:
    """Five things; before the fourth frame one of them is moved or removed."""
    names = rng.permutation(sorted(scans)).tolist()
    things: list[Thing] = []
    while len(things) < 5:
        things.append(added(drawn(names.pop(), scans, rng), things, rng))
    after: list[Thing | None] = [*things]
    while after == things:
        which = int(rng.integers(5))
        azimuth, way = rng.uniform((0, 0.03), (2 * np.pi, 0.12))
        there = things[which].by((way * np.cos(azimuth), way * np.sin(azimuth), 0))
        others = [*things[:which], *things[which + 1 :]]
        if number % 2 or distance(there, together(others)) > 2 * TOUCHING:
            after[which] = None if number % 2 else there
    poses = views(things, (0, 1, 2, 0.5, 1.5), rng)
    states = [[*things]] * 3 + [after] * 2
    shots = list(zip(states, poses, strict=True))
    return case_of(shots, room(rng), rng, "removed" if number % 2 else "moved")


def hidden(number: int, scans: Scans, rng: np.random.Generator) -> Case:
    """A thing behind a box, or at the border of the picture."""
    order = np.random.default_rng(6).permutation(sorted(scans))
    thing = drawn(str(order[number % len(order)]), scans, rng)
    centre = middle(thing.points)
    pose = views([thing], (0,), rng)[0]
    left = shown(pose, thing) * (1 / 2 if number >= 12 or number % 2 == 0 else 1 / 3)
    if number >= 12:
        side = pose[:3, 0] * rng.choice([-1, 1])
        aims = [looking(pose[:3, 3], centre + shift * side) for shift in STEPS + 0.1]
        pose = min(aims, key=lambda aim: abs(shown(aim, thing) - left))
        return case_of([([thing], pose)], room(rng), rng, "at the border")

    azimuth = np.arctan2(*(pose[:3, 3] - centre)[1::-1])
    out = np.array([np.cos(azimuth), np.sin(azimuth), 0])
    side = np.array([-out[1], out[0], 0]) * rng.choice([-1, 1])
    solid = trimesh.creation.box((0.05, 0.3, 2 * centre[2] + 0.12))
    screen = Thing(f"{STRANGER}screen", solid, turned((0, 0, azimuth))).stood()
    near = advanced(screen.by(centre * (1, 1, 0) + 0.6 * out), [thing], -out, 0.02)
    tried = [near.by(shift * side) for shift in STEPS]
    best = min(tried, key=lambda one: abs(shown(pose, thing, one) - left))
    kind = "half hidden" if number % 2 == 0 else "two thirds hidden"
    return case_of([([thing, best], pose)], room(rng), rng, kind)


DRAWS: dict[str, tuple[Callable[[int, Scans, np.random.Generator], Case], int]] = {
    "tables": (table, 15),
    "single": (single, 30),
    "parts": (part, 14),
    "moves": (move, 8),
    "places": (hidden, 20),
}


def case(part: str, number: int, scans: Scans, folder: Path) -> Case:
    """A case of a part; it is drawn if the folder does not hold it."""
    file = folder / f"{VERSION}" / f"{part}-{number:02}.npz"
    if file.exists():
        with np.load(file) as stored:
            return Case(*(stored[field.name] for field in fields(Case)))
    print(f"draws {file}", file=sys.stderr)
    file.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([sorted(DRAWS).index(part), number])
    made = DRAWS[part][0](number, scans, rng)
    half = file.with_suffix(".half.npz")
    np.savez_compressed(half, **vars(made))
    half.rename(file)
    return made
