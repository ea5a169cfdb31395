"""Farthest-point sampling: each view as far as possible from all before it (Gonzalez 1985; Eldar et al. 1997)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.policies.base import EpisodeState, Scope, best_in_window
from nextview.viewsphere import Viewpoints, ViewSphere


def nearest_visited(sphere: Viewpoints, visited: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Great-circle angle from every view to the closest one visited.

    Args:
        sphere: the viewpoints.
        visited: (B, V) bool, in each row at least one.

    Returns:
        (B, V) float64, radians; 0 for the visited ones.
    """
    nearest = np.full(visited.shape, np.inf)
    for view in range(len(sphere)):  # one at a time, so that the memory does not grow with V squared
        seen = visited[:, view]
        nearest[seen] = np.minimum(nearest[seen], sphere.arc[view])
    return nearest


@dataclass(frozen=True)
class Spread:
    """The unvisited view farthest on the sphere from all visited ones; equal ones with equal chance.

    Attributes:
        sphere: the viewpoints; a ``ViewSphere`` where the scope is local.
        scope: "global", among all views; or "local", among those of the local window.
    """

    sphere: Viewpoints
    scope: Scope = "global"
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """See ``Policy.next_views``."""
        distance = nearest_visited(self.sphere, state.visited)
        distance += 1e-6 * rng.random(distance.shape)
        if self.scope == "global":
            return np.where(state.free, distance, -1.0).argmax(1)
        assert isinstance(self.sphere, ViewSphere)
        rows = np.arange(len(distance))[:, None, None]
        return best_in_window(self.sphere, state, distance[rows, self.sphere.windows[state.current]])
