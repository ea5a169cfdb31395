"""Test whether an object was taught, by the residual of the likeliest hypothesis."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.types import Float

# weight of the mean of all things, in residuals of one thing
SHRINKAGE = 2.0
LEAST_RESIDUAL = 0.02  # lower bound: smaller residuals are equivalent
# mean residual by noise alone: half the square of a standard normal variable
NOISE_RESIDUAL = 0.5
# share of the pixels that the surface must explain before noise is an excuse
NOISE_SHARE = 0.8
# share of the noise in the variance of a depth, from which noise is an excuse
MOSTLY_NOISE = 0.5
# factor by which the noise of a real camera may exceed its estimate
NOISE_KNOWN = 1.5


@dataclass(frozen=True, eq=False)
class KnownResiduals:
    """Residuals of taught things under their own geometry, through the sensor.

    Some things always have larger residuals than others: thin things, and things whose parts moved
    after the scan. Therefore each thing has a usual residual, and the test uses the ratio to it.

    Attributes:
        usual: usual residual of each thing, (T,) float64.
        excess: logarithms of the ratios of known things, ascending, for each number of views,
            (views, N) float64.
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
        """Fit to residuals of known things whose likeliest hypothesis is correct.

        Args:
            things: thing of each residual, (N,) int.
            residuals: ``Verified.residual`` of each, (N,).
            views: number of views of each, (N,) int. A number without residuals gets those of all.
            count: number of things, T.

        Returns:
            The usual residuals and the distribution of the ratios.
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
        """Add things without changing the fits of the others.

        Args:
            carried: previous number of each thing, -1 for a new one, (T,) int.
            things: thing of each additional residual, (N,) int.
            residuals: the additional residuals, (N,).
            views: number of views of each, (N,) int.

        Returns:
            The residuals of the T things. A new thing without residuals gets the mean of the
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

    @property
    def least_p_value(self) -> float:
        """Smallest p-value that is possible after any number of views."""
        return 1 / (1 + min(len(excess) for excess in self.excess))

    def p_value(self, residual: float, thing: int, views: int) -> float:
        """Share of known things with at least this residual, relative to the usual one.

        Args:
            residual: residual of the likeliest hypothesis.
            thing: number of its thing.
            views: number of views.

        Returns:
            Between 0 and 1; small for an object that was not taught.
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
        """p-value for a real camera, whose noise is not known exactly.

        Cameras have errors beyond any noise model, so known things have larger residuals than in
        the simulation of the fit. A residual that noise of ``NOISE_KNOWN`` times the estimate
        explains is therefore no reason to call an object unknown, provided that the surface
        explains most of the pixels and that the noise exceeds the errors of the scans.

        Args:
            residual: residual of the likeliest hypothesis.
            thing: number of its thing.
            views: number of views.
            explained: mean share of the thing's pixels that the hypothesis explains.
            noise_share: share of the camera noise in the variance of a depth; the errors of the
                scan have the rest.

        Returns:
            See ``p_value``; at least 0.5 if the noise explains the residual.
        """
        p_value = self.p_value(residual, thing, views)
        noise_explains = residual <= NOISE_RESIDUAL * NOISE_KNOWN**2 * noise_share
        if noise_share >= MOSTLY_NOISE and noise_explains and explained >= NOISE_SHARE:
            return 0.5 + p_value / 2
        return p_value


def _logarithms(residuals: Float) -> Float:
    """Logarithms of residuals, with a lower bound."""
    return np.log(np.maximum(residuals, 0) + LEAST_RESIDUAL)
