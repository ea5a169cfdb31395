"""The contract of a policy: what it sees, and what it answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from nextview.viewsphere import ViewSphere

Scope = Literal["global", "local"]
"""Where a policy may go: to all views, or to those of the local window."""


@dataclass(frozen=True)
class Evidence:
    """What the models say of one view in each of B episodes.

    Attributes:
        logits: (B, classes) float.
        maps: those that the policy needs, by name: predicted local maps ("lem"), each (B, rings, 3) float, and maps of
            the whole sphere ("lem-sphere"), (B, rings, azimuths), columns once round from the view.
        azimuth_bins: logarithms of how likely each side of the object is the one that is seen, if it is of each class,
            (B, classes, azimuth bins) float: azimuth bins in even steps of azimuth from one that the recogniser has
            settled on for the class. None if the recogniser cannot tell.
        seen: whether anything was seen, (B,) bool; None if something was in all. A view without is no evidence: in
            episodes all the above counts as zero there.
        novelty: how strange each view is, (B,) float, see ``nextview.novelty``; None if the recogniser cannot tell.
    """

    logits: NDArray[np.floating]
    maps: dict[str, NDArray[np.floating]] = field(default_factory=dict)
    azimuth_bins: NDArray[np.floating] | None = None
    seen: NDArray[np.bool_] | None = None
    novelty: NDArray[np.floating] | None = None


@dataclass(frozen=True)
class EpisodeState:
    """Where B episodes stand when the next view is to be chosen. The true label is not part of it.

    Attributes:
        current: the view just taken, (B,) int64.
        visited: views taken so far, the current one included, (B, V) bool.
        belief: fused over all views, (B, classes) float64.
        evidence: of the current view.
        step: views taken so far, 1 or more.
        episodes: which episodes these are, (B,) int64: where an oracle looks up its truth. Live there is one, 0.
        azimuth_bins: belief, over all views, in the azimuth bin that is seen from the current view, if the object is
            of each class, (B, classes, azimuth bins) float64, sums to 1 over the azimuth bins. None if the recogniser
            cannot tell, or "azimuth_bins" is not among the policy's needs.
    """

    current: NDArray[np.int64]
    visited: NDArray[np.bool_]
    belief: NDArray[np.float64]
    evidence: Evidence
    step: int
    episodes: NDArray[np.int64] = field(default_factory=lambda: np.zeros(1, np.int64))
    azimuth_bins: NDArray[np.float64] | None = None


class Policy(Protocol):
    """Chooses where to look next, in many episodes at once, in each by itself: no row may depend on another."""

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the maps it wants in the evidence; "azimuth_bins" for what the recogniser says of them."""
        ...

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """The next view of each episode, (B,) int64: one not visited yet, as long as there is any."""
        ...


@runtime_checkable
class ValuesViews(Protocol):
    """A policy that can show what it decides by. Optional: nothing but pictures depends on it."""

    def view_values(self, state: EpisodeState) -> NDArray[np.float64]:
        """What each candidate view is valued at, (B, V) float64; NaN for those that are not considered."""
        ...


def maps_among(needs: Sequence[str]) -> list[str]:
    """Those of a policy's needs that are maps."""
    return [name for name in needs if name != "azimuth_bins"]


def best_in_window(sphere: ViewSphere, state: EpisodeState, scores: NDArray[np.floating]) -> NDArray[np.int64]:
    """The unvisited view of the local window with the highest score.

    Where the whole window is visited, the unvisited view with the shortest travel; where all are, the window's best.

    Args:
        sphere: the viewpoints.
        state: B episodes.
        scores: of the windows' cells, (B, rings, 3), finite.

    Returns:
        (B,) int64.
    """
    b = len(state.current)
    rows = np.arange(b)
    window = sphere.windows[state.current].reshape(b, -1)
    flat = np.asarray(scores, np.float64).reshape(b, -1)
    free = ~state.visited[rows[:, None], window]
    chosen = window[rows, np.where(free, flat, -np.inf).argmax(1)]
    stuck = ~free.any(1)
    if stuck.any():
        near = np.where(state.visited[stuck], np.inf, sphere.travel[state.current[stuck]])
        left = np.isfinite(near).any(1)
        chosen[stuck] = np.where(left, near.argmin(1), window[stuck, flat[stuck].argmax(1)])
    return chosen
