"""The noise of a depth image, measured from the image itself."""

from dataclasses import dataclass

import numpy as np

from nextview.types import Float, Float32, Floats, Mask

MEDIAN_OF_NORMAL = 0.6745  # median of the size of a normal deviate
LEAST_NOISE = 2e-4  # relative noise of depth assumed for noise-free frames
ROWS_MEASURED = 20  # approximate number of image rows used to measure it
# standard deviation of a measured depth, relative, at least: real depth is bent
LEAST_ERROR = 0.0025
ALIKE = 3.0  # standard deviations between two measurements of one place


@dataclass(frozen=True)
class Noise:
    """The noise of a depth image, as a function of depth.

    Attributes:
        depths: ascending, metres, (D,).
        sigmas: standard deviation of inverse depth at each, 1/metres, (D,).
        grain: distance within which the errors of pixels are correlated, pixels.
    """

    depths: Float
    sigmas: Float
    grain: int = 1

    def at(self, depth: Floats | float) -> Float:
        """Return the standard deviation of inverse depth at some depths, same shape, 1/metres."""
        return np.asarray(np.interp(depth, self.depths, self.sigmas))


def estimate_noise(depth: Float32, usable: Mask) -> Noise:
    """Measure the noise of a depth image.

    On a plane the second difference of inverse depth along a row is pure noise, with the variance 6
    sigma^2 if its pixels are independent. The median of its size is not affected by edges.

    Args:
        depth: (H, W) float32, metres.
        usable: pixels to use, (H, W) bool.

    Returns:
        The noise; zero if there are few pixels.
    """
    q = np.where(usable, 1 / np.where(usable, depth, 1), np.nan)
    found = []

    for lag in (1, 2, 4, 6):  # pixels, as the errors of neighbours are often correlated
        second = (
            np.abs(q[:, : -2 * lag] - 2 * q[:, lag:-lag] + q[:, 2 * lag :])
            if q.shape[1] > 2 * lag
            else q[:, :0]
        )
        known = np.isfinite(second)
        if not known.any():
            break
        found.append((lag, second[known], depth[:, lag:-lag][known]))
    if not found:
        return Noise(np.ones(1), np.zeros(1))

    typical = np.array([_sigma(second) for _, second, _ in found])
    grain = found[int((typical >= 0.7 * typical.max()).argmax())][0]
    _, second, at = found[-1]
    # four ranges of depth with equally many pixels
    parts = np.array_split(np.argsort(at), min(4, len(at)))
    depths = np.array([np.median(at[part]) for part in parts], np.float64)

    return Noise(depths, np.array([_sigma(second[part]) for part in parts]), grain)


def _sigma(second: Floats) -> float:
    """Estimate the standard deviation of the noise from second differences."""
    middle = (len(second) - 1) // 2, len(second) // 2
    median = np.partition(second, middle)[
        list(middle)
    ].mean()  # faster than a median that checks for NaN
    return float(median) / (MEDIAN_OF_NORMAL * np.sqrt(6))
