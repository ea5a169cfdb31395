"""The contract of a policy: what it sees, and what it answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from nextview.errors import PolicyError
from nextview.observation import Observation
from nextview.viewsphere import Viewpoints, ViewSphere

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
        observations: the views themselves, B of them; None where only what the models say of them is known.
        shown: share of the object that shows in each view, as far as it can tell, (B,) float; None where nothing is
            known to hide any, or that does not matter. See ``Calibration.weights``.
    """

    logits: NDArray[np.floating]
    maps: dict[str, NDArray[np.floating]] = field(default_factory=dict)
    azimuth_bins: NDArray[np.floating] | None = None
    seen: NDArray[np.bool_] | None = None
    novelty: NDArray[np.floating] | None = None
    observations: Sequence[Observation] | None = None
    shown: NDArray[np.floating] | None = None

    def of(self, rows: Any) -> Evidence:
        """That of some of the episodes, by index or mask."""
        return Evidence(
            self.logits[rows],
            {name: values[rows] for name, values in self.maps.items()},
            None if self.azimuth_bins is None else self.azimuth_bins[rows],
            None if self.seen is None else self.seen[rows],
            None if self.novelty is None else self.novelty[rows],
            _some(self.observations, rows),
            None if self.shown is None else self.shown[rows],
        )


def _some(given: Sequence[Any] | None, rows: Any) -> list[Any] | None:
    """Some items of a sequence, by index or mask."""
    return None if given is None else [given[i] for i in np.arange(len(given))[rows]]


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
        reachable: which views the camera can be brought to, (B, V) bool; None for all.
        travel: what it costs to go from here to each view, grid cells, (B, V) float64; None for the travel of the
            viewpoints, see ``travel_from``.
        places: unit vectors towards the places where the camera really stood, the last one here, (B, step, 3) float64;
            None where these are the views themselves. Then ``visited`` are the views nearest to them.
        observations: all views taken so far in each episode, in order, B sequences; None if "observations" is not among
            the policy's needs.
        visibility: share of the object that is expected to show from each view, 0 to 1, (B, V) float64; None if
            "visibility" is not among the policy's needs. 1 where nothing is known to stand around the object.
    """

    current: NDArray[np.int64]
    visited: NDArray[np.bool_]
    belief: NDArray[np.float64]
    evidence: Evidence
    step: int
    episodes: NDArray[np.int64] = field(default_factory=lambda: np.zeros(1, np.int64))
    azimuth_bins: NDArray[np.float64] | None = None
    reachable: NDArray[np.bool_] | None = None
    travel: NDArray[np.float64] | None = None
    places: NDArray[np.float64] | None = None
    observations: Sequence[Sequence[Observation]] | None = None
    visibility: NDArray[np.float64] | None = None

    @property
    def free(self) -> NDArray[np.bool_]:
        """The views that may be chosen: reachable and not visited, (B, V) bool."""
        return ~self.visited if self.reachable is None else ~self.visited & self.reachable

    def of(self, rows: Any) -> EpisodeState:
        """Some of the episodes, by index or mask."""

        def part(values: NDArray[Any] | None) -> Any:
            return None if values is None else values[rows]

        return EpisodeState(
            self.current[rows],
            self.visited[rows],
            self.belief[rows],
            self.evidence.of(rows),
            self.step,
            self.episodes[rows],
            part(self.azimuth_bins),
            part(self.reachable),
            part(self.travel),
            part(self.places),
            _some(self.observations, rows),
            part(self.visibility),
        )


class Policy(Protocol):
    """Chooses where to look next, in many episodes at once, in each by itself: no row may depend on another."""

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the maps it wants in the evidence; "azimuth_bins" for what the recogniser says of them;
        "observations" for the depth seen so far; and "visibility" for what is expected to show from each view.
        """
        ...

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """The next view of each episode, (B,) int64: one of ``state.free``, of which each episode has at least one."""
        ...


@runtime_checkable
class ValuesViews(Protocol):
    """A policy that can show what it decides by. Optional: nothing but pictures depends on it."""

    def view_values(self, state: EpisodeState) -> NDArray[np.float64]:
        """What each candidate view is valued at, (B, V) float64; NaN for those that are not considered."""
        ...


@runtime_checkable
class ScoresViews(Protocol):
    """A policy on a grid that goes to the free view with the highest score less its weighted travel.

    It can be asked from any place about any views, see ``policies.off_grid``.

    Attributes:
        travel_weight: of a grid cell of travel.
    """

    @property
    def travel_weight(self) -> float:
        """Of a grid cell of travel."""
        ...

    def scores(self, state: EpisodeState) -> NDArray[np.float64]:
        """The score of each view before travel counts, (B, V) float64; NaN for those that are not considered."""
        ...


def maps_among(needs: Sequence[str]) -> list[str]:
    """Those of a policy's needs that are maps."""
    return [name for name in needs if name not in ("azimuth_bins", "observations", "visibility")]


def travel_from(sphere: Viewpoints, state: EpisodeState) -> NDArray[np.float64]:
    """What it costs to go from where the camera is to each view, grid cells, (B, V)."""
    return sphere.travel[state.current] if state.travel is None else state.travel


def visibility_of(state: EpisodeState) -> NDArray[np.float64]:
    """What is expected to show from each view, (B, V).

    Raises:
        PolicyError: it is not told, though a policy needs it.
    """
    if state.visibility is None:
        raise PolicyError("this policy needs the share of the object that is expected to show from each view")
    return state.visibility


def in_window(sphere: ViewSphere, state: EpisodeState, values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Values of the local window's cells, (B, rings, 3), where they lie on the sphere, (B, V); NaN elsewhere."""
    found = np.full(state.visited.shape, np.nan)
    np.put_along_axis(found, sphere.windows[state.current].reshape(len(found), -1), values.reshape(len(found), -1), 1)
    return found


def best_in_window(sphere: ViewSphere, state: EpisodeState, scores: NDArray[np.floating]) -> NDArray[np.int64]:
    """The free view of the local window with the highest score.

    Where none of the window is free, the free view with the shortest travel; where none is, the window's best.

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
    free = state.free[rows[:, None], window]
    chosen = window[rows, np.where(free, flat, -np.inf).argmax(1)]
    stuck = ~free.any(1)
    if stuck.any():
        near = np.where(state.free[stuck], travel_from(sphere, state)[stuck], np.inf)
        left = np.isfinite(near).any(1)
        chosen[stuck] = np.where(left, near.argmin(1), window[stuck, flat[stuck].argmax(1)])
    return chosen
