"""``nextview render``: every view of every object of a dataset, into one store."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro


def render(
    dataset: tyro.conf.Positional[Path],
    store: tyro.conf.Positional[Path],
    /,
    sphere: Literal["40", "12"] = "40",
    azimuths: int | None = None,
    size: int = 224,
    split: Literal["train", "test"] | None = None,
    stretch: float = 0.0,
    turn: bool = False,
    seed: int = 0,
    workers: int | None = None,
) -> None:
    """Render a dataset folder (CLASS/train|test/MESH or CLASS/MESH) into a view store. Resumes where it was.

    Args:
        dataset: folder of meshes.
        store: the store to make or to complete.
        sphere: viewpoints.
        azimuths: views on each ring, if not the sphere's own.
        size: side of the images, pixels.
        split: only this split.
        stretch: scale each axis of each mesh by a random factor between 1/(1 + STRETCH) and 1 + STRETCH.
        turn: turn each mesh about the vertical by a random angle.
        seed: decides the stretch and the turn of each mesh.
        workers: processes; one for each core by default.
    """
    from dataclasses import replace

    from nextview.cli.progress import console, track
    from nextview.data.folders import list_dataset
    from nextview.data.render import Deform
    from nextview.data.render import render as render_dataset
    from nextview.viewsphere import ViewSphere

    views = ViewSphere.named(sphere)
    if azimuths:
        views = replace(views, azimuths=azimuths)
    total = sum(split in (None, entry.split) for entry in list_dataset(dataset))
    failures: list[str] = []

    def done():  # noqa: ANN202
        jobs = render_dataset(dataset, store, views, size, seed, Deform(stretch, turn), split, workers)
        for n, (_, reason) in enumerate(jobs, 1):
            if reason:
                failures.append(reason)
            yield n

    track(done(), total, f"rendering {store.name}")
    for reason in failures:
        console.print(f"left out: {reason}", style="yellow")
