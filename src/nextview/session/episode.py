"""The recognition loop: observe, update the belief, stop or choose the next view, move.

The same code runs one robot and thousands of replays at once.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nextview.checks import plugin_errors
from nextview.errors import PolicyError, SessionError, UsageError
from nextview.geometry.viewsphere import (
    SNAP,
    VISITED_ANGLE,
    Viewpoints,
    angle_between,
    azimuth_of,
)
from nextview.policies.base import EpisodeState, Evidence, Policy
from nextview.policies.off_grid import OffGrid
from nextview.recognition.belief import (
    PLAIN_SUM,
    Calibration,
    Stopping,
    log_evidence_of,
)
from nextview.recognition.protocol import JointBelief
from nextview.sensing.observation import Observation
from nextview.types import Float, Floats, Index, Mask
from nextview.views.expected_visibility import SeenScene, expected_visibility


@dataclass(frozen=True)
class Step:
    """One view in each of the A running episodes.

    Attributes:
        episodes: their indices, (A,).
        views: the view taken, or the view nearest to the camera position, (A,).
        evidence: of the view in each episode.
        belief: fused belief after the view, (A, classes).
        enough: whether the belief suffices to stop, (A,).
        stopped: whether the episode ended with this view, (A,).
        next_views: next view of each episode, (A,); -1 if it ended.
        total: sum of the log-evidence up to this view, (A, D), see ``belief.log_evidence_of``.
        seen: number of views so far in which the object was visible, (A,).
        state: state that was passed to the policy for the episodes that continue; None if all
            ended.
        joint: joint belief from all views so far, one for each of the A episodes, None before the
            object is visible; () if views are judged separately.
    """

    episodes: Index
    views: Index
    evidence: Evidence
    belief: Float
    enough: Mask
    stopped: Mask
    next_views: Index
    total: Float
    seen: Float
    state: EpisodeState | None = None
    joint: tuple[JointBelief | None, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """Outcomes of B episodes, (B,) each.

    Attributes:
        answer: class with the highest belief.
        confidence: belief in that class.
        n_views: number of views taken.
        confident: whether the threshold was reached; otherwise no view was left.
        travel: distance travelled between the views, grid cells.
        arc: the same in radians.
        views: in order, (B, max views), -1 after the end.
    """

    answer: Index
    confidence: Float
    n_views: Index
    confident: Mask
    travel: Float
    arc: Float
    views: Index


@dataclass(frozen=True)
class Taken:
    """A step that has not been committed yet, with the state that belongs to it.

    Attributes:
        step: the step.
        counts: whether the object is visible in the view, (A,).
        visited: views that count as visited after the step, (A, V).
        azimuth: of the cameras, radians, (A,).
        places: camera positions so far, (A, step, 3); None if they are those of the views.
    """

    step: Step
    counts: Mask
    visited: Mask
    azimuth: Float
    places: Float | None


# expected visible share of the object from each view, (B, V)
Visible = Callable[[EpisodeState], Float]
# adds reachable views and travel costs to a state
Constrain = Callable[[EpisodeState], EpisodeState]
# see ``protocol.JudgesTogether.together``
Together = Callable[[Sequence[Observation], Float, int], JointBelief]
# see ``protocol.LooksAhead.outlook``
LookAhead = Callable[[Sequence[Observation], JointBelief], Any]


def unconstrained(state: EpisodeState) -> EpisodeState:
    """Return the state unchanged: all views can be reached at their usual cost."""
    return state


class Episodes:
    """B episodes that run side by side.

    Pass the evidence of the views ``current`` to ``update`` until ``running`` is empty.
    """

    def __init__(
        self,
        sphere: Viewpoints,
        policy: Policy,  # chooses the next views
        starts: Index,  # first view of each episode, (B,)
        # stopping rule; an episode also ends after all views of the sphere
        stopping: Stopping,
        rng: np.random.Generator,  # for random policies
        # calibration of the summed logits; none by default
        calibration: Calibration = PLAIN_SUM,
        # expected visibility, for policies that need it; by default from the scenes in the
        # observations, see ``SeenScene``
        visibility: Visible | None = None,
        # judges all views of an episode jointly; by default their evidence is summed
        together: Together | None = None,
        # predicts further views, for policies that need it
        outlook: LookAhead | None = None,
    ) -> None:
        self.sphere = sphere
        self.policy = policy
        self.stopping = stopping
        self.rng = rng
        self.calibration = calibration
        self.visibility = visibility
        self.together = together
        self.outlook = outlook

        self.running = np.arange(len(starts))
        self.current = np.array(starts, np.int64)
        if ((self.current < 0) | (self.current >= len(sphere))).any():
            raise UsageError(
                f"a first view has to be one of the {len(sphere)} views, 0 to {len(sphere) - 1}"
            )

        self.steps: list[Step] = []
        self._last: Taken | None = None
        self._scenes: dict[int, tuple[list[Observation], SeenScene]] = {}

    def update(
        self,
        evidence: Evidence,
        directions: Float | None = None,
        constrain: Constrain = unconstrained,
    ) -> Step:
        """Process one view of every running episode, and stop it or choose its next view.

        A view without visible object counts as taken, but changes no belief and ends no episode
        with confidence. If an error is raised, nothing changes, and the same view can be passed
        again.

        If directions are given, the views nearest to the cameras count as taken, and views within
        VISITED_ANGLE as visited; azimuths and travel are computed from the camera positions. An
        episode without a free view ends.

        Args:
            evidence: of the views of the A running episodes.
            directions: unit vectors towards the actual cameras, (A, 3), in all updates or in none;
                None if the cameras were at ``current``.
            constrain: marks the views that can be reached; called before the policy.

        Returns:
            The step.
        """
        taken = self.next_step(evidence, directions, constrain)
        self.keep(taken)
        return taken.step

    def next_step(
        self,
        evidence: Evidence,
        directions: Float | None = None,
        constrain: Constrain = unconstrained,
        hold: Callable[[Step], bool] = lambda step: False,
    ) -> Taken:
        """Compute the step of ``update`` without changing anything; ``keep`` commits it.

        Args:
            evidence: of the views of the A running episodes.
            directions: unit vectors towards the actual cameras, (A, 3); None if the cameras were at
                ``current``.
            constrain: marks the views that can be reached.
            hold: called if the belief suffices to stop; no episode stops if it returns True.

        Returns:
            The step, not committed yet.
        """
        taken = self._taken(evidence, directions)
        step = taken.step
        n_views = len(self.steps) + 1
        enough = self._reached(step) & (step.seen > 0)
        enough &= not (enough.any() and hold(step))
        stopped = enough & taken.counts
        if n_views >= min(self.stopping.max_views, len(self.sphere)):
            stopped[:] = True

        if not stopped.all():
            going = ~stopped
            state, chosen = self._move(self._state(taken, going), constrain)
            step.next_views[going] = chosen
            step = replace(step, state=state)

        return replace(
            taken,
            step=replace(step, enough=enough, stopped=step.next_views < 0),
        )

    def take(
        self,
        evidence: Evidence,
        directions: Float | None = None,
        joint: tuple[JointBelief | None, ...] | None = None,
    ) -> None:
        """Process a view of episodes that are known to continue, without stopping or choosing.

        Args:
            evidence: of the views of the A running episodes.
            directions: unit vectors towards the actual cameras, (A, 3); None if the cameras were at
                ``current``.
            joint: joint belief after the view, if it is known already; it is then not computed
                again.
        """
        self.keep(self._taken(evidence, directions, joint))

    def __copy__(self) -> "Episodes":
        """Return episodes that continue independently."""
        other = object.__new__(Episodes)
        vars(other).update(
            vars(self), steps=list(self.steps), current=self.current.copy()
        )
        return other

    def keep(self, taken: Taken) -> None:
        """Commit a step of ``next_step``."""
        self._last = taken
        self.steps.append(taken.step)
        self._go(taken.step)

    def next_choice(self, constrain: Constrain = unconstrained) -> Step:
        """Ask the policy again after a change of the reachable views; see ``update``.

        Nothing is changed; ``keep_choice`` commits the returned step, which is the last one with
        other ``next_views``. An episode without a free view ends.
        """
        if not self.steps or self.steps[-1].state is None or len(self.running) == 0:
            raise SessionError(
                "there is nothing to choose: no view was taken yet, or the episodes have ended"
            )
        step = self.steps[-1]
        before = self.steps[-1].state
        state, chosen = self._move(
            before.select(np.isin(before.episodes, self.running)),
            constrain,
        )
        next_views = np.full(len(step.episodes), -1)
        next_views[np.isin(step.episodes, self.running)] = chosen
        return replace(step, next_views=next_views, stopped=next_views < 0, state=state)

    def keep_choice(self, step: Step) -> None:
        """Commit a step of ``next_choice``."""
        self.steps[-1] = step
        self._go(step)

    def _reached(self, step: Step) -> Mask:
        """Return which episodes of a step the stopping rule ends, (A,)."""
        if type(self.stopping).reached_along is Stopping.reached_along:
            return self.stopping.reached(step.belief, np.maximum(step.seen, 1))

        beliefs = [step.belief]
        n_views = [step.seen]
        for earlier in reversed(self.steps):
            rows = np.searchsorted(earlier.episodes, step.episodes)
            beliefs.insert(0, earlier.belief[rows])
            n_views.insert(0, earlier.seen[rows])
        path = np.stack(beliefs, 1)
        return self.stopping.reached_along(path, np.maximum(np.stack(n_views, 1), 1))[
            :,
            -1,
        ]

    def _go(self, step: Step) -> None:
        moved = step.next_views >= 0
        self.current[step.episodes[moved]] = step.next_views[moved]
        self.running = step.episodes[~step.stopped]

    def _state(self, taken: Taken, going: Mask) -> EpisodeState:
        """Return the state that the policy receives for the episodes that continue."""
        step = taken.step
        needs = self.policy.needs
        azimuth_bins = None
        total = step.total[going]
        weighed = np.maximum(step.seen, 1)[going]
        classes = step.belief.shape[1]

        if "azimuth_bins" in needs:
            azimuth_bins = self.calibration.azimuth_bins(
                total,
                weighed,
                classes,
                taken.azimuth[going],
            )

        state = EpisodeState(
            step.views[going],
            taken.visited[going],
            step.belief[going],
            step.evidence.select(going),
            len(self.steps) + 1,
            step.episodes[going],
            azimuth_bins,
            places=None if taken.places is None else taken.places[going],
            observations=self._observations(step, step.episodes[going])
            if "observations" in needs
            else None,
            outlook=self.outlooks(step, going) if "outlook" in needs else None,
        )

        return (
            replace(state, visibility=self._visibility(step, state))
            if "visibility" in needs
            else state
        )

    def outlooks(self, step: Step, some: Mask) -> list[Any]:
        """Return the predictions of further views after a step.

        Args:
            step: the step.
            some: mask of its episodes, (A,) bool.

        Returns:
            A prediction for each selected episode, None if there is none.
        """
        rows = np.flatnonzero(some)
        if self.outlook is None or not any(step.joint):
            return [None] * len(rows)
        taken = self._observations(step, step.episodes, counted=True)
        found = []
        for row in rows:
            joint = step.joint[row]
            found.append(None if joint is None else self.outlook(taken[row], joint))
        return found

    def _taken(
        self,
        evidence: Evidence,
        directions: Float | None,
        joint: tuple[JointBelief | None, ...] | None = None,
    ) -> Taken:
        """Return the next step as if every episode continued. Nothing is changed."""
        now = self.running
        if len(evidence.logits) != len(now):
            raise UsageError(
                f"evidence of {len(evidence.logits)} views for {len(now)} running episodes"
            )
        evidence, seen = _without_unseen(evidence)
        total, counted, visited, earlier = self._before(directions is not None)
        views = self.current[now]
        azimuth = self.sphere.azimuth[views]
        places = None
        if directions is not None:
            arc = angle_between(directions[:, None], self.sphere.directions[None])
            views = arc.argmin(1)
            there = arc.min(1) < SNAP
            azimuth = np.where(
                there, self.sphere.azimuth[views], azimuth_of(directions)
            )
            place = np.where(there[:, None], self.sphere.directions[views], directions)
            places = np.concatenate([*earlier, place[:, None]], 1)
            visited |= arc <= VISITED_ANGLE
        visited[np.arange(len(now)), views] = True

        said = np.asarray(
            log_evidence_of(evidence.logits, evidence.azimuth_bins, azimuth),
            np.float64,
        )
        total = total + seen[:, None] * said
        counted = counted + seen
        # Before the object is visible the total is zero, so the divisor does not matter.
        belief = self.calibration.belief(
            total,
            np.maximum(counted, 1),
            evidence.logits.shape[1],
        )
        no = np.zeros(len(now), bool)
        nowhere = np.full(len(now), -1)
        step = Step(now, views, evidence, belief, no, no, nowhere, total, counted)
        if self.together is not None:
            step = self._judged(step, seen, joint or (None,) * len(now))
        return Taken(step, seen, visited, azimuth, places)

    def _before(self, placed: bool) -> tuple[Float, Float, Mask, list[Float]]:
        """Return what is known of the running episodes before a step.

        Args:
            placed: whether the positions of the cameras are given.

        Returns:
            Sum of the log-evidence, (A, D) or (A, 1) before the first step; number of views in
            which the object was visible, (A,); visited views, (A, V); and the camera positions,
            (A, step, 3), in a list that is empty before the first step.

        Raises:
            UsageError: the positions are given in some steps only.
        """
        now = self.running
        last = self._last
        if last is None:
            visited = np.zeros((len(now), len(self.sphere)), bool)
            return np.zeros((len(now), 1)), np.zeros(len(now)), visited, []
        if placed != (last.places is not None):
            raise UsageError(
                "give the places of the cameras for all views, or for none"
            )
        going = ~self.steps[-1].stopped
        earlier = [] if last.places is None else [last.places[going]]
        return (
            last.step.total[going],
            last.step.seen[going],
            last.visited[going],
            earlier,
        )

    def _judged(
        self,
        step: Step,
        seen: Mask,
        known: tuple[JointBelief | None, ...],
    ) -> Step:
        """Add the joint belief from all views so far to a step.

        ``seen`` tells in which episodes the object is visible in this view, (A,); ``known`` holds
        joint beliefs that are known already. The belief is unchanged until the object is visible.
        """
        assert self.together is not None
        before: dict[int, JointBelief | None] = {}
        if self.steps and self.steps[-1].joint:
            before = dict(
                zip(self.steps[-1].episodes.tolist(), self.steps[-1].joint, strict=True)
            )
        taken = (
            self._observations(step, step.episodes, counted=True) if seen.any() else []
        )

        joint = list(known)
        belief = step.belief.copy()
        for row, episode in enumerate(step.episodes.tolist()):
            if joint[row] is None and seen[row]:
                joint[row] = self.together(
                    taken[row],
                    step.total[row],
                    int(step.seen[row]),
                )
            elif joint[row] is None:
                joint[row] = before.get(episode)
            found = joint[row]
            if found is not None:
                belief[row] = found.belief
        return replace(step, belief=belief, joint=tuple(joint))

    def _visibility(self, last: Step, state: EpisodeState) -> Float:
        """Return the expected visible share from each view for the episodes of a state."""
        if self.visibility is not None:
            return self.visibility(state)
        if any(step.evidence.observations is None for step in (*self.steps, last)):
            return np.ones(state.visited.shape)
        positions = self.sphere.poses[:, :3, 3]
        found = []

        for episode, views in zip(
            state.episodes,
            self._observations(last, state.episodes),
            strict=True,
        ):
            framed = [seen for seen in views if seen.sighting is not None]
            found.append(
                expected_visibility(
                    self._seen_scene(int(episode), framed),
                    positions,
                )
            )

        return np.stack(found)

    def _seen_scene(self, episode: int, views: list[Observation]) -> SeenScene:
        """Combine the frames of an episode; the combination of the earlier frames is cached."""
        known, seen = self._scenes.get(episode, ([], SeenScene.unseen()))
        if any(old is not new for old, new in zip(known, views, strict=False)):
            known = []
            seen = SeenScene.unseen()
        for view in views[len(known) :]:
            seen = seen.seen(view)
        self._scenes[episode] = views, seen
        return seen

    def _observations(
        self,
        last: Step,
        episodes: Index,
        counted: bool = False,
    ) -> list[list[Observation]]:
        """Return all views of some episodes, including the last step.

        With ``counted``, views that are no evidence are left out.
        """
        kept = bool(self.steps) and self.steps[-1] is last
        steps = self.steps if kept else [*self.steps, last]
        found: dict[int, list[Observation]] = {int(episode): [] for episode in episodes}
        for step in steps:
            evidence = step.evidence
            if evidence.observations is None:
                who = "this recogniser" if counted else "this policy"
                raise UsageError(
                    f"{who} needs the depth that was seen, and only evidence is given"
                )

            counts = np.ones(len(step.episodes), bool)
            if counted and evidence.seen is not None:
                counts = evidence.seen
            for episode, view, is_evidence in zip(
                step.episodes,
                evidence.observations,
                counts,
                strict=True,
            ):
                if is_evidence and int(episode) in found:
                    found[int(episode)].append(view)
        return list(found.values())

    def _move(
        self,
        state: EpisodeState,
        constrain: Constrain,
    ) -> tuple[EpisodeState, Index]:
        """Return the state for the policy, and the chosen views, -1 if no view is free."""
        state = constrain(replace(state, reachable=None, travel=self._travel(state)))
        chosen = np.full(len(state.current), -1)
        free = state.free.any(1)
        if free.all():
            chosen = self._choose(state)
        elif free.any():
            chosen[free] = self._choose(state.select(free))
        return state, chosen

    def _travel(self, state: EpisodeState) -> Float | None:
        """Return the distance from the camera positions to each view, cells, (B, V).

        Returns None if the positions are those of views.
        """
        if state.places is None:
            return None
        here = state.places[:, -1]
        there = (here == self.sphere.directions[state.current]).all(1)
        if there.all():
            return None
        cells = self.sphere.travel_between(here[:, None], self.sphere.directions[None])
        return np.where(there[:, None], self.sphere.travel[state.current], cells)

    def _choose(self, state: EpisodeState) -> Index:
        """Return the choice of the policy, checked.

        If it chooses an unreachable view, it is asked again with that view marked as visited.
        """
        name = self._name
        free = state.free
        rows = np.arange(len(state.current))
        chosen = self._ask(state)

        barred = ~free[rows, chosen] & ~state.visited[rows, chosen]
        if barred.any():
            some = state.select(barred)
            chosen = chosen.copy()
            chosen[barred] = self._ask(replace(some, visited=~some.free))

        wrong = ~free[rows, chosen]
        if wrong.any():
            view = int(chosen[wrong][0])
            where = int(state.episodes[wrong][0])
            why = (
                "was visited before"
                if state.visited[wrong][0, view]
                else "cannot be reached"
            )
            raise PolicyError(f"policy {name} chose view {view}, which {why}", where)
        return chosen

    def _ask(self, state: EpisodeState) -> Index:
        """Return the unchecked choice of the policy."""
        name = self._name
        with plugin_errors(
            lambda said: PolicyError(
                f"policy {name} raised {said}",
                self._first_to_fail(state),
            )
        ):
            chosen = np.asarray(self.policy.next_views(state, self.rng))

        if chosen.shape != state.current.shape or not np.issubdtype(
            chosen.dtype,
            np.integer,
        ):
            raise PolicyError(
                f"policy {name} has to return {len(state.current)} integers, one for each episode"
            )

        if (off := (chosen < 0) | (chosen >= len(self.sphere))).any():
            where = int(state.episodes[off][0])
            raise PolicyError(
                f"policy {name} chose view {chosen[off][0]}, which is not on the sphere",
                where,
            )

        return chosen

    @property
    def _name(self) -> str:
        return type(
            self.policy.policy if isinstance(self.policy, OffGrid) else self.policy
        ).__name__

    def _first_to_fail(self, state: EpisodeState) -> int | None:
        """Return the first episode for which the policy raises an error on its own."""
        for episode in state.episodes:
            alone = state.select(state.episodes == episode)
            try:
                self.policy.next_views(alone, self.rng)
            except (Exception, SystemExit):
                return int(episode)
        return None

    @property
    def outcome(self) -> Outcome:
        """Return the outcomes of the episodes."""
        if len(self.running):
            raise SessionError("the episodes are still running")
        b = len(self.current)
        views = np.full((b, len(self.steps)), -1)
        confident = np.zeros(b, bool)
        answer = np.zeros(b, np.int64)
        n_views = np.zeros(b, np.int64)
        confidence = np.zeros(b)

        for k, step in enumerate(self.steps):
            views[step.episodes, k] = step.views
            answer[step.episodes] = step.belief.argmax(1)
            confidence[step.episodes] = step.belief.max(1)
            n_views[step.episodes] = k + 1
            confident[step.episodes] = step.enough

        moved = views[:, 1:] >= 0
        legs = (views[:, :-1], views[:, 1:])
        travel, arc = (
            (ways[legs] * moved).sum(1)
            for ways in (self.sphere.travel, self.sphere.arc)
        )
        return Outcome(answer, confidence, n_views, confident, travel, arc, views)


def _without_unseen(evidence: Evidence) -> tuple[Evidence, Mask]:
    """Return the evidence with zeros where no object is visible, and the visibility, (B,) bool."""
    seen = evidence.seen
    if seen is None or seen.all():
        return evidence, np.ones(len(evidence.logits), bool)

    def kept(values: Floats) -> Floats:
        return np.where(seen.reshape(-1, *[1] * (values.ndim - 1)), values, 0)

    maps = {name: kept(values) for name, values in evidence.maps.items()}
    others = {name: getattr(evidence, name) for name in ("logits", "azimuth_bins")}
    others = {
        name: values if values is None else kept(values)
        for name, values in others.items()
    }
    return replace(evidence, maps=maps, **others), seen


def run_episodes(
    observe: Callable[[Index, Index], Evidence],
    sphere: Viewpoints,
    policy: Policy,
    starts: Index,
    stopping: Stopping,
    rng: np.random.Generator,
    calibration: Calibration = PLAIN_SUM,
    constrain: Constrain = unconstrained,
    visibility: Visible | None = None,
) -> Episodes:
    """Run episodes until all have ended.

    Args:
        observe: returns the evidence of some episodes, (A,), each from one view, (A,).
        sphere: the candidate views.
        policy: chooses the next views.
        starts: first view of each episode, (E,) int64.
        stopping: the stopping rule.
        rng: source of all random numbers.
        calibration: turns sums of evidence into belief.
        constrain: marks the views that can be reached.
        visibility: returns the expected visible shares, for policies that need them.

    Returns:
        The finished episodes.
    """
    episodes = Episodes(sphere, policy, starts, stopping, rng, calibration, visibility)
    while len(episodes.running):
        episodes.update(
            observe(episodes.running, episodes.current[episodes.running]),
            constrain=constrain,
        )
    return episodes
