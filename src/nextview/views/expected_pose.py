"""Expected reduction of the pose error by views that were not taken yet.

The measure is the displacement of the surface along its normals as the next camera sees it.
Rotations of a round thing about its axis, which no view determines, do not count.
"""

from functools import lru_cache

import numpy as np

from nextview.things.surface import SCAN_ERROR, Surface
from nextview.types import Float, Float32, Mask
from nextview.views.expected_images import ExpectedSensor, HypothesisImages
from nextview.views.expected_model import (
    OUTLINE_PIXELS,
    ExpectedModel,
    inverses,
)

# smallest surface error, metres: below the accuracy of all cameras
LEAST_SURFACE_ERROR = 1e-6


@lru_cache(maxsize=256)
def _normal_displacements(surface: Surface) -> Float:
    """Mean square displacement of the surface along its normals by rotation and translation, (6,
    6).

    The axes are those of the scan file; the rotation is about the centre of the surface.
    """
    corners = surface.vertices[surface.faces].astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(across, axis=1)
    normals = across / np.maximum(areas, 1e-30)[:, None]
    arms = corners.mean(1) - surface.centre
    moved = np.concatenate([np.cross(arms, normals), normals], 1)
    return np.asarray((moved * areas[:, None]).T @ moved / areas.sum(), np.float64)


def surface_errors(surface: Surface, rotation: Float, covariances: Float) -> Float:
    """Standard deviation of the displacement of a surface along its normals.

    Args:
        surface: surface of the thing.
        rotation: from the axes of the scan file to the object frame, (3, 3).
        covariances: covariances of rotation, about the centre of the surface, and translation,
            object frame, (..., 6, 6).

    Returns:
        Standard deviations, (...) float64, metres.
    """
    turned = np.kron(np.eye(2), rotation)
    displaced = turned @ _normal_displacements(surface) @ turned.T
    variances = np.einsum("ij,...ji->...", displaced, covariances)
    # rounding can make the variance of an exact pose negative, and the logarithm needs a positive
    # value
    return np.sqrt(np.maximum(variances, LEAST_SURFACE_ERROR**2))


def sharper_poses(
    images: HypothesisImages,
    surface: Surface,
    pose: Float,
    covariance: Float,
    sensor: ExpectedSensor,
    model: ExpectedModel,
    taken: int,
) -> Float:
    """Logarithm of the reduction of the surface error by each view.

    A camera that sees little of the thing hardly determines its own pose error, so the error can
    also be larger in a new view than in the last one.

    Args:
        images: renderings for each view; the first hypothesis is the likeliest.
        surface: surface of its thing.
        pose: its pose, (4, 4).
        covariance: covariance of rotation and translation after the views so far, (6, 6).
        sensor: the camera.
        model: errors that are expected of the camera pose.
        taken: number of views so far.

    Returns:
        Logarithms, (V,) float64; positive where the error becomes smaller.
    """
    rotation = pose[:3, :3]
    centre = rotation @ surface.centre.astype(np.float64) + pose[:3, 3]
    told = _information(images, centre, sensor, model)

    away = np.linalg.norm(images.origins - centre, axis=1)
    displaced = (model.camera**2 + (model.aim * away) ** 2) * (1 + 1 / taken)
    before = np.tile(covariance, (len(away), 1, 1))
    before[:, 3:, 3:] += displaced[:, None, None] * np.eye(3)
    after = inverses(inverses(before) + told)

    now = surface_errors(surface, rotation, covariance)
    return np.log(now / surface_errors(surface, rotation, after))


def _information(
    images: HypothesisImages,
    centre: Float,
    sensor: ExpectedSensor,
    model: ExpectedModel,
) -> Float:
    """Fisher information of each view about rotation and translation of the first hypothesis, (V,
    6, 6).
    """
    shows = np.isfinite(images.depth[:, 0])
    depth = np.where(shows, images.depth[:, 0], 0)
    points = images.origins[:, None] + images.rays * depth[..., None]
    arms = points - centre.astype(np.float32)
    seen = images.clear * shows

    noise = SCAN_ERROR**2 + (sensor.noise * depth**2) ** 2
    area = (images.step / sensor.pitch).prod(1)[:, None]
    weights = (seen / noise).astype(np.float32)
    inside = _summed(arms, images.normals[:, 0], weights, seen * area, model)

    aside = _outward(images, shows)
    rim = seen * (np.abs(aside).sum(2) > 0)
    deviation = SCAN_ERROR**2 + (OUTLINE_PIXELS * sensor.pitch * depth) ** 2
    width = (images.step / sensor.pitch).mean(1)[:, None]
    weights = (rim / deviation).astype(np.float32)
    return inside + _summed(arms, aside, weights, rim * width, model)


def _summed(
    arms: Float32,
    directions: Float32,
    weights: Float32,
    pixels: Float32,
    model: ExpectedModel,
) -> Float:
    """Fisher information of pixels that constrain a thing in some directions, (V, 6, 6)."""
    moved = np.concatenate([np.cross(arms, directions), directions], 2).astype(
        np.float64
    )
    # As in the registration: the errors of neighbouring pixels are correlated.
    count = np.minimum(pixels.sum(1), model.pixels) / np.maximum(
        (weights > 0).sum(1),
        1,
    )
    weighted = moved * (weights * count[:, None])[..., None]
    return np.asarray(weighted.swapaxes(1, 2) @ moved, np.float64)


def _outward(images: HypothesisImages, shows: Mask) -> Float32:
    """Outward normals of the outline, (V, P, 3) float32: unit vectors at the rim, zero elsewhere.

    The border to an occluder is no outline of the thing.
    """
    side = images.side
    views = len(shows)
    own = (shows | images.hidden[:, 0]).reshape(views, side, side)
    padded = np.pad(own, ((0, 0), (1, 1), (1, 1))).astype(np.float32)
    right = padded[:, 1:-1, :-2] - padded[:, 1:-1, 2:]
    down = padded[:, :-2, 1:-1] - padded[:, 2:, 1:-1]

    rays = images.rays.reshape(views, side, side, 3)
    across = rays[:, 0, 1] - rays[:, 0, 0]
    along = rays[:, 1, 0] - rays[:, 0, 0]
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    out = (
        right[..., None] * across[:, None, None]
        + down[..., None] * along[:, None, None]
    )
    length = np.linalg.norm(out, axis=3, keepdims=True)
    return (out / np.maximum(length, 1e-6)).reshape(views, -1, 3)
