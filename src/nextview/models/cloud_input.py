"""What the map networks eat: the partial cloud, upright, turned so that the camera stands at azimuth zero."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def cloud_input(points: NDArray[np.float32], poses: NDArray[np.float64]) -> NDArray[np.float32]:
    """Clouds in the frame of gravity and of the camera's azimuth, scaled to [0, 1] by their own global extent.

    A robot knows gravity and where its camera stands. In this frame the cells of the predicted map, all rings and
    azimuth -1, 0, +1, are in the same place for every view.

    Args:
        points: (B, P, 3), object frame.
        poses: camera-to-world, (B, 4, 4).

    Returns:
        (B, P, 3) float32; all zero for a cloud without extent.
    """
    azimuth = np.arctan2(poses[:, 1, 3], poses[:, 0, 3])
    c, s = np.cos(azimuth).astype(np.float32)[:, None], np.sin(azimuth).astype(np.float32)[:, None]
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    turned = np.stack([c * x + s * y, c * y - s * x, z], -1)
    low = turned.min((1, 2), keepdims=True)
    span = turned.max((1, 2), keepdims=True) - low
    return np.where(span > 0, (turned - low) / np.where(span > 0, span, 1), 0).astype(np.float32)
