"""Whether a thing was taught at all: by how badly the likeliest hypothesis explains the views."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.types import Float

# number of residuals that the mean of all things counts for, beside those of a thing
SHRINKAGE = 2.0
LEAST_RESIDUAL = 0.02  # below which residuals do not differ
# of pixels that are off by just the noise: half a squared standard normal
NOISE_RESIDUAL = 0.5
NOISE_SHARE = 0.8  # of a thing's pixels that the surface explains, if only the noise is in the way
# part of the noise in the variance of a depth, from which it is in the way
MOSTLY_NOISE = 0.5
# by what factor the noise of a real camera may be larger than it is measured
NOISE_KNOWN = 1.5


@dataclass(frozen=True, eq=False)
class KnownResiduals:
    """Residuals of taught things, as their own geometry explains them through the sensor.

    Some things are always explained worse than others: thin ones, and those that moved since they
    were scanned. So each thing has its own usual residual, and what counts is how many times it is
    exceeded.

    Attributes:
        usual: usual residual of each thing, (T,) float64.
        excess: logarithms of how many times known things exceed it, ascending, for each number of
            views, (views, N) float64.
    """

    usual: Float
    excess: tuple[Float, ...]

    @classmethod
    def fit(
        cls,
        things: NDArray[np.integer],
        residuals: Float,
        views: NDArray[np.integer],
        count: int,
    ) -> "KnownResiduals":
        """Fit to residuals of known things, each with its own thing as the likeliest hypothesis.

        Args:
            things: which thing each is of, (N,) int.
            residuals: ``Verified.residual`` of each, (N,).
            views: after how many views, (N,) int, from 1 on without a gap.
            count: number of things, T.

        Raises:
            ModelError: there is no residual for some number of views.
        """
        logarithms = _logarithms(residuals)
        mean = logarithms.mean()
        sums = np.bincount(things, logarithms - mean, count)
        typical = mean + sums / (np.bincount(things, minlength=count) + SHRINKAGE)
        usual = np.exp(typical) - LEAST_RESIDUAL
        over = logarithms - typical[things]

        excess = []
        for number in range(1, int(views.max()) + 1):
            here = (
                np.sort(over[views == number])
                if (views == number).any()
                else np.sort(over)
            )
            excess.append(here)
        return cls(usual, tuple(excess))

    def extended(
        self,
        carried: NDArray[np.integer],
        things: NDArray[np.integer],
        residuals: Float,
        views: NDArray[np.integer],
    ) -> "KnownResiduals":
        """Add things, and leave what is known of the others as it is.

        Args:
            carried: number that each thing had before, -1 for a new one, (T,) int.
            things: which thing each further residual is of, among these, (N,) int.
            residuals: the further ones, (N,).
            views: after how many views, (N,) int.

        Returns:
            The residuals of the T things. A new one that has none of its own has the mean of the
            others.
        """
        known = np.log(self.usual + LEAST_RESIDUAL)
        typical = np.append(known, known.mean())[carried]
        logarithms = _logarithms(residuals)
        for thing in np.flatnonzero(np.asarray(carried) < 0):
            own = logarithms[things == thing] - known.mean()
            typical[thing] += own.sum() / (len(own) + SHRINKAGE)

        over = logarithms - typical[things]
        excess = []
        for number, before in enumerate(self.excess, 1):
            excess.append(np.sort(np.concatenate([before, over[views == number]])))
        return KnownResiduals(np.exp(typical) - LEAST_RESIDUAL, tuple(excess))

    def p_value(self, residual: float, thing: int, views: int) -> float:
        """Share of known things that are explained as badly.

        Args:
            residual: of the likeliest hypothesis.
            thing: which thing it is of.
            views: how many views there are.

        Returns:
            Between 0 and 1; small for a thing that was not taught.
        """
        excess = self.excess[min(views, len(self.excess)) - 1]
        exceeded = (max(residual, 0) + LEAST_RESIDUAL) / (
            self.usual[thing] + LEAST_RESIDUAL
        )
        over = np.log(exceeded)
        as_bad = len(excess) - np.searchsorted(excess, over - 1e-12)
        return float((1 + as_bad) / (1 + len(excess)))

    def of_real_camera(
        self,
        residual: float,
        thing: int,
        views: int,
        explained: float = 1.0,
        noise_share: float = 1.0,
    ) -> float:
        """The p-value of what a real camera sees, whose noise is not known exactly.

        Cameras have errors that no model of their noise holds. Known things are then explained
        worse than in the simulation that this was fitted to. So a residual that the noise alone
        explains, if it is larger than it was measured by ``NOISE_KNOWN``, is no reason to call a
        thing unknown; provided that the surface explains most of the pixels at all, and that the
        noise is larger than the errors of the scans.

        Args:
            residual: of the likeliest hypothesis.
            thing: which thing it is of.
            views: how many views there are.
            explained: share of the thing's pixels that the hypothesis explains, in the mean.
            noise_share: part that the noise of the camera has in the variance of a depth; the
                errors of the scan have the rest.

        Returns:
            See ``p_value``; at least 0.5 where the noise explains the residual.
        """
        p_value = self.p_value(residual, thing, views)
        noise_explains = residual <= NOISE_RESIDUAL * NOISE_KNOWN**2 * noise_share
        if noise_share >= MOSTLY_NOISE and noise_explains and explained >= NOISE_SHARE:
            return 0.5 + p_value / 2
        return p_value


def _logarithms(residuals: Float) -> Float:
    """Logarithms of residuals; very small ones do not differ."""
    return np.log(np.maximum(residuals, 0) + LEAST_RESIDUAL)
