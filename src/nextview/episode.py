"""The loop: observe, believe, stop or choose, move. One for a robot and for a hundred thousand replays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from nextview.belief import PLAIN_SUM, Calibration, Stopping, log_evidence_of
from nextview.errors import PolicyError, SessionError, UsageError
from nextview.observation import Observation, SceneView
from nextview.occupancy import SeenScene, expected_visibility
from nextview.own_code import fails, own_code
from nextview.policies.base import EpisodeState, Evidence, Policy
from nextview.policies.off_grid import OffGrid
from nextview.viewsphere import SNAP, Viewpoints, angle_between, turn_of

VISITED = np.radians(6.0)
"""Views within this angle of where a camera stood count as visited, beside the nearest one: it saw what they show."""


@dataclass(frozen=True)
class Step:
    """One view in the episodes that were still running, A of them.

    Attributes:
        episodes: which ones, (A,) int64.
        views: the view taken, or the one nearest to where the camera stood, (A,) int64.
        evidence: what the models said of it.
        belief: fused after it, (A, classes).
        stopped: whether the episode ended here, (A,) bool.
        next_views: where it goes next, (A,) int64; -1 where it ended.
        total: sum of the log-evidence in it and before, (A, D), see ``belief.log_evidence_of``.
        seen: views so far in which anything was seen, each as much as it counts, (A,) float64; see
            ``Calibration.weights``.
        state: what the policy was shown of the episodes that go on; None where all ended.
    """

    episodes: NDArray[np.int64]
    views: NDArray[np.int64]
    evidence: Evidence
    belief: NDArray[np.float64]
    stopped: NDArray[np.bool_]
    next_views: NDArray[np.int64]
    total: NDArray[np.float64]
    seen: NDArray[np.float64]
    state: EpisodeState | None = None


@dataclass(frozen=True)
class Outcome:
    """How B episodes ended.

    Attributes:
        answer: most believed class, (B,) int64.
        confidence: its belief, (B,) float64.
        n_views: views taken, (B,) int64.
        confident: whether the threshold was reached (else no view was left), (B,) bool; never where nothing was seen.
        travel: sum over the moves between these views in grid cells, (B,) float64.
        arc: the same in radians, (B,) float64.
        views: the views in order, (B, max views) int64, -1 after the end.
    """

    answer: NDArray[np.int64]
    confidence: NDArray[np.float64]
    n_views: NDArray[np.int64]
    confident: NDArray[np.bool_]
    travel: NDArray[np.float64]
    arc: NDArray[np.float64]
    views: NDArray[np.int64]


@dataclass(frozen=True)
class _Sums:
    """What A episodes have taken in: see ``Step`` and ``EpisodeState``."""

    total: NDArray[np.float64]
    seen: NDArray[np.float64]
    visited: NDArray[np.bool_]
    azimuth: NDArray[np.float64]
    places: NDArray[np.float64] | None


Visible = Callable[[EpisodeState], NDArray[np.float64]]
"""Share of the object that is expected to show from each view in the episodes of a state, (B, V)."""


def unconstrained(state: EpisodeState) -> EpisodeState:
    """Every view can be reached, and travel costs what it is."""
    return state


class Episodes:
    """B episodes side by side. Give ``update`` what was seen from ``current``, until ``running`` is empty.

    Args:
        sphere: the viewpoints.
        policy: chooses where to go.
        starts: first view of each episode, (B,).
        stopping: when an episode ends; a sphere with fewer views than ``max_views`` ends it too.
        rng: for policies that draw.
        calibration: how far to trust the sum of the logits; fully by default.
        visibility: what is expected to show from each view, for policies that need it, (B, V) of a state that lacks
            it; by default what the scenes in the observations of the evidence tell, see ``SeenScene``.
    """

    def __init__(
        self,
        sphere: Viewpoints,
        policy: Policy,
        starts: NDArray[np.int64],
        stopping: Stopping,
        rng: np.random.Generator,
        calibration: Calibration = PLAIN_SUM,
        visibility: Visible | None = None,
    ) -> None:
        self.sphere, self.policy, self.stopping, self.rng = sphere, policy, stopping, rng
        self.calibration, self.visibility = calibration, visibility
        self.running = np.arange(len(starts))
        self.current = np.array(starts, np.int64)
        if ((self.current < 0) | (self.current >= len(sphere))).any():
            raise UsageError(f"a first view has to be one of the {len(sphere)} views, 0 to {len(sphere) - 1}")
        self.steps: list[Step] = []
        self._visited = np.zeros((len(starts), len(sphere)), bool)
        self._total: NDArray[np.float64] = np.zeros((len(starts), 0))
        self._seen = np.zeros(len(starts))
        self._places: NDArray[np.float64] | None = None
        self._scenes: dict[int, tuple[list[SceneView], SeenScene]] = {}

    def update(
        self,
        evidence: Evidence,
        directions: NDArray[np.float64] | None = None,
        constrain: Callable[[EpisodeState], EpisodeState] = unconstrained,
    ) -> Step:
        """Take in the evidence of one view in every running episode; stop or choose its next view.

        A view in which nothing was seen is taken, but changes no belief and ends no episode as a confident one. Where
        this raises, nothing is taken in: the same view can be told again.

        Args:
            evidence: of the A running episodes.
            directions: unit vectors towards where the cameras really stood, (A, 3); in all updates or in none. The
                nearest views then count as taken, those within VISITED as visited too, and azimuths and travel are
                measured from the places themselves. By default the cameras stood at ``current``.
            constrain: before the policy is asked, says where the robots can go and what that costs them: the state with
                ``reachable`` and ``travel``. An episode without a free view ends.

        Raises:
            UsageError: the evidence is of another number of episodes, or a logit is not finite.
            PolicyError: the policy failed or chose something that is not a next view.
        """
        step, sums = self._taken(evidence, directions)
        n_views, weighed = len(self.steps) + 1, np.maximum(sums.seen, 1)
        stopped = (step.belief.max(1) >= self.stopping.threshold_at(weighed)) & (step.seen > self._seen[self.running])
        if n_views >= min(self.stopping.max_views, len(self.sphere)):
            stopped[:] = True
        going = ~stopped
        needs = self.policy.needs
        if going.any():
            azimuth_bins, places = None, None if sums.places is None else sums.places[going]
            observations = self._observations(step, step.episodes[going]) if "observations" in needs else None
            if "azimuth_bins" in needs:
                classes, azimuth = evidence.logits.shape[1], sums.azimuth[going]
                azimuth_bins = self.calibration.azimuth_bins(sums.total[going], weighed[going], classes, azimuth)
            state = EpisodeState(
                step.views[going],
                sums.visited[going],
                step.belief[going],
                step.evidence.of(going),
                n_views,
                step.episodes[going],
                azimuth_bins,
                places=places,
                observations=observations,
            )
            if "visibility" in needs:
                state = replace(state, visibility=self._visibility(step, state))
            state, next_views = self._move(state, constrain)
            step.next_views[going] = next_views
            step = replace(step, state=state)
        self._keep(replace(step, stopped=step.next_views < 0), sums)
        return self.steps[-1]

    def take(self, evidence: Evidence, directions: NDArray[np.float64] | None = None) -> None:
        """Take in a view after which it is known that the episodes went on: neither stop nor choose.

        Arguments and errors as for ``update``.
        """
        self._keep(*self._taken(evidence, directions))

    def choose_again(self, constrain: Callable[[EpisodeState], EpisodeState] = unconstrained) -> Step:
        """Ask the policy once more where to go from here, for what ``constrain`` says has changed; see ``update``.

        Returns:
            The last step, with other ``next_views``. Where no view is free any more the episode has ended.

        Raises:
            SessionError: no view was taken yet, or all have ended.
            PolicyError: as for ``update``.
        """
        if not self.steps or self.steps[-1].state is None or len(self.running) == 0:
            raise SessionError("there is nothing to choose: no view was taken yet, or the episodes have ended")
        step, here = self.steps[-1], np.isin(self.steps[-1].state.episodes, self.running)
        state, chosen = self._move(self.steps[-1].state.of(here), constrain)
        next_views = np.full(len(step.episodes), -1)
        next_views[np.isin(step.episodes, self.running)] = chosen
        self.steps[-1] = replace(step, next_views=next_views, stopped=next_views < 0, state=state)
        self._go(self.steps[-1])
        return self.steps[-1]

    def _taken(self, evidence: Evidence, directions: NDArray[np.float64] | None) -> tuple[Step, _Sums]:
        """The next step, as if no episode ended and none moved on, and what it adds up to. Nothing is changed yet."""
        now = self.running
        if len(evidence.logits) != len(now):
            raise UsageError(f"evidence of {len(evidence.logits)} views for {len(now)} running episodes")
        if self.steps and (directions is None) != (self._places is None):
            raise UsageError("where the cameras stood is told of all views or of none")
        evidence, seen = _without_unseen(evidence)
        visited = self._visited[now]
        views, azimuth, places = self.current[now], self.sphere.turn[self.current[now]], None
        if directions is not None:
            arc = angle_between(directions[:, None], self.sphere.directions[None])
            views, there = arc.argmin(1), arc.min(1) < SNAP
            azimuth = np.where(there, self.sphere.turn[views], turn_of(directions))
            place = np.where(there[:, None], self.sphere.directions[views], directions)[:, None]
            places = place if self._places is None else np.concatenate([self._places[now], place], 1)
            visited |= arc <= VISITED
        visited[np.arange(len(now)), views] = True
        before = self._total[now] if self.steps else 0.0
        weights = seen * np.asarray(self.calibration.weights(evidence.shown))
        said = np.asarray(log_evidence_of(evidence.logits, evidence.azimuth_bins, azimuth), np.float64)
        total, counted = before + weights[:, None] * said, self._seen[now] + weights
        # Before anything is seen the total is zero, whatever it is divided by.
        belief = self.calibration.belief(total, np.maximum(counted, 1), evidence.logits.shape[1])
        going, nowhere = np.zeros(len(now), bool), np.full(len(now), -1)
        step = Step(now, views, evidence, belief, going, nowhere, total, counted)
        return step, _Sums(total, counted, visited, azimuth, places)

    def _visibility(self, last: Step, state: EpisodeState) -> NDArray[np.float64]:
        """What is expected to show from each view in the episodes of a state."""
        if self.visibility is not None:
            return self.visibility(state)
        if any(step.evidence.observations is None for step in (*self.steps, last)):
            return np.ones(state.visited.shape)
        positions, found = self.sphere.poses[:, :3, 3], []
        for episode, views in zip(state.episodes, self._observations(last, state.episodes), strict=True):
            scenes = [seen.scene for seen in views if seen.scene is not None]
            found.append(expected_visibility(self._seen_scene(int(episode), scenes), positions).expected)
        return np.stack(found)

    def _seen_scene(self, episode: int, scenes: list[SceneView]) -> SeenScene:
        """What the frames of an episode say together: that of all but the last ones is kept."""
        known, seen = self._scenes.get(episode, ([], SeenScene.unseen()))
        if any(old is not new for old, new in zip(known, scenes, strict=False)):
            known, seen = [], SeenScene.unseen()
        for scene in scenes[len(known) :]:
            seen = seen.seen(scene)
        self._scenes[episode] = scenes, seen
        return seen

    def _observations(self, last: Step, episodes: NDArray[np.int64]) -> list[list[Observation]]:
        """All that was seen so far in some episodes, the last step included."""
        found: dict[int, list[Observation]] = {int(episode): [] for episode in episodes}
        for step in (*self.steps, last):
            if step.evidence.observations is None:
                raise UsageError(
                    "this policy needs the depth that was seen, and only what the models say of it is known"
                )
            for episode, seen in zip(step.episodes, step.evidence.observations, strict=True):
                if int(episode) in found:
                    found[int(episode)].append(seen)
        return list(found.values())

    def _keep(self, step: Step, sums: _Sums) -> None:
        if not self.steps:
            self._total = np.zeros((len(self.current), sums.total.shape[1]))
        self._total[step.episodes], self._visited[step.episodes] = sums.total, sums.visited
        self._seen[step.episodes] = sums.seen
        if sums.places is not None:
            self._places = np.zeros((len(self.current), *sums.places.shape[1:]))
            self._places[step.episodes] = sums.places
        self.steps.append(step)
        self._go(step)

    def _go(self, step: Step) -> None:
        moved = step.next_views >= 0
        self.current[step.episodes[moved]] = step.next_views[moved]
        self.running = step.episodes[~step.stopped]

    def _move(
        self, state: EpisodeState, constrain: Callable[[EpisodeState], EpisodeState]
    ) -> tuple[EpisodeState, NDArray[np.int64]]:
        """What the policy is shown, and where it goes, -1 where no view is free."""
        state = constrain(replace(state, reachable=None, travel=self._travel(state)))
        chosen, free = np.full(len(state.current), -1), state.free.any(1)
        if free.all():
            chosen = self._choose(state)
        elif free.any():
            chosen[free] = self._choose(state.of(free))
        return state, chosen

    def _travel(self, state: EpisodeState) -> NDArray[np.float64] | None:
        """Cells to each view from the places, (B, V); None where these are views."""
        if state.places is None:
            return None
        here = state.places[:, -1]
        there = (here == self.sphere.directions[state.current]).all(1)
        if there.all():
            return None
        cells = self.sphere.travel_between(here[:, None], self.sphere.directions[None])
        return np.where(there[:, None], self.sphere.travel[state.current], cells)

    def _choose(self, state: EpisodeState) -> NDArray[np.int64]:
        """What the policy chooses, checked. One that goes where it cannot is asked again as if it had been there."""
        name, free, rows = self._name, state.free, np.arange(len(state.current))
        chosen = self._ask(state)
        barred = ~free[rows, chosen] & ~state.visited[rows, chosen]
        if barred.any():
            some = state.of(barred)
            chosen = chosen.copy()
            chosen[barred] = self._ask(replace(some, visited=~some.free))
        wrong = ~free[rows, chosen]
        if wrong.any():
            view, where = int(chosen[wrong][0]), int(state.episodes[wrong][0])
            why = "was visited before" if state.visited[wrong][0, view] else "cannot be reached"
            raise PolicyError(f"policy {name} chose view {view}, which {why}", where)
        return chosen

    def _ask(self, state: EpisodeState) -> NDArray[np.int64]:
        """What the policy answers: views of the sphere, whichever."""
        name = self._name
        with own_code(lambda said: PolicyError(f"policy {name} raised {said}", self._first_to_fail(state))):
            chosen = np.asarray(self.policy.next_views(state, self.rng))
        if chosen.shape != state.current.shape or not np.issubdtype(chosen.dtype, np.integer):
            raise PolicyError(f"policy {name} has to return {len(state.current)} integers, one for each episode")
        off = (chosen < 0) | (chosen >= len(self.sphere))
        if off.any():
            where = int(state.episodes[off][0])
            raise PolicyError(f"policy {name} chose view {chosen[off][0]}, which is not on the sphere", where)
        return chosen

    @property
    def _name(self) -> str:
        policy = self.policy.policy if isinstance(self.policy, OffGrid) else self.policy
        return type(policy).__name__

    def _first_to_fail(self, state: EpisodeState) -> int | None:
        """The first episode for which the policy raises even if asked for it alone."""
        for episode in state.episodes:
            alone = state.of(state.episodes == episode)
            if fails(partial(self.policy.next_views, alone, self.rng)):
                return int(episode)
        return None

    @property
    def outcome(self) -> Outcome:
        """How the episodes ended.

        Raises:
            SessionError: some are still running.
        """
        if len(self.running):
            raise SessionError("the episodes are still running")
        b = len(self.current)
        views = np.full((b, len(self.steps)), -1)
        answer, n_views, confidence = np.zeros(b, np.int64), np.zeros(b, np.int64), np.zeros(b)
        for k, step in enumerate(self.steps):
            views[step.episodes, k] = step.views
            answer[step.episodes] = step.belief.argmax(1)
            confidence[step.episodes] = step.belief.max(1)
            n_views[step.episodes] = k + 1
        moved = views[:, 1:] >= 0
        legs = (views[:, :-1], views[:, 1:])
        return Outcome(
            answer,
            confidence,
            n_views,
            (confidence >= self.stopping.threshold_at(np.maximum(self._seen, 1))) & (self._seen > 0),
            (self.sphere.travel[legs] * moved).sum(1),
            (self.sphere.arc[legs] * moved).sum(1),
            views,
        )


def _without_unseen(evidence: Evidence) -> tuple[Evidence, NDArray[np.bool_]]:
    """The evidence with zeros where nothing was seen, and where anything was, (B,) bool."""
    seen = evidence.seen
    if seen is None or seen.all():
        return evidence, np.ones(len(evidence.logits), bool)

    def kept(values: NDArray[np.floating]) -> NDArray[np.floating]:
        return np.where(seen.reshape(-1, *[1] * (values.ndim - 1)), values, 0)

    azimuth_bins = None if evidence.azimuth_bins is None else kept(evidence.azimuth_bins)
    maps = {name: kept(values) for name, values in evidence.maps.items()}
    novelty = None if evidence.novelty is None else kept(evidence.novelty)
    logits = kept(evidence.logits)
    return replace(evidence, logits=logits, maps=maps, azimuth_bins=azimuth_bins, novelty=novelty), seen


def run_episodes(
    observe: Callable[[NDArray[np.int64], NDArray[np.int64]], Evidence],
    sphere: Viewpoints,
    policy: Policy,
    starts: NDArray[np.int64],
    stopping: Stopping,
    rng: np.random.Generator,
    calibration: Calibration = PLAIN_SUM,
    constrain: Callable[[EpisodeState], EpisodeState] = unconstrained,
    visibility: Visible | None = None,
) -> Episodes:
    """Run episodes to their end.

    Args:
        observe: evidence of looking, in the given episodes (A,), from the given views (A,).
        sphere: the viewpoints.
        policy: chooses where to go.
        starts: first view of each episode, (B,).
        stopping: when an episode ends.
        rng: for policies that draw.
        calibration: how far to trust the sum of the logits; fully by default.
        constrain: see ``Episodes.update``.
        visibility: see ``Episodes``.
    """
    episodes = Episodes(sphere, policy, starts, stopping, rng, calibration, visibility)
    while len(episodes.running):
        episodes.update(observe(episodes.running, episodes.current[episodes.running]), constrain=constrain)
    return episodes
