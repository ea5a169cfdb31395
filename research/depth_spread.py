"""Depth measures of the object alone: how its depth is spread, how far it reaches (thesis,
section 3.4.3), and how complex its surface is (section 3.5).
"""

from __future__ import annotations

import numpy as np

from nextview_lab.data.measures import MeasuredView
from research.area import bits

BIN = 0.01
"""Width of the depth histogram's bins, object radii: a hundred across the object's radius."""

LEVELS = 256
"""Grey levels of the depth image that is described."""


def depth_distribution(view: MeasuredView) -> float:
    """One minus the sum of the squared normalised depth histogram, over the pixels that show the
    object.

    It is the chance that two of them lie at different depths. Secord et al. 2011 ("depth
    distribution"); thesis, equation 5.

    Returns:
        0 where all is at one depth or nothing is seen, less than 1.
    """
    if len(view.depths) == 0:
        return 0.0
    share = np.bincount((view.depths / BIN).astype(np.int64)) / len(view.depths)
    return float(1 - (share**2).sum())


def max_depth(view: MeasuredView) -> float:
    """The largest depth at which the object is seen, measured from its nearest visible point.

    Secord et al. 2011 ("maximum depth"); thesis, section 3.4.3.

    Returns:
        Object radii; 0 where nothing is seen.
    """
    return float(np.ptp(view.depths)) if len(view.depths) else 0.0


def fused_descriptor(view: MeasuredView) -> float:
    """Mean of variance, entropy and Vollath's autocorrelation of the depth image, each scaled to 0
    .. 1.

    Ding et al., as the thesis describes it (section 3.5): they predict surface complexity by these
    three. The image is 1 at the nearest visible point, 1/256 two object radii behind it, and 0
    where there is no object. The variance is divided by its largest value, 1/4; the entropy of the
    grey levels by 8 bits; Vollath's F4 (Vollath 1987), the sum of products of neighbours less that
    of neighbours but one along the rows, by the sum of squares.

    Returns:
        Between 0 and 1; 0 where nothing is seen.
    """
    n = view.depth.size
    if len(view.depths) == 0:
        return 0.0
    nearest = view.depths.min()
    level = np.rint(LEVELS - (LEVELS - 1) / 2 * (view.depths - nearest)).clip(1, LEVELS)
    grey = level / LEVELS
    image = np.zeros(view.near.shape)
    image[view.seen] = grey
    counts = np.bincount(level.astype(np.int64), minlength=LEVELS + 1)
    counts[0] = n - len(level)
    total = grey.sum()
    squares = grey @ grey
    variance = squares / n - (total / n) ** 2
    nearer, farther = (
        np.einsum("hw,hw->", image[:, :-k], image[:, k:]) for k in (1, 2)
    )
    vollath = nearer - farther
    # The entropy of 257 levels can pass 8 bits by a hair.
    return float(
        (4 * variance + min(bits(counts / n) / 8, 1) + max(vollath, 0) / squares) / 3
    )
