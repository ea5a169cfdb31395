"""Policies without networks: by the path so far, by visibility, and fixed views.

The baselines of the thesis (section 5.3, figure 11) are ``Random``, ``Furthest`` and
``Unidirectional``.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from nextview.geometry.viewsphere import Viewpoints
from nextview.policies.base import (
    EpisodeState,
    Scope,
    best_in_window,
    best_view,
    check_weight,
    travel_from,
    visibility_of,
)
from nextview.types import Float, Floats, Index


@dataclass(frozen=True)
class Baseline:
    """A policy that needs only the viewpoints.

    Attributes:
        sphere: a ``ViewSphere``; for ``RandomAll`` any ``Viewpoints``.
        needs: required inputs, see ``Policy.needs``.
    """

    sphere: Any
    needs: tuple[str, ...] = ()


class Random(Baseline):
    """Any unvisited view of the local window, with equal probability."""

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Draw a free view of the local window.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        return best_in_window(
            self.sphere,
            state,
            rng.random((len(state.current), self.sphere.rings, 3)),
        )


class RandomAll(Baseline):
    """Any unvisited view of the whole sphere, with equal probability."""

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Draw any free view.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        return best_view(self.sphere, state, rng.random(state.visited.shape))


class Furthest(Baseline):
    """The unvisited view of the local window with the largest travel; ties are broken at random."""

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the view of the local window with the longest travel; ties are broken at random.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        distance = self.sphere.travel[
            state.current[:, None, None],
            self.sphere.windows[state.current],
        ]
        return best_in_window(
            self.sphere,
            state,
            distance + 1e-6 * rng.random(distance.shape),
        )


class Unidirectional(Baseline):
    """The next unvisited azimuth on the same ring, always in the same direction."""

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the next free view on the ring; a local view once the ring is complete.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        n = self.sphere.azimuths
        ring, azimuth = np.divmod(state.current, n)
        ahead = ring[:, None] * n + (azimuth[:, None] + np.arange(1, n)) % n
        free = state.free[np.arange(len(ring))[:, None], ahead]
        chosen = ahead[np.arange(len(ring)), free.argmax(1)]
        round_trip = ~free.any(1)
        if round_trip.any():
            window = np.zeros((len(ring), self.sphere.rings, 3))
            chosen = np.where(
                round_trip,
                best_in_window(self.sphere, state, window),
                chosen,
            )
        return chosen


@dataclass(frozen=True)
class Spread:
    """The unvisited view farthest from all visited ones; ties are broken at random.

    Attributes:
        sphere: the candidates, with any positions.
        scope: views that may be chosen.
        needs: required inputs, see ``Policy.needs``.
    """

    sphere: Viewpoints
    scope: Scope = "global"
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the view whose nearest visited view is farthest away; ties are broken at random.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        nearest = np.full(state.visited.shape, np.inf)
        # one at a time, so that memory does not grow with V squared
        for view in range(len(self.sphere)):
            seen = state.visited[:, view]
            nearest[seen] = np.minimum(nearest[seen], self.sphere.arc[view])
        return best_view(
            self.sphere,
            state,
            nearest + 1e-6 * rng.random(nearest.shape),
            self.scope,
        )


@dataclass(frozen=True)
class MostVisible:
    """The free view with the highest expected visible share minus weighted travel.

    Ties are broken at random.

    Attributes:
        sphere: the candidates, with any positions.
        travel_weight: of a grid cell of travel, shares of the object.
        needs: required inputs, see ``Policy.needs``.
    """

    sphere: Viewpoints
    travel_weight: float = 0.0
    needs: tuple[str, ...] = ("visibility",)

    def __post_init__(self) -> None:
        check_weight(self.travel_weight)

    def view_values(self, state: EpisodeState) -> Float:
        """Return the expected visible share minus weighted travel, (B, V)."""
        return visibility_of(state) - self.travel_weight * travel_from(
            self.sphere,
            state,
        )

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the view with the highest value; ties are broken at random.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        return best_view(
            self.sphere,
            state,
            self.view_values(state) + 1e-6 * rng.random(state.visited.shape),
        )


def ranked(values: Floats, k: int) -> Index:
    """Return the views with the highest values.

    Args:
        values: of all views, (E, V).
        k: number of views.

    Returns:
        The views, highest value first, ties in index order, (E, k) int64.
    """
    return np.argsort(-values, axis=1, kind="stable")[:, :k]
