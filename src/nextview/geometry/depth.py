"""Depth images in object radii: their points, and their look under a headlight.

A depth of 0 means that there is no object.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nextview.geometry.pinhole import PinholeCamera
from nextview.types import Float, Float32, Floats

# object radii; what is farther is no object: depth cameras have large numbers for "nothing"
FARTHEST_SURFACE = 50.0
# brightness of a surface seen edge-on, so that it stays apart from the black background
AMBIENT = 0.15
CLOUD_POINTS = 1024  # points in the partial cloud of one view (thesis, section 4.1.2)


def object_depth(depth: Floats) -> Floats:
    """Return the depth with 0 for NaN, infinity, negative and huge numbers.

    If there are none, the array itself is returned.
    """
    if depth.min() >= 0 and depth.max() < FARTHEST_SURFACE:  # not so if there is a NaN
        return depth
    return np.where((depth > 0) & (depth < FARTHEST_SURFACE), depth, 0)


def slope(before: NDArray, here: NDArray, after: NDArray) -> Float32:
    """Return the change of depth per pixel along one axis of an image.

    Of the two one-sided differences the smaller one is taken, which is the one on the same surface.

    Args:
        before: depth of the previous pixel, any shape; 0 where there is no object.
        here: depth of the pixel itself, the same shape.
        after: depth of the next pixel, the same shape.

    Returns:
        The slope, the same shape, float32; 0 where both neighbours are empty.
    """
    back = np.where(before > 0, here - before, np.inf)
    forth = np.where(after > 0, after - here, np.inf)
    slope = np.where(np.abs(back) < np.abs(forth), back, forth)
    return np.where(np.isfinite(slope), slope, 0).astype(np.float32)


def headlight(depth: Float32, intrinsics: Float) -> NDArray[np.uint8]:
    """Shade a depth image as if it were lit by a lamp at the camera.

    Args:
        depth: (H, W) float32; 0 where there is no object.
        intrinsics: pinhole matrix, (3, 3), pixels.

    Returns:
        Brightness, (H, W) uint8: the cosine between the ray and the surface normal.
    """
    camera = PinholeCamera.of(intrinsics, depth.shape)
    padded = np.pad(depth, 1)
    across = camera.fx * slope(padded[1:-1, :-2], depth, padded[1:-1, 2:])
    down = camera.fy * slope(padded[:-2, 1:-1], depth, padded[2:, 1:-1])
    x, y = camera.image_slopes
    y = y[:, None]
    # The surface is P = (x z, y z, z); the cross product of its derivatives, scaled:
    length = np.sqrt(across**2 + down**2 + (depth + x * across + y * down) ** 2)
    cosine = depth / (length * np.sqrt(x**2 + y**2 + 1) + 1e-30)
    return np.where(
        depth > 0,
        255 * (AMBIENT + (1 - AMBIENT) * cosine) + 0.5,
        0,
    ).astype(np.uint8)


@lru_cache(maxsize=8)
def pixel_order(pixels: int) -> NDArray[np.int32]:
    """Return a fixed shuffle of an image's pixels, by which points are drawn.

    Args:
        pixels: number of pixels of the image.

    Returns:
        Indices of the pixels, (pixels,) int32; earlier ones are preferred.
    """
    return np.random.default_rng(0).permutation(pixels).astype(np.int32)


def visible_points(
    depth: Float32,
    pose: Float,
    intrinsics: Float,
) -> Float32:
    """Draw points on the visible surface.

    The draw is uniform over the pixels that show the object. It depends on these pixels alone,
    and few repeat.

    Args:
        depth: (H, W) float32; 0 where there is no object.
        pose: camera-to-world, (4, 4), OpenCV axes, in the unit of the depth.
        intrinsics: pinhole matrix, (3, 3), pixels.

    Returns:
        Points, (1024, 3) float32, object frame; all zero if nothing is visible.
    """
    flat = object_depth(depth).ravel()
    order = pixel_order(flat.size)
    # most often the beginning of the order holds enough
    for first in (4 * CLOUD_POINTS, 8 * CLOUD_POINTS, 16 * CLOUD_POINTS, flat.size):
        visible = np.flatnonzero(flat[order[:first]])
        if len(visible) >= CLOUD_POINTS:
            break
    chosen = order[visible[:CLOUD_POINTS]]
    if len(chosen) == 0:
        return np.zeros((CLOUD_POINTS, 3), np.float32)
    chosen = np.resize(chosen, CLOUD_POINTS)
    rows, columns = np.divmod(chosen, depth.shape[1])
    rays = PinholeCamera.of(intrinsics, depth.shape).rays_through(rows, columns)
    return ((rays * flat[chosen, None]) @ pose[:3, :3].T + pose[:3, 3]).astype(
        np.float32
    )
