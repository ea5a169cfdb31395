"""Pictures of a view store: one object from all sides, or the whole data set, whose numbers are
printed.

python -m nextview_lab.thesis.inspect_store views.zarr [views.png] [--object-name table_0399]
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from nextview.cli.common_options import check_file
from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import console
from nextview.errors import DatasetError
from nextview.files import new_file
from nextview.geometry.viewsphere import ViewSphere
from nextview.session.style import BLUE, PlainFigure
from nextview_lab.data.store import ViewStore

ORANGE = "#e08a2e"
MAPS_ACROSS = 6
CELL = 112
"""Largest side of one view in a mosaic, pixels."""


def object_figure(store: ViewStore, i: int) -> Figure:
    """Shaded images and depth of all views of object i, and the map of every measure that the store
    holds of it.

    Rows are rings, the horizon lowest; columns are azimuths. A dot marks the view that measures
    most.
    """
    sphere = store.sphere
    names = [name for name in store.measures if store.has(f"measures/{name}", i)]
    names.sort(key=lambda name: name != "depth_entropy")  # the thesis's first
    wide = sphere.azimuths / sphere.rings
    rows, columns = (2, 1) if wide > 3 else (1, 2)
    heights = [rows * (14 / columns / wide + 0.6), 2.2 * -(-len(names) // MAPS_ACROSS)]
    figure = PlainFigure(figsize=(14, sum(heights)), layout="constrained")
    split = f", {store.splits[i]} split" if store.splits[i] else ""
    figure.suptitle(
        f"{store.names[i]}  ·  {store.classes[store.labels[i]]}{split}",
        fontsize=14,
    )
    top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=heights))

    left, right = top.subplots(rows, columns)
    step = -(-store.image(i).shape[-1] // CELL)
    image, depth = (
        _mosaic(views[:, ::step, ::step], sphere)
        for views in (store.image(i), store.depth(i))
    )
    left.imshow(image, cmap="gray", vmin=0, vmax=255)
    shown = right.imshow(np.ma.masked_equal(depth, 0), cmap="viridis_r")
    right.set_facecolor("black")
    top.colorbar(shown, ax=right, label="object radii", shrink=0.8, pad=0.01)
    for axes, title in ((left, "shaded image"), (right, "depth")):
        axes.set_title(title)
        _ticks(axes, sphere, image.shape[1] / sphere.azimuths, downwards=True)
    across = min(max(len(names), 3), MAPS_ACROSS)
    panels = np.ravel(bottom.subplots(-(-len(names) // across), across, squeeze=False))
    for axes in panels[len(names) :]:
        axes.axis("off")
    for axes, name in zip(panels, names, strict=False):
        best = _draw_map(axes, sphere, store.read(f"measures/{name}", i))
        elevation, azimuth = sphere.angles(best)
        axes.set_title(name.replace("_", " "), fontsize=11)
        axes.set_xlabel(f"most from {azimuth:g}°, {elevation:g}° up", fontsize=9)
        axes.plot(
            best % sphere.azimuths,
            best // sphere.azimuths,
            "o",
            color="white",
            markeredgecolor="black",
        )
    return figure


def store_figure(store: ViewStore) -> Figure:
    """Objects of each class and split, and the mean depth entropy of the views."""
    figure = PlainFigure(
        figsize=(14, max(5.5, 0.24 * len(store.classes) + 1.5)),
        layout="constrained",
    )
    figure.suptitle(store.path.name, fontsize=14)
    left, right = np.asarray(
        figure.subfigures(1, 2, width_ratios=[1.5, 1], wspace=0.04)
    )
    _class_bars(left.subplots(), store)
    axes = right.subplots()
    axes.set_title("mean depth entropy of the views, bits", fontsize=11)
    if store.done.any() and "depth_entropy" in store.measures:
        _draw_map(axes, store.sphere, store.measure()[store.done].mean(0))
    return figure


def summary(store: ViewStore) -> dict[str, str]:
    """What a store holds, in words."""
    size = sum(file.stat().st_size for file in store.path.rglob("*") if file.is_file())
    rendered = int(store.done.sum())
    views = len(store.sphere)
    side = store.attributes.size
    copies = sum(map(len, store.duplicates)) - len(store.duplicates)
    conflicting = sum(len(set(store.labels[group])) > 1 for group in store.duplicates)
    return {
        "objects": f"{len(store):,} in {len(store.classes)} classes",
        "rendered": f"{rendered:,}",
        "left out": f"{len(store.attributes.failures):,}",
        "not rendered yet": f"{len(store) - rendered - len(store.attributes.failures):,}",
        "views": f"{rendered * views:,}  ({views} of {side} x {side} each)",
        "byte-identical copies": f"{copies:,}  ({conflicting} with several labels)",
        "size on disk": f"{size / 1e9:.2f} GB"
        if size > 1e9
        else f"{size / 1e6:.1f} MB",
    }


def _class_bars(axes: Axes, store: ViewStore) -> None:
    labels = store.labels
    splits = store.splits
    done = store.done
    rows = np.arange(len(store.classes))
    start = np.zeros(len(rows))
    parts = [
        (name, done & (splits == name), colour)
        for name, colour in (("train", BLUE), ("test", ORANGE), ("", BLUE))
    ]
    for name, select, colour in [*parts, ("not rendered", ~done, "lightgrey")]:
        counts = np.bincount(labels[select], minlength=len(rows))
        if counts.any():
            axes.barh(
                rows,
                counts,
                left=start,
                color=colour,
                label=name or "objects",
                height=0.72,
            )
            start += counts
    for row, count in enumerate(start):
        axes.text(count, row, f" {int(count):,}", va="center", fontsize=9)
    axes.set_yticks(rows, store.classes)
    # a few classes get bars no thicker than those of many
    axes.set_ylim(max(len(rows), 6) - 0.5, -0.5)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlim(0, start.max() * 1.1)
    axes.set_xlabel("objects")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="lower right", bbox_to_anchor=(1, 1), ncols=3)


def _draw_map(axes: Axes, sphere: ViewSphere, values: NDArray[np.floating]) -> int:
    """Values of the views, (V,), by ring and azimuth; returns the view of the highest."""
    shown = axes.imshow(
        values.reshape(sphere.rings, sphere.azimuths),
        origin="lower",
        aspect="auto",
    )
    axes.figure.colorbar(shown, ax=axes, pad=0.02)
    _ticks(axes, sphere)
    return int(values.argmax())


def _mosaic(views: NDArray, sphere: ViewSphere) -> NDArray:
    """(V, H, W) to one image, the first ring lowest."""
    _, height, width = views.shape
    grid = views.reshape(sphere.rings, sphere.azimuths, height, width)[::-1]
    return grid.transpose(0, 2, 1, 3).reshape(
        sphere.rings * height,
        sphere.azimuths * width,
    )


def _ticks(
    axes: Axes,
    sphere: ViewSphere,
    side: float = 1,
    downwards: bool = False,
) -> None:
    """Azimuths and elevations, at the middle of cells of a side."""
    middle = side / 2 - 0.5
    every = 2 if sphere.azimuths > 6 else 1
    elevations = [f"{e:g}°" for e in sphere.elevations]
    azimuths = [f"{360 * k / sphere.azimuths:g}°" for k in range(sphere.azimuths)]
    axes.set_xticks(
        (middle + side * np.arange(sphere.azimuths))[::every],
        azimuths[::every],
        fontsize=8,
    )
    rows = elevations[::-1] if downwards else elevations
    axes.set_yticks(middle + side * np.arange(sphere.rings), rows, fontsize=8)
    axes.tick_params(length=0)


def inspect(
    store: Path,
    out: Path | None = None,
    /,
    object_name: str | None = None,
    overwrite: bool = False,
) -> None:
    """Draw what a view store holds: classes, counts, failures; or one object from all sides.

    Args:
        store: view store made by nextview-lab render.
        out: picture to make (PNG, PDF or SVG); STORE.png or OBJECT.png here if not given.
        object_name: name of the object to draw instead of the whole store.
        overwrite: replace the picture if it exists.
    """
    views = ViewStore.open(store)
    out = out or Path(f"{object_name or store.resolve().stem}.png")
    check_file(out, overwrite)
    if object_name is not None:
        if object_name not in views.names:
            raise DatasetError(f"{store}: has no object {object_name!r}")
        row = views.names.index(object_name)
        if not views.done[row]:
            raise DatasetError(
                f"{store}: {object_name} is not rendered"
                f" ({views.attributes.failures.get(object_name, 'not yet')})"
            )
        figure = object_figure(views, row)
    else:
        for what, value in summary(views).items():
            console.print(f"{what:22} {value}", soft_wrap=True)
        for reason in views.attributes.failures.values():
            console.print(f"left out: {reason}", style="yellow")
        figure = store_figure(views)
    with new_file(out, overwrite) as part:
        figure.savefig(part, dpi=150, facecolor="white")
    console.print(f"{out}")


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(inspect)
