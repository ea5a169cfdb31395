"""Generate a folder of random scenes around the objects of a dataset, in parallel and resumable.

Objects are placed at free positions around a target until the visible share of the target is as
required. There is no physics simulation: they stand upright on the table. Their footprints, which
are convex hulls, never overlap.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from nextview.checks import whole
from nextview.data.folders import list_dataset, select
from nextview.data.pool import WorkerDied, each
from nextview.errors import DatasetError, MeshError, UsageError
from nextview.files import check_new
from nextview.geometry.mesh import Mesh
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster
from nextview.geometry.viewsphere import ViewSphere
from nextview.simulation.boxes import BLOCK_HEIGHT, FOOTPRINT
from nextview.simulation.simulated import SimulatedCamera
from nextview.types import Mask
from nextview_lab.data.store import writing
from nextview_lab.worlds.scene import (
    SCENE_TABLE,
    Item,
    TargetScene,
    block_item,
    cached_mesh,
    footprint,
    mesh_hash,
    place,
    separation,
)
from nextview_lab.worlds.scene_cameras import visible_shares
from nextview_lab.worlds.scene_layout import (
    CLUTTER_LEVELS,
    SUFFIX,
    Block,
    Placement,
    SceneLayout,
)

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
THING_GAP = 0.04  # least distance between objects, object radii
# distance from the target's centre, object radii
CLUTTER_DISTANCES = {"light": (0.5, 2.6), "medium": (0.5, 2.3), "heavy": (0.5, 2.1)}
OBJECT_RADIUS = (0.5, 1.1)
# least number of meshes among the objects, if there are any
FEWEST_OBJECTS = 2
# share of meshes among meshes and boxes
OBJECTS = {"light": 0.7, "medium": 0.6, "heavy": 0.4}
# boxes must be high to occlude views from above
BOX_HEIGHT = {"light": BLOCK_HEIGHT, "medium": BLOCK_HEIGHT, "heavy": (1.4, 2.9)}
# least share occluded by one object, because space on the table is limited
LEAST_HIDDEN = {"light": 0.0, "medium": 0.0, "heavy": 0.008}
# probabilities of 0, 1 and 2 walls
WALLS = {"light": (0.8, 0.2, 0.0), "medium": (0.5, 0.4, 0.1), "heavy": (0.3, 0.4, 0.3)}
WALL_AWAY = (1.2, 1.9)
WALL_WIDTH = (2.0, 3.5)
WALL_DEPTH = 0.1
WALL_HEIGHT = (1.0, 2.6)
# meshes tried per scene, each at several positions, because loading them is slow
MESHES_TRIED = 8
# largest number of triangles of an object around the target, to limit the run time
MOST_FACES = 100_000
MOST_SCENES = 100_000  # per level and split


@dataclass(frozen=True)
class SceneTask:
    """A scene to generate.

    Attributes:
        target: mesh file of the target, relative to the dataset folder.
        split: split of the target.
        level: clutter level.
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
    """

    folder: Path
    files: tuple[str, ...]


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
) -> Iterator[tuple[str, str | None]]:
    """Generate scenes around the objects of a dataset folder and write their files.

    Existing scenes are kept; scenes depend only on the seed. The objects of each split are used in
    a random order, the same at all levels, each once before any is repeated. The objects around a
    target are from the same split. Files are CLASS/SPLIT/NAME@LEVEL-NUMBER.json, or
    CLASS/NAME@LEVEL-NUMBER.json if the dataset has no splits.

    Args:
        dataset: folder of meshes.
        out: folder of the scenes.
        levels: names of the clutter levels.
        scenes: number of scenes per level; None for one around each object.
        seed: of all random numbers.
        split: name of the split; None for all.
        workers: number of processes; None for one per core, 0 for this process.
        scheduler: address of a dask.distributed scheduler to use instead.
        held_out: name or path of a card, whose held-out objects are the targets; None for all.

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

    files: dict[str, list[str]] = {}
    for entry in list_dataset(dataset):
        files.setdefault(entry.split, []).append(
            entry.path.relative_to(dataset).as_posix()
        )
    meshes = {
        name: Meshes(dataset.absolute(), tuple(sorted(found)))
        for name, found in files.items()
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
    unknown = [level for level in levels if level not in CLUTTER_LEVELS]
    if unknown or not levels:
        raise UsageError(
            f"the level of a scene is {', '.join(CLUTTER_LEVELS)},"
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
        level: of clutter.
        seed: of all random numbers, together with the name.
        name: of the scene.

    Returns:
        The scene.

    Raises:
        MeshError: the target cannot be used.
        DatasetError: no layout has the visible share of the level.
    """
    rng = np.random.default_rng([seed, *name.encode()])
    mesh = cached_mesh(meshes.folder / target)
    others = [file for file in meshes.files if file != target]
    others = [others[i] for i in rng.permutation(len(others))[:MESHES_TRIED]]
    hiding = _Hiding(mesh)

    for _ in range(SCENE_LAYOUTS_TRIED):
        goal = CLUTTER_LEVELS[level] + rng.uniform(-SPREAD, SPREAD)
        placed = _layout(mesh, others, meshes.folder, hiding, level, goal, rng)
        if placed is None:
            continue

        scene = TargetScene(mesh, tuple(item for _, item in placed))
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
            target=Placement(target, mesh_hash(meshes.folder / target)),
            objects=tuple(thing for thing in things if isinstance(thing, Placement)),
            blocks=tuple(thing for thing in things if isinstance(thing, Block)),
            visible=tuple(_rounded(*shares)),
            unreachable=tuple(np.flatnonzero(~reachable).tolist()),
        )

    raise DatasetError(
        f"{meshes.folder / target}: no layout of {SCENE_LAYOUTS_TRIED} lets"
        f" {CLUTTER_LEVELS[level]:.0%} of it show"
    )


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


def _layout(
    mesh: Mesh,
    others: Sequence[str],
    folder: Path,
    hiding: _Hiding,
    level: str,
    goal: float,
    rng: np.random.Generator,
) -> list[PlacedItem] | None:
    """Place objects that occlude a given share of a target; None if that fails."""
    walls = int(rng.choice(3, p=WALLS[level]))
    middle = footprint(mesh.vertices)
    floor = float(mesh.vertices[:, 2].min())
    placed: list[PlacedItem] = []
    free = np.ones(len(hiding.views), bool)

    for _ in range(THINGS_TRIED):
        share = hiding.share(free)
        if len(placed) >= FEWEST_AROUND + walls and share <= goal + VISIBLE_TOLERANCE:
            return placed
        if len(placed) == MOST_AROUND:
            return None

        short = (
            bool(others)
            and sum(isinstance(thing, Placement) for thing, _ in placed)
            < FEWEST_OBJECTS
        )
        thing = (
            _wall(rng)
            if len(placed) < walls
            else _thing(others, folder, level, short, rng)
        )
        item = _stood(thing, folder, floor)
        if item is None or np.abs(item.footprint).max() > SCENE_TABLE:
            continue

        # skip it if it overlaps with others
        if (
            min(
                separation(item.footprint, other)
                for other in [middle, *(i.footprint for _, i in placed)]
            )
            < THING_GAP
        ):
            continue

        left = free & ~hiding.by(item, free)
        if (
            goal - VISIBLE_TOLERANCE
            <= hiding.share(left)
            <= share - LEAST_HIDDEN[level] * (not short)
        ):
            placed.append((thing, item))
            free = left
    return None


def _thing(
    others: Sequence[str],
    folder: Path,
    level: str,
    short: bool,
    rng: np.random.Generator,
) -> Placement | Block:
    """Draw a mesh or a box at a random position; a mesh if there are too few."""
    away = rng.uniform(*CLUTTER_DISTANCES[level])
    towards = rng.uniform(0, 2 * np.pi)
    azimuth = rng.uniform(0, 2 * np.pi)
    there = away * np.cos(towards), away * np.sin(towards), azimuth

    if short or (others and rng.random() < OBJECTS[level]):
        file = others[int(rng.integers(len(others)))]
        return Placement(
            file,
            mesh_hash(folder / file),
            *_rounded(*there, rng.uniform(*OBJECT_RADIUS)),
        )

    x, y, azimuth, *size = _rounded(
        *there,
        *rng.uniform(*FOOTPRINT, 2),
        rng.uniform(*BOX_HEIGHT[level]),
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


def _stood(thing: Placement | Block, folder: Path, floor: float) -> Item | None:
    """Place an object on the table; None for a mesh that is too large or damaged."""
    try:
        if isinstance(thing, Block):
            return block_item(thing, floor)
        return place(cached_mesh(folder / thing.mesh, MOST_FACES), thing, floor)
    except MeshError:
        return None


def _rounded(*values: float) -> list[float]:
    """Round values to a few digits, which JSON represents exactly."""
    return [round(float(value), 4) for value in values]
