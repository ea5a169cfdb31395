"""The thesis's baselines (section 5.3, figure 11): they look at nothing but where the camera has been."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.policies.base import EpisodeState, best_in_window
from nextview.viewsphere import Viewpoints, ViewSphere


@dataclass(frozen=True)
class Random:
    """Any unvisited view of the local window, with equal chance."""

    sphere: ViewSphere
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """See ``Policy.next_views``."""
        return best_in_window(self.sphere, state, rng.random((len(state.current), self.sphere.rings, 3)))


@dataclass(frozen=True)
class RandomAll:
    """Any unvisited view of the whole sphere, with equal chance: the far views that a local window rules out."""

    sphere: Viewpoints
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """See ``Policy.next_views``."""
        return np.where(state.free, rng.random(state.visited.shape), -1.0).argmax(1)


@dataclass(frozen=True)
class Furthest:
    """The unvisited view of the local window with the largest grid distance; equal ones with equal chance."""

    sphere: ViewSphere
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """See ``Policy.next_views``."""
        window = self.sphere.windows[state.current]
        distance = self.sphere.travel[state.current[:, None, None], window]
        return best_in_window(self.sphere, state, distance + 1e-6 * rng.random(distance.shape))


@dataclass(frozen=True)
class Unidirectional:
    """The next unvisited azimuth on the same ring, always the same way round."""

    sphere: ViewSphere
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """See ``Policy.next_views``."""
        n = self.sphere.azimuths
        ring, azimuth = np.divmod(state.current, n)
        ahead = ring[:, None] * n + (azimuth[:, None] + np.arange(1, n)) % n
        free = state.free[np.arange(len(ring))[:, None], ahead]
        chosen = ahead[np.arange(len(ring)), free.argmax(1)]
        round_trip = ~free.any(1)
        if round_trip.any():
            window = np.zeros((len(ring), self.sphere.rings, 3))
            chosen = np.where(round_trip, best_in_window(self.sphere, state, window), chosen)
        return chosen
