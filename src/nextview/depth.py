"""Depth images as all of nextview understands them: in object radii, 0 where there is no object."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FARTHEST = 50.0
"""Depth at which nothing counts as an object any more, object radii: depth cameras have large numbers for "nothing"."""


def object_depth(depth: NDArray[np.floating]) -> NDArray[np.floating]:
    """Depth with 0 where a sensor gives NaN, infinity, a negative or a huge number.

    Args:
        depth: any shape, object radii.

    Returns:
        The same array if it holds nothing of the kind, else a mended copy.
    """
    if depth.min() >= 0 and depth.max() < FARTHEST:  # not so if there is a NaN
        return depth
    return np.where((depth > 0) & (depth < FARTHEST), depth, 0)


def slope(before: NDArray, here: NDArray, after: NDArray) -> NDArray[np.float32]:
    """Change of depth per pixel, from the side where it is smaller: the one on the same surface. 0 if alone."""
    back = np.where(before > 0, here - before, np.inf)
    forth = np.where(after > 0, after - here, np.inf)
    slope = np.where(np.abs(back) < np.abs(forth), back, forth)
    return np.where(np.isfinite(slope), slope, 0).astype(np.float32)
