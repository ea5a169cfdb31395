"""The policy that has learned what a view from each viewpoint brings, and weighs it against the travel there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from nextview.errors import PolicyError
from nextview.policies.base import EpisodeState, Scope, best_in_window, in_window, maps_among, travel_from
from nextview.policies.gain.decision_features import INPUTS, VISIBILITY, Frame, features, maps_of, origin
from nextview.policies.learned_tables import cells_to
from nextview.viewsphere import ViewSphere

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Gain:
    """The unvisited view whose predicted value, less the travel weight of the way there, is highest.

    Small networks learn by replay of predictions what the belief in the true class becomes after each possible next
    view (``nextview train gain``, ``training.gain_training``): fitted one-step lookahead, as in the value functions for
    sensor planning of Denzler and Brown, "Information theoretic sensor data selection for active object recognition",
    PAMI 24 (2002), but regressed from the decision state instead of simulated. They decide by ``features`` alone.

    Attributes:
        sphere: the viewpoints.
        classes: how many, C.
        score: from the features, (B, D) float32, to the value of each cell, (B, V) float32: the mean over some
            networks and over the object and its mirror image. Each row by itself, to the last bit.
        inputs: what the features are made of: some of INPUTS, VISIBILITY and names of predicted maps.
        travel_weight: of a grid cell of travel, in the unit of the values: log-belief for the bundled one.
        scope: "global", among all views; or "local", among those of the local window.
        frame: in which cells are counted, "camera" or "object".

    Raises:
        PolicyError: unknown inputs or frame, or a travel weight that is negative or not finite.

    Example:
        >>> policy = make_policy("gain", ViewSphere.named("40"))  # the bundled one
        >>> careful = replace(policy, travel_weight=0.01)  # or make_policy("gain@0.01", ...)
        >>> careful.next_views(state, np.random.default_rng(0))  # (B,) int64
    """

    sphere: ViewSphere
    classes: int
    score: Callable[[NDArray[np.float32]], NDArray[np.floating]]
    inputs: tuple[str, ...]
    travel_weight: float = 0.0
    scope: Scope = "global"
    frame: Frame = "camera"

    def __post_init__(self) -> None:
        maps = maps_of(self.inputs)
        unknown = [name for name in maps if name not in maps_among(maps)]  # other needs of policies
        if unknown or not self.inputs:
            known, other = ", ".join((*INPUTS, VISIBILITY)), ", ".join(unknown) or "nothing"
            raise PolicyError(f"a gain policy takes some of {known} and of the maps that are predicted, not {other}")
        if not np.isfinite(self.travel_weight) or self.travel_weight < 0:
            raise PolicyError(f"needs a travel weight that is not negative, not {self.travel_weight}")
        if self.frame not in get_args(Frame):
            raise PolicyError(f"cells are counted from one of {', '.join(get_args(Frame))}, not {self.frame!r}")

    @property
    def needs(self) -> tuple[str, ...]:
        """The maps that the features are made of, the azimuth bins, and what shows."""
        azimuth_bins = "azimuth_bin" in self.inputs or self.frame == "object"
        others = {"azimuth_bins": azimuth_bins, VISIBILITY: VISIBILITY in self.inputs}
        return (*maps_of(self.inputs), *(name for name, taken in others.items() if taken))

    def to_dict(self) -> dict[str, Any]:
        """What a card says of it beside the sphere, for JSON."""
        return {
            "classes": self.classes,
            "inputs": list(self.inputs),
            "travel_weight": self.travel_weight,
            "frame": self.frame,
        }

    def gains(self, state: EpisodeState) -> Float:
        """The predicted value of each view, (B, V) float64; only differences between views mean anything."""
        seen = features(self.sphere, state, self.inputs, self.frame).astype(np.float32)
        cells = self.score(seen).astype(np.float64)
        cells -= 1e-9 * np.arange(len(self.sphere))  # cells that are mirror images may tie; the first of them is taken
        return np.take_along_axis(cells, cells_to(self.sphere)[origin(self.sphere, state, self.frame)], 1)

    def view_values(self, state: EpisodeState) -> Float:
        """Predicted gain of each view less the weighted travel there, (B, V); differences between views count."""
        return self.gains(state) - self.travel_weight * travel_from(self.sphere, state)

    def scores(self, state: EpisodeState) -> Float:
        """The gains of the views where it may go; see ``ScoresViews``."""
        gains = self.gains(state)
        if self.scope == "global":
            return gains
        rows = np.arange(len(gains))[:, None, None]
        return in_window(self.sphere, state, gains[rows, self.sphere.windows[state.current]])

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """See ``Policy.next_views``."""
        scores = self.view_values(state)
        if self.scope == "global":
            return np.where(state.free, scores, -np.inf).argmax(1)
        rows = np.arange(len(scores))[:, None, None]
        return best_in_window(self.sphere, state, scores[rows, self.sphere.windows[state.current]])
