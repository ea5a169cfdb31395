"""How far to trust a sum of logits, and how often those who stop at a threshold are wrong: from held-out predictions.

Both are fitted over random walks, half of them in the local window and half over the whole sphere, with the classes
weighted evenly: the mix of classes that a robot will meet is not the training split's.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import beta

from nextview.belief import Calibration, RiskBounds, of_true_class
from nextview.calibration.fitting_set import FittingSet, blind_walks
from nextview.policies.baselines import Random, RandomAll

Float = NDArray[np.float64]

THRESHOLDS = tuple(np.round(1 - np.geomspace(0.5, 0.002, 32), 4).tolist())
"""Of the belief, from 0.5 to 0.998: those for which error rates are promised."""


def fit_temperature(data: FittingSet, rng: np.random.Generator, n_views: int = 5, walks: int = 4) -> Calibration:
    """Temperature of one view and correlations of several, by maximum likelihood over 1 to ``n_views`` views.

    Args:
        data: what the recogniser says.
        rng: draws the walks.
        n_views: at most.
        walks: of each object in either half.
    """
    measure = _loss(data, rng, n_views, walks)

    def made_of(parameters: Float) -> Calibration:
        temperature, correlation, *of_bins = parameters.tolist()
        return Calibration(temperature, correlation, bin_correlation=of_bins[0] if of_bins else None)

    def of(parameters: Float) -> float:
        return measure(made_of(parameters))

    begin = np.array([1.0, 0.5] if data.azimuth_bins is None else [1.0, 0.5, 0.1])
    bounds = [(0.01, 100.0), (0.0, 5.0), (0.0, 5.0)][: len(begin)]
    found = minimize(of, begin, method="L-BFGS-B", bounds=bounds)
    return made_of(np.round(found.x, 4))


def loss(
    data: FittingSet, calibration: Calibration, rng: np.random.Generator, n_views: int = 5, walks: int = 4
) -> float:
    """Mean negative log-likelihood of the true class over 1 to ``n_views`` views; see ``fit_temperature``."""
    return _loss(data, rng, n_views, walks)(calibration)


def _loss(data: FittingSet, rng: np.random.Generator, n_views: int, walks: int) -> Callable[[Calibration], float]:
    """That loss as a function of the calibration, over the same walks each time."""
    n_views = min(n_views, len(data.sphere))
    objects, views = _walks(data, n_views, walks, rng)
    totals = np.cumsum(data.log_evidence[objects[:, None], views].astype(np.float64), axis=1)
    numbers, labels = np.arange(1, n_views + 1), data.labels[objects]
    weights = data.weights[objects] / data.weights[objects].sum() / n_views

    def measure(calibration: Calibration) -> float:
        logs = calibration.log_belief(totals, numbers, len(data.classes))
        return -float(weights @ of_true_class(logs, labels).sum(1))

    return measure


def fit_risk(
    data: FittingSet,
    calibration: Calibration,
    rng: np.random.Generator,
    delta: float = 0.1,
    n_views: int = 8,
    walks: int = 4,
) -> RiskBounds:
    """Error rates that can be promised among those who stop at a threshold, on either half of the walks.

    Going down from a strict threshold, each is tested at the full ``delta`` until one fails (fixed-sequence testing;
    Angelopoulos et al., Learn then test, 2021). It begins at the strictest that half of the episodes reach, which is
    known without the labels: beyond it too few stop to say anything.

    Args:
        data: what the recogniser says.
        calibration: of the belief.
        rng: draws the walks.
        delta: how often a promise may fail.
        n_views: for at most 1 to so many views.
        walks: of each object in either half.
    """
    n_views = min(n_views, len(data.sphere))
    objects, views = _walks(data, n_views, walks, rng)
    totals = np.cumsum(data.log_evidence[objects[:, None], views].astype(np.float64), axis=1)
    belief = calibration.belief(totals, np.arange(1, n_views + 1), len(data.classes))
    sure, wrong = belief.max(2), belief.argmax(2) != data.labels[objects][:, None]
    promised = np.zeros((n_views, len(THRESHOLDS)))
    for k in range(n_views):
        for half in np.split(np.arange(len(objects)), 2):
            promise = _promise(sure[half, : k + 1], wrong[half, : k + 1], data.weights, delta)
            promised[k] = np.maximum(promised[k], promise)
    return RiskBounds(THRESHOLDS, tuple(map(tuple, np.round(promised, 5).tolist())), delta)


def _promise(sure: Float, wrong: NDArray[np.bool_], weights: Float, delta: float) -> Float:
    """Promised error rate of each threshold, (T,), from confidences and mistakes (walks * N, views)."""
    promised, worst = np.ones(len(THRESHOLDS)), 0.0
    for t in reversed(range(len(THRESHOLDS))):
        reached = sure >= THRESHOLDS[t]
        failed = wrong[np.arange(len(wrong)), reached.argmax(1)] & reached.any(1)
        failed, stopped = (x.reshape(-1, len(weights)).mean(0) for x in (failed, reached.any(1)))
        if worst > 0 or weights @ stopped >= weights.sum() / 2:
            worst = max(worst, error_bound(failed, stopped, weights, delta))
            promised[t] = worst
    return promised


def error_bound(failed: Float, stopped: Float, weights: Float, delta: float) -> float:
    """Upper confidence bound of a weighted share of failures: Clopper and Pearson's for an effective number of objects.

    Korn and Graubard, Confidence intervals for proportions with small expected number of positive counts estimated from
    survey data, Survey Methodology 24 (1998) 193. Episodes of one object count as one; the effective number is never
    more than the weights leave of the objects.

    Args:
        failed: share of each object's episodes that stopped and failed, (N,).
        stopped: share that stopped, (N,).
        weights: of the objects, (N,).
        delta: how often the bound may be too low.

    Returns:
        The bound; 1 if nothing stopped.
    """
    total = float(weights @ stopped)
    if total == 0:
        return 1.0
    rate = float(weights @ failed) / total
    objects = total**2 / float(((weights * stopped) ** 2).sum())
    variance = float(((weights * (failed - rate * stopped)) ** 2).sum()) / total**2
    effective = min(objects, rate * (1 - rate) / variance) if variance > 0 else objects
    return float(beta.ppf(1 - delta, effective * rate + 1, max(effective * (1 - rate), 1e-9)))


def _walks(
    data: FittingSet, n_views: int, walks: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Objects (2 * walks * N,) and views (2 * walks * N, views): the first half local, the second over the sphere."""
    objects, views = np.tile(np.arange(len(data)), 2 * walks), []
    for policy in (Random(data.sphere), RandomAll(data.sphere)):
        starts = rng.integers(len(data.sphere), size=walks * len(data))
        views.append(blind_walks(data.sphere, policy, starts, n_views, rng))
    return objects, np.concatenate(views)
