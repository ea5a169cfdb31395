"""Draw a folder of scenes around the objects of a dataset, on all cores, resumable."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from nextview.checks import whole
from nextview.data.folders import Entry, list_dataset, select
from nextview.data.pool import each
from nextview.data.store import writing
from nextview.errors import DatasetError, MeshError, UsageError
from nextview.files import check_new
from nextview.simulation.scene_drawing import Meshes, draw_scene
from nextview.simulation.scene_layout import LEVELS, SUFFIX, SceneLayout

MOST = 100_000
"""Scenes at each level, of each split."""


@dataclass(frozen=True)
class Task:
    """One scene to draw: its target's mesh file (relative to the dataset), split, level of clutter, name and file."""

    target: str
    split: str
    level: str
    name: str
    path: Path


def draw_scenes(
    dataset: Path,
    out: Path,
    levels: Sequence[str] = tuple(LEVELS),
    scenes: int | None = None,
    seed: int = 0,
    split: str | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    held_out: Path | None = None,
) -> Iterator[tuple[str, str | None]]:
    """Draw the scenes that are not in the folder yet. Which they are depends on the seed alone.

    The objects of each split are taken in an order that the seed draws, each once before any is taken again, the same
    at all levels. What stands around an object is of its own split. Files are CLASS/SPLIT/NAME@LEVEL-NUMBER.json, or
    CLASS/NAME@LEVEL-NUMBER.json where the dataset has no splits.

    Args:
        dataset, out: folder of meshes, and of scenes.
        levels, scenes, seed, split, held_out: as of ``nextview scenes``.
        workers, scheduler: see ``pool.each``; a scheduler's workers see the same files.

    Yields:
        (name, None) for each scene that is there, (name, reason) for one that cannot be drawn.
    """
    dataset, out = Path(dataset), Path(out)
    wanted = tasks(dataset, out, levels, scenes, seed, split, held_out)
    there = next(out.rglob(f"*@*{SUFFIX}"), None)
    if there is None:
        check_new(out, folder=True)
    elif SceneLayout.load(there).seed != seed:
        raise DatasetError(f"{there}: was drawn with another seed; give another folder or the same seed")
    done = {task for task in wanted if task.path.exists()}
    yield from ((task.name, None) for task in wanted if task in done)
    todo = [task for task in wanted if task not in done]
    files: dict[str, list[str]] = {}
    for entry in list_dataset(dataset):
        files.setdefault(entry.split, []).append(_relative(entry, dataset))
    meshes = {name: Meshes(dataset.absolute(), tuple(sorted(found))) for name, found in files.items()}
    with writing(out):
        for task, reason in each(partial(_draw, meshes, seed), todo, workers, scheduler):
            yield task.name, None if reason is None else f"{reason}"


def tasks(
    dataset: Path,
    out: Path,
    levels: Sequence[str],
    scenes: int | None,
    seed: int,
    split: str | None,
    held_out: Path | None = None,
) -> list[Task]:
    """All scenes that are asked for, see ``draw_scenes``."""
    unknown = [level for level in levels if level not in LEVELS]
    if unknown or not levels:
        raise UsageError(f"the level of a scene is {', '.join(LEVELS)}, not {unknown[0] if unknown else 'none'}")
    if scenes is not None:
        whole(scenes, "the number of scenes at each level", 1, MOST)
    whole(seed, "a seed", 0, 2**31 - 1)
    found: list[Task] = []
    entries = select(list_dataset(dataset), dataset, split, held_out)
    for one in dict.fromkeys(entry.split for entry in entries):
        mine = [entry for entry in entries if entry.split == one]
        order = np.random.default_rng([seed, *one.encode()]).permutation(len(mine))
        for number in range(len(mine) if scenes is None else scenes):
            entry = mine[order[number % len(mine)]]
            for level in levels:
                name = f"{entry.name}@{level}-{number // len(mine)}"
                path = out.absolute() / entry.label / one / f"{name}{SUFFIX}"
                found.append(Task(_relative(entry, dataset), one, level, name, path))
    return found


def _relative(entry: Entry, dataset: Path) -> str:
    return entry.path.relative_to(dataset).as_posix()


def _draw(meshes: dict[str, Meshes], seed: int, task: Task) -> str | None:
    """Draw one scene into its file; the reason if that cannot be."""
    try:
        draw_scene(task.target, meshes[task.split], task.level, seed, task.name).save(task.path)
    except (MeshError, DatasetError) as error:
        return str(error)
    return None
