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
from dataclasses import astuple, dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

Float = NDArray[np.float64]
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
STEP_AZIMUTH = 40.0  # degrees from view to view
SMALL = ("lemon", "plum", "strawberry", "golf_ball", "dice", "apple", "padlock")
FLAT = ("tuna_fish_can", "pudding_box", "gelatin_box", "sponge", "rubiks_cube", "mug")
LONG = ("sugar_box", "mustard_bottle", "spatula", "large_marker", "hammer")


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

    def stood(self, height: float = 0.0) -> Thing:
        """The thing above the origin, its lowest point at a height."""
        corners = moved(self.mesh.vertices, self.pose)
        low, high = corners.min(0), corners.max(0)
        middle = (low + high) / 2
        return self.by((-middle[0], -middle[1], height - low[2]))


def moved(points: Float, pose: Float) -> Float:
    """Points after a pose, (N, 3)."""
    return points @ pose[:3, :3].T + pose[:3, 3]


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


def upright(name: str, mesh: trimesh.Trimesh, tilt: float, azimuth: float) -> Thing:
    """A thing with its longest side up, tilted towards an azimuth."""
    long = int(np.argmax(mesh.extents))
    up: list[Float] = [turned((0, -np.pi / 2, 0)), turned((np.pi / 2, 0, 0)), np.eye(4)]
    axis = tilt * np.array([-np.sin(azimuth), np.cos(azimuth), 0])
    return Thing(name, mesh, turned(axis, up[long])).stood()


def advanced(
    thing: Thing,
    others: Sequence[Thing],
    direction: Float,
    gap: float,
) -> Thing | None:
    """A thing, moved in a direction until it is so near to others; None if it misses them."""
    tree = cKDTree(np.concatenate([other.points for other in others]))
    points = thing.points
    way = 0.0
    while way < 1:
        distance = float(np.min(tree.query(points + way * direction)[0])) - gap
        if distance < 5e-4:
            return thing.by(way * direction)
        way += distance
    return None


def apart(thing: Thing, others: Sequence[Thing], gap: float) -> bool:
    """Whether a thing is so far from all others."""
    tree = cKDTree(np.concatenate([other.points for other in others]))
    return float(np.min(tree.query(thing.points)[0])) >= gap


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
        if place is not None and np.abs(place.points[:, :2]).max() < 0.36:
            return place


def lowered(
    thing: Thing,
    others: Sequence[Thing],
    place: Float,
) -> Thing:
    """A thing, lowered above a place until it touches others."""
    found = advanced(
        thing.by((*place[:2], 0.4)), others, np.array([0, 0, -1.0]), TOUCHING
    )
    assert found is not None, thing.name
    return found


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

    def at(mesh: trimesh.Trimesh, *place: float) -> trimesh.Trimesh:
        return mesh.apply_translation(place)

    def rod(radius: float, height: float, middle: float, sides: int = 48) -> Any:
        return at(make.cylinder(radius, height, sections=sides), 0, 0, middle)

    lying = turned((np.pi / 2, 0, 0))
    parts = {
        "flange": [
            make.annulus(0.010, 0.040, 0.008, sections=64),
            at(make.annulus(0.010, 0.018, 0.018, sections=64), 0, 0, 0.013),
        ],
        "bracket": [
            make.box((0.070, 0.030, 0.004)),
            at(make.box((0.004, 0.030, 0.046)), -0.033, 0, 0.023),
            at(make.box((0.030, 0.004, 0.030)), -0.020, 0, 0.015),
        ],
        "bolt": [rod(0.015, 0.012, 0, 6), rod(0.008, 0.060, 0.035)],
        "shaft": [rod(0.012, 0.040, 0), rod(0.018, 0.015, 0.027), rod(0.008, 0.035, 0.052)],
        "tee": [
            rod(0.012, 0.050, 0.025),
            make.cylinder(0.014, 0.070, sections=48, transform=lying),
            rod(0.016, 0.010, 0.046),
        ],
    }  # fmt: skip
    return {name: trimesh.util.concatenate(solids) for name, solids in parts.items()}


