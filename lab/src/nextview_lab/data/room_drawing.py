"""Generate a folder of random rooms around the objects of a dataset, in parallel and resumable.

A room is as seen by a mobile robot: floor, walls, ceiling and furniture, all life-size, and a level
camera. Furniture stands on the floor, half of it against a wall. Monitors and hand-sized objects
are on a table. Objects with a known unit of length lie there in any resting pose; furniture stands
upright.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from nextview.checks import whole
from nextview.data.folders import Entry, list_dataset, select
from nextview.data.pool import WorkerDied, each
from nextview.errors import DatasetError, MeshError, UsageError
from nextview.files import check_new
from nextview.geometry.mesh import MAX_FACES, Mesh, load_mesh
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster
from nextview.geometry.resting import resting_poses
from nextview.geometry.viewsphere import level_pose, rotation_z
from nextview.types import Float
from nextview_lab.data.scene_drawing import MOST_FACES, MOST_SCENES
from nextview_lab.data.store import writing
from nextview_lab.worlds.room import Room, at_rest, build_room
from nextview_lab.worlds.room_layout import IDENTITY, RoomLayout, Slab, Standing
from nextview_lab.worlds.scene import footprint, mesh_hash, separation
from nextview_lab.worlds.scene_layout import SUFFIX

# in the names of rooms, in place of the clutter level of other scenes
ROOM_NAME = "room"
ROOM_LAYOUTS_TRIED = 60
VIEWS_TRIED = 60  # attempts to find a first view of a layout

ROOM_SIDE = (3.5, 6.5)  # metres
ROOM_HEIGHT = (2.4, 2.8)
AT_WALL = (0.0, 0.06)  # metres between a wall and furniture against it
FURNITURE_GAP = 0.3  # metres, least distance between the target and other furniture
FURNITURE = (1, 3)  # least and largest number of other pieces of furniture
PLACES_TRIED = 20  # attempts for each
HAND_SIZED = 0.3  # metres; objects with a smaller radius are on a table
TABLE_HEIGHTS = (0.70, 0.78)
TABLE_WIDTH = (1.2, 1.6)
TABLE_DEPTH = (0.7, 0.9)
TABLE_TOP_THICKNESS = 0.04  # thickness
TABLE_LEG = 0.05
TABLE_EDGE = 0.08  # metres, least distance of objects from the edge of the table
LEAST_SPACING = 0.08  # metres, least distance between objects on a table
MOST_BESIDE = 2
# width, depth and height of boxes on a table
BOOK = ((0.05, 0.25), (0.05, 0.2), (0.03, 0.15))
CABINET = ((0.4, 1.2), (0.3, 0.5), (0.6, 2.0))

# first view: distance from the target, height above the floor, and above a table, metres
FLOOR_DISTANCE = (1.5, 3.5)
FLOOR_HEIGHT = (0.6, 1.6)
ABOVE_TABLE = 0.1
CLOSEST_CAMERA = 0.8  # metres from the target's sphere
TABLE_DISTANCE = (0.4, 0.7)
CLOSEST_TO_SMALL = 0.25
TABLE_ELEVATION = (20.0, 60.0)  # degrees
# standard deviation of the aiming point, relative to the distance
AIM_OFF = 0.02
# least visible share of the target in the first view
LEAST_SHOWN = 0.7
PREVIEW_SIDE = 96  # pixels, side of the image that measures it
FIELD = 0.9  # half width of that image at unit distance
# placeholder for the first pose of a layout
NO_POSE = tuple(np.eye(4).ravel().tolist())

# the target, the other objects, and the boxes
Furnished = tuple[Standing, list[Standing], list[Slab]]


@dataclass(frozen=True)
class LifeSize:
    """Usual size of the objects of a class.

    Attributes:
        measure: "height", or "length" for the longer side on the floor.
        low: metres.
        high: metres.
        back: direction from an object's centre to its back, degrees from +x, in ModelNet's axes.
    """

    measure: str
    low: float
    high: float
    back: float


# usual sizes of furniture
LIFE_SIZES = {
    "bathtub": LifeSize("length", 1.5, 1.8, 0),
    "bed": LifeSize("length", 1.9, 2.2, 90),
    "chair": LifeSize("height", 0.78, 1.0, 90),
    "desk": LifeSize("height", 0.70, 0.78, 0),
    "dresser": LifeSize("height", 0.8, 1.25, 0),
    "monitor": LifeSize("length", 0.4, 0.7, 0),
    "night_stand": LifeSize("height", 0.45, 0.65, 0),
    "sofa": LifeSize("length", 1.5, 2.2, 0),
    "table": LifeSize("height", 0.70, 0.78, 0),
    "toilet": LifeSize("height", 0.68, 0.82, 90),
}
ON_TABLES = ("monitor",)
MOST_LENGTH = 2.6  # metres, largest length on the floor; wider tables are scaled down


@dataclass(frozen=True)
class RoomTask:
    """One room to generate.

    Attributes:
        target: mesh file of the target, below the dataset.
        split: of the target and of all other objects.
        label: class of the target.
        name: of the room.
        path: its file.
    """

    target: str
    split: str
    label: str
    name: str
    path: Path


@dataclass(frozen=True)
class RoomMeshes:
    """Meshes for rooms.

    Attributes:
        folder: of the meshes.
        unit: of length of all of them; None for furniture of known classes, and files that define
            it.
        furniture: file below the folder and class of possible furniture, by split.
        small: files of possible objects on a table, by split.
    """

    folder: Path
    unit: str | None
    furniture: dict[str, tuple[tuple[str, str], ...]]
    small: dict[str, tuple[str, ...]]


@dataclass(frozen=True)
class LifeSizeMesh:
    """A life-size mesh.

    Attributes:
        file: below the folder of the meshes.
        sha256: of the file.
        mesh: contents of the file.
        radius: object radius, metres.
    """

    file: str
    sha256: str
    mesh: Mesh
    radius: float

    @classmethod
    def of(
        cls,
        folder: Path,
        file: str,
        mesh: Mesh,
        radius: float,
    ) -> "LifeSizeMesh":
        """Create a life-size mesh from a file below a folder, and its object radius, metres."""
        return cls(file, mesh_hash(folder / file), mesh, _short(radius))


def draw_rooms(
    dataset: Path,
    out: Path,
    rooms: int | None = None,
    seed: int = 0,
    split: str | None = None,
    unit: str | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
) -> Iterator[tuple[str, str | None]]:
    """Generate the rooms that are missing in the folder. They depend only on the seed.

    Classes alternate, and so do the objects of each class, in a random order. Files are
    CLASS/SPLIT/NAME@room-NUMBER.json, or CLASS/NAME@room-NUMBER.json if the dataset has no splits.

    Args:
        dataset: folder of meshes.
        out: folder of the rooms.
        rooms: number of rooms per split; by default one around each object.
        seed: of all random numbers.
        split: name of the split; None for all.
        unit: of length of the mesh files.
        workers: see ``pool.each``.
        scheduler: see ``pool.each``.

    Yields:
        The name of each existing room, and None, or the reason why it cannot be generated.
    """
    dataset = Path(dataset)
    out = Path(out)
    wanted = room_tasks(dataset, out, rooms, seed, split)
    there = next(out.rglob(f"*@{ROOM_NAME}-*{SUFFIX}"), None)
    if there is None:
        check_new(out, folder=True)
    elif RoomLayout.load(there).seed != seed:
        raise DatasetError(
            f"{there}: was drawn with another seed; give another folder or the same seed"
        )

    done = [task for task in wanted if task.path.exists()]
    yield from ((task.name, None) for task in done)
    todo = [task for task in wanted if not task.path.exists()]
    source = _source(dataset.absolute(), unit)
    with writing(out):
        for task, result in each(
            partial(_draw, source, seed),
            todo,
            workers,
            scheduler,
        ):
            yield (
                task.name,
                f"{task.name}: {result}" if isinstance(result, WorkerDied) else result,
            )


def room_tasks(
    dataset: Path,
    out: Path,
    rooms: int | None,
    seed: int,
    split: str | None,
) -> list[RoomTask]:
    """Return a task for each room, see ``draw_rooms``.

    Args:
        dataset: folder of meshes.
        out: folder of the rooms.
        rooms: number of rooms; None for one around each object.
        seed: of all random numbers.
        split: name of the split; None for all.
    """
    if rooms is not None:
        whole(rooms, "the number of rooms", 1, MOST_SCENES)
    whole(seed, "a seed", 0, 2**31 - 1)
    entries = select(list_dataset(dataset), dataset, split, None)
    found = []
    for one in dict.fromkeys(entry.split for entry in entries):
        order = _in_turns([entry for entry in entries if entry.split == one], seed)
        for number in range(len(order) if rooms is None else rooms):
            entry = order[number % len(order)]
            name = f"{entry.name}@{ROOM_NAME}-{number // len(order)}"
            path = out.absolute() / entry.label / one / f"{name}{SUFFIX}"
            target = entry.path.relative_to(dataset).as_posix()
            found.append(RoomTask(target, one, entry.label, name, path))
    return found


def _in_turns(entries: list[Entry], seed: int) -> list[Entry]:
    """Order the entries of one split so that classes alternate."""
    rng = np.random.default_rng([seed, *entries[0].split.encode()])
    shuffled = [entries[i] for i in rng.permutation(len(entries))]
    labels = list(dict.fromkeys(entry.label for entry in shuffled))
    turn = dict.fromkeys(labels, 0)
    turns = []
    for entry in shuffled:
        turns.append((turn[entry.label], labels.index(entry.label)))
        turn[entry.label] += 1
    return [shuffled[i] for i in sorted(range(len(shuffled)), key=turns.__getitem__)]


def _source(dataset: Path, unit: str | None) -> RoomMeshes:
    """Return the meshes of a dataset that may surround a target."""
    furniture: dict[str, list[tuple[str, str]]] = {}
    small: dict[str, list[str]] = {}
    for entry in list_dataset(dataset):
        file = entry.path.relative_to(dataset).as_posix()
        if unit is not None:
            small.setdefault(entry.split, []).append(file)
        elif entry.label in LIFE_SIZES and entry.label not in ON_TABLES:
            furniture.setdefault(entry.split, []).append((file, entry.label))
    return RoomMeshes(
        dataset,
        unit,
        {split: tuple(sorted(some)) for split, some in furniture.items()},
        {split: tuple(sorted(some)) for split, some in small.items()},
    )


def _draw(source: RoomMeshes, seed: int, task: RoomTask) -> str | None:
    """Generate one room and write its file; returns the reason if that is not possible."""
    try:
        draw_room(source, task, seed).save(task.path)
    except (MeshError, DatasetError) as error:
        return str(error)
    return None


def draw_room(source: RoomMeshes, task: RoomTask, seed: int) -> RoomLayout:
    """Generate a room around a target; all random numbers depend on seed and name.

    Args:
        source: available meshes.
        task: the room.
        seed: of the random numbers.

    Raises:
        MeshError: the target cannot be used.
        DatasetError: its size is not known, or it is not visible in any tried layout.
    """
    rng = np.random.default_rng([seed, *task.name.encode()])
    mesh = load_mesh(source.folder / task.target, unit=source.unit)
    radius = life_radius(mesh, task.label, rng)
    thing = LifeSizeMesh.of(source.folder, task.target, mesh, radius)

    for _ in range(ROOM_LAYOUTS_TRIED):
        layout = _layout(source, task, thing, seed, rng)
        if layout is None:
            continue

        room = build_room(layout, source.folder, MAX_FACES)
        pose = _first_view(room, rng)
        if pose is not None:
            return replace(layout, pose=tuple(np.round(pose, 5).ravel().tolist()))

    raise DatasetError(
        f"{source.folder / task.target}: shows in none of {ROOM_LAYOUTS_TRIED} rooms"
    )


def life_radius(mesh: Mesh, label: str, rng: np.random.Generator) -> float:
    """Return the real object radius of a mesh, metres: from its unit, or drawn for its class.

    Args:
        mesh: of the object.
        label: its class.
        rng: for the size.
    """
    if mesh.metres is not None:
        return mesh.metres
    size = LIFE_SIZES.get(label)
    if size is None:
        known = ", ".join(LIFE_SIZES)
        raise UsageError(
            f"{mesh.name}: how large is a {label}? Give the files' --unit; without one, rooms hold"
            f" {known}"
        )
    extent = np.ptp(mesh.vertices, axis=0)
    measured = extent[2] if size.measure == "height" else extent[:2].max()
    radius = rng.uniform(size.low, size.high) / max(measured, 1e-6)
    return float(min(radius, MOST_LENGTH / max(extent[:2].max(), 1e-6)))


def _layout(
    source: RoomMeshes,
    task: RoomTask,
    thing: LifeSizeMesh,
    seed: int,
    rng: np.random.Generator,
) -> RoomLayout | None:
    """Return a room without a first view; None if the target does not fit."""
    width, depth, height = rng.uniform(
        *np.transpose([ROOM_SIDE, ROOM_SIDE, ROOM_HEIGHT])
    )
    measured = thing.mesh.metres is not None
    small = task.label in ON_TABLES or (measured and thing.radius < HAND_SIZED)
    furnish = _on_table if small else _on_floor

    placed = furnish(source, task, thing, (width, depth), rng)
    if placed is None:
        return None

    target, objects, slabs = placed
    return RoomLayout(
        name=task.name,
        kind="table" if small else "floor",
        seed=seed,
        label=task.label,
        target=target,
        width=_short(width),
        depth=_short(depth),
        height=_short(height),
        pose=NO_POSE,
        objects=tuple(objects),
        slabs=tuple(slabs),
    )


def _on_floor(
    source: RoomMeshes,
    task: RoomTask,
    thing: LifeSizeMesh,
    room: tuple[float, float],
    rng: np.random.Generator,
) -> Furnished | None:
    """Place a target on the floor, half of them with the back to a wall; None if it cannot."""
    back = np.radians(LIFE_SIZES[task.label].back) if task.label in LIFE_SIZES else 0.0
    against = bool(rng.integers(2))
    target = _standing(thing, room, back, against, rng)
    if target is None:
        return None

    taken = [footprint(at_rest(thing.mesh.vertices, target))]
    objects, slabs = _furniture(source, task.split, room, taken, rng)
    return target, objects, slabs


def _on_table(
    source: RoomMeshes,
    task: RoomTask,
    thing: LifeSizeMesh,
    room: tuple[float, float],
    rng: np.random.Generator,
) -> Furnished | None:
    """Place a target on a table; None if it does not fit."""
    slabs = _table(room, rng)
    top = slabs[0]
    upright = task.label in ON_TABLES
    poses = np.eye(3)[None] if upright else resting_poses(thing.mesh)
    rest = poses[rng.integers(len(poses))]
    azimuth = rng.uniform(0, 2 * np.pi)
    if upright:  # facing away from the wall behind the table
        azimuth = top.azimuth + np.pi / 2 - np.radians(LIFE_SIZES[task.label].back)
    taken: list[Float] = []
    target = _lying(thing, azimuth, rest, top, taken, rng)
    if target is None:
        return None

    objects = []
    for _ in range(int(rng.integers(MOST_BESIDE + 1)) * (not upright)):
        other = _beside(source, task, top, taken, rng)
        if isinstance(other, Standing):
            objects.append(other)
        elif other is not None:
            slabs.append(other)
    around = [footprint(_slab_corners(top))]
    more, boxes = _furniture(source, task.split, room, around, rng)
    return target, [*objects, *more], [*slabs, *boxes]


def _standing(
    thing: LifeSizeMesh,
    room: tuple[float, float],
    back: float,
    against: bool,
    rng: np.random.Generator,
) -> Standing | None:
    """Place a mesh on the floor of a room, ``against`` a wall or anywhere.

    ``back`` is the direction from its centre to its back, radians. Returns None if it is too large.
    """
    wall = int(rng.integers(4))
    azimuth = np.pi / 2 * wall - back if against else rng.uniform(0, 2 * np.pi)
    placed = Standing(thing.file, thing.sha256, thing.radius, azimuth=_short(azimuth))
    half = np.ptp(at_rest(thing.mesh.vertices, placed)[:, :2], axis=0) / 2
    free = np.array(room) / 2 - half - AT_WALL[1]
    if (free <= 0).any():
        return None

    place = rng.uniform(-free, free)
    if against:
        axis = wall % 2
        side = 1 if wall < 2 else -1
        place[axis] = side * (room[axis] / 2 - half[axis] - rng.uniform(*AT_WALL))
    return replace(placed, x=_short(place[0]), y=_short(place[1]))


def _furniture(
    source: RoomMeshes,
    split: str,
    room: tuple[float, float],
    taken: list[Float],
    rng: np.random.Generator,
) -> tuple[list[Standing], list[Slab]]:
    """Place furniture against the walls, outside the footprints ``taken``, which are extended."""
    objects: list[Standing] = []
    slabs: list[Slab] = []

    for _ in range(int(rng.integers(FURNITURE[0], FURNITURE[1] + 1))):
        for _ in range(PLACES_TRIED):
            piece, corners = _piece(source, split, room, rng)
            if piece is None:
                continue

            outline = footprint(corners)
            if min(separation(outline, there) for there in taken) < FURNITURE_GAP:
                continue

            taken.append(outline)
            if isinstance(piece, Slab):
                slabs.append(piece)
            else:
                objects.append(piece)
            break

    return objects, slabs


def _piece(
    source: RoomMeshes,
    split: str,
    room: tuple[float, float],
    rng: np.random.Generator,
) -> tuple[Standing | Slab | None, Float]:
    """Return a cabinet or another piece of furniture against a wall, and its corners, (K, 3).

    Returns None for a mesh that cannot be used or is too large.
    """
    cabinet = _cabinet(room, rng)
    others = source.furniture.get(split, ())
    if not others or not rng.integers(3):
        return cabinet, _slab_corners(cabinet)

    file, label = others[int(rng.integers(len(others)))]
    mesh = _other(source.folder / file)
    if mesh is None:
        return None, np.zeros((0, 3))

    radius = life_radius(mesh, label, rng)
    thing = LifeSizeMesh.of(source.folder, file, mesh, radius)
    placed = _standing(thing, room, np.radians(LIFE_SIZES[label].back), True, rng)
    if placed is None:
        return None, np.zeros((0, 3))
    return placed, at_rest(mesh.vertices, placed)


@lru_cache(maxsize=64)
def _other(path: Path, unit: str | None = None) -> Mesh | None:
    """Load a mesh that stands near a target; None if it is too large or damaged."""
    try:
        return load_mesh(path, unit=unit, max_faces=MOST_FACES)
    except MeshError:
        return None


def _cabinet(room: tuple[float, float], rng: np.random.Generator) -> Slab:
    """Return a box against a wall."""
    width, depth, height = rng.uniform(*np.transpose(CABINET))
    wall = int(rng.integers(4))
    azimuth = np.pi / 2 * (wall - 1)
    axis = wall % 2
    side = 1 if wall < 2 else -1
    free = np.maximum(np.array(room) / 2 - width / 2, 0)
    place = rng.uniform(-free, free)
    place[axis] = side * (room[axis] / 2 - depth / 2 - rng.uniform(*AT_WALL))
    return _slab((*place, 0.0), azimuth, (width, depth, height))


def _table(room: tuple[float, float], rng: np.random.Generator) -> list[Slab]:
    """Return a table top with four legs, against a wall or in the room; the top comes first."""
    width, depth = rng.uniform(*np.transpose([TABLE_WIDTH, TABLE_DEPTH]))
    height = rng.uniform(*TABLE_HEIGHTS)
    wall = int(rng.integers(4))
    azimuth = np.pi / 2 * (wall - 1)
    half = np.array([width, depth] if wall % 2 else [depth, width]) / 2
    free = np.maximum(np.array(room) / 2 - half - AT_WALL[1], 0)
    place = rng.uniform(-free, free)
    if rng.integers(2):
        axis = wall % 2
        side = 1 if wall < 2 else -1
        place[axis] = side * (room[axis] / 2 - half[axis] - rng.uniform(*AT_WALL))

    size = width, depth, TABLE_TOP_THICKNESS
    top = _slab((*place, height - TABLE_TOP_THICKNESS), azimuth, size, even=False)
    legs = []
    for x in (-1, 1):
        for y in (-1, 1):
            aside = np.array([x * (width - TABLE_LEG), y * (depth - TABLE_LEG), 0]) / 2
            at = place + (rotation_z(azimuth) @ aside)[:2]
            size = TABLE_LEG, TABLE_LEG, height - 2 * TABLE_TOP_THICKNESS
            legs.append(_slab((*at, 0.0), azimuth, size))
    return [top, *legs]


def _lying(
    thing: LifeSizeMesh,
    azimuth: float,
    rest: Float,
    top: Slab,
    taken: list[Float],
    rng: np.random.Generator,
) -> Standing | None:
    """Place a mesh on a table in a resting pose, a rotation (3, 3); None if it does not fit.

    Its footprint is added to ``taken``.
    """
    rotation = (
        IDENTITY if np.array_equal(rest, np.eye(3)) else tuple(rest.ravel().tolist())
    )

    for _ in range(PLACES_TRIED):
        aside = _on_top(top, rng)
        placed = Standing(
            mesh=thing.file,
            sha256=thing.sha256,
            radius=thing.radius,
            x=_short(aside[0]),
            y=_short(aside[1]),
            z=_short(top.z + top.height),
            azimuth=_short(azimuth),
            rotation=rotation,
        )
        outline = footprint(at_rest(thing.mesh.vertices, placed))
        if _fits(outline, top, taken):
            taken.append(outline)
            return placed

    return None


def _beside(
    source: RoomMeshes,
    task: RoomTask,
    top: Slab,
    taken: list[Float],
    rng: np.random.Generator,
) -> Standing | Slab | None:
    """Return another object on a table, or a box; None if it does not fit."""
    others = [file for file in source.small.get(task.split, ()) if file != task.target]
    if others and rng.integers(2):
        file = others[int(rng.integers(len(others)))]
        mesh = _other(source.folder / file, source.unit)
        if mesh is None or mesh.metres is None or mesh.metres > HAND_SIZED:
            return None
        thing = LifeSizeMesh.of(source.folder, file, mesh, mesh.metres)
        return _lying(thing, rng.uniform(0, 2 * np.pi), np.eye(3), top, taken, rng)

    x, y = _on_top(top, rng)
    size = rng.uniform(*np.transpose(BOOK))
    box = _slab((x, y, top.z + top.height), rng.uniform(0, 2 * np.pi), size.tolist())
    outline = footprint(_slab_corners(box))
    if not _fits(outline, top, taken):
        return None
    taken.append(outline)
    return box


def _on_top(top: Slab, rng: np.random.Generator) -> Float:
    """Draw a position on a table, (2,)."""
    free = np.array([top.width, top.depth]) / 2 - TABLE_EDGE
    aside = np.append(rng.uniform(-free, free), 0)
    return np.array([top.x, top.y]) + (rotation_z(top.azimuth) @ aside)[:2]


def _fits(outline: Float, top: Slab, taken: list[Float]) -> bool:
    """Return True if an outline, (K, 2), is on a table, clear of its edge and of others."""
    own = (outline - (top.x, top.y)) @ rotation_z(top.azimuth)[:2, :2]
    inside = (np.abs(own) < np.array([top.width, top.depth]) / 2 - TABLE_EDGE / 2).all()
    return bool(inside) and all(
        separation(outline, other) >= LEAST_SPACING for other in taken
    )


def _slab(
    place: Sequence[float],
    azimuth: float,
    size: Sequence[float],
    even: bool = True,
) -> Slab:
    """Return a box with its bottom at a position, (3,), and with a width, a depth and a height."""
    x, y, z = map(_short, place)
    width, depth, height = map(_short, size)
    return Slab(x, y, z, _short(azimuth), width, depth, height, even)


def _slab_corners(slab: Slab) -> Float:
    """Return the corners of a box, (8, 3)."""
    half = np.array([slab.width, slab.depth]) / 2
    corners = np.array(
        [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, 1)],
        float,
    )
    corners *= (*half, slab.height)
    return corners @ rotation_z(slab.azimuth).T + (slab.x, slab.y, slab.z)


def _first_view(room: Room, rng: np.random.Generator) -> Float | None:
    """Find a level pose, (4, 4), from which the target is visible; None if none was found."""
    centre = room.centre
    for _ in range(VIEWS_TRIED):
        azimuth = rng.uniform(0, 2 * np.pi)
        if room.layout.kind == "floor" or room.layout.label in ON_TABLES:
            distance = max(rng.uniform(*FLOOR_DISTANCE), room.radius + CLOSEST_CAMERA)
            lowest = max(FLOOR_HEIGHT[0], room.layout.target.z + ABOVE_TABLE)
            rise = np.clip(
                (rng.uniform(lowest, FLOOR_HEIGHT[1]) - centre[2]) / distance,
                -1,
                1,
            )
        else:
            distance = max(rng.uniform(*TABLE_DISTANCE), room.radius + CLOSEST_TO_SMALL)
            rise = np.sin(np.radians(rng.uniform(*TABLE_ELEVATION)))

        level = np.sqrt(1 - rise**2)
        direction = np.array([level * np.cos(azimuth), level * np.sin(azimuth), rise])
        aim = centre + rng.normal(0, AIM_OFF * distance, 3)
        pose = level_pose(direction, distance)
        pose[:3, 3] += aim
        if room.reachable(pose) and _shown(room, pose) >= LEAST_SHOWN:
            return pose
    return None


def _shown(room: Room, pose: Float) -> float:
    """Return the share of the target that is inside the image of a pose and not occluded."""
    focal = PREVIEW_SIDE / 2 / FIELD
    camera = PinholeCamera.centred(focal, (PREVIEW_SIDE, PREVIEW_SIDE))
    rays = camera.rays.reshape(-1, 3) @ pose[:3, :3].T
    alone, _ = RayCaster(room.things[:1]).cast(pose[:3, 3], rays.astype(np.float32))
    _, which = room.caster.cast(pose[:3, 3], rays.astype(np.float32))
    whole_picture = np.isfinite(alone).sum()
    return float((which == 0).sum() / whole_picture) if whole_picture else 0.0


def _short(value: float) -> float:
    """Round a value to a few digits, which JSON represents exactly."""
    return round(float(value), 5)
