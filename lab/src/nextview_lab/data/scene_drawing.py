"""Generate a folder of random scenes around the objects of a dataset, in parallel and resumable.

Objects and boxes are placed on the height map of a level (``worlds.HeightMap``) where it is free:
around a target on a table until the visible share of the target is as required, or, in a room, on
its floor or on a table in it. There is no physics simulation.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from nextview.checks import whole
from nextview.data.folders import list_dataset, select
from nextview.data.pool import WorkerDied, each
from nextview.errors import DatasetError, MeshError, UsageError
from nextview.files import check_new
from nextview.geometry.mesh import MAX_FACES, Mesh
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster
from nextview.geometry.resting import resting_poses, rotated
from nextview.geometry.viewsphere import ViewSphere, look_at_origin
from nextview.simulation.boxes import BLOCK_HEIGHT, FOOTPRINT
from nextview.simulation.simulated import SimulatedCamera
from nextview.types import Float, Mask
from nextview_lab.data.store import writing
from nextview_lab.worlds.life_sizes import LIFE_SIZES, ON_TABLES, life_radius
from nextview_lab.worlds.scene import (
    Item,
    TargetScene,
    block_item,
    cached_mesh,
    mesh_hash,
    place,
)
from nextview_lab.worlds.scene_cameras import OccludedCamera, visible_shares
from nextview_lab.worlds.scene_layout import (
    CLUTTER_LEVELS,
    ROOM,
    SCENE_TABLE,
    SUFFIX,
    UPRIGHT,
    Block,
    Placement,
    SceneLayout,
)
from nextview_lab.worlds.worlds import HeightMap

SCENE_VIEWS = ViewSphere.named("40")
# side of the images that measure the visible share, pixels: final, and while searching
SHARE_PIXELS = 112
COARSE_PICTURE = 48
# largest difference of a scene's required share from that of its level, and tolerance
SPREAD = 0.04
VISIBLE_TOLERANCE = 0.02
# numbers of objects around a target
FEWEST_AROUND = 3
MOST_AROUND = 20
# attempts to place an object per layout, and layouts per scene
THINGS_TRIED = 200
SCENE_LAYOUTS_TRIED = 20
OBJECT_RADIUS = (0.5, 1.1)  # of meshes without a size, object radii of the target
THING_GAP = 0.04  # least distance between objects, object radii
# least number of meshes among the objects, if there are any
FEWEST_OBJECTS = 2
WALL_AWAY = (1.2, 1.9)
WALL_WIDTH = (2.0, 3.5)
WALL_DEPTH = 0.1
WALL_HEIGHT = (1.0, 2.6)
# meshes tried per scene, each at several positions, because loading them is slow
MESHES_TRIED = 8
# largest number of triangles of an object around the target, to limit the run time
MOST_FACES = 100_000
MOST_SCENES = 100_000  # per level and split

# rooms, metres
ROOM_WALLS = (0.6, 3.5)  # distance of each wall from the target's sphere
ROOM_HEIGHT = (2.4, 2.8)
HAND_SIZED = 0.3  # objects with a smaller radius are on a table
TABLE_HEIGHTS = (0.70, 0.78)
TABLE_HALVES = (0.35, 0.7)
LEAST_IN_ROOM = 0.35  # least visible share of a target in a room, mean over the views
VIEWS_TRIED = 60  # attempts to find a first view
AIM_OFF = 0.02  # standard deviation of its aim, relative to the distance
LEAST_SHOWN = 0.7  # least visible share of the target in it
# distance of the first camera, its elevation, degrees, and its least distance from the target's
# sphere
FROM_FLOOR = (1.5, 3.5), (5.0, 30.0), 0.8
FROM_TABLE = (0.4, 0.7), (20.0, 60.0), 0.25


@dataclass(frozen=True)
class Clutter:
    """What stands around a target; in object radii of the target, or in metres in rooms.

    Attributes:
        distances: from the target's centre, least and greatest.
        meshes: share of meshes among meshes and boxes.
        height: of boxes, which must be high to occlude views from above.
        sides: of boxes.
        hidden: least share occluded by one object, because space on the table is limited.
        walls: probabilities of 0, 1 and 2 walls.
    """

    distances: tuple[float, float]
    meshes: float
    height: tuple[float, float] = BLOCK_HEIGHT
    sides: tuple[float, float] = FOOTPRINT
    hidden: float = 0.0
    walls: tuple[float, float, float] = (1.0, 0.0, 0.0)


CLUTTER = {
    "light": Clutter((0.5, 2.6), 0.7, walls=(0.8, 0.2, 0.0)),
    "medium": Clutter((0.5, 2.3), 0.6, walls=(0.5, 0.4, 0.1)),
    "heavy": Clutter((0.5, 2.1), 0.4, (1.4, 2.9), FOOTPRINT, 0.008, (0.3, 0.4, 0.3)),
}
FURNITURE = Clutter((0.8, 3.5), 0.7, (0.6, 2.0), (0.3, 1.2))
BESIDE = Clutter((0.1, 0.5), 0.5, (0.03, 0.15), (0.05, 0.25))


@dataclass(frozen=True)
class SceneTask:
    """A scene to generate.

    Attributes:
        target: mesh file of the target, relative to the dataset folder.
        split: split of the target.
        level: clutter level, or ROOM.
        name: name of the scene.
        path: file to write.
    """

    target: str
    split: str
    level: str
    name: str
    path: Path


@dataclass(frozen=True)
class Meshes:
    """The mesh files that may stand around a target.

    Attributes:
        folder: dataset folder.
        files: paths below it, sorted.
        labels: class of each file; needed for rooms.
        unit: unit of length of the files; None if not known.
    """

    folder: Path
    files: tuple[str, ...]
    labels: dict[str, str] = field(default_factory=dict)
    unit: str | None = None


def draw_scenes(
    dataset: Path,
    out: Path,
    levels: Sequence[str] = tuple(CLUTTER_LEVELS),
    scenes: int | None = None,
    seed: int = 0,
    split: str | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    held_out: str | Path | None = None,
    unit: str | None = None,
) -> Iterator[tuple[str, str | None]]:
    """Generate scenes around the objects of a dataset folder and write their files.

    Existing scenes are kept; scenes depend only on the seed. The objects of each split are used in
    a random order, the same at all levels, each once before any is repeated. The objects around a
    target are from the same split. Files are CLASS/SPLIT/NAME@LEVEL-NUMBER.json, or
    CLASS/NAME@LEVEL-NUMBER.json if the dataset has no splits.

    Args:
        dataset: folder of meshes.
        out: folder of the scenes.
        levels: names of the clutter levels, or ROOM.
        scenes: number of scenes per level; None for one around each object.
        seed: of all random numbers.
        split: name of the split; None for all.
        workers: number of processes; None for one per core, 0 for this process.
        scheduler: address of a dask.distributed scheduler to use instead.
        held_out: name or path of a card, whose held-out objects are the targets; None for all.
        unit: of length of the mesh files, for rooms; None for furniture of known classes.

    Yields:
        The name of each scene and None, or the reason why it cannot be generated.
    """
    dataset = Path(dataset)
    out = Path(out)
    wanted = tasks(dataset, out, levels, scenes, seed, split, held_out)

    there = next(out.rglob(f"*@*{SUFFIX}"), None)
    if there is None:
        check_new(out, folder=True)
    elif SceneLayout.load(there).seed != seed:
        raise DatasetError(
            f"{there}: was drawn with another seed; give another folder or the same seed"
        )

    done = {task for task in wanted if task.path.exists()}
    yield from ((task.name, None) for task in wanted if task in done)
    todo = [task for task in wanted if task not in done]

    labels: dict[str, dict[str, str]] = {}
    for entry in list_dataset(dataset):
        file = entry.path.relative_to(dataset).as_posix()
        labels.setdefault(entry.split, {})[file] = entry.label
    meshes = {
        name: Meshes(dataset.absolute(), tuple(sorted(found)), found, unit)
        for name, found in labels.items()
    }

    with writing(out):
        for task, result in each(
            partial(_draw, meshes, seed),
            todo,
            workers,
            scheduler,
        ):
            reason = (
                f"{task.name}: {result}" if isinstance(result, WorkerDied) else result
            )
            yield task.name, reason


def tasks(
    dataset: Path,
    out: Path,
    levels: Sequence[str],
    scenes: int | None,
    seed: int,
    split: str | None,
    held_out: str | Path | None = None,
) -> list[SceneTask]:
    """List all scenes to generate, see ``draw_scenes``.

    Args:
        dataset: folder of meshes.
        out: folder of the scenes.
        levels: names of the clutter levels.
        scenes: number of scenes per level; None for one around each object.
        seed: of all random numbers.
        split: name of the split; None for all.
        held_out: name or path of a card, whose held-out objects are the targets; None for all.

    Returns:
        The scenes to generate.

    Raises:
        UsageError: a level, the number of scenes or the seed is not valid.
    """
    known = (*CLUTTER_LEVELS, ROOM)
    unknown = [level for level in levels if level not in known]
    if unknown or not levels:
        raise UsageError(
            f"the level of a scene is {', '.join(known)},"
            f" not {unknown[0] if unknown else 'none'}"
        )
    if scenes is not None:
        whole(scenes, "the number of scenes at each level", 1, MOST_SCENES)
    whole(seed, "a seed", 0, 2**31 - 1)

    found: list[SceneTask] = []
    entries = select(list_dataset(dataset), dataset, split, held_out)
    for one in dict.fromkeys(entry.split for entry in entries):
        mine = [entry for entry in entries if entry.split == one]
        order = np.random.default_rng([seed, *one.encode()]).permutation(len(mine))

        for number in range(len(mine) if scenes is None else scenes):
            entry = mine[order[number % len(mine)]]
            for level in levels:
                name = f"{entry.name}@{level}-{number // len(mine)}"
                path = out.absolute() / entry.label / one / f"{name}{SUFFIX}"
                found.append(
                    SceneTask(
                        entry.path.relative_to(dataset).as_posix(),
                        one,
                        level,
                        name,
                        path,
                    )
                )

    return found


def _draw(meshes: dict[str, Meshes], seed: int, task: SceneTask) -> str | None:
    """Generate one scene and write its file; returns the reason if that is not possible."""
    try:
        draw_scene(task.target, meshes[task.split], task.level, seed, task.name).save(
            task.path
        )
    except (MeshError, DatasetError) as error:
        return str(error)
    return None


@dataclass(frozen=True, eq=False)
class _Stage:
    """Where objects are placed around a target; lengths in its object radii.

    Attributes:
        low: least x and y of their footprints.
        high: greatest x and y.
        half: half the side of the table or floor.
        shares: visible shares of the target between which placing ends.
        fewest: least number of objects.
        walls: number of walls among them.
        blocks: walls of a room, its ceiling, and the floor below a table.
    """

    low: Float
    high: Float
    half: float
    shares: tuple[float, float]
    fewest: int
    walls: int = 0
    blocks: tuple[Block, ...] = ()


def draw_scene(
    target: str,
    meshes: Meshes,
    level: str,
    seed: int,
    name: str,
) -> SceneLayout:
    """Generate a scene around a target.

    Args:
        target: mesh file of the target, in the folder of the meshes.
        meshes: the folder and its files.
        level: of clutter, or ROOM.
        seed: of all random numbers, together with the name.
        name: of the scene.

    Returns:
        The scene.

    Raises:
        MeshError: the target cannot be used.
        UsageError: the size of a target in a room is not known.
        DatasetError: no layout has the visible share of the level.
    """
    rng = np.random.default_rng([seed, *name.encode()])
    mesh = cached_mesh(meshes.folder / target, MAX_FACES, meshes.unit)
    rest = UPRIGHT
    metres = None
    small = False
    others = [file for file in meshes.files if file != target]
    if level == ROOM:
        label = meshes.labels[target]
        metres = life_radius(mesh, label, rng)
        small = label in ON_TABLES or (mesh.metres or np.inf) < HAND_SIZED
        if meshes.unit is None:
            known = set() if small else set(LIFE_SIZES) - set(ON_TABLES)
            others = [file for file in others if meshes.labels[file] in known]
        elif small:
            poses = resting_poses(mesh)
            turn = poses[rng.integers(len(poses))]
            rest = tuple(turn.ravel().tolist())
            mesh = rotated(mesh, turn)
    others = [others[i] for i in rng.permutation(len(others))[:MESHES_TRIED]]
    hiding = _Hiding(mesh)

    for _ in range(SCENE_LAYOUTS_TRIED):
        stage = (
            _on_table(level, rng) if metres is None else _in_room(metres, small, rng)
        )
        how = CLUTTER[level] if metres is None else BESIDE if small else FURNITURE
        floor = float(mesh.vertices[:, 2].min())
        placed = _placed(mesh, others, meshes, hiding, stage, how, metres, rng)
        if placed is None:
            continue

        placed += [(block, block_item(block, floor)) for block in stage.blocks]
        items = tuple(item for _, item in placed)
        scene = TargetScene(mesh, items, stage.half, metres)
        pose = None
        if metres is not None:
            pose = _first_pose(scene, metres, rng)
            if pose is None:
                continue

        shares = visible_shares(
            scene,
            SCENE_VIEWS.poses,
            SHARE_PIXELS,
            SCENE_VIEWS.distance,
        )
        reachable = scene.reachable(SCENE_VIEWS.poses[:, :3, 3])
        things = [thing for thing, _ in placed]
        return SceneLayout(
            name=name,
            level=level,
            seed=seed,
            target=Placement(target, mesh_hash(meshes.folder / target), rotation=rest),
            objects=tuple(thing for thing in things if isinstance(thing, Placement)),
            blocks=tuple(thing for thing in things if isinstance(thing, Block)),
            visible=tuple(_rounded(*shares)),
            unreachable=tuple(np.flatnonzero(~reachable).tolist()),
            table=stage.half,
            label=meshes.labels.get(target, ""),
            metres=metres,
            pose=pose,
        )

    raise DatasetError(
        f"{meshes.folder / target}: no layout of {SCENE_LAYOUTS_TRIED} lets"
        f" {CLUTTER_LEVELS.get(level, LEAST_SHOWN):.0%} of it show"
    )


def _on_table(level: str, rng: np.random.Generator) -> _Stage:
    """Draw the number of walls and the visible share of a cluttered table."""
    goal = CLUTTER_LEVELS[level] + rng.uniform(-SPREAD, SPREAD)
    walls = int(rng.choice(3, p=CLUTTER[level].walls))
    half = np.full(2, SCENE_TABLE)
    shares = goal - VISIBLE_TOLERANCE, goal + VISIBLE_TOLERANCE
    return _Stage(-half, half, SCENE_TABLE, shares, FEWEST_AROUND + walls, walls)


def _in_room(metres: float, small: bool, rng: np.random.Generator) -> _Stage:
    """Draw a room around a target, which stands on its floor or, if small, on a table."""
    away = np.array(_rounded(*1 + rng.uniform(*ROOM_WALLS, 4) / metres))
    height, below, thick = _rounded(
        rng.uniform(*ROOM_HEIGHT) / metres,
        small * rng.uniform(*TABLE_HEIGHTS) / metres,
        WALL_DEPTH / metres,
    )
    side = float(2 * away.max())
    blocks = [Block(0.0, 0.0, 0.0, side, side, thick, z=height - below)]
    if small:
        blocks.append(Block(0.0, 0.0, 0.0, side, side, thick, z=-below - thick))
    for quarter, far in enumerate((away + thick / 2).tolist()):
        x, y = ((far, 0.0), (0.0, far), (-far, 0.0), (0.0, -far))[quarter]
        azimuth = quarter * np.pi / 2
        blocks.append(Block(x, y, azimuth, thick, side, height, wall=True, z=-below))

    half = max(1.5, *_rounded(rng.uniform(*TABLE_HALVES) / metres))
    low = -away[2:]
    high = away[:2]
    if small:
        low = np.full(2, -half)
        high = -low
    return _Stage(
        low,
        high,
        half if small else side / 2,
        (LEAST_IN_ROOM, 1.0),
        int(rng.integers(1, FEWEST_AROUND + 1)),
        blocks=tuple(blocks),
    )


def _first_pose(
    scene: TargetScene, metres: float, rng: np.random.Generator
) -> tuple[float, ...] | None:
    """Find a level pose from which the target is visible, (16,), metres; None if there is none."""
    distances, elevations, free = FROM_TABLE if metres < HAND_SIZED else FROM_FLOOR
    for _ in range(VIEWS_TRIED):
        away = max(rng.uniform(*distances), metres + free) / metres
        elevation = np.radians(rng.uniform(*elevations, 1))
        pose = look_at_origin(elevation, rng.uniform(0, 2 * np.pi, 1), away)[0]
        pose[:3, 3] += rng.normal(0, AIM_OFF * away, 3)
        if not scene.reachable(pose[None, :3, 3])[0]:
            continue
        shown = OccludedCamera(scene, SHARE_PIXELS, away).visible_share(pose)
        if shown >= LEAST_SHOWN:
            pose[:3, 3] *= metres
            return tuple(np.round(pose, 6).ravel().tolist())
    return None


class _Hiding:
    """Rays from 40 cameras to the visible points of a target's surface."""

    def __init__(self, mesh: Mesh) -> None:
        camera = SimulatedCamera(mesh, COARSE_PICTURE, SCENE_VIEWS.distance)
        eyes = []
        rays = []
        views = []

        for view, pose in enumerate(SCENE_VIEWS.poses):
            seen = camera.observe(pose)
            rows, columns = np.nonzero(seen.depth)
            ahead = PinholeCamera.of(seen.intrinsics, seen.depth.shape).rays_through(
                rows,
                columns,
            )
            rays.append(seen.depth[rows, columns, None] * ahead @ pose[:3, :3].T)
            eyes.append(np.broadcast_to(pose[:3, 3], rays[-1].shape))
            views.append(np.full(len(rows), view))

        self.eyes, self.rays = (
            np.concatenate(rows).astype(np.float32) for rows in (eyes, rays)
        )
        self.views = np.concatenate(views)
        self.whole = np.maximum(np.bincount(self.views, minlength=len(SCENE_VIEWS)), 1)

    def by(self, item: Item, still: Mask) -> Mask:
        """Return the rays that an item blocks.

        Args:
            item: the item.
            still: the rays that nothing else blocks, (R,) bool.

        Returns:
            Whether each ray is blocked by the item, (R,) bool.
        """
        length, _ = RayCaster([(item.vertices, item.faces)]).cast(
            self.eyes[still],
            self.rays[still],
        )
        hidden = np.zeros(len(still), bool)
        hidden[still] = length < 1
        return hidden

    def share(self, still: Mask) -> float:
        """Return the visible share of the target, averaged over the views."""
        return float(
            (
                np.bincount(self.views[still], minlength=len(SCENE_VIEWS)) / self.whole
            ).mean()
        )


