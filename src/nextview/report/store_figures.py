"""Pictures of a view store: one object from all sides, the whole data set, and point correspondence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from nextview.arguments import takes_paths
from nextview.data.store import RENDERED, ViewStore
from nextview.outputs import written_whole
from nextview.report.style import BLUE, GREY, PlainFigure
from nextview.viewsphere import ViewSphere

ORANGE = "#e08a2e"
MAPS_ACROSS = 6
"""Maps of measures side by side; more go into further rows."""
CELL = 112
"""Largest side of one view in a mosaic, pixels."""


@takes_paths("path")
def save(figure: Figure, path: Path) -> None:
    """Write a PNG or whatever the suffix says, aside and then renamed."""
    with written_whole(path) as part:
        figure.savefig(part, dpi=150, facecolor="white")


def object_figure(store: ViewStore, i: int) -> Figure:
    """Shaded images and depth of all views of object i, and the map of every measure that the store holds of it.

    Rows are rings, the horizon lowest; columns are azimuths. A dot marks the view that measures most.
    """
    sphere = store.sphere
    names = [name for name in store.measures if store.has(f"measures/{name}", i)]
    names.sort(key=lambda name: name != "depth_entropy")  # the thesis's first
    wide = sphere.azimuths / sphere.rings
    rows, columns = (2, 1) if wide > 3 else (1, 2)
    views_height = rows * (14 / columns / wide + 0.6)
    across = min(max(len(names), 3), MAPS_ACROSS)
    down = -(-max(len(names), 1) // across)
    maps_height = down * (2.2 if sphere.rings > 1 else 1.3)
    figure = PlainFigure(figsize=(14, views_height + maps_height), layout="constrained")
    label = store.classes[store.labels[i]]
    figure.suptitle(
        f"{store.names[i]}  ·  {label}{f', {store.splits[i]} split' if store.splits[i] else ''}", fontsize=14
    )
    top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=[views_height, maps_height]))

    left, right = top.subplots(rows, columns)
    step = max(1, -(-store.image(i).shape[-1] // CELL))
    left.imshow(_mosaic(store.image(i)[:, ::step, ::step], sphere), cmap="gray", vmin=0, vmax=255)
    left.set_title("shaded image")
    depth = store.depth(i)[:, ::step, ::step]
    shown = right.imshow(np.ma.masked_equal(_mosaic(depth, sphere), 0), cmap="viridis_r")
    right.set_facecolor("black")
    right.set_title("depth")
    top.colorbar(shown, ax=right, label="object radii", shrink=0.8, pad=0.01)
    for axes in (left, right):
        _mosaic_ticks(axes, sphere, depth.shape[-1])

    panels = np.ravel(bottom.subplots(down, across, squeeze=False))
    for axes in panels[len(names) :]:
        axes.axis("off")
    if len(names) < len(panels):
        hint = f"nextview measure {store.path.name}\nadds other view measures"
        spare = panels[len(names)]
        spare.text(0.5, 0.5, hint, ha="center", va="center", color=GREY, transform=spare.transAxes)
    for axes, name in zip(panels, names, strict=False):
        values = store.read(f"measures/{name}", i).reshape(sphere.rings, sphere.azimuths)
        shown = axes.imshow(values, cmap="viridis", origin="lower", aspect="auto")
        elevation, azimuth = sphere.angles(int(values.argmax()))
        axes.set_title(name.replace("_", " "), fontsize=11)
        axes.set_xlabel(f"most from {azimuth:g}°, {elevation:g}° up", fontsize=9)
        _map_ticks(axes, sphere)
        bottom.colorbar(shown, ax=axes, pad=0.02)
        best = np.unravel_index(values.argmax(), values.shape)
        axes.plot(best[1], best[0], "o", color="white", markeredgecolor="black", markersize=7)
    return figure


def store_figure(store: ViewStore) -> Figure:
    """Objects of each class and split, what could not be rendered, what the store weighs, the mean entropy map."""
    sphere, done = store.sphere, store.done
    figure = PlainFigure(figsize=(14, max(5.5, 0.24 * len(store.classes) + 1.5)), layout="constrained")
    figure.suptitle(store.path.name, fontsize=14)
    left, right = np.asarray(figure.subfigures(1, 2, width_ratios=[1.5, 1], wspace=0.04))
    _class_bars(left.subplots(), store)

    table, axes = right.subplots(2, 1, height_ratios=[1.2, 1])
    table.axis("off")
    rows = summary(store)
    for row, (what, value) in enumerate(rows.items()):
        y = 1 - row / len(rows)
        table.text(0, y, what, color=GREY, fontsize=11, va="top")
        table.text(1, y, value, fontsize=11, va="top", ha="right")
    axes.set_title("mean depth entropy of the views", fontsize=11)
    _map_ticks(axes, sphere)
    axes.set_xlabel("azimuth", fontsize=9)
    axes.set_ylabel("elevation", fontsize=9)
    if done.any() and "depth_entropy" in store.measures:
        mean = store.measure()[done].mean(0).reshape(sphere.rings, sphere.azimuths)
        shown = axes.imshow(mean, cmap="viridis", origin="lower", aspect="auto")
        right.colorbar(shown, ax=axes, label="bits", pad=0.02)
    return figure


def correspondence_figure(maps: NDArray[np.floating], sphere: ViewSphere, title: str) -> Figure:
    """The map of every view, laid out as the views are (thesis, figure 14).

    Args:
        maps: (V, V) from 0 to 1; row = the view, column = the other view.
        sphere: the viewpoints.
        title: what the maps are.
    """
    rings, azimuths = sphere.rings, sphere.azimuths
    figure = PlainFigure(figsize=(1.65 * azimuths + 1.2, 1.15 * rings + 1.3), layout="constrained")
    figure.suptitle(title, fontsize=13)
    panels = figure.subplots(rings, azimuths, squeeze=False)
    for view in range(len(sphere)):
        ring, azimuth = int(sphere.ring[view]), int(sphere.azimuth_index[view])
        axes = panels[rings - 1 - ring, azimuth]
        shown = axes.imshow(
            maps[view].reshape(rings, azimuths), cmap="viridis", origin="lower", vmin=0, vmax=1, aspect="auto"
        )
        axes.plot(azimuth, ring, "o", color="white", markeredgecolor="black", markersize=5)
        axes.set_xticks([])
        axes.set_yticks([])
        if ring == 0:
            axes.set_xlabel(f"{sphere.angles(view)[1]:g}°")
        if azimuth == 0:
            axes.set_ylabel(f"{sphere.angles(view)[0]:g}°")
    figure.supxlabel("azimuth", fontsize=11)
    figure.supylabel("elevation", fontsize=11)
    figure.colorbar(shown, ax=panels, label="share of the view's points, scaled", shrink=0.8, pad=0.01)
    return figure


def summary(store: ViewStore) -> dict[str, str]:
    """What a store holds, in words."""
    sizes = disk_use(store)
    size = sum(sizes.values())
    labels, done, views = store.labels, store.done, len(store.sphere)
    rendered = int(done.sum())
    copies = sum(map(len, store.duplicates)) - len(store.duplicates)
    conflicting = sum(len(set(labels[group])) > 1 for group in store.duplicates)
    side = store.group.attrs["size"]
    rows = {
        "objects": f"{len(store):,} in {len(store.classes)} classes",
        "rendered": f"{rendered:,}",
        "left out": f"{len(store.failures):,}",
        "not rendered yet": f"{len(store) - rendered - len(store.failures):,}",
        "views": f"{rendered * views:,}  ({views} of {side} x {side} each)",
        "byte-identical copies": f"{copies:,}  ({conflicting} with several labels)",
        "size on disk": f"{size / 1e9:.2f} GB" if size > 1e9 else f"{size / 1e6:.1f} MB",
    }
    if rendered:
        rows["per view"] = "  ".join(
            f"{name} {sizes[name] / rendered / views / 1e3:.1f} kB"
            for name in ("image", "depth", "points")
            if name in sizes
        )
    missing = [name for name in RENDERED if not store.holds(name)]
    if missing:
        rows["arrays that are missing"] = ", ".join(missing)
    if "sha256" not in store.group.attrs:
        rows["byte-identical copies"] = "unknown, made without hashes"
    return rows


def median_radii(store: ViewStore) -> dict[str, float]:
    """Of the objects of each class, metres; empty where the unit of the meshes is not known."""
    radii, labels = store.radii, store.labels
    known = store.done & np.isfinite(radii)
    return {store.classes[c]: float(np.median(radii[known & (labels == c)])) for c in np.unique(labels[known])}


def disk_use(store: ViewStore) -> dict[str, int]:
    """Bytes of the files of each array or group of a store, and of its attributes."""
    sizes = {}
    for part in sorted(store.path.iterdir()):
        files = part.rglob("*") if part.is_dir() else [part]
        sizes[part.name] = sum(file.stat().st_size for file in files if file.is_file())
    return sizes


def _class_bars(axes: Axes, store: ViewStore) -> None:
    labels, splits, done = store.labels, store.splits, store.done
    rows = np.arange(len(store.classes))
    start = np.zeros(len(rows))
    for split, colour in (("train", BLUE), ("test", ORANGE), ("", BLUE)):
        counts = np.bincount(labels[done & (splits == split)], minlength=len(rows))
        if counts.any():
            axes.barh(rows, counts, left=start, color=colour, label=split or "objects", height=0.72)
            start += counts
    missing = np.bincount(labels[~done], minlength=len(rows))
    if missing.any():
        axes.barh(rows, missing, left=start, color="lightgrey", label="not rendered", height=0.72)
        start += missing
    for row, count in enumerate(start):
        axes.text(count, row, f" {int(count):,}", va="center", fontsize=9)
    axes.set_yticks(rows, store.classes)
    axes.set_ylim(max(len(rows), 6) - 0.5, -0.5)  # a few classes get bars no thicker than those of many
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlim(0, start.max() * 1.1)
    axes.set_xlabel("objects")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="lower right", bbox_to_anchor=(1, 1), ncols=3)


def _mosaic(views: NDArray, sphere: ViewSphere) -> NDArray:
    """(V, H, W) to one image, the first ring lowest."""
    _, height, width = views.shape
    grid = views.reshape(sphere.rings, sphere.azimuths, height, width)[::-1]
    return grid.transpose(0, 2, 1, 3).reshape(sphere.rings * height, sphere.azimuths * width)


def _mosaic_ticks(axes: Axes, sphere: ViewSphere, side: int) -> None:
    middle = side / 2 - 0.5
    axes.set_xticks(middle + side * np.arange(sphere.azimuths), _azimuths(sphere), fontsize=9)
    axes.set_yticks(middle + side * np.arange(sphere.rings), _elevations(sphere)[::-1], fontsize=9)
    axes.tick_params(length=0)


def _map_ticks(axes: Axes, sphere: ViewSphere) -> None:
    every = 2 if sphere.azimuths > 6 else 1
    axes.set_xticks(np.arange(sphere.azimuths)[::every], _azimuths(sphere)[::every], fontsize=8)
    axes.set_yticks(np.arange(sphere.rings), _elevations(sphere), fontsize=8)
    axes.tick_params(length=0)


def _azimuths(sphere: ViewSphere) -> list[str]:
    return [f"{360 * i / sphere.azimuths:g}°" for i in range(sphere.azimuths)]


def _elevations(sphere: ViewSphere) -> list[str]:
    return [f"{e:g}°" for e in sphere.elevations]
