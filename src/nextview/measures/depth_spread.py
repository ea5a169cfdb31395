"""Depth measures of the object alone: how its depth is spread, how far it reaches (thesis, section 3.4.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview.depth import object_depth

BIN = 0.01
"""Width of the depth histogram's bins, object radii: a hundred across the object's radius."""


def depth_distribution(depth: NDArray[np.floating]) -> float:
    """One minus the sum of the squared normalised depth histogram (equation 5), over the pixels that show the object.

    It is the chance that two of them lie at different depths.

    Args:
        depth: (H, W), object radii, 0 where there is no object.

    Returns:
        0 where all is at one depth or nothing is seen, less than 1.
    """
    depth = object_depth(depth)
    bins = (depth[depth > 0] / BIN).astype(np.int64)
    share = np.bincount(bins) / max(len(bins), 1)
    return float(1 - (share**2).sum()) if len(bins) else 0.0


def max_depth(depth: NDArray[np.floating]) -> float:
    """The largest depth at which the object is seen, measured from its nearest visible point.

    Args:
        depth: (H, W), object radii, 0 where there is no object.

    Returns:
        Object radii; 0 where nothing is seen.
    """
    depth = object_depth(depth)
    seen = depth[depth > 0]
    return float(np.ptp(seen)) if len(seen) else 0.0
