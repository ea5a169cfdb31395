"""Depth measures of the object alone: how its depth is spread, how far it reaches (thesis,
section 3.4.3).
"""

from __future__ import annotations

import numpy as np

from nextview.data.measures import MeasuredView

BIN = 0.01
"""Width of the depth histogram's bins, object radii: a hundred across the object's radius."""


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
