"""A grey picture of a depth image, for cameras that have no other and for people to look at."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview.depth import slope

AMBIENT = 0.15
"""Brightness of a surface seen edge-on, so that it stays apart from the black background."""


def headlight(depth: NDArray[np.float32], intrinsics: NDArray[np.float64]) -> NDArray[np.uint8]:
    """The surface as a lamp at the camera lights it: brightness grows with the cosine of ray and surface normal.

    Normals come from differences between neighbouring pixels, as in ``models.geometry_input``.

    Args:
        depth: (H, W), 0 where there is no object.
        intrinsics: pinhole matrix, (3, 3), pixels.

    Returns:
        (H, W) uint8, 0 where there is no object.
    """
    height, width = depth.shape
    padded = np.pad(depth, 1)
    (fx, _, cx), (_, fy, cy) = intrinsics[:2]
    across = fx * slope(padded[1:-1, :-2], depth, padded[1:-1, 2:])
    down = fy * slope(padded[:-2, 1:-1], depth, padded[2:, 1:-1])
    x = (np.arange(width) + 0.5 - cx) / fx
    y = ((np.arange(height) + 0.5 - cy) / fy)[:, None]
    # The surface is P = (x z, y z, z); the cross product of its derivatives, scaled:
    length = np.sqrt(across**2 + down**2 + (depth + x * across + y * down) ** 2)
    cosine = depth / (length * np.sqrt(x**2 + y**2 + 1) + 1e-30)
    return np.where(depth > 0, 255 * (AMBIENT + (1 - AMBIENT) * cosine) + 0.5, 0).astype(np.uint8)
