"""The tables of ``nextview.policies.learned_tables``, chosen by how much the true class is believed after the views.

The measure is the logarithm of that belief, calibrated, averaged with the classes weighted evenly: accuracy, made
smooth.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview.belief import Calibration, of_true_class
from nextview.calibration.fitting_set import FittingSet, blind_walks
from nextview.policies.base import Scope
from nextview.policies.learned_tables import FixedRing, cells_from, cells_to

Float = NDArray[np.float64]


def log_belief(data: FittingSet, calibration: Calibration, total: NDArray[np.floating], n_views: int) -> Float:
    """Logarithm of the belief in the true class, (N, ...), after so many views with that sum, (N, ..., D)."""
    return of_true_class(calibration.log_belief(total, n_views, len(data.classes)), data.labels)


def fit_sequence(
    data: FittingSet, scope: Scope, length: int, calibration: Calibration, travel_weight: float = 0.0
) -> NDArray[np.int64]:
    """The greedily best moves from each ring: each the best for all objects and azimuths together.

    Args:
        data: what the recogniser says.
        scope: choose among all views ("global") or in the local window ("local").
        length: moves.
        calibration: of the belief.
        travel_weight: of one cell of travel, in the measure.

    Returns:
        (rings, length) int64, cells as in ``FixedSequence``.
    """
    n = data.sphere.azimuths
    rings = [n * ring + np.arange(n) for ring in range(data.sphere.rings)]
    paths = [greedy_path(data, starts, scope, length, calibration, travel_weight) for starts in rings]
    return np.array([cells_to(data.sphere)[path[:-1], path[1:]] for path in paths])


def greedy_path(
    data: FittingSet,
    starts: NDArray[np.int64],
    scope: Scope,
    length: int,
    calibration: Calibration,
    travel_weight: float = 0.0,
) -> NDArray[np.int64]:
    """The greedily best path from some views of one ring: each move the best for all objects and starts together.

    Args:
        data: what the recogniser says.
        starts: views of one ring.
        scope: choose among all views ("global") or in the local window ("local").
        length: moves.
        calibration: of the belief.
        travel_weight: of one cell of travel, in the measure.

    Returns:
        (length + 1,) int64: the cell of each view, seen from the start, the start's own first.
    """
    sphere = data.sphere
    path = [int(sphere.ring[starts[0]]) * sphere.azimuths]

    def log_evidence(place: int) -> Float:
        return data.log_evidence[:, cells_from(sphere)[starts, place]].astype(np.float64)

    total = log_evidence(path[0])
    for k in range(2, min(length, len(sphere) - 1) + 2):
        reachable = np.arange(len(sphere)) if scope == "global" else sphere.window(path[-1]).ravel()
        free = np.setdiff1d(reachable, path)
        free = free if len(free) else np.setdiff1d(np.arange(len(sphere)), path)
        beliefs = [log_belief(data, calibration, total + log_evidence(v), k).mean(1) for v in free]
        value = np.array(beliefs) @ data.weights / len(data) - travel_weight * sphere.travel[path[-1], free]
        path.append(int(free[np.argmax(value)]))
        total += log_evidence(path[-1])
    return np.array(path)


def fit_ring(data: FittingSet, scope: Scope, n_views: int, calibration: Calibration) -> tuple[int, int]:
    """The best ring to go to, and in which steps to walk it, over all starts, after 2 to ``n_views`` views.

    Args:
        data: what the recogniser says.
        scope: any number of azimuth steps ("global") or 1 ("local"), which stays in the local window.
        n_views: at most.
        calibration: of the belief.

    Returns:
        Ring and steps.
    """
    everywhere, nothing_drawn = np.arange(len(data.sphere)), np.random.default_rng(0)

    def walks_from_everywhere(walk: tuple[int, int]) -> NDArray[np.int64]:
        policy = FixedRing(data.sphere, *walk)
        return blind_walks(data.sphere, policy, everywhere, min(n_views, len(data.sphere)), nothing_drawn)

    def value(walk: tuple[int, int]) -> float:
        total, sum_over_views = np.zeros(data.log_evidence.shape), 0.0
        for k, views in enumerate(walks_from_everywhere(walk).T, 1):
            total += data.log_evidence[:, views]
            if k > 1:
                belief = log_belief(data, calibration, total, k)
                sum_over_views += float(data.weights @ belief.mean(1))
        return sum_over_views

    steps = range(1, data.sphere.azimuths // 2 + 1) if scope == "global" else (1,)
    return max(((ring, step) for ring in range(data.sphere.rings) for step in steps), key=value)


def fit_class_table(
    data: FittingSet, n_views: int, shrinkage: float, calibration: Calibration, rng: np.random.Generator, walks: int = 8
) -> Float:
    """Mean gain of a next view by believed class, current ring and cell, over random walks through all views.

    Few objects are ever taken for a rare class by mistake, so the mean of each cell is drawn towards that of all
    believed classes together, as if ``shrinkage`` objects more had shown that one.

    Args:
        data: what the recogniser says.
        n_views: the gain of views 2 to this one is averaged.
        shrinkage: objects.
        calibration: of the belief.
        rng: draws the walks.
        walks: of each object.

    Returns:
        (classes, rings, V) float64, as in ``ClassTable``.
    """
    sphere, c, n = data.sphere, len(data.classes), len(data)
    gains, weight = np.zeros((c, sphere.rings, len(sphere))), np.zeros((c, sphere.rings, len(sphere)))
    cell = cells_to(sphere)
    for _ in range(walks):
        walk = rng.permuted(np.tile(np.arange(len(sphere)), (n, 1)), axis=1)
        total = np.zeros((n, data.log_evidence.shape[2]))
        for k in range(1, min(n_views, len(sphere))):
            current = walk[:, k - 1]
            total += data.log_evidence[np.arange(n), current]
            now = log_belief(data, calibration, total, k)
            after = log_belief(data, calibration, total[:, None] + data.log_evidence, k + 1)
            free = np.ones((n, len(sphere)), bool)
            free[np.arange(n)[:, None], walk[:, :k]] = False
            believed = calibration.log_belief(total, k, c).argmax(1)
            at = (believed[:, None], sphere.ring[current][:, None], cell[current])
            each = free * data.weights[:, None]
            np.add.at(gains, at, each * (after - now[:, None]))
            np.add.at(weight, at, each)
    duplicate_groups = gains.sum(0) / np.maximum(weight.sum(0), 1e-12)
    # A cell is met once in so many views of a walk: what one object weighs in the sums over all walks.
    met = walks * (min(n_views, len(sphere)) - 1) / sphere.rings
    return (gains + shrinkage * met * duplicate_groups) / np.maximum(weight + shrinkage * met, 1e-12)
