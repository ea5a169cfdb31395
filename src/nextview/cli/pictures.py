"""``nextview inspect`` and ``nextview overlap``: pictures of a view store."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path

import numpy as np

from nextview.cli.progress import console, follow
from nextview.cli.sources import check_file
from nextview.data.overlap import overlap as overlap_store
from nextview.data.overlap import overlap_maps
from nextview.data.store import OVERLAP, ViewStore
from nextview.errors import DatasetError
from nextview.files import check_new, new_file
from nextview.viewers.store_figures import object_figure, overlap_figure, store_figure, summary


def inspect(
    store: Path,  # view store made by nextview render
    out: Path | None = None,  # picture to make (PNG, PDF or SVG); STORE.png or OBJECT.png here if not given
    /,
    object: str | None = None,  # name of the object to draw instead of the whole store
    overwrite: bool = False,  # replace the picture if it exists
) -> None:
    """Draw what a view store holds: classes, counts, failures; or one object from all sides."""
    views = ViewStore.open(store)
    out = out or Path(f"{object or store.resolve().stem}.png")
    check_file(out, overwrite)
    if object is not None:
        if object not in views.names:
            near = get_close_matches(object, views.names, 3, 0) or views.names[:3]
            raise DatasetError(f"{store}: has no object {object!r}; there are {', '.join(near)} and others")
        row = views.names.index(object)
        if not views.done[row]:
            raise DatasetError(f"{store}: {object} is not rendered ({views.failures.get(object, 'not yet')})")
        figure = object_figure(views, row)
    else:
        for what, value in summary(views).items():
            console.print(f"{what:22} {value}", soft_wrap=True)
        for reason in views.failures.values():
            console.print(f"left out: {reason}", style="yellow")
        figure = store_figure(views)
    with new_file(out, overwrite) as part:
        figure.savefig(part, dpi=150, facecolor="white")
    console.print(f"{out}")


def overlap(
    store: Path,  # view store made by nextview render
    out: Path = Path("overlap"),  # name of the two files, without a suffix
    /,
    label: str | None = None,  # average over this class only
    workers: int | None = None,  # processes; one for each core by default
    scheduler: str | None = None,  # address of a dask.distributed scheduler to use instead
    overwrite: bool = False,  # replace the two files if they exist
) -> None:
    """How much of what one view shows is seen from each other view, averaged over the objects. Resumes where it was.

    Every object's share (V, V) is kept in the store; OUT.npz gets the mean ``share`` and the mean ``maps``, each row of
    an object scaled to [0, 1] first, and OUT.png the picture.
    """
    views, arrays, picture = ViewStore.open(store), Path(f"{out}.npz"), Path(f"{out}.png")
    for path in (arrays, picture):
        check_new(path, overwrite)
    if label is not None and label not in views.classes:
        raise DatasetError(f"{store}: has no class {label!r}; there are {', '.join(views.classes)}")
    select = views.done & (True if label is None else views.labels == views.classes.index(label))
    if not select.any():
        raise DatasetError(f"{store}: holds no rendered object" + (f" of the class {label!r}" if label else ""))
    follow(overlap_store(store, workers, scheduler), f"overlap in {store.name}")
    share, count = ViewStore.open(store).rows(OVERLAP)[select], int(select.sum())
    maps = overlap_maps(share).mean(0)
    title = f"Overlap of views, mean over {count:,} objects" + (f" of the class {label}" if label else "")
    with new_file(arrays, overwrite) as part:
        np.savez(part, share=share.mean(0), maps=maps, objects=count)
    with new_file(picture, overwrite) as part:
        overlap_figure(maps, views.sphere, title).savefig(part, dpi=150, facecolor="white")
    console.print(f"{arrays}\n{picture}")
