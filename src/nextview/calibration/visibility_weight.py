"""How much a view counts in which other things hide a part of the object: from worlds of held-out objects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nextview.belief import Calibration, of_true_class
from nextview.calibration.fitting_set import FittingSet
from nextview.data.world_sight import WorldSight

POWERS = (0.0, 0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)
"""That are tried. 0 counts all views alike."""
FLOOR = -20.0
"""Log-beliefs below this are taken for it."""


def visibility_losses(
    data: FittingSet,
    worlds: WorldSight,
    calibration: Calibration,
    rng: np.random.Generator,
    n_views: int = 5,
    walks: int = 16,
) -> dict[float, float]:
    """Mean negative log-likelihood of the true class over 1 to ``n_views`` views, for each of POWERS.

    Args:
        data: what the recogniser says of N objects in worlds.
        worlds: the same N.
        calibration: of the recogniser; its own power counts for nothing here.
        rng: draws the walks, among the views that can be reached.
        n_views: at most.
        walks: of each object.
    """
    objects = np.repeat(np.arange(len(data)), walks)
    draws = np.where(worlds.reachable[objects], rng.random((len(objects), len(data.sphere))), -1)
    views = np.argsort(-draws, axis=1)[:, :n_views]
    shown, seen = worlds.all_shown()[objects[:, None], views], data.seen[objects[:, None], views]
    said = data.log_evidence[objects[:, None], views].astype(np.float64)
    class_weights = data.weights[objects] / len(objects)
    found = {}
    for power in POWERS:
        counts = seen * np.asarray(replace(calibration, visibility=power).weights(shown))
        total, n = (counts[..., None] * said).cumsum(1), np.maximum(counts.cumsum(1), 1)
        logs = calibration.log_belief(total, n, len(data.classes))
        right = np.maximum(of_true_class(logs, data.labels[objects]), FLOOR)
        found[power] = -float(class_weights @ right.mean(1))
    return found
