"""``nextview worlds``: tables with several things on them, of which one is meant and half hidden."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro


def worlds(
    meshes: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    /,
    level: tuple[Literal["light", "medium", "heavy"], ...] = ("light", "medium", "heavy"),
    worlds: int | None = None,
    split: Literal["train", "test"] | None = None,
    held_out: Path | None = None,
    seed: int = 0,
    workers: int | None = None,
    scheduler: str | None = None,
) -> None:
    """Draw worlds: a target at rest on a table among other objects, boxes and walls that hide parts of it.

    Each world is a small JSON file that names meshes and says where they stand; the same seed draws the same files.
    Resumes where it was. Objects of one split stand only among objects of that split. Render them, and go on as with
    any other store:

    nextview worlds ModelNet10 worlds --split test --worlds 100

    nextview render worlds worlds.zarr --meshes ModelNet10

    nextview predict worlds.zarr worlds.npz

    Args:
        meshes: dataset folder, CLASS/train|test/MESH or CLASS/MESH.
        out: folder for the worlds; those that are there are kept.
        level: how much of the target shows, on the average over the 40 views: light 85 %, medium 65 %, heavy 45 %.
        worlds: how many at each level, of each split; by default one around each object.
        split: only this one.
        held_out: only around objects that the model of this card (NAME.json) calls held out of its training: worlds for
            learning policies.
        seed: decides which objects are targets, and all that stands around them.
        workers: processes; one for each core by default.
        scheduler: address of a dask.distributed scheduler to use instead, as tcp://HOST:8786.
    """
    from nextview.cli.progress import console, track
    from nextview.data.world_drawing import draw_worlds, tasks
    from nextview.errors import DatasetError

    total = len(tasks(meshes, out, level, worlds, seed, split, held_out))
    reasons: list[str] = []

    def count(n: int, reason: str | None) -> int:
        reasons.extend([] if reason is None else [reason])
        return n

    drawn = draw_worlds(meshes, out, level, worlds, seed, split, workers, scheduler, held_out)
    track((count(n, reason) for n, (_, reason) in enumerate(drawn, 1)), total, f"drawing {out.name}")
    for reason in reasons:
        console.print(f"left out: {reason}", style="yellow", highlight=False)
    if len(reasons) == total:
        raise DatasetError(f"{out}: none of the {total} worlds can be drawn; see the reasons above")
    console.print(f"{out}: {total - len(reasons)} worlds; next: nextview render {out} STORE --meshes {meshes}")