def shallow_box() -> Thing:
    """A box without a lid, 32 x 26 x 6 cm, that stands on the table."""
    walls = [trimesh.creation.box((0.32, 0.26, 0.004))]
    for side in (-1, 1):
        long = trimesh.creation.box((0.32, 0.004, 0.06))
        short = trimesh.creation.box((0.004, 0.26, 0.06))
        walls += [
            long.apply_translation((0, 0.13 * side, 0.03)),
            short.apply_translation((0.16 * side, 0, 0.03)),
        ]
    return Thing(f"{STRANGER}box", trimesh.util.concatenate(walls), np.eye(4)).stood()


def room(rng: np.random.Generator) -> list[trimesh.Trimesh]:
    """A table that is not quite even, the floor, a wall, furniture."""
    count = 40
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, count), np.linspace(-0.45, 0.45, count))
    uneven = gaussian_filter(rng.normal(size=x.shape), 4)
    uneven *= 0.0007 / uneven.std()
    at = np.arange(count * count).reshape(count, count)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]
    faces = np.stack([a, b, c, a, c, d], -1).reshape(-1, 3)
    top = trimesh.Trimesh(
        np.c_[x.ravel(), y.ravel(), uneven.ravel()], faces, process=False
    )
    box = trimesh.creation.box
    parts = [
        top,
        box(bounds=[(-0.6, -0.45, -0.04), (0.6, 0.45, -0.004)]),
        box(bounds=[(-6, -6, -0.8), (6, 6, -0.75)]),
        box(bounds=[(-6, 2.2, -0.8), (6, 2.3, 3)]),
    ]
    for _ in range(4):
        azimuth = rng.uniform(0, 2 * np.pi)
        low = np.array([1.5 * np.cos(azimuth), 1.5 * np.sin(azimuth), -0.75])
        parts.append(
            box(bounds=[low, low + rng.uniform((0.2, 0.2, 0.4), (0.6, 0.5, 1))])
        )
    return parts


class World:
    """Things on a table in a room, at which rays are cast."""

    def __init__(self, things: Sequence[Thing], around: Sequence[Any]) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        solids = [moved(one.mesh.vertices, one.pose)[one.mesh.faces] for one in things]
        solids += [mesh.triangles for mesh in around]
        triangles = np.concatenate(solids).astype(np.float32)
        numbers = [*range(1, len(things) + 1), *[0] * len(around)]
        self.labels = np.repeat(numbers, [len(one) for one in solids])
        sides = np.cross(
            triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        )
        lengths = np.linalg.norm(sides, axis=1, keepdims=True)
        self.normals = sides / np.maximum(lengths, 1e-12)
        self.scene = EmbreeScene()
        TriangleMesh(self.scene, triangles)

    def cast(self, pose: Float, step: int = 1) -> tuple[Float, Any, Float]:
        """Exact depth, 0 for nothing, label and cosine of the incidence in each pixel, or in one of
        ``step`` rows and columns.
        """
        rows, columns = np.mgrid[0:HEIGHT:step, 0:WIDTH:step]
        pixels = np.stack([columns, rows, np.ones(rows.shape)], -1).reshape(-1, 3)
        rays = pixels @ np.linalg.inv(INTRINSICS).T @ pose[:3, :3].T
        starts = np.broadcast_to(pose[:3, 3], rays.shape)
        hits = self.scene.run(
            np.ascontiguousarray(starts, np.float32),
            np.ascontiguousarray(rays, np.float32),
            output=1,
        )
        hit = hits["primID"] >= 0
        number = np.where(hit, hits["primID"], 0)
        depth = np.where(hit, hits["tfar"], 0.0).astype(float)
        across = np.abs((self.normals[number] * rays).sum(1))
        cosine = across / np.linalg.norm(rays.astype(float), axis=1)
        label = np.where(hit, self.labels[number], 0)
        shape = rows.shape
        return depth.reshape(shape), label.reshape(shape), cosine.reshape(shape)

    def share(self, pose: Float, number: int) -> int:
        """How many pixels of a coarse picture show a thing."""
        return int((self.cast(pose, 4)[1] == number + 1).sum())


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
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, place], 1)
    return pose


