"""Select pixels of a frame: in a box, in a sphere, above a plane, or in a trimmed mask."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from nextview.sensing.frame import WHOLE, Frame, Part, within
from nextview.sensing.mask_edges import SQUARE_WIDTH, trimmed
from nextview.sensing.noise import Noise
from nextview.sensing.object_frame import Box
from nextview.sensing.planes import Plane
from nextview.types import Float, Float32, Mask

# A point is on a plane if its height is at most so many deviations of its noise, and this share of
# its distance.
PLANE_NOISE = 4.0
PLANE_SHARE = 0.003  # the same as a share of the distance
BESIDE = 20  # width of the margin around a mask in which the noise of the plane is measured, pixels
SPHERE_MARGIN = 1.02  # times the radius of a known object within which its pixels lie


def inside_box(frame: Frame, box: Box) -> Mask:
    """Return the pixels with positions inside an upright box.

    Args:
        frame: the frame.
        box: the box.

    Returns:
        The pixels, (H, W) bool.
    """
    inside = frame.depth > 0
    for axis, low, high in zip(box.axes, box.low, box.high, strict=True):
        position = frame.along(axis)
        inside &= (position >= low) & (position <= high)
    return inside


def inside_sphere(
    frame: Frame,
    centre: Float,
    radius: float,
    part: Part = WHOLE,
) -> Mask:
    """Return the pixels with positions inside a sphere.

    Args:
        frame: the frame.
        centre: of the sphere, world, (3,), metres.
        radius: of the sphere, metres.
        part: rows and columns to compute.

    Returns:
        The pixels of the part, (H, W) bool.
    """
    x, y, z = (
        frame.along(axis, float(-at), part)
        for axis, at in zip(np.eye(3), centre, strict=True)
    )
    return (frame.depth[part] > 0) & (x * x + y * y + z * z < radius**2)


def above_plane(frame: Frame, plane: Plane, noise: Noise, part: Part = WHOLE) -> Mask:
    """Return the pixels that are above a plane by more than the noise.

    Args:
        frame: the frame.
        plane: the plane.
        noise: of the frame.
        part: rows and columns to compute.

    Returns:
        The pixels of the part, (H, W) bool.
    """
    z = frame.depth[part]
    # Noise moves a point along its ray, so the height error depends on the slope of the ray.
    least = PLANE_NOISE * noise.at(z) * z * np.abs(_rise(frame, plane, part))
    height = frame.along(plane.normal, plane.offset, part)
    return np.asarray((z > 0) & (height > z * (least + PLANE_SHARE)))


def _rise(frame: Frame, plane: Plane, part: Part) -> Float32:
    """Return by how much the ray of each pixel rises over a plane with depth."""
    a, b, c = (frame.camera_to_world[:3, :3].T @ plane.normal).astype(np.float32)
    x, y = frame.rays
    return a * x[part[1]] + (b * y[part[0]] + c)[:, None]


def inside_mask(
    frame: Frame,
    given: Mask,
    plane: Plane | None,
    noise: Noise,
) -> Mask:
    """Return the pixels of a mask without background at its edge and without the support plane.

    Args:
        frame: the frame.
        given: the mask, (H, W) bool.
        plane: support plane of the object; None if it is not visible.
        noise: of the frame.
    """
    if plane is None:
        return trimmed(frame.depth, given, noise)

    # from such a height on a pixel at the edge of a mask is not on the plane
    high = frame.along(plane.normal, plane.offset) > 0.02 * frame.depth
    mask = trimmed(frame.depth, given, noise, high)
    part = within(mask, BESIDE)
    above = mask.copy()
    above[part] &= _above_on_average(frame, mask, plane, noise, part)
    # a plane may lie above what is hidden or flat
    return above if 2 * np.count_nonzero(above) > np.count_nonzero(mask) else mask


def _above_on_average(
    frame: Frame,
    mask: Mask,
    plane: Plane,
    noise: Noise,
    part: Part,
) -> Mask:
    """Return the pixels of a mask whose neighbourhood is above a plane by more than its noise.

    The mean height of the neighbours in the mask has less noise than a single pixel, whose noise
    would hide the lower part of a small object. The errors of neighbouring pixels are correlated,
    so the noise of the mean is measured on the plane beside the mask.
    """
    z = frame.depth[part]
    own = mask[part] & (z > 0)
    height = frame.along(plane.normal, plane.offset, part)
    deviation = noise.at(z) * z**2 * np.abs(_rise(frame, plane, part))

    on_plane = np.abs(height) < PLANE_NOISE * deviation + PLANE_SHARE * z
    beside = ~mask[part] & (z > 0) & on_plane
    means = _local_mean(height, beside)[beside] / np.maximum(deviation[beside], 1e-9)
    ratio = 1.0  # deviation of the mean, relative to that of a pixel
    if len(means) >= 100:  # pixels that measure it
        ratio = min(1.0, float(np.sqrt(np.mean(means**2))))

    least = PLANE_NOISE * ratio * deviation + PLANE_SHARE * z
    return own & (_local_mean(height, own) > least)


def _local_mean(values: Float32, among: Mask) -> Float32:
    """Return means over the neighbours within a mask, (H, W) float32."""
    share = ndimage.uniform_filter(
        among.astype(np.float32), SQUARE_WIDTH, mode="constant"
    )
    total = ndimage.uniform_filter(values * among, SQUARE_WIDTH, mode="constant")
    return np.asarray(total / np.maximum(share, np.float32(1e-6)))


def touching(frame: Frame, one: Mask, other: Mask) -> bool:
    """Return True if two objects touch in the image and in depth.

    Args:
        frame: of both masks.
        one: mask of one object, (H, W) bool.
        other: mask of the other one, (H, W) bool.
    """
    depth = frame.depth
    if not (depth[one] > 0).any():
        return False
    focal = float(frame.intrinsics[[0, 1], [0, 1]].mean())
    away = float(np.median(depth[one & (depth > 0)]))
    # 6 mm in the image, and 15 mm in depth along a quarter of the border, are no gap
    reach = max(2.0, 0.006 * focal / away)
    near = within(one, int(reach) + 1)
    apart, nearest = ndimage.distance_transform_edt(~one[near], return_indices=True)
    beside = other[near] & (apart <= reach)
    own = depth[near][tuple(nearest)][beside]
    its = depth[near][beside]
    step = np.abs(own - its)[(own > 0) & (its > 0)]
    return len(step) > 0 and float(np.quantile(step, 0.25)) < 0.015
