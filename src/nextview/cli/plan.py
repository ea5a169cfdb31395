"""``nextview plan``: where policies that decide by geometry go, into the store, for the benchmark."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro


def plan(
    store: tyro.conf.Positional[Path],
    names: tyro.conf.Positional[tuple[str, ...]] = (),
    /,
    split: Literal["train", "test"] | None = None,
    held_out: str | None = None,
    objects: int | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
) -> None:
    """Find the way of geometric policies from every first view of every object, and keep it in the store.

    They decide by the depth seen so far, which predictions do not hold; nextview benchmark takes them from here.
    Resumes where it was.

    Args:
        store: view store made by nextview render.
        names: volumetric, coverage, or MODULE:CLASS for one of your own; the first two by default.
        split: only this split.
        held_out: only the objects that this model, bundled or a card (NAME.json), calls held out of its training.
        objects: only so many of these, spread evenly; twice as many later hold the same.
        workers: processes; one for each core by default.
        scheduler: address of a dask.distributed scheduler to use instead.
    """
    from nextview.cli.progress import track
    from nextview.data.planning import plan as plan_store
    from nextview.data.splits import some_objects
    from nextview.data.store import ViewStore

    chosen = some_objects(ViewStore.open(store), split, held_out, objects)
    steps = plan_store(store, names, workers, scheduler, chosen)
    before, total = next(steps)
    track((done for done, _ in steps), total, f"planning {store.name}", before)
