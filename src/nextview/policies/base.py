"""The interface of policies: the state of the episodes, and the choice of next views."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from nextview.errors import PolicyError
from nextview.geometry.viewsphere import Viewpoints, ViewSphere
from nextview.recognition.evidence import Evidence, items_at
from nextview.sensing.observation import Observation
from nextview.types import Float, Floats, Index, Mask
from nextview.views.expected_views import Outlook

# relative to the best value; among views within this range, travel decides
NEAR_TIE = 0.05
# candidate views of a policy: all views, or those of the local window
Scope = Literal["global", "local"]


@dataclass(frozen=True)
class EpisodeState:
    """State of B episodes when the next view is chosen. The true label is not part of it.

    Attributes:
        current: the view just taken, (B,) int64.
        visited: views taken so far, including the current one, (B, V) bool.
        belief: fused over all views, (B, classes) float64.
        evidence: of the current view.
        step: number of views taken so far, 1 or more.
        episodes: indices of the episodes, (B,) int64, with which an oracle looks up the truth. A
            live session has one, 0.
        azimuth_bins: belief, over all views, in the azimuth bin of the current view for each class,
            (B, classes, azimuth bins) float64; None unless the policy needs it.
        reachable: views that the camera can reach, (B, V) bool; None for all.
        travel: cost of moving to each view, grid cells, (B, V) float64; None for the travel of the
            viewpoints.
        places: unit vectors towards the actual camera positions, the current one last, (B, step, 3)
            float64; None if these are those of the views. Otherwise ``visited`` are the views
            nearest to them.
        observations: all views taken so far, in order, B sequences; None unless the policy needs
            them.
        visibility: expected visible share of the object from each view, 0 to 1, (B, V) float64;
            None unless the policy needs it.
        outlook: predictions of further views from the geometry of taught things, one per episode or
            None; None unless the policy needs it.

    Example:

        >>> visited = np.eye(40, dtype=bool)[[3]]  # one episode, seen from view 3
        >>> evidence = Evidence(np.zeros((1, 10)))
        >>> state = EpisodeState(np.array([3]), visited, np.full((1, 10), 0.1), evidence, step=1)
        >>> int(state.free.sum())
        39
    """

    current: Index
    visited: Mask
    belief: Float
    evidence: Evidence
    step: int
    episodes: Index = field(default_factory=lambda: np.zeros(1, np.int64))
    azimuth_bins: Float | None = None
    reachable: Mask | None = None
    travel: Float | None = None
    places: Float | None = None
    observations: Sequence[Sequence[Observation]] | None = None
    visibility: Float | None = None
    outlook: Sequence[Outlook | None] | None = None

    @property
    def free(self) -> Mask:
        """Views that may be chosen: reachable and not visited, (B, V) bool."""
        return (
            ~self.visited if self.reachable is None else ~self.visited & self.reachable
        )

    def select(self, rows: Any) -> "EpisodeState":
        """Return a subset of the episodes, by index or mask."""
        parts: dict[str, Any] = {}
        for name, value in vars(self).items():
            parts[name] = value[rows] if isinstance(value, np.ndarray) else value
        parts["evidence"] = self.evidence.select(rows)
        parts["observations"] = items_at(self.observations, rows)
        parts["outlook"] = items_at(self.outlook, rows)
        return EpisodeState(**parts)


class Policy(Protocol):
    """Chooses the next views of many episodes at once; rows must not depend on each other.

    MODULE:CLASS names one of your own in commands; it is created with the viewpoints alone.

    Example:

        >>> policy = nextview.make_policy("furthest", nextview.ViewSphere.named("40"))
        >>> policy.needs
        ()
    """

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the required inputs.

        These are maps in the evidence, "azimuth_bins", "observations", "outlook" and "visibility".
        """

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the next view of each episode.

        Args:
            state: the state of B episodes with V candidate views; each has at least one free view.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64: one of ``state.free``.
        """


@runtime_checkable
class ValuesViews(Protocol):
    """A policy that exposes the values behind its choice. Optional, and used only for figures."""

    def view_values(self, state: EpisodeState) -> Float:
        """Return the value of each candidate view, (B, V) float64; NaN if not considered."""


@runtime_checkable
class SeeksPose(Protocol):
    """A policy that can aim at the pose of a thing, and not only at its identity."""

    def seeking(self, goal: Literal["thing", "pose"]) -> Policy:
        """Return the policy with this goal."""


@runtime_checkable
class ScoresViews(Protocol):
    """A policy on a grid that maximises a score minus weighted travel; see ``off_grid``."""

    @property
    def travel_weight(self) -> float:
        """Weight of a grid cell of travel."""

    def scores(self, state: EpisodeState) -> Float:
        """Return the score of each view without travel, (B, V) float64; NaN if not considered."""


def travel_from(sphere: Viewpoints, state: EpisodeState) -> Float:
    """Return the cost of moving from the camera to each view.

    Args:
        sphere: the candidate views.
        state: the state of B episodes.

    Returns:
        Cost in grid cells, (B, V) float64; the robot's own cost if the state has one.
    """
    return sphere.travel[state.current] if state.travel is None else state.travel


def nearer_first(values: Float, way: Float, best: float) -> Float:
    """Return values of views of which, among similar ones, the nearer are higher.

    Args:
        values: of V views, (V,).
        way: to each view, in any unit, (V,).
        best: value relative to which others are similar.

    Returns:
        The values, less up to NEAR_TIE of the best one for the farthest view, (V,).
    """
    return values - NEAR_TIE * best * way / max(float(way.max(initial=0.0)), 1e-9)


def visibility_of(state: EpisodeState) -> Float:
    """Return the expected visible share from each view, (B, V)."""
    if state.visibility is None:
        raise PolicyError(
            "this policy needs the share of the object that is expected to show from each view"
        )
    return state.visibility


def check_weight(travel_weight: float) -> None:
    """Reject a travel weight that is negative or not finite."""
    if not 0 <= travel_weight < np.inf:
        raise PolicyError(f"a travel weight is a number from 0 on, not {travel_weight}")


def in_window(sphere: ViewSphere, state: EpisodeState, values: Floats) -> Float:
    """Place the values of the local window's cells on the whole sphere.

    Args:
        sphere: the candidate views.
        state: the state of B episodes.
        values: of the cells of the local window, (B, rings, 3).

    Returns:
        Values of all views, (B, V) float64; NaN outside the window.
    """
    found = np.full(state.visited.shape, np.nan)
    np.put_along_axis(
        found,
        sphere.windows[state.current].reshape(len(found), -1),
        values.reshape(len(found), -1),
        1,
    )
    return found


def window_of(sphere: ViewSphere, state: EpisodeState, values: Floats) -> Floats:
    """Select the values of the local window's cells.

    Args:
        sphere: the candidate views.
        state: the state of B episodes.
        values: of all views, (B, V).

    Returns:
        Values of the window, (B, rings, 3).
    """
    return values[np.arange(len(values))[:, None, None], sphere.windows[state.current]]


def considered(
    sphere: ViewSphere,
    state: EpisodeState,
    values: Float,
    scope: Scope,
) -> Float:
    """Return the values of the views that a policy may choose.

    Args:
        sphere: the candidate views.
        state: the state of B episodes.
        values: of all views, (B, V).
        scope: "global" for all views, "local" for the local window.

    Returns:
        Values, (B, V); NaN outside of the scope.
    """
    return (
        values
        if scope == "global"
        else in_window(sphere, state, window_of(sphere, state, values))
    )


def best_view(
    sphere: Viewpoints,
    state: EpisodeState,
    values: Floats,
    scope: Scope = "global",
) -> Index:
    """Return the free view with the highest value.

    Args:
        sphere: the candidate views.
        state: the state of B episodes.
        values: of all views, (B, V).
        scope: "global" for all views, "local" for the local window.

    Returns:
        The view of each episode, (B,) int64.
    """
    if scope == "global":
        return np.where(state.free, values, -np.inf).argmax(1)
    assert isinstance(sphere, ViewSphere)
    return best_in_window(sphere, state, window_of(sphere, state, values))


def best_in_window(sphere: ViewSphere, state: EpisodeState, scores: Floats) -> Index:
    """Return the free view of the local window with the highest score.

    If no view of the window is free, it is the free view with the shortest travel; if no view is
    free at all, the best one of the window.

    Args:
        sphere: the candidate views.
        state: the state of B episodes.
        scores: of the cells of the window, (B, rings, 3), finite.

    Returns:
        The view of each episode, (B,) int64.
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
        chosen[stuck] = np.where(
            np.isfinite(near).any(1),
            near.argmin(1),
            window[stuck, flat[stuck].argmax(1)],
        )

    return chosen
