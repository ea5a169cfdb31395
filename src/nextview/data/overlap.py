"""Overlap: how much of what one view shows is seen from each other view (the thesis's point correspondence, 5.2)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.data.measures import normalise_per_object
from nextview.data.measuring import keep
from nextview.data.store import OVERLAP, ViewStore

TOLERANCE = 0.003
"""How far behind the visible surface a point may lie and still count as seen, object radii. Against rays cast from the
camera to each point, this one and a pixel's four neighbours differ least; much more sees through table tops."""

overlap_maps = normalise_per_object
"""The thesis's maps: each view's row of (..., V, V) scaled so that the least is 0 and the most, itself, is 1."""


def overlap(
    path: Path, workers: int | None = None, scheduler: str | None = None, overwrite: bool = False
) -> Iterator[tuple[int, int]]:
    """Put the overlap of the views of every object into its store, as ``overlap`` (N, V, V) float32.

    Yields:
        Objects done so far, and how many there are.
    """
    store = ViewStore.open(path)
    store.array("depth"), store.array("points")  # say if they are missing, before anything is begun
    yield from keep(path, [OVERLAP], _overlap, workers, scheduler, overwrite=overwrite)


def _overlap(store: ViewStore, i: int) -> dict[str, NDArray[np.float32]]:
    return {OVERLAP: shared_points(store.points(i), store.depth(i), store.sphere.poses, store.intrinsics)}


def shared_points(
    points: NDArray[np.float32], depth: NDArray[np.float32], poses: NDArray[np.float64], intrinsics: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Share of the points visible from each view that each view sees.

    A point is seen if it is not hidden behind the depth of the pixel that it falls on, or of one beside it: on slopes
    and on the silhouette, half a pixel would decide.

    ``points`` (V, P, 3), object frame, are visible from each view; ``depth`` is (V, H, W); ``poses`` (V, 4, 4).

    Returns:
        (V, V) float32: row = view whose points they are, column = view that sees them; 0 for a view of nothing.
    """
    v, count, _ = points.shape
    height, width = depth.shape[1:]
    cloud = points.reshape(-1, 3)
    share = np.zeros((v, v), np.float32)
    for other in range(v):
        p = np.pad(depth[other], 1)  # the largest depth of each pixel and the four beside it
        reach = np.maximum.reduce([depth[other], p[:-2, 1:-1], p[2:, 1:-1], p[1:-1, :-2], p[1:-1, 2:]])
        x, y, z = ((cloud - poses[other, :3, 3]) @ poses[other, :3, :3]).T
        column = np.floor(x / z * intrinsics[0, 0] + intrinsics[0, 2]).astype(np.int64).clip(0, width - 1)
        row = np.floor(y / z * intrinsics[1, 1] + intrinsics[1, 2]).astype(np.int64).clip(0, height - 1)
        share[:, other] = (z < reach[row, column] + TOLERANCE).reshape(v, count).mean(1)
    return share * np.any(depth, axis=(1, 2))[:, None]
