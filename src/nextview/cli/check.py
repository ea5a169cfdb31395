"""``nextview check``: whether a store holds what it says."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import tyro

from nextview.errors import DatasetError


def check(
    store: tyro.conf.Positional[Path], /, repair: bool = False, workers: int | None = None, scheduler: str | None = None
) -> None:
    """Read every object of a view store and hold its arrays against each other. Ends with status 2 if one is damaged.

    Args:
        store: view store made by nextview render.
        repair: take damaged objects out, so that the next nextview render makes them anew.
        workers: processes; one for each core by default.
        scheduler: address of a dask.distributed scheduler to use instead.
    """
    from nextview.cli.progress import console, track
    from nextview.data.checking import check as check_store
    from nextview.data.checking import mend
    from nextview.data.store import ViewStore

    if repair:
        mend(store)
    views = ViewStore.open(store)
    damaged: list[str] = []

    def checked() -> Iterator[int]:
        for n, (name, problem) in enumerate(check_store(store, repair, workers, scheduler), 1):
            if problem:
                damaged.append(f"{name}: {problem}")
            yield n

    done = int(views.done.sum()) + len(views.lost)
    track(checked(), done, f"checking {store.name}", views=len(views.sphere))
    for line in damaged:
        console.print(line, style="red", highlight=False)
    for reason in views.failures.values():
        console.print(f"left out: {reason}", style="yellow", highlight=False)
    missing = len(views) - done - len(views.failures)
    console.print(
        f"{store}: {done - len(damaged)} objects are sound, {len(damaged)} damaged, {missing} not rendered yet"
    )
    if damaged:
        what = "nextview render makes them anew" if repair else "with --repair, nextview render makes them anew"
        raise DatasetError(f"{store}: {len(damaged)} of {done} objects are damaged; {what}")
