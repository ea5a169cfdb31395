"""Depth-entropy, the thesis's measure of how much a view shows (section 4.1.2, equation 3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview.depth import object_depth
from nextview.errors import MeasureError
from nextview.observation import depth_image, numbers

QUANTUM = 1e-3
"""Depth values closer than this count as equal, object radii."""


def depth_entropy(depth: NDArray[np.floating]) -> float:
    """Shannon entropy, in bits, of the distribution of depth values in a depth image, background included.

    Args:
        depth: (H, W), object radii, 0 where there is no object.

    Returns:
        0 for an image of one value, at most log2 of the number of pixels.

    Raises:
        ObservationError: no depth image.
    """
    depth = object_depth(depth_image(depth).astype(np.float64, copy=False))
    return entropy_of_depths(depth[depth > 0], depth.size)


def entropy_of_depths(seen: NDArray[np.floating], pixels: int) -> float:
    """The same, of the depth where there is an object, (n,), and how many pixels the image has."""
    counts = np.bincount(np.rint(seen / QUANTUM).astype(np.int64), minlength=1)
    counts[0] += pixels - seen.size
    share = counts[counts > 0] / pixels
    return float((share * np.log2(1 / share)).sum())


def normalise_per_object(values: NDArray[np.floating]) -> NDArray[np.float32]:
    """Scale a measure over an object's views to [0, 1], along the last axis; all 0 where the views do not differ.

    Args:
        values: (..., V), one value for each view.

    Returns:
        (..., V) float32.

    Raises:
        MeasureError: no such values.
    """
    values = numbers(values, "the values of a measure")
    if values.ndim == 0 or values.shape[-1] == 0:
        raise MeasureError("a measure has a value for each view, and here is none")
    low = values.min(-1, keepdims=True)
    span = values.max(-1, keepdims=True) - low
    return np.where(span > 0, (values - low) / np.where(span > 0, span, 1), 0).astype(np.float32)
