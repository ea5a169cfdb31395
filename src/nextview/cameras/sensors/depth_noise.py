"""Laws of the noise of depth cameras, and random fields whose neighbouring pixels err together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from scipy.special import ndtr

from nextview.cameras.sensors.surface_angle import STEEPEST

Image = NDArray[np.float64]
NO_GRAIN = 0.1
"""Pixels: a window so narrow holds one pixel."""


def kinect_axial(depth: NDArray[np.floating], angle: NDArray[np.floating]) -> Image:
    """Standard deviation of the depth of a Kinect (v1) along its optical axis, metres.

    0.0012 + 0.0019 (z - 0.4)^2 + 0.0001 / sqrt(z) (angle / (pi/2 - angle))^2, from Nguyen, Izadi and Lovell, "Modeling
    Kinect sensor noise for improved 3D reconstruction and tracking", 3DIMPVT 2012.

    Args:
        depth: z, metres, positive.
        angle: between the surface's normal and the line of sight, radians.
    """
    angle = np.minimum(angle, STEEPEST)
    return 0.0012 + 0.0019 * (depth - 0.4) ** 2 + 0.0001 / np.sqrt(depth) * (angle / (np.pi / 2 - angle)) ** 2


def kinect_lateral(angle: NDArray[np.floating]) -> Image:
    """Standard deviation of where a Kinect (v1) sees an edge, pixels: 0.8 + 0.035 angle / (pi/2 - angle), same source.

    Args:
        angle: between the surface's normal and the line of sight, radians.
    """
    angle = np.minimum(angle, STEEPEST)
    return 0.8 + 0.035 * angle / (np.pi / 2 - angle)


def normal_field(rng: np.random.Generator, shape: tuple[int, int], grain: float) -> Image:
    """Standard normal numbers, (H, W), of which neighbours are alike.

    White noise under a Gaussian window: the correlation of two pixels at a distance k is exp(-k^2 / (4 grain^2)).

    Args:
        rng: draws them.
        shape: H and W.
        grain: standard deviation of the window, pixels; 0 for numbers that have nothing to do with each other.
    """
    white = rng.standard_normal(shape)
    if grain < NO_GRAIN:
        return white
    impulse = np.zeros(8 * int(np.ceil(grain)) + 17)
    impulse[len(impulse) // 2] = 1
    power = (gaussian_filter1d(impulse, grain) ** 2).sum()
    return np.asarray(gaussian_filter(white, grain, mode="wrap")) / power


def uniform_field(rng: np.random.Generator, shape: tuple[int, int], grain: float) -> Image:
    """Numbers between 0 and 1, each as likely, of which neighbours are alike as in ``normal_field``."""
    return rng.random(shape) if grain == 0 else np.asarray(ndtr(normal_field(rng, shape, grain)))
