"""From a depth image to points: the cloud of one view, and the point under every pixel."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nextview.depth import object_depth

POINTS = 1024
"""Points in the partial cloud of one view (thesis, section 4.1.2)."""


@lru_cache(maxsize=8)
def pixel_order(pixels: int, seed: int) -> NDArray[np.int32]:
    """A fixed shuffle of an image's pixels, (pixels,) int32; earlier ones are preferred when points are drawn."""
    return np.random.default_rng(seed).permutation(pixels).astype(np.int32)


def visible_points(
    depth: NDArray[np.float32],
    pose: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    seed: int = 0,
) -> NDArray[np.float32]:
    """Points on the visible surface: a uniform draw, without replacement, from the pixels that show the object.

    The draw depends on the seed and the visible pixels alone, so a view is the same whenever it is taken. With fewer
    visible pixels than points they repeat.

    Args:
        depth: (H, W), object radii, 0 where there is no object.
        pose: camera-to-world, (4, 4), OpenCV axes.
        intrinsics: pinhole matrix, (3, 3), pixels.
        seed: decides which pixels are preferred.

    Returns:
        (1024, 3) float32, object frame; all zero if nothing is visible.
    """
    flat = object_depth(depth).ravel()
    order = pixel_order(flat.size, seed)
    for first in (4 * POINTS, 8 * POINTS, 16 * POINTS, flat.size):  # most often the beginning of the order holds enough
        visible = np.flatnonzero(flat[order[:first]])
        if len(visible) >= POINTS:
            break
    chosen = order[visible[:POINTS]]
    if len(chosen) == 0:
        return np.zeros((POINTS, 3), np.float32)
    chosen = np.resize(chosen, POINTS)
    rows, columns = np.divmod(chosen, depth.shape[1])
    rays = np.stack(
        [
            (columns + 0.5 - intrinsics[0, 2]) / intrinsics[0, 0],
            (rows + 0.5 - intrinsics[1, 2]) / intrinsics[1, 1],
            np.ones(POINTS),
        ],
        -1,
    )
    return ((rays * flat[chosen, None]) @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)