PlacedItem = tuple[Placement | Block, Item]


def _placed(
    mesh: Mesh,
    others: Sequence[str],
    meshes: Meshes,
    hiding: _Hiding,
    stage: _Stage,
    how: Clutter,
    metres: float | None,
    rng: np.random.Generator,
) -> list[PlacedItem] | None:
    """Place objects that occlude a given share of a target; None if that fails."""
    floor = float(mesh.vertices[:, 2].min())
    lowest, highest = stage.shares
    side = 2 * float(np.abs([stage.low, stage.high]).max())
    ground = HeightMap(side, np.zeros(2), floor)
    ground.stands((mesh.vertices, mesh.faces), 0.0)
    placed: list[PlacedItem] = []
    free = np.ones(len(hiding.views), bool)

    for _ in range(THINGS_TRIED):
        share = hiding.share(free)
        if len(placed) >= stage.fewest and share <= highest:
            return placed
        if len(placed) == MOST_AROUND:
            return None

        counted = sum(isinstance(thing, Placement) for thing, _ in placed)
        short = metres is None and bool(others) and counted < FEWEST_OBJECTS
        try:
            if len(placed) < stage.walls:
                thing: Placement | Block = _wall(rng)
            else:
                thing = _thing(others, meshes, how, metres, short, rng)
            item = _stood(thing, meshes, floor)
        except MeshError:  # too large or damaged
            continue
        inside = (item.footprint > stage.low) & (item.footprint < stage.high)
        if not inside.all():
            continue

        left = free & ~hiding.by(item, free)
        if not lowest <= hiding.share(left) <= share - how.hidden * (not short):
            continue
        if ground.stands((item.vertices, item.faces), THING_GAP):
            placed.append((thing, item))
            free = left
    return None


