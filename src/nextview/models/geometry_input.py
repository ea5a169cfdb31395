"""What the recogniser eats: the geometry that a depth camera sees, free of texture and lighting."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview.depth import object_depth, slope
from nextview.errors import ObservationError

CHANNELS = ("facing", "up", "height", "nearness")


def geometry_input(
    depth: NDArray[np.float32], poses: NDArray[np.float64], intrinsics: NDArray[np.float64], size: int
) -> NDArray[np.uint8]:
    """Depth images as four channels in the frame of gravity and of the viewing ray.

    facing: cosine between the surface normal and the ray to the camera, 0 .. 1 (what a headlight would show).
    up: vertical part of the normal, -1 .. 1. height: above the object's centre, -1 .. 1 radii. nearness: towards the
    camera from the object's centre, -1 .. 1 radii. Each becomes 1 .. 255; 0 is background. Normals come from
    differences between neighbouring pixels of the full image, on whichever side the depth changes less; the image is
    then thinned to every k-th pixel.

    Args:
        depth: (B, H, W), object radii, 0 = no object; H and W are multiples of ``size``.
        poses: camera-to-world, (B, 4, 4), OpenCV axes.
        intrinsics: (3, 3), pixels.
        size: side of the result.

    Returns:
        (B, 4, size, size) uint8.

    Raises:
        ObservationError: the image is not a square multiple of ``size``.
    """
    _b, h, w = depth.shape
    if h != w or h % size:
        raise ObservationError(f"a depth image of {h}x{w} cannot be thinned to {size}x{size}: use a multiple of {size}")
    k = h // size
    rotation, origin = poses[:, :3, :3].astype(np.float32), poses[:, :3, 3].astype(np.float32)
    padded = np.pad(object_depth(depth).astype(np.float32, copy=False), ((0, 0), (1, 1), (1, 1)))
    z = padded[:, 1:-1:k, 1:-1:k]
    along_column = slope(padded[:, 1:-1:k, :-2:k], z, padded[:, 1:-1:k, 2::k])
    along_row = slope(padded[:, :-2:k, 1:-1:k], z, padded[:, 2::k, 1:-1:k])
    focal, focal_y = intrinsics[0, 0].astype(np.float32), intrinsics[1, 1].astype(np.float32)
    along_row *= focal_y / focal  # a step down the image as long as one across it
    x = ((np.arange(0, w, k) + 0.5 - intrinsics[0, 2]) / focal).astype(np.float32)[None, None, :]
    y = ((np.arange(0, h, k) + 0.5 - intrinsics[1, 2]) / focal_y).astype(np.float32)[None, :, None]
    # The surface is P = (x z, y z, z); the cross product of its derivatives, scaled, points to the camera:
    through = z / focal + x * along_column + y * along_row
    length = np.sqrt(along_column**2 + along_row**2 + through**2) + 1e-12

    def vertical(a: NDArray, b: NDArray, c: NDArray) -> NDArray:
        up = rotation[:, 2, :, None, None]  # the world's z axis in each camera's frame
        return up[:, 0] * a + up[:, 1] * b + up[:, 2] * c

    facing = z / focal / (length * np.sqrt(x**2 + y**2 + 1))
    up = vertical(along_column, along_row, -through) / length
    height = vertical(x * z, y * z, z) + origin[:, 2, None, None]
    nearness = np.linalg.norm(origin, axis=1)[:, None, None] - z
    channels = np.stack([2 * facing - 1, up, height, nearness], 1)
    coded = 1 + 127 * (np.clip(channels, -1, 1) + 1) + 0.5
    return np.where(z[:, None] > 0, coded, 0).astype(np.uint8)