def views(
    at: Float,
    steps: Sequence[float],
    rng: np.random.Generator,
    distances: tuple[float, float] = (0.5, 0.8),
) -> list[Float]:
    """Poses of a camera on a wrist around a place, so many steps of azimuth from the first."""
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
    worlds: dict[int, tuple[World, list[int]]] = {}
    depths, labels, told, poses = [], [], [], []
    for things, pose in shots:
        there = [number for number, thing in enumerate(things) if thing is not None]
        if id(things) not in worlds:
            shown = [thing for thing in things if thing is not None]
            worlds[id(things)] = World(shown, around), [0, *(n + 1 for n in there)]
        world, numbers = worlds[id(things)]
        depth, label, cosine = world.cast(pose)
        depths.append(sensed(depth, cosine, rng))
        labels.append(np.array(numbers, np.uint8)[label])

        error = turned(rng.normal(size=3) * np.radians(POSE_DEGREES) / np.sqrt(3))
        wrong = pose.copy()
        wrong[:3, :3] = pose[:3, :3] @ error[:3, :3]
        wrong[:3, 3] += rng.normal(size=3) * POSE_METRES / np.sqrt(3)
        told.append(wrong)
        gone = np.full((4, 4), np.nan)
        poses.append([gone if thing is None else thing.pose for thing in things])
    return Case(
        np.stack(depths),
        np.stack(labels),
        np.stack(told),
        np.array([thing.name for thing in first]),
        np.array(poses),
        np.stack([cloud(thing.mesh)[0] for thing in first]),
        np.array(kind),
    )


def middle(things: Sequence[Thing]) -> Float:
    """Centre of some things, (3,)."""
    points = np.concatenate([thing.points for thing in things])
    return np.asarray((points.min(0) + points.max(0)) / 2)


Scans = dict[str, Path]


def drawn(name: str, scans: Scans, rng: np.random.Generator) -> Thing:
    """A scanned thing as it may come to rest."""
    return resting(name, scan(scans[name]), rng)


def table(number: int, scans: Scans, rng: np.random.Generator) -> Case:
    """Things on a table; from the thirteenth on some lie in a bowl, on a box or lean against
    one.
    """
    names = rng.permutation(sorted(scans)).tolist()
    things: list[Thing] = []
    kind = "apart"
    if number >= 12:
        kind = ("in a bowl", "on a box", "leaning")[number % 3]
        holder = ("bowl", "wood_block", "cracker_box")[number % 3]
        mesh = scan(scans[holder])
        base = Thing(holder, mesh, np.eye(4)).stood()
        if kind == "in a bowl":
            things = [base]
            for name in rng.choice(SMALL, 2, replace=False).tolist():
                place = rng.uniform(-0.02, 0.02, 2)
                things.append(lowered(drawn(name, scans, rng), things, place))
        elif kind == "on a box":
            base = Thing(holder, mesh, turned((np.pi / 2, 0, 0))).stood()
            name = str(rng.choice(FLAT))
            flat = Thing(name, scan(scans[name]), np.eye(4)).stood()
            things = [base, lowered(flat, [base], rng.uniform(-0.02, 0.02, 2))]
        else:
            base = upright(holder, mesh, 0.0, 0.0)
            things = [base]
            for side, name in enumerate(rng.choice(LONG, 2, replace=False).tolist()):
                azimuth = np.pi / 2 * side
                tilt = np.radians(rng.uniform(15, 30))
                leans = upright(name, scan(scans[name]), tilt, azimuth)
                out = np.array([np.cos(azimuth), np.sin(azimuth), 0])
                found = advanced(leans.by(-0.4 * out), things, out, TOUCHING)
                assert found is not None, name
                things.append(found)
    used = {thing.name for thing in things}
    names = [name for name in names if name not in used]
    for count in range(int(rng.integers(4, 10)) - len(things)):
        new = rng.random() < 0.15
        thing = stranger(count, rng) if new else drawn(names.pop(), scans, rng)
        things.append(added(thing, things, rng))
    shots = [(things, pose) for pose in views(middle(things), (0, 1, 2), rng)]
    return case_of(shots, room(rng), rng, kind)


def single(number: int, scans: Scans, rng: np.random.Generator) -> Case:
    """One thing on a table: other ones than those of the numbers before."""
    order = np.random.default_rng(5).permutation(sorted(scans))
    things = [drawn(str(order[number % len(order)]), scans, rng)]
    pose = views(middle(things), (0,), rng)[0]
    return case_of([(things, pose)], room(rng), rng, "single")


