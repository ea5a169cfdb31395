"""Error bars and tests.

What is drawn anew is the object: the views and runs of one object are not independent.
"""

import numpy as np
from scipy.stats import chi2, norm

from nextview.data import metrics
from nextview.types import Float, Index, Mask

NO_SPREAD = 1e-9  # standard deviation of samples that differ by rounding alone


def resample(n: int, samples: int, rng: np.random.Generator) -> Float:
    """Draw bootstrap weights.

    Args:
        n: number of objects.
        samples: number of samples.
        rng: source of all random numbers.

    Returns:
        How often each object is drawn in each sample, (samples, n) float64; each row sums to n.
    """
    return rng.multinomial(n, np.full(n, 1 / n), size=samples).astype(np.float64)


def interval(samples: Float) -> tuple[Float, Float]:
    """95 % percentile interval of bootstrap samples (S, M): its ends, each (M,)."""
    empty = np.isnan(samples).all(0)
    low, high = np.nanquantile(np.where(empty, 0, samples), [0.025, 0.975], axis=0)
    return np.where(empty, np.nan, low), np.where(empty, np.nan, high)


def estimate(
    top: Float,
    bottom: Float,
    weights: Float,
    labels: Index | None = None,
) -> tuple[Float, Float]:
    """Return ratios of sums over objects and their bootstrap samples.

    Args:
        top: numerators, (N, M).
        bottom: denominators, (N, M).
        weights: bootstrap weights, (S, N).
        labels: class of each object, (N,), for means over classes; None for sums over all objects.

    Returns:
        Ratios, (M,), and their samples, (S, M).
    """
    once = np.ones((1, len(top)))
    if labels is None:
        return metrics.ratio(top, bottom, once)[0], metrics.ratio(top, bottom, weights)
    return metrics.class_mean(top, bottom, labels, once)[0], metrics.class_mean(
        top,
        bottom,
        labels,
        weights,
    )


def bootstrap_p(difference: Float, samples: Float) -> Float:
    """Return two-sided p-values of "no difference".

    Args:
        difference: observed differences, (M,).
        samples: paired bootstrap samples of the differences, (S, M).

    Returns:
        p-values, (M,).
    """
    error = samples.std(0)
    return 2 * norm.sf(np.abs(difference) / np.where(error > NO_SPREAD, error, np.inf))


def mcnemar(right: Mask, reference: Mask) -> float:
    """Return the two-sided p-value of McNemar's test, clustered by object.

    Args:
        right: whether the answers of a policy are right, (runs, N) bool.
        reference: the same of the reference policy, (runs, N) bool.

    Returns:
        The p-value.
    """
    difference = (right.astype(np.float64) - reference).mean(0)
    spread = (difference**2).sum()
    return float(chi2.sf(difference.sum() ** 2 / spread, 1)) if spread > 0 else 1.0


def holm(p: Float) -> Float:
    """Holm's correction of p-values (M,); those that are NaN are no tests and stay NaN."""
    adjusted = np.full(len(p), np.nan)
    tested = np.flatnonzero(~np.isnan(p))
    order = tested[np.argsort(p[tested])]
    adjusted[order] = np.minimum(
        1,
        np.maximum.accumulate(p[order] * np.arange(len(order), 0, -1)),
    )
    return adjusted
