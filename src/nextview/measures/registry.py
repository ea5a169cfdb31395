"""View measures by name. To add one: write a function of a depth image, and enter it here."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from nextview.measures.depth_entropy import depth_entropy
from nextview.measures.depth_spread import depth_distribution, max_depth
from nextview.measures.silhouette import silhouette_area, silhouette_length

Measure = Callable[[NDArray[np.floating]], float]
"""From one depth image, (H, W) in object radii, 0 where there is no object, to a number."""

MEASURES: dict[str, Measure] = {
    "depth_entropy": depth_entropy,
    "silhouette_area": silhouette_area,
    "silhouette_length": silhouette_length,
    "depth_distribution": depth_distribution,
    "max_depth": max_depth,
}
