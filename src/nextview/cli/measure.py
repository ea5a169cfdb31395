"""``nextview measure``: view measures of every object, into the store."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro

from nextview.mesh_format import MAX_FACES


def measure(
    store: tyro.conf.Positional[Path],
    meshes: tyro.conf.Positional[Path | None] = None,
    /,
    measures: tuple[str, ...] = (),
    max_faces: int = MAX_FACES,
    split: Literal["train", "test"] | None = None,
    held_out: str | None = None,
    objects: int | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
) -> None:
    """Compute view measures of every rendered object and keep them in the store. Resumes where it was.

    Args:
        store: view store made by nextview render.
        meshes: the dataset folder that it was rendered from: measures that need the mesh find there which face each
            pixel shows.
        measures: names (nextview measures lists them), all, or MODULE:FUNCTION for one of your own; by default all that
            need the depth alone, or with MESHES all.
        max_faces: of a mesh, as for nextview render.
        split: only this split.
        held_out: only the objects that this model, bundled or a card (NAME.json), calls held out of its training.
        objects: only so many of these, spread evenly; twice as many later hold the same.
        workers: processes; one for each core by default.
        scheduler: address of a dask.distributed scheduler to use instead.
    """
    from rich.table import Table

    from nextview.cli.progress import console, track
    from nextview.data.measuring import Cost
    from nextview.data.measuring import measure as measure_store
    from nextview.data.splits import some_objects
    from nextview.data.store import ViewStore

    cost = Cost()
    views = ViewStore.open(store)
    chosen = some_objects(views, split, held_out, objects)
    steps = measure_store(store, measures, workers, scheduler, meshes, max_faces, cost, chosen)
    before, total = next(steps)
    track((done for done, _ in steps), total, f"measuring {store.name}", before, len(views.sphere))
    if cost.views:
        peak = f"{cost.peak / 2**20:,.0f} MiB in the largest process"
        table = Table("measure", "views/s of one core", title=f"{cost.views:,} views, {peak}")
        table.columns[1].justify = "right"
        for name, rate in cost.per_second().items():
            table.add_row(name, f"{rate:,.0f}")
        console.print(table)
