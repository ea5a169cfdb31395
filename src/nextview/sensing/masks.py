"""Pixels of a frame in a box, in a sphere, above a plane, or in a mask without its edge."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.ndimage import uniform_filter

from nextview.sensing.facets import Noise
from nextview.sensing.frame import WHOLE, Frame, Part, within
from nextview.sensing.mask_edges import SQUARE_WIDTH, trimmed
from nextview.sensing.object_frame import Box
from nextview.sensing.planes import Plane
from nextview.types import Float, Float32, Mask

# height over a plane, as a part of the distance, above which a pixel at a mask's edge is not the
# plane's
STANDS = 0.02
PLANE_SHARE = 0.003  # of the distance, by which a plane is off beside the noise
BESIDE = 20  # pixels around a mask in which the noise of the plane is measured
FEWEST_BESIDE = 100  # pixels of the plane by which it is
TOUCHING_GAP = 0.006  # metres between two things that touch, at most
TOUCHING_STEP = 0.015  # metres between their depths where they are nearest, at most
BESIDE_POINTS = 200  # pixels at a border that are compared
SPHERE_MARGIN = 1.02  # times the radius of a known object within which its pixels lie


def inside_box(frame: Frame, box: Box) -> Mask:
    """Return the pixels whose positions lie in an upright box.

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
    """Return the pixels whose positions lie in a sphere.

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
    """Return the pixels that are higher above a plane than the noise explains.

    Args:
        frame: the frame.
        plane: the plane.
        noise: of the frame.
        part: rows and columns to compute.

    Returns:
        The pixels of the part, (H, W) bool.
    """
    depth = frame.depth[part]
    height = frame.along(plane.normal, plane.offset, part)
    least = np.float32(PLANE_SHARE) * depth
    high = (height > least) & (depth > 0)

    # Noise moves a point along its ray: it rises by so much as the ray does.
    a, b, c = (frame.camera_to_world[:3, :3].T @ plane.normal).astype(np.float32)
    x = frame.rays[0][part[1]]
    y = frame.rays[1][part[0]]
    most_noise = 4 * float(noise.sigmas.max(initial=0.0))
    steepest = float(
        np.abs(a) * np.abs(x).max() + np.abs(b) * np.abs(y).max() + np.abs(c)
    )
    unsure = height < least + np.float32(most_noise * steepest) * depth**2
    unsure &= high

    rows, columns = np.divmod(np.flatnonzero(unsure), high.shape[1])
    z = depth[rows, columns]
    rise = np.abs((a * x)[columns] + (b * y + c)[rows])
    high[rows, columns] = height[rows, columns] > z * (
        4 * noise.at(z) * z * rise + PLANE_SHARE
    )
    return high


def inside_mask(
    frame: Frame,
    given: Mask,
    plane: Plane | None,
    noise: Noise,
) -> Mask:
    """The pixels of a mask without the background at its edge and the support plane.

    Args:
        frame: the frame.
        given: the mask, (H, W) bool.
        plane: that the object stands on; None if it is not seen.
        noise: of the frame.
    """
    if plane is None:
        return trimmed(frame.depth, given, noise)

    high = frame.along(plane.normal, plane.offset) > STANDS * frame.depth
    mask = trimmed(frame.depth, given, noise, high)
    part = within(mask, BESIDE)
    above = mask.copy()
    above[part] &= _above_in_the_mean(frame, mask, plane, noise, part)
    # a plane may lie above what is hidden or flat
    return above if 2 * np.count_nonzero(above) > np.count_nonzero(mask) else mask


def _above_in_the_mean(
    frame: Frame,
    mask: Mask,
    plane: Plane,
    noise: Noise,
    part: Part,
) -> Mask:
    """Which pixels of a mask are higher above a plane than the noise of their neighbourhood.

    The mean of the neighbours in the mask is less noisy than a pixel: with the noise of a pixel the
    lower part of a small thing would be taken for the plane. How much less is measured beside the
    mask, since neighbouring pixels of a sensor err together.
    """
    z = frame.depth[part]
    own = mask[part] & (z > 0)
    height = frame.along(plane.normal, plane.offset, part)
    a, b, c = (frame.camera_to_world[:3, :3].T @ plane.normal).astype(np.float32)
    x, y = frame.rays[0][part[1]], frame.rays[1][part[0]]
    deviation = noise.at(z) * z**2 * np.abs(a * x + (b * y + c)[:, None])

    beside = ~mask[part] & (z > 0) & (np.abs(height) < 4 * deviation + PLANE_SHARE * z)
    means = _mean(height, beside)[beside] / np.maximum(deviation[beside], 1e-9)
    left = 1.0
    if len(means) >= FEWEST_BESIDE:
        left = min(1.0, float(np.sqrt(np.mean(means**2))))
    return own & (_mean(height, own) > 4 * left * deviation + PLANE_SHARE * z)


def _mean(values: Float32, among: Mask) -> Float32:
    """Means of the neighbours that are among some pixels, (H, W) float32."""
    share = uniform_filter(among.astype(np.float32), SQUARE_WIDTH, mode="constant")
    total = uniform_filter(values * among, SQUARE_WIDTH, mode="constant")
    return np.asarray(total / np.maximum(share, np.float32(1e-6)))


def touching(
    frame: Frame,
    one: Mask,
    other: Mask,
    gap: float = TOUCHING_GAP,
    step: float = TOUCHING_STEP,
) -> bool:
    """Whether two things meet in the picture and in depth.

    Args:
        frame: that shows them.
        one: the pixels of one of them, (H, W) bool.
        other: those of the other.
        gap: metres between them in the picture, at most.
        step: metres between their depths where they are nearest, at most.
    """
    part = within(one)
    away_from_camera = frame.depth[part][one[part]]
    if not away_from_camera.any():
        return False

    focal = float(frame.intrinsics[[0, 1], [0, 1]].mean())
    reach = max(
        2.0,
        gap * focal / float(np.median(away_from_camera[away_from_camera > 0])),
    )
    near = within(one, int(reach) + 1)
    if not other[near].any():
        return False

    away, nearest = ndimage.distance_transform_edt(~one[near], return_indices=True)
    beside = np.nonzero(other[near] & (away <= reach))
    if not len(beside[0]):
        return False

    few = slice(None, None, max(1, len(beside[0]) // BESIDE_POINTS))
    rows, columns = beside[0][few], beside[1][few]
    depth = frame.depth[near]
    own = depth[nearest[0][rows, columns], nearest[1][rows, columns]]
    its = depth[rows, columns]
    known = (own > 0) & (its > 0)
    apart = np.abs(own - its)[known]
    return bool(len(apart)) and float(np.median(apart)) < step
