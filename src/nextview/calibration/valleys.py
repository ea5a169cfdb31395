"""Which classes are better served by the valley of the map than by its peak; decided on validation objects."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview.belief import fuse
from nextview.policies.base import EpisodeState, Evidence
from nextview.policies.maps import MapPeak
from nextview.viewsphere import ViewSphere


def valley_gains(
    sphere: ViewSphere, logits: NDArray[np.floating], maps: NDArray[np.floating], labels: NDArray[np.int64]
) -> dict[int, float]:
    """For each class, what the second view gains in belief in the truth at the valley rather than at the peak.

    Every view of every object is taken as the first view once; the second goes to the peak or to the valley of the
    predicted map.

    Args:
        sphere: V viewpoints.
        logits: of validation objects, (N, V, classes).
        maps: predicted around every view, (N, V, rings, 3).
        labels: (N,).

    Returns:
        Mean difference of the true class's belief, by class; positive where the valley is better.
    """
    n, v, classes = logits.shape
    objects, first = np.repeat(np.arange(n), v), np.tile(np.arange(v), n)
    state = EpisodeState(
        current=first,
        visited=np.eye(v, dtype=bool)[first],
        belief=fuse(logits[objects, first][:, None]),
        evidence=Evidence(logits[objects, first], {"map": maps[objects, first]}),
        step=1,
    )
    rng = np.random.default_rng(0)  # the policies draw nothing
    truth = []
    for valley_classes in (tuple(range(classes)), ()):
        second = MapPeak(sphere, "map", valley_classes).next_views(state, rng)
        belief = fuse(np.stack([logits[objects, first], logits[objects, second]], 1))
        truth.append(belief[np.arange(n * v), labels[objects]])
    gain = truth[0] - truth[1]
    return {int(c): float(gain[labels[objects] == c].mean()) for c in np.unique(labels)}
