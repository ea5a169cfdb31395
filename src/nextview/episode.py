"""The loop: observe, believe, stop or choose, move. One for a robot and for a hundred thousand replays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.belief import PLAIN_SUM, Calibration, Stopping, log_evidence_of
from nextview.errors import PolicyError, SessionError, UsageError
from nextview.policies.base import EpisodeState, Evidence, Policy
from nextview.viewsphere import ViewSphere


@dataclass(frozen=True)
class Step:
    """One view in the episodes that were still running, A of them.

    Attributes:
        episodes: which ones, (A,) int64.
        views: the view taken, (A,) int64.
        evidence: what the models said of it.
        belief: fused after it, (A, classes).
        stopped: whether the episode ended here, (A,) bool.
        next_views: where it goes next, (A,) int64; -1 where it ended.
        total: sum of the log-evidence in it and before, (A, D), see ``belief.log_evidence_of``.
        seen: views so far in which anything was seen, (A,) int64.
        state: what the policy was shown of the episodes that go on; None where all ended.
    """

    episodes: NDArray[np.int64]
    views: NDArray[np.int64]
    evidence: Evidence
    belief: NDArray[np.float64]
    stopped: NDArray[np.bool_]
    next_views: NDArray[np.int64]
    total: NDArray[np.float64]
    seen: NDArray[np.int64]
    state: EpisodeState | None = None


@dataclass(frozen=True)
class Outcome:
    """How B episodes ended.

    Attributes:
        answer: most believed class, (B,) int64.
        confidence: its belief, (B,) float64.
        n_views: views taken, (B,) int64.
        confident: whether the threshold was reached (else the views ran out), (B,) bool; never where nothing was seen.
        travel: sum over the moves in grid cells, (B,) float64.
        arc: sum over the moves in radians, (B,) float64.
        views: the views in order, (B, max views) int64, -1 after the end.
    """

    answer: NDArray[np.int64]
    confidence: NDArray[np.float64]
    n_views: NDArray[np.int64]
    confident: NDArray[np.bool_]
    travel: NDArray[np.float64]
    arc: NDArray[np.float64]
    views: NDArray[np.int64]


class Episodes:
    """B episodes side by side. Give ``update`` what was seen from ``current``, until ``running`` is empty.

    Args:
        sphere: the viewpoints.
        policy: chooses where to go.
        starts: first view of each episode, (B,).
        stopping: when an episode ends; a sphere with fewer views than ``max_views`` ends it too.
        rng: for policies that draw.
        calibration: how far to trust the sum of the logits; fully by default.
    """

    def __init__(
        self,
        sphere: ViewSphere,
        policy: Policy,
        starts: NDArray[np.int64],
        stopping: Stopping,
        rng: np.random.Generator,
        calibration: Calibration = PLAIN_SUM,
    ) -> None:
        self.sphere, self.policy, self.stopping, self.rng = sphere, policy, stopping, rng
        self.calibration = calibration
        self.running = np.arange(len(starts))
        self.current = np.array(starts, np.int64)
        if ((self.current < 0) | (self.current >= len(sphere))).any():
            raise UsageError(f"a first view has to be one of the {len(sphere)} views, 0 to {len(sphere) - 1}")
        self.steps: list[Step] = []
        self._visited = np.zeros((len(starts), len(sphere)), bool)
        self._total: NDArray[np.float64] = np.zeros((len(starts), 0))
        self._seen = np.zeros(len(starts), np.int64)

    def update(self, evidence: Evidence) -> Step:
        """Take in the evidence of one view in every running episode; stop or choose its next view.

        A view in which nothing was seen is taken, but changes no belief and ends no episode as a confident one. Where
        this raises, nothing is taken in: the same view can be told again.

        Raises:
            UsageError: the evidence is of another number of episodes, or a logit is not finite.
            PolicyError: the policy failed or chose something that is not a next view.
        """
        now, views = self.running, self.current[self.running]
        if len(evidence.logits) != len(now):
            raise UsageError(f"evidence of {len(evidence.logits)} views for {len(now)} running episodes")
        evidence, seen = _without_unseen(evidence)
        before = self._total[now] if self.steps else 0.0
        azimuth = self.sphere.turn[views]
        total = before + np.asarray(log_evidence_of(evidence.logits, evidence.azimuth_bins, azimuth), np.float64)
        n_views, classes = len(self.steps) + 1, evidence.logits.shape[1]
        counted = self._seen[now] + seen
        weighed = np.maximum(counted, 1)  # before anything is seen the total is zero, whatever it is divided by
        belief = self.calibration.belief(total, weighed, classes)
        visited = self._visited[now]
        visited[np.arange(len(now)), views] = True
        stopped = (belief.max(1) >= self.stopping.threshold_at(weighed)) & seen
        if n_views >= min(self.stopping.max_views, len(self.sphere)):
            stopped[:] = True
        going = ~stopped
        next_views, state = np.full(len(now), -1), None
        if going.any():
            left, azimuth_bins = now[going], None
            if "azimuth_bins" in self.policy.needs:
                azimuth_bins = self.calibration.azimuth_bins(total[going], weighed[going], classes, azimuth[going])
            state = EpisodeState(
                views[going],
                visited[going],
                belief[going],
                select(evidence, going),
                n_views,
                left,
                azimuth_bins,
            )
            next_views[going] = self._choose(state)
        step = Step(now, views, evidence, belief, stopped, next_views, total, counted, state)
        if not self.steps:
            self._total = np.zeros((len(self.current), total.shape[1]))
        self._total[now], self._visited[now], self._seen[now] = total, visited, counted
        self.current[now[going]] = next_views[going]
        self.steps.append(step)
        self.running = now[going]
        return step

    def _choose(self, state: EpisodeState) -> NDArray[np.int64]:
        name = type(self.policy).__name__
        try:
            chosen = np.asarray(self.policy.next_views(state, self.rng))
        except Exception as error:  # whatever a user's policy may raise
            reason = f"policy {name} raised {type(error).__name__}: {error}"
            raise PolicyError(reason, self._first_to_fail(state)) from error
        if chosen.shape != state.current.shape or not np.issubdtype(chosen.dtype, np.integer):
            raise PolicyError(f"policy {name} has to return {len(state.current)} integers, one for each episode")
        off = (chosen < 0) | (chosen >= len(self.sphere))
        if off.any():
            where = int(state.episodes[off][0])
            raise PolicyError(f"policy {name} chose view {chosen[off][0]}, which is not on the sphere", where)
        again = state.visited[np.arange(len(chosen)), chosen]
        if again.any():
            where = int(state.episodes[again][0])
            raise PolicyError(f"policy {name} chose view {chosen[again][0]}, which was visited before", where)
        return chosen

    def _first_to_fail(self, state: EpisodeState) -> int | None:
        """The first episode for which the policy raises even if asked for it alone."""
        for episode in state.episodes:
            here = state.episodes == episode
            alone = EpisodeState(
                state.current[here],
                state.visited[here],
                state.belief[here],
                select(state.evidence, here),
                state.step,
                state.episodes[here],
                None if state.azimuth_bins is None else state.azimuth_bins[here],
            )
            try:
                self.policy.next_views(alone, self.rng)
            except Exception:
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


def select(evidence: Evidence, keep: NDArray[np.bool_]) -> Evidence:
    """The evidence of some of the episodes."""
    azimuth_bins = None if evidence.azimuth_bins is None else evidence.azimuth_bins[keep]
    seen = None if evidence.seen is None else evidence.seen[keep]
    novelty = None if evidence.novelty is None else evidence.novelty[keep]
    return Evidence(evidence.logits[keep], {k: m[keep] for k, m in evidence.maps.items()}, azimuth_bins, seen, novelty)


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
    return Evidence(kept(evidence.logits), maps, azimuth_bins, seen, novelty), seen


def run_episodes(
    observe: Callable[[NDArray[np.int64], NDArray[np.int64]], Evidence],
    sphere: ViewSphere,
    policy: Policy,
    starts: NDArray[np.int64],
    stopping: Stopping,
    rng: np.random.Generator,
    calibration: Calibration = PLAIN_SUM,
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
    """
    episodes = Episodes(sphere, policy, starts, stopping, rng, calibration)
    while len(episodes.running):
        episodes.update(observe(episodes.running, episodes.current[episodes.running]))
    return episodes