def _thing(
    others: Sequence[str],
    meshes: Meshes,
    how: Clutter,
    metres: float | None,
    short: bool,
    rng: np.random.Generator,
) -> Placement | Block:
    """Draw a mesh or a box at a random position; a mesh if there are too few."""
    unit = 1.0 if metres is None else 1 / metres
    away = unit * rng.uniform(*how.distances)
    towards = rng.uniform(0, 2 * np.pi)
    azimuth = rng.uniform(0, 2 * np.pi)
    there = away * np.cos(towards), away * np.sin(towards), azimuth

    if short or (others and rng.random() < how.meshes):
        file = others[int(rng.integers(len(others)))]
        radius = rng.uniform(*OBJECT_RADIUS)
        if metres is not None:
            other = cached_mesh(meshes.folder / file, MOST_FACES, meshes.unit)
            radius = unit * life_radius(other, meshes.labels[file], rng)
        x, y, azimuth, radius = _rounded(*there, radius)
        sha256 = mesh_hash(meshes.folder / file)
        return Placement(file, sha256, x, y, azimuth, radius)

    x, y, azimuth, *size = _rounded(
        *there,
        *unit * rng.uniform(*how.sides, 2),
        unit * rng.uniform(*how.height),
    )
    return Block(x, y, azimuth, size[0], size[1], size[2])


def _wall(rng: np.random.Generator) -> Block:
    """Draw a wall perpendicular to the direction from the target."""
    away = rng.uniform(*WALL_AWAY)
    towards = rng.uniform(0, 2 * np.pi)
    lean = rng.uniform(-0.3, 0.3)
    x = away * np.cos(towards)
    y = away * np.sin(towards)
    azimuth = towards + np.pi / 2 + lean
    x, y, azimuth, width, height = _rounded(
        x,
        y,
        azimuth,
        rng.uniform(*WALL_WIDTH),
        rng.uniform(*WALL_HEIGHT),
    )
    return Block(x, y, azimuth, width, WALL_DEPTH, height, wall=True)


def _stood(thing: Placement | Block, meshes: Meshes, floor: float) -> Item:
    """Place an object on the table."""
    if isinstance(thing, Block):
        return block_item(thing, floor)
    mesh = cached_mesh(meshes.folder / thing.mesh, MOST_FACES, meshes.unit)
    return place(mesh, thing, floor)


def _rounded(*values: float) -> list[float]:
    """Round values to a few digits, which JSON represents exactly."""
    return [round(float(value), 4) for value in values]
