"""``nextview inspect``: pictures of a view store."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path

from nextview.cli.progress import console
from nextview.cli.sources import check_file
from nextview.data.store import ViewStore
from nextview.errors import DatasetError
from nextview.files import new_file
from nextview.viewers.store_figures import object_figure, store_figure, summary


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
