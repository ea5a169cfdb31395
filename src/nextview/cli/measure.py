"""``nextview measure``: view measures of every object, into the store."""

from __future__ import annotations

from pathlib import Path

import tyro


def measure(
    store: tyro.conf.Positional[Path],
    names: tyro.conf.Positional[tuple[str, ...]] = (),
    /,
    workers: int | None = None,
    scheduler: str | None = None,
) -> None:
    """Compute view measures of every rendered object and keep them in the store. Resumes where it was.

    Args:
        store: view store made by nextview render.
        names: depth_entropy, silhouette_area, silhouette_length, depth_distribution, max_depth; all by default.
        workers: processes; one for each core by default.
        scheduler: address of a dask.distributed scheduler to use instead.
    """
    from nextview.cli.progress import track
    from nextview.data.measuring import measure as measure_store
    from nextview.data.store import ViewStore
    from nextview.measures.registry import MEASURES

    steps = measure_store(store, names or tuple(MEASURES), workers, scheduler)
    before, total = next(steps)
    views = len(ViewStore.open(store).sphere)
    track((done for done, _ in steps), total, f"measuring {store.name}", before, views)
