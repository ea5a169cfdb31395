"""The other thing that a recogniser may eat, and the published one: the shaded image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview.errors import ObservationError


def image_input(images: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    """Grey images as one channel, every pixel the mean of a square of pixels.

    Args:
        images: (B, H, W), 0 = background; H and W are the same multiple of ``size``.
        size: side of the result.

    Returns:
        (B, 1, size, size) uint8.

    Raises:
        ObservationError: the image is not a square multiple of ``size``.
    """
    b, h, w = images.shape
    if h != w or h % size:
        raise ObservationError(f"an image of {h}x{w} cannot be reduced to {size}x{size}: use a multiple of {size}")
    squares = images.reshape(b, size, h // size, size, h // size)
    return np.rint(squares.mean((2, 4), dtype=np.float32)).astype(np.uint8)[:, None]
