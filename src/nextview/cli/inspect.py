"""``nextview inspect``: a picture of a store, or of one object in it."""

from __future__ import annotations

from pathlib import Path

import tyro

from nextview.errors import DatasetError


def inspect(
    store: tyro.conf.Positional[Path], out: tyro.conf.Positional[Path | None] = None, /, object: str | None = None
) -> None:
    """Draw what a view store holds: classes, counts, failures, size on disk; or one object from all sides.

    Args:
        store: view store made by nextview render.
        out: picture to make; STORE.png or OBJECT.png here by default.
        object: name of the object to draw instead of the whole store.
    """
    from nextview.cli.progress import console
    from nextview.data.store import ViewStore
    from nextview.report.store_figures import median_radii, object_figure, save, store_figure, summary

    views = ViewStore.open(store)
    out = out or Path(f"{object or store.resolve().stem}.png")
    if out.suffix not in (".png", ".pdf", ".svg"):
        raise DatasetError(f"{out}: pictures are .png, .pdf or .svg")
    if object is not None:
        if object not in views.names:
            near = [name for name in views.names if name.startswith(object[:3])][:3] or views.names[:3]
            raise DatasetError(f"{store}: has no object {object!r}; there are {', '.join(near)} and others")
        row = views.names.index(object)
        if not views.done[row]:
            raise DatasetError(f"{store}: {object} is not rendered ({views.failures.get(object, 'not yet')})")
        save(object_figure(views, row), out)
    else:
        for what, value in summary(views).items():
            console.print(f"{what:22} {value}", highlight=False)
        sizes = median_radii(views)
        if sizes:
            shown = ", ".join(f"{name} {radius:.2f}" for name, radius in sizes.items())
            console.print(f"{'median radius, m':22} {shown}", highlight=False, soft_wrap=True)
        for reason in views.failures.values():
            console.print(f"left out: {reason}", style="yellow", highlight=False)
        save(store_figure(views), out)
    console.print(f"{out}")
