"""Silhouette measures: how large the object appears, and how long its outline is (thesis, sections 3.4.1 and 3.4.2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview.depth import object_depth


def silhouette_area(depth: NDArray[np.floating]) -> float:
    """Share of the image that shows the object ("view area").

    Args:
        depth: (H, W), object radii, 0 where there is no object.

    Returns:
        Between 0 and 1; the sphere around the object fills pi/4 of the image.
    """
    return np.count_nonzero(object_depth(depth)) / depth.size


def silhouette_length(depth: NDArray[np.floating]) -> float:
    """Length of the object's outline, holes included, in sides of the image.

    By Cauchy and Crofton: the length of a curve is half the mean number of times that lines cross it, over all lines.
    Counted over the lines through the pixels' centres in four directions, which is right within a few per cent where
    counting edge pixels is wrong by up to 41 % on slopes.

    Args:
        depth: (H, W), object radii, 0 where there is no object.

    Returns:
        0 where nothing is seen.
    """
    seen = np.pad(object_depth(depth) > 0, 1)
    straight = (seen[1:] != seen[:-1]).sum() + (seen[:, 1:] != seen[:, :-1]).sum()
    diagonal = (seen[1:, 1:] != seen[:-1, :-1]).sum() + (seen[1:, :-1] != seen[:-1, 1:]).sum()
    # Lines along the diagonals are 1/sqrt(2) pixels apart; the four directions share pi.
    return float(np.pi / 8 * (straight + diagonal / np.sqrt(2)) / max(depth.shape))
