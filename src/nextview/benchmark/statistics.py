"""Error bars and tests. What is drawn anew is the object: the views and runs of one object are not independent."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, norm

Float = NDArray[np.float64]


def resample(n: int, samples: int, rng: np.random.Generator) -> Float:
    """Bootstrap weights: how often each of n objects is drawn in each sample, (samples, n); each row sums to n."""
    return rng.multinomial(n, np.full(n, 1 / n), size=samples).astype(np.float64)


def interval(samples: Float, level: float = 0.95) -> tuple[Float, Float]:
    """Percentile interval of bootstrap samples (S, M): its ends, each (M,)."""
    empty = np.isnan(samples).all(0)
    low, high = np.nanquantile(np.where(empty, 0, samples), [(1 - level) / 2, (1 + level) / 2], axis=0)
    return np.where(empty, np.nan, low), np.where(empty, np.nan, high)


def bootstrap_p(difference: Float, samples: Float) -> Float:
    """Two-sided p-values of "no difference": the observed ones over their bootstrap standard errors, against a normal.

    Counting samples beyond zero instead could not go below 2 / S, too coarse for a correction over many tests.

    Args:
        difference: observed, (M,).
        samples: paired bootstrap samples of it, (S, M).

    Returns:
        (M,); 1 where nothing differs in any sample.
    """
    error = samples.std(0)
    return 2 * norm.sf(np.abs(difference) / np.where(error > 0, error, np.inf))


def mcnemar(right: NDArray[np.bool_], reference: NDArray[np.bool_]) -> float:
    """McNemar's test for answers that come in clusters: several runs of each object.

    With one run it is McNemar's test without continuity correction. Durkalski et al., Analysis of clustered
    matched-pair data, Statistics in Medicine 22 (2003) 2417.

    Args:
        right: whether each answer is right, (runs, N).
        reference: the same of the policy compared with.

    Returns:
        Two-sided p-value; 1 if no object is answered differently.
    """
    difference = (right.astype(np.float64) - reference).mean(0)
    spread = (difference**2).sum()
    return float(chi2.sf(difference.sum() ** 2 / spread, 1)) if spread > 0 else 1.0


def holm(p: Float) -> Float:
    """Holm's correction for as many tests as there are p-values (M,): NaN ones are no tests and stay NaN."""
    adjusted = np.full(len(p), np.nan)
    tested = np.flatnonzero(~np.isnan(p))
    order = tested[np.argsort(p[tested])]
    adjusted[order] = np.minimum(1, np.maximum.accumulate(p[order] * np.arange(len(order), 0, -1)))
    return adjusted


def area(x: Float, y: Float, low: float, high: float) -> float:
    """Mean height of the curve through (x, y) between ``low`` and ``high``.

    ``x`` ascends; before its first point and after its last one the curve goes on level.
    """
    inside = (x > low) & (x < high)
    grid = np.concatenate([[low], x[inside], [high]])
    first, last = np.interp([low, high], x, y)
    return float(np.trapezoid(np.concatenate([[first], y[inside], [last]]), grid) / (high - low))
