"""Point correspondence: how much of what one view shows is seen from each other view (thesis, section 5.2)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import takes_paths
from nextview.data.measuring import Made, keep
from nextview.data.store import ViewStore

ARRAY = "correspondence"
TOLERANCE = 0.003
"""How far behind the visible surface a point may lie and still count as seen, object radii. Against rays cast from the
camera to each point, this one and a pixel's four neighbours differ least; much more sees through table tops."""


@takes_paths("path")
def correspond(path: Path, workers: int | None = None, scheduler: str | None = None) -> Iterator[tuple[int, int]]:
    """Put the correspondence of every object into its store, as ``correspondence`` (N, V, V) float32.

    Yields:
        Objects done so far, and how many there are.

    Raises:
        DatasetError: there is no store, or it cannot be written.
    """
    store = ViewStore.open(path)
    store.array("depth"), store.array("points")  # say if they are missing, before anything is begun
    yield from keep(path, [ARRAY], _correspond, workers, scheduler)


def _correspond(store: ViewStore, i: int) -> Made:
    return {ARRAY: correspondence(store.points(i), store.depth(i), store.sphere.poses, store.intrinsics)}, None


def correspondence(
    points: NDArray[np.float32],
    depth: NDArray[np.float32],
    poses: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Share of the points visible from each view that each view sees.

    A point is seen if it is not hidden behind the depth of the pixel that it falls on, or of one beside it: on slopes
    and on the silhouette, half a pixel would decide.

    Args:
        points: visible from each view, (V, P, 3), object frame.
        depth: of each view, (V, H, W), object radii, 0 where there is no object.
        poses: camera-to-world, (V, 4, 4), OpenCV axes.
        intrinsics: pinhole matrix, (3, 3), pixels.

    Returns:
        (V, V) float32: row = view whose points they are, column = view that sees them; 1 on the diagonal, 0 for a view
        that shows nothing.
    """
    v, count, _ = points.shape
    height, width = depth.shape[1:]
    cloud = points.reshape(-1, 3)
    share = np.zeros((v, v), np.float32)
    for other in range(v):
        reach = _deepest_neighbour(depth[other])
        x, y, z = ((cloud - poses[other, :3, 3]) @ poses[other, :3, :3]).T
        column = np.floor(x / z * intrinsics[0, 0] + intrinsics[0, 2]).astype(np.int64).clip(0, width - 1)
        row = np.floor(y / z * intrinsics[1, 1] + intrinsics[1, 2]).astype(np.int64).clip(0, height - 1)
        share[:, other] = (z < reach[row, column] + TOLERANCE).reshape(v, count).mean(1)
    return share * np.any(depth, axis=(1, 2))[:, None]


def _deepest_neighbour(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Largest depth of each pixel and the four beside it."""
    padded = np.pad(depth, 1)
    beside = (padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:])
    return np.maximum.reduce([depth, *beside])


def correspondence_maps(share: NDArray[np.float32]) -> NDArray[np.float32]:
    """The thesis's maps: each view's row scaled so that the view with the least is 0 and the most, itself, is 1.

    Args:
        share: (..., V, V).

    Returns:
        (..., V, V) float32.
    """
    low, high = share.min(-1, keepdims=True), share.max(-1, keepdims=True)
    return np.where(high > low, (share - low) / np.where(high > low, high - low, 1), 0).astype(np.float32)
