"""Slopes and angles of the surfaces in a depth image, and where one surface ends before another.

On inverse depth q = 1/z, where planes of the world are planes of the image: q changes by the same amount from pixel to
pixel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float64]

STEP = 0.02
"""Difference of neighbouring pixels, as a part of the inverse depth and beyond the surface's own slope, from which on
they show two surfaces."""
STEEPEST = np.radians(80.0)
"""Angle of incidence at which the laws of noise are held: they grow without bound towards 90 degrees."""


def inverse_depth(depth: NDArray[np.floating]) -> Image:
    """1/z, (H, W) float64, 0 where there is nothing."""
    return np.divide(1.0, depth, out=np.zeros(depth.shape), where=depth > 0)


def slopes(q: Image) -> tuple[Image, Image]:
    """Change of inverse depth per pixel along the columns (x) and along the rows (y), each (H, W).

    From the side where it is smaller, which is the one on the same surface; 0 for a pixel alone.
    """
    return _slope(q), _slope(q.T).T


def _slope(q: Image) -> Image:
    here, nothing = q > 0, np.full((len(q), 1), np.inf)
    difference = np.where(here[:, 1:] & here[:, :-1], q[:, 1:] - q[:, :-1], np.inf)
    forth, back = np.hstack([difference, nothing]), np.hstack([nothing, difference])
    smaller = np.where(np.abs(back) < np.abs(forth), back, forth)
    return np.where(np.isfinite(smaller), smaller, 0.0)


def incidence(q: Image, slope: tuple[Image, Image], intrinsics: NDArray[np.float64]) -> Image:
    """Angle between the surface's normal and the ray of each pixel, (H, W), radians, 0 where there is nothing.

    Args:
        q: inverse depth.
        slope: of it, see ``slopes``.
        intrinsics: (3, 3), pixels, first pixel's centre at 0.5.
    """
    (fx, _, cx), (_, fy, cy) = intrinsics[:2]
    x = (np.arange(q.shape[1]) + 0.5 - cx) / fx
    y = ((np.arange(q.shape[0]) + 0.5 - cy) / fy)[:, None]
    a, b = slope[0] * fx, slope[1] * fy  # n = (a, b, c) with n . (x, y, 1) = q
    c = q - a * x - b * y
    length = np.sqrt((a * a + b * b + c * c) * (x * x + y * y + 1))
    return np.where(q > 0, np.arccos(np.clip(q / np.where(length > 0, length, 1), 0, 1)), 0.0)


def across_edges(q: Image, slope: tuple[Image, Image]) -> Image:
    """Inverse depth of the neighbour, of the four, on the other side of the highest step; a pixel's own if none."""
    padded, other, highest = np.pad(q, 1), q.copy(), STEP * q
    height, width = q.shape
    for dy, dx in ((0, -1), (0, 1), (-1, 0), (1, 0)):
        beside = padded[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]
        step = np.abs(beside - q - slope[0] * dx - slope[1] * dy)
        over = (step > highest) & (beside > 0) & (q > 0)
        other[over], highest[over] = beside[over], step[over]
    return other
