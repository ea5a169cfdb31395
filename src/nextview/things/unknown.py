"""Whether a thing was taught at all: by how badly the likeliest hypothesis explains the views."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

SHRINKAGE = (
    2.0  # number of residuals that the mean of all things counts for, beside those of a thing
)
LEAST_RESIDUAL = 0.02  # below which residuals do not differ


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
        cls, things: NDArray[np.integer], residuals: Float, views: NDArray[np.integer], count: int
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
        logarithms = np.log(np.maximum(residuals, 0) + LEAST_RESIDUAL)
        mean = logarithms.mean()
        sums = np.bincount(things, logarithms - mean, count)
        typical = mean + sums / (np.bincount(things, minlength=count) + SHRINKAGE)
        usual = np.exp(typical) - LEAST_RESIDUAL
        over = logarithms - typical[things]

        excess = []
        for number in range(1, int(views.max()) + 1):
            here = np.sort(over[views == number]) if (views == number).any() else np.sort(over)
            excess.append(here)
        return cls(usual, tuple(excess))

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
        exceeded = (max(residual, 0) + LEAST_RESIDUAL) / (self.usual[thing] + LEAST_RESIDUAL)
        over = np.log(exceeded)
        as_bad = len(excess) - np.searchsorted(excess, over - 1e-12)
        return float((1 + as_bad) / (1 + len(excess)))
