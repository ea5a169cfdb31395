"""``nextview-lab check``: verify a view store."""

from pathlib import Path

from nextview.cli.common_options import Workers
from nextview.cli.progress import console, track_all
from nextview.errors import DatasetError
from nextview_lab.data import store as view_store
from nextview_lab.data.store import ViewStore


def check(
    store: Path,
    /,
    workers: Workers = Workers(),
) -> None:
    """Verify the checksum of every object in a view store.

    The exit status is 2 if an object is damaged.

    Args:
        store: view store made by nextview-lab render.
    """
    views = ViewStore.open(store)
    done = int(views.done.sum())

    damaged = track_all(
        view_store.check(store, **vars(workers)),
        done,
        f"checking {store.name}",
    )
    for reason in views.attributes.failures.values():
        console.print(f"left out: {reason}", style="yellow")

    missing = len(views) - done - len(views.attributes.failures)
    console.print(
        f"{store}: {done - len(damaged)} objects are sound, {len(damaged)} damaged, {missing} not"
        " rendered"
    )

    if damaged:
        raise DatasetError(
            f"{store}: {len(damaged)} of {done} objects are damaged; remove the store and render"
            " again"
        )