def part(number: int, scans: Scans, rng: np.random.Generator) -> Case:
    """Two of each machine part alone, then all five in a shallow box."""
    meshes = machine_parts()
    if number < 2 * len(meshes):
        name = sorted(meshes)[number % len(meshes)]
        things = [resting(name, meshes[name], rng)]
        shots = [(things, views(middle(things), (0,), rng, NEARER)[0])]
        return case_of(shots, room(rng), rng, "alone")
    box = shallow_box()
    things = [box]
    for name, mesh in meshes.items():
        while True:
            place = (*rng.uniform((-0.13, -0.1), (0.13, 0.1)), 0.004)
            lies = resting(name, mesh, rng).by(place)
            inside = (np.abs(lies.points[:, :2]) < (0.152, 0.122)).all()
            if inside and (len(things) == 1 or apart(lies, things[1:], 2 * TOUCHING)):
                break
        things.append(lies)
    turn = turned((0, 0, rng.uniform(0, 2 * np.pi)))
    things = [Thing(one.name, one.mesh, turn @ one.pose) for one in things]
    shots = [(things, pose) for pose in views(middle(things), (0, 1), rng, NEARER)]
    return case_of(shots, room(rng), rng, "in a box")


def move(number: int, scans: Scans, rng: np.random.Generator) -> Case:
    """Five things; before the fourth frame one of them is moved or removed."""
    names = rng.permutation(sorted(scans)).tolist()
    things: list[Thing] = []
    while len(things) < 5:
        things.append(added(drawn(names.pop(), scans, rng), things, rng))
    around = room(rng)
    poses = views(middle(things), (0, 1, 2, 0.5, 1.5), rng)
    after: list[Thing | None] = [*things]
    while after == things:
        which = int(rng.integers(5))
        azimuth = rng.uniform(0, 2 * np.pi)
        way = rng.uniform(0.03, 0.12)
        there = things[which].by((way * np.cos(azimuth), way * np.sin(azimuth), 0))
        others = [*things[:which], *things[which + 1 :]]
        if number % 2:
            after[which] = None
        elif apart(there, others, 2 * TOUCHING):
            after[which] = there
    before: list[Thing | None] = [*things]
    shots = [(before, pose) for pose in poses[:3]]
    shots += [(after, pose) for pose in poses[3:]]
    return case_of(shots, around, rng, "removed" if number % 2 else "moved")


def hidden(number: int, scans: Scans, rng: np.random.Generator) -> Case:
    """A thing behind a box, or at the border of the picture."""
    order = np.random.default_rng(6).permutation(sorted(scans))
    thing = drawn(str(order[number % len(order)]), scans, rng)
    things = [thing]
    around = room(rng)
    pose = views(middle(things), (0,), rng)[0]
    whole = World(things, []).share(pose, 0)
    if number >= 12:
        right = pose[:3, 0] * rng.choice([-1, 1])
        aims = []
        for shift in np.linspace(0.1, 0.5, 41):
            aim = looking(pose[:3, 3], pose[:3, 3] + pose[:3, 2] * 0.65 + shift * right)
            aims.append((abs(World(things, []).share(aim, 0) - whole / 2), aim))
        pose = min(aims, key=lambda pair: pair[0])[1]
        return case_of([(things, pose)], around, rng, "at the border")

    left = (1 / 2, 1 / 3)[number % 2]
    back = pose[:3, 3] - middle(things)
    azimuth = np.arctan2(back[1], back[0])
    height = float(np.ptp(thing.points[:, 2])) + 0.12
    screen = trimesh.creation.box((0.05, 0.3, height))
    box = Thing(f"{STRANGER}screen", screen, turned((0, 0, azimuth))).stood()
    out = np.array([np.cos(azimuth), np.sin(azimuth), 0])
    side = np.array([-out[1], out[0], 0]) * rng.choice([-1, 1])
    before = advanced(
        box.by(middle(things) * (1, 1, 0) + 0.6 * out), things, -out, 0.02
    )
    assert before is not None
    tried = [before.by(shift * side) for shift in np.linspace(0, 0.3, 41)]
    shares = [World([thing, one], []).share(pose, 0) for one in tried]
    best = int(np.abs(np.array(shares) - left * whole).argmin())
    kind = "half hidden" if number % 2 == 0 else "two thirds hidden"
    return case_of([([thing, tried[best]], pose)], around, rng, kind)


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
    values = dict(zip([f.name for f in fields(Case)], astuple(made), strict=True))
    half = file.with_suffix(".half.npz")
    np.savez_compressed(half, **values)
    half.rename(file)
    return made
