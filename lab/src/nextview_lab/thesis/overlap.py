"""Overlap: how much of what one view shows is seen from each other view (the thesis's point
correspondence, 5.2).

python -m nextview_lab.thesis.overlap views.zarr figure14 [--label chair]
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure
from numpy.typing import NDArray

from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import console, track
from nextview.data.pool import WorkerDied, each
from nextview.errors import DatasetError
from nextview.files import check_new, new_file
from nextview.geometry.viewsphere import ViewSphere
from nextview.session.style import PlainFigure
from nextview_lab.data.measures import normalise_per_object
from nextview_lab.data.store import ViewStore, opened

TOLERANCE = 0.003
"""How far behind the visible surface a point may lie and still count as seen, object radii. Against
rays cast from the camera to each point, this one and a pixel's four neighbours differ least; much
more sees through table tops."""

overlap_maps = normalise_per_object
"""The thesis's maps: each view's row of (..., V, V) scaled so that the least is 0 and the most,
itself, is 1.
"""


def shared_points(
    points: NDArray[np.float32],
    depth: NDArray[np.float32],
    poses: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Share of the points visible from each view that each view sees.

    A point is seen if it is not hidden behind the depth of the pixel that it falls on, or of one
    beside it: on slopes and on the silhouette, half a pixel would decide.

    ``points`` (V, P, 3), object frame, are visible from each view; ``depth`` is (V, H, W);
    ``poses`` (V, 4, 4).

    Returns:
        (V, V) float32: row = view whose points they are, column = view that sees them; 0 for a view
        of nothing.
    """
    v, count, _ = points.shape
    height, width = depth.shape[1:]
    cloud = points.reshape(-1, 3)
    share = np.zeros((v, v), np.float32)
    for other in range(v):
        # the largest depth of each pixel and the four beside it
        p = np.pad(depth[other], 1)
        reach = np.maximum.reduce(
            [depth[other], p[:-2, 1:-1], p[2:, 1:-1], p[1:-1, :-2], p[1:-1, 2:]]
        )
        x, y, z = ((cloud - poses[other, :3, 3]) @ poses[other, :3, :3]).T
        column = (
            np.floor(x / z * intrinsics[0, 0] + intrinsics[0, 2])
            .astype(np.int64)
            .clip(0, width - 1)
        )
        row = (
            np.floor(y / z * intrinsics[1, 1] + intrinsics[1, 2])
            .astype(np.int64)
            .clip(0, height - 1)
        )
        share[:, other] = (z < reach[row, column] + TOLERANCE).reshape(v, count).mean(1)
    return share * np.any(depth, axis=(1, 2))[:, None]


def _overlap(path: Path, i: int) -> NDArray[np.float32]:
    store = opened(path)
    return shared_points(
        store.points(i),
        store.depth(i),
        store.sphere.poses,
        store.intrinsics,
    )


def overlap_figure(
    maps: NDArray[np.floating],
    sphere: ViewSphere,
    title: str,
) -> Figure:
    """The map of every view, laid out as the views are (thesis, figure 14).

    ``maps`` are (V, V) from 0 to 1; row = the view, column = the other view.
    """
    rings = sphere.rings
    azimuths = sphere.azimuths
    figure = PlainFigure(
        figsize=(1.65 * azimuths + 1.2, 1.15 * rings + 1.3),
        layout="constrained",
    )
    figure.suptitle(title, fontsize=13)
    panels = figure.subplots(rings, azimuths, squeeze=False)
    for view in range(len(sphere)):
        ring, azimuth = divmod(view, azimuths)
        axes = panels[rings - 1 - ring, azimuth]
        shown = axes.imshow(
            maps[view].reshape(rings, azimuths),
            origin="lower",
            vmin=0,
            vmax=1,
            aspect="auto",
        )
        axes.plot(
            azimuth,
            ring,
            "o",
            color="white",
            markeredgecolor="black",
            markersize=5,
        )
        axes.set(xticks=[], yticks=[])
        if ring == 0:
            axes.set_xlabel(f"{sphere.angles(view)[1]:g}°")
        if azimuth == 0:
            axes.set_ylabel(f"{sphere.angles(view)[0]:g}°")
    figure.supxlabel("azimuth", fontsize=11)
    figure.supylabel("elevation", fontsize=11)
    figure.colorbar(
        shown,
        ax=panels,
        label="share of the view's points, scaled",
        shrink=0.8,
        pad=0.01,
    )
    return figure


def overlap(
    store: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path] = Path("overlap"),
    /,
    label: str | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
) -> None:
    """How much of what one view shows is seen from each other view, averaged over the objects.

    OUT.npz gets the mean ``share`` (V, V) and the mean ``maps``, each row of an object scaled to
    [0, 1] first, and OUT.png the picture.

    Args:
        store: view store made by nextview-lab render.
        out: name of the two files, without a suffix.
        label: average over this class only.
        workers: processes; one for each core by default.
        scheduler: address of a dask.distributed scheduler to use instead.
        overwrite: replace the two files if they exist.
    """
    views = ViewStore.open(store)
    arrays = Path(f"{out}.npz")
    picture = Path(f"{out}.png")
    for path in (arrays, picture):
        check_new(path, overwrite)
    if label is not None and label not in views.classes:
        raise DatasetError(
            f"{store}: has no class {label!r}; there are {', '.join(views.classes)}"
        )
    select = np.flatnonzero(
        views.done
        & (True if label is None else views.labels == views.classes.index(label))
    )
    if len(select) == 0:
        raise DatasetError(
            f"{store}: holds no rendered object"
            + (f" of the class {label!r}" if label else "")
        )
    share, maps = np.zeros((2, len(views.sphere), len(views.sphere)))

    def sums() -> Iterator[int]:
        work = partial(_overlap, store.absolute())
        for count, (i, found) in enumerate(
            each(work, select.tolist(), workers, scheduler),
            1,
        ):
            if isinstance(found, WorkerDied):
                raise DatasetError(
                    f"{store}: {views.names[i]} cannot be computed: {found}"
                )
            share[:] += found / len(select)
            maps[:] += overlap_maps(found) / len(select)
            yield count

    track(sums(), len(select), f"overlap in {store.name}")
    title = f"Overlap of views, mean over {len(select):,} objects" + (
        f" of the class {label}" if label else ""
    )
    with new_file(arrays, overwrite) as part:
        np.savez(part, share=share, maps=maps, objects=len(select))
    with new_file(picture, overwrite) as part:
        overlap_figure(maps, views.sphere, title).savefig(
            part,
            dpi=150,
            facecolor="white",
        )
    console.print(f"{arrays}\n{picture}")


if __name__ == "__main__":
    with orderly_end("run the same command again"):
        tyro.cli(overlap)
