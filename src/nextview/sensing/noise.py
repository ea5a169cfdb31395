"""How noisy a depth image is, measured on the image itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BINS = 4
"""Ranges of depth in which the noise is measured, with equally many pixels."""
ROWS = 20
"""About so many rows of a picture are enough to measure it."""
LAGS = (1, 2, 4, 6)
"""Distances of the pixels that are compared. Neighbours err together in many sensors: a structured-light camera has
patches of four pixels with the same error."""


@dataclass(frozen=True)
class Noise:
    """The noise of inverse depth as it depends on depth: each sensor has its own law.

    Attributes:
        depths: middle of each range of depth, ascending, (B,) float64, metres.
        sigmas: standard deviation of inverse depth there, (B,) float64, 1/metres.
        grain: about how many pixels in a row err together: 1 if each errs for itself.
    """

    depths: NDArray[np.float64]
    sigmas: NDArray[np.float64]
    grain: int = 1

    def at(self, depth: NDArray[np.floating] | float) -> NDArray[np.float64]:
        """The standard deviation of inverse depth at some depths, same shape, 1/metres."""
        return np.asarray(np.interp(depth, self.depths, self.sigmas))


def estimate_noise(depth: NDArray[np.float32], usable: NDArray[np.bool_]) -> Noise:
    """Measure the noise of a depth image.

    On a plane the second difference of inverse depth along a row is noise alone, with the variance 6 sigma^2 if its
    pixels do not err together; the median of its size does not mind the edges.

    Args:
        depth: (H, W), metres.
        usable: which pixels have a depth, (H, W) bool.

    Returns:
        The noise; none at all where too few pixels lie in a row.
    """
    q = np.where(usable, 1 / np.where(usable, depth, 1), np.nan)
    found = []
    for lag in LAGS:
        second = np.abs(q[:, : -2 * lag] - 2 * q[:, lag:-lag] + q[:, 2 * lag :]) if q.shape[1] > 2 * lag else q[:, :0]
        known = np.isfinite(second)
        if not known.any():
            break
        found.append((lag, second[known], depth[:, lag:-lag][known]))
    if not found:
        return Noise(np.ones(1), np.zeros(1))
    typical = np.array([_sigma(second) for _, second, _ in found])
    grain = found[int((typical >= 0.7 * typical.max()).argmax())][0]
    _, second, at = found[-1]
    parts = np.array_split(np.argsort(at), min(BINS, len(at)))
    depths = np.array([np.median(at[part]) for part in parts], np.float64)
    return Noise(depths, np.array([_sigma(second[part]) for part in parts]), grain)


def _sigma(second: NDArray[np.floating]) -> float:
    """Standard deviation of the noise from the sizes of second differences."""
    return float(np.median(second)) / (0.6745 * np.sqrt(6))
