"""Policies for objects that stand among others: where most of the object will show, and what that will be worth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.errors import PolicyError
from nextview.policies.base import EpisodeState, travel_from, visibility_of
from nextview.policies.gain import Gain
from nextview.viewsphere import Viewpoints, ViewSphere

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Visibility:
    """The free view from which most of the object is expected to show, less the weighted travel; equal ones by chance.

    Attributes:
        sphere: the viewpoints.
        travel_weight: of a grid cell of travel, in shares of the object.

    Raises:
        PolicyError: a travel weight that is negative or not finite.
    """

    sphere: Viewpoints
    travel_weight: float = 0.0
    needs: tuple[str, ...] = ("visibility",)

    def __post_init__(self) -> None:
        if not 0 <= self.travel_weight < np.inf:
            raise PolicyError(f"needs a travel weight that is not negative, not {self.travel_weight}")

    def view_values(self, state: EpisodeState) -> Float:
        """Expected share less the weighted travel there, (B, V)."""
        return visibility_of(state) - self.travel_weight * travel_from(self.sphere, state)

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """See ``Policy.next_views``."""
        values = self.view_values(state) + 1e-6 * rng.random(state.visited.shape)
        return np.where(state.free, values, -np.inf).argmax(1)


@dataclass(frozen=True)
class VisibleGain:
    """The free view with the highest product of what shows from it and what it is worth if all shows.

    The learned gain of a view tells only how much better it is than others. So a clear view is taken to bring, on the
    average, all that the belief still lacks: its entropy, which is what a view that settles the class adds to the
    log-belief in it. To this the gain of the view is added; of the sum the share that shows is expected. Where
    everything shows it goes where the gain policy goes.

    Attributes:
        gain: the learned policy, in the unit of log-belief.
        travel_weight: of a grid cell of travel, in the same unit.

    Raises:
        PolicyError: a travel weight that is negative or not finite.
    """

    gain: Gain
    travel_weight: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.travel_weight < np.inf:
            raise PolicyError(f"needs a travel weight that is not negative, not {self.travel_weight}")

    @property
    def sphere(self) -> ViewSphere:
        """The viewpoints."""
        return self.gain.sphere

    @property
    def needs(self) -> tuple[str, ...]:
        """Those of the gain policy, and what shows."""
        return (*(name for name in self.gain.needs if name != "visibility"), "visibility")

    def scores(self, state: EpisodeState) -> Float:
        """The products, (B, V); see ``ScoresViews``."""
        gains, free = self.gain.gains(state), state.free
        mean = (gains * free).sum(1, keepdims=True) / np.maximum(free.sum(1, keepdims=True), 1)
        lacking = -(state.belief * np.log(np.maximum(state.belief, 1e-300))).sum(1, keepdims=True)
        return visibility_of(state) * (lacking + gains - mean)

    def view_values(self, state: EpisodeState) -> Float:
        """The products less the weighted travel there, (B, V)."""
        return self.scores(state) - self.travel_weight * travel_from(self.sphere, state)

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """See ``Policy.next_views``."""
        return np.where(state.free, self.view_values(state), -np.inf).argmax(1)
