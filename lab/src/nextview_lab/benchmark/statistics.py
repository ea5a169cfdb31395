"""Confidence intervals and significance tests.

Objects are resampled, because the views and runs of one object are not independent.
"""

from collections.abc import Iterator

import numpy as np
from scipy.stats import binomtest

from nextview.types import Float, Index
from nextview_lab.data import metrics

NO_SPREAD = 1e-9  # smaller differences are rounding errors
EXACT_FAMILIES = 16  # largest number of families for an exact test
RANDOM_FLIPS = 99_999  # random sign flips for more families
FLIPS_AT_ONCE = 4096
FLIP_SEED = 0


def resample(n: int, samples: int, rng: np.random.Generator) -> Float:
    """Draw bootstrap weights.

    Args:
        n: number of objects.
        samples: number of samples.
        rng: source of all random numbers.

    Returns:
        Number of draws of each object in each sample, (samples, n) float64; each row sums to n.
    """
    return rng.multinomial(n, np.full(n, 1 / n), size=samples).astype(np.float64)


def resample_families(
    families: Index,
    samples: int,
    rng: np.random.Generator,
) -> Float:
    """Draw bootstrap weights of objects whose families are resampled as a whole.

    Args:
        families: family index of each object, (N,) int64.
        samples: number of samples.
        rng: source of all random numbers.

    Returns:
        Number of draws of each object in each sample, (samples, N) float64.
    """
    return resample(int(families.max()) + 1, samples, rng)[:, families]


def by_family(values: Float, families: Index) -> Float:
    """Sum values of objects, (N, M), over each family, (F, M).

    Args:
        values: of the objects.
        families: family index of each object, (N,) int64.
    """
    sums = np.zeros((int(families.max()) + 1, values.shape[1]))
    np.add.at(sums, families, values)
    return sums


def interval(samples: Float) -> tuple[Float, Float]:
    """Return the 95 % percentile interval of bootstrap samples, (S, M): its limits, each (M,)."""
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


def sign_flip_p(differences: Float) -> Float:
    """Return two-sided p-values of the hypothesis that two policies do not differ.

    Under this hypothesis the sign of the difference in each family is random. p is the share of all
    sign flips whose sum is at least as large: exact for few families with a difference, else
    estimated from random flips.

    Args:
        differences: of two policies in each family, (F, M), where a family is a unit of resampling,
            such as an object with all its runs.

    Returns:
        p-values, (M,).
    """
    differs = np.abs(differences) > NO_SPREAD
    few = differs.sum(0) <= EXACT_FAMILIES
    found = np.ones(differences.shape[1])
    for column in np.flatnonzero(few):
        own = differences[differs[:, column], column]
        found[column] = _exchange_p(own[:, None])[0]
    if not few.all():
        found[~few] = _exchange_p(differences[:, ~few])
    return found


def _exchange_p(differences: Float) -> Float:
    """Return the share of sign flips whose sum is as far from 0 as that of differences, (F, M)."""
    families = len(differences)
    observed = np.abs(np.ones((1, families)) @ differences)[0]
    count = np.zeros(len(observed))
    total = 0
    for signs in _flips(families):
        count += (np.abs(signs @ differences) >= observed - NO_SPREAD).sum(0)
        total += len(signs)
    if families > EXACT_FAMILIES:  # the observed signs are one of the possible draws
        count += 1
        total += 1
    return count / total


def _flips(families: int) -> Iterator[Float]:
    """Iterate over all sign flips of few families, else over random ones, (S, F) each."""
    if families <= EXACT_FAMILIES:
        codes = np.arange(2**families)[:, None]
        bits = (codes >> np.arange(families) & 1).astype(np.float64)
        yield from (
            1.0 - 2.0 * bits[first : first + FLIPS_AT_ONCE]
            for first in range(0, len(bits), FLIPS_AT_ONCE)
        )
        return
    rng = np.random.default_rng(FLIP_SEED)
    for first in range(0, RANDOM_FLIPS, FLIPS_AT_ONCE):
        count = min(FLIPS_AT_ONCE, RANDOM_FLIPS - first)
        drawn = rng.integers(2, size=(count, families), dtype=np.int8)
        yield 1.0 - 2.0 * drawn.astype(np.float64)


def holm(p: Float) -> Float:
    """Apply Holm's correction to p-values, (M,); NaN entries are not tests and stay NaN."""
    adjusted = np.full(len(p), np.nan)
    tested = np.flatnonzero(~np.isnan(p))
    order = tested[np.argsort(p[tested])]
    adjusted[order] = np.minimum(
        1,
        np.maximum.accumulate(p[order] * np.arange(len(order), 0, -1)),
    )
    return adjusted


def wilson(count: int, total: int) -> tuple[float, float]:
    """Return the 95 % Wilson interval of a share.

    Args:
        count: of what has a property.
        total: of all.
    """
    low, high = binomtest(count, total).proportion_ci(method="wilson")
    return float(low), float(high)
