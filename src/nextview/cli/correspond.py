"""``nextview correspond``: point correspondence between the views, as arrays and as the thesis's figure 14."""

from __future__ import annotations

from pathlib import Path

import tyro

from nextview.errors import DatasetError


def correspond(
    store: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path] = Path("correspondence"),
    /,
    label: str | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
) -> None:
    """How much of what one view shows is seen from each other view, averaged over the objects. Resumes where it was.

    Every object's share (V, V) is kept in the store; OUT.npz gets the mean ``share`` and the mean ``maps``, each row of
    an object scaled to [0, 1] first, and OUT.png the picture.

    Args:
        store: view store made by nextview render.
        out: name of the two files, without a suffix.
        label: average over this class only.
        workers: processes; one for each core by default.
        scheduler: address of a dask.distributed scheduler to use instead.
    """
    import numpy as np

    from nextview.cli.progress import console, track
    from nextview.data.correspond import ARRAY, correspondence_maps
    from nextview.data.correspond import correspond as correspond_store
    from nextview.data.store import ViewStore
    from nextview.outputs import written_whole
    from nextview.report.store_figures import correspondence_figure, save

    views = ViewStore.open(store)
    if label is not None and label not in views.classes:
        raise DatasetError(f"{store}: has no class {label!r}; there are {', '.join(views.classes)}")
    steps = correspond_store(store, workers, scheduler)
    before, total = next(steps)
    track((done for done, _ in steps), total, f"corresponding {store.name}", before, len(views.sphere))

    of = views.done & (True if label is None else views.labels == views.classes.index(label))
    if not of.any():
        raise DatasetError(f"{store}: holds no rendered object" + (f" of the class {label!r}" if label else ""))
    share = ViewStore.open(store).rows(ARRAY)[of]
    maps = correspondence_maps(share).mean(0)
    arrays, picture = out.with_name(out.name + ".npz"), out.with_name(out.name + ".png")
    with written_whole(arrays) as part:
        np.savez(part, share=share.mean(0), maps=maps, objects=int(of.sum()))
    title = f"Point correspondence, mean over {int(of.sum()):,} objects" + (f" of the class {label}" if label else "")
    save(correspondence_figure(maps, views.sphere, title), picture)
    console.print(f"{arrays}\n{picture}")
