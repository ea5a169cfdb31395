"""Replay: run policies through all episodes at once, from predictions instead of a camera.

A policy does not know the threshold, so every policy is run once, to the last view, through the
same loop as live use; ``truncate`` then applies a ``Stopping`` rule. A path ends early only if the
belief is exactly 1.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from nextview.errors import NextviewError, PolicyError, UsageError
from nextview.policies.base import EpisodeState, Evidence, Policy
from nextview.recognition.belief import FixedLength, Stopping
from nextview.recognition.map_names import maps_among
from nextview.recognition.own_stopping import Rule, own_stopping
from nextview.session.episode import Outcome, run_episodes
from nextview.types import Float, Index, Mask
from nextview_lab.benchmark.entries import EpisodeSpecs, entry_policy, fixed_views
from nextview_lab.benchmark.true_maps import TRUE, true_map
from nextview_lab.data.predictions import Predictions
from nextview_lab.errors import EntryError

THESIS_THRESHOLDS = (0.85, 0.9, 0.95, 0.97, 0.99)  # of the thesis (section 5.3)
EPISODES_TOGETHER = 4096  # episodes of fixed views per batch


@dataclass(frozen=True)
class ViewList:
    """Follows a fixed list of views.

    Attributes:
        views: of each episode in order, (E, k), starting with the first view.
        needs: required inputs, see ``Policy.needs``.
    """

    views: Index
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Take the next view of the list.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.

        Raises:
            PolicyError: the list is exhausted.
        """
        if state.step >= self.views.shape[1]:
            raise PolicyError(f"only {self.views.shape[1]} views are listed")
        return self.views[state.episodes, state.step]


@dataclass(frozen=True)
class Trajectories:
    """Paths of E episodes with up to K views, and the belief after each view.

    Attributes:
        views: in order, (E, K).
        answers: most likely class after each view, (E, K).
        confidences: belief in it, (E, K).
        travel: grid cells until each view, (E, K).
        arc: radians until each view, (E, K).
        seen: number of views so far with a visible object.
        fixed: whether all episodes make the same moves whatever the evidence.
        beliefs: in all classes, (E, K, classes), for rules that need more than the largest one.
    """

    views: Index
    answers: Index
    confidences: Float
    travel: Float
    arc: Float
    seen: Index
    fixed: bool
    beliefs: Float | None = None


def make_specs(predictions: Predictions, runs: int, seed: int) -> EpisodeSpecs:
    """Create episodes with every object, from random first views.

    The index of an episode is run * objects + object.

    Args:
        predictions: of the N objects.
        runs: first views of each object.
        seed: of the random first views.

    Returns:
        The episodes.

    Raises:
        UsageError: the number of runs is below 1.
    """
    if runs < 1:
        raise UsageError(f"at least one run is needed, not {runs}")
    n = len(predictions)
    rng = np.random.default_rng([seed])
    starts = rng.integers(len(predictions.sphere), size=runs * n)
    return EpisodeSpecs(predictions, np.tile(np.arange(n), runs), starts)


def replay(
    name: str,
    specs: EpisodeSpecs,
    max_views: int,
    seed: int,
    beliefs: bool = False,
) -> Trajectories:
    """Run a benchmark entry through all episodes, to the last view.

    Args:
        name: of the entry.
        specs: the episodes.
        max_views: views of each episode.
        seed: of the entry's random numbers, together with its name.
        beliefs: whether to keep complete beliefs, for a custom stopping rule.

    Returns:
        The paths of the episodes.

    Raises:
        EntryError: the entry cannot run on these predictions.
    """
    rng = np.random.default_rng([seed, *name.encode()])
    views = fixed_views(name, specs, rng)
    if views is None:
        to_the_end = (
            FixedLength(max_views=max_views) if beliefs else Stopping(1.0, max_views)
        )
        return replay_policy(
            name,
            entry_policy(name, specs),
            specs,
            to_the_end,
            rng,
            beliefs,
        )
    # Fixed views need no random numbers and may be many, so they run in batches to limit memory.
    parts = []
    for start in range(0, len(views), EPISODES_TOGETHER):
        part = slice(start, start + EPISODES_TOGETHER)
        here = replace(specs, objects=specs.objects[part], starts=views[part, 0])
        parts.append(
            replay_policy(
                name,
                ViewList(views[part]),
                here,
                FixedLength(max_views=views.shape[1]),
                rng,
            )
        )
    names = [f.name for f in fields(Trajectories) if f.name not in ("fixed", "beliefs")]
    whole = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in names
    }
    return replace(parts[0], **whole, fixed=True)


def replay_policy(
    name: str,
    policy: Policy,
    specs: EpisodeSpecs,
    stopping: Stopping,
    rng: np.random.Generator,
    beliefs: bool = False,
) -> Trajectories:
    """Run a policy through all episodes until a rule ends them.

    Args:
        name: of the policy, for messages.
        policy: the policy.
        specs: the episodes.
        stopping: ends the episodes.
        rng: source of all random numbers.
        beliefs: whether to keep complete beliefs.

    Returns:
        The paths of the episodes.
    """
    p = specs.predictions
    objects = specs.objects
    needs = maps_among(policy.needs)
    maps = {
        m: true_map(p, m.removeprefix(TRUE)) if m.startswith(TRUE) else p.maps[m]
        for m in needs
    }
    p = replace(p, maps=maps)

    def observe(which: Index, views: Index) -> Evidence:
        return p.evidence(objects[which], views)

    try:
        done = run_episodes(
            observe,
            p.sphere,
            policy,
            specs.starts,
            stopping,
            rng,
            p.calibration,
        )
    except PolicyError as error:
        where = (
            ""
            if error.episode is None
            else f" (object {p.names[objects[error.episode]]})"
        )
        raise EntryError(f"{name}: {error}{where}") from error
    shape = (len(objects), len(done.steps))
    answers = np.zeros(shape, np.int64)
    confidences = np.full(shape, -1.0)
    seen = np.zeros(shape, np.int64)
    kept = np.zeros((*shape, len(p.classes))) if beliefs else None
    for k, step in enumerate(done.steps):
        answers[step.episodes, k] = step.belief.argmax(1)
        confidences[step.episodes, k] = step.belief.max(1)
        seen[step.episodes, k] = step.seen
        if kept is not None:
            kept[step.episodes, k] = step.belief
    views = done.outcome.views
    legs = (views[:, :-1], views[:, 1:])
    going = views[:, 1:] >= 0
    still = np.zeros((len(views), 1))
    travel, arc = (
        np.hstack([still, np.cumsum(d[legs] * going, axis=1)])
        for d in (p.sphere.travel, p.sphere.arc)
    )
    return Trajectories(
        views,
        answers,
        confidences,
        travel,
        arc,
        seen,
        fixed=False,
        beliefs=kept,
    )


def truncate(paths: Trajectories, stopping: Stopping | None) -> Outcome:
    """Apply a stopping rule to episodes, as in live use.

    No episode ends with confidence after a view without a visible object.

    Args:
        paths: of the episodes.
        stopping: the rule; None takes all views.

    Returns:
        Outcomes of the episodes.

    Raises:
        UsageError: a custom rule needs complete beliefs.
    """
    e = np.arange(len(paths.views))
    count = (paths.views >= 0).sum(1)
    if stopping is None or paths.fixed:
        confident = np.zeros(len(e), bool)
        at = count - 1

    else:
        last = min(paths.views.shape[1], stopping.max_views)
        seen = paths.seen[:, :last]
        beliefs = paths.beliefs
        if beliefs is None:
            kind = type(stopping)
            known = (Stopping.reached, Stopping.reached_along)
            if (kind.reached, kind.reached_along) != known:
                raise UsageError(
                    "a stopping rule of your own needs whole beliefs: replay with beliefs=True"
                )
            beliefs = paths.confidences[:, :, None]

        there = (np.diff(seen, prepend=0) > 0) & (paths.views[:, :last] >= 0)
        reached = stopping.reached_along(beliefs[:, :last], np.maximum(seen, 1)) & there
        confident = np.asarray(reached.any(1))
        at = np.where(confident, reached.argmax(1), np.minimum(count, last) - 1)

    moved = paths.travel[e, at], paths.arc[e, at]
    views = np.where(np.arange(paths.views.shape[1]) <= at[:, None], paths.views, -1)
    return Outcome(
        paths.answers[e, at],
        paths.confidences[e, at],
        at + 1,
        confident,
        *moved,
        views,
    )


@dataclass(frozen=True)
class Grid:
    """Every entry under every threshold from the same first views, with the results.

    Attributes:
        specs: the episodes.
        runs: episodes of each object.
        thresholds: of the belief.
        max_views: largest number of views.
        seed: of the first views and of the policies.
        threshold_decay: decrease of the threshold from view to view; None for the default.
        rule: custom stopping rule; None for a threshold.
        paths: of each entry, by name.
        failures: why an entry has no results, by name.
    """

    specs: EpisodeSpecs
    runs: int
    thresholds: tuple[float, ...]
    max_views: int
    seed: int
    threshold_decay: float | None = None
    rule: Rule | str | None = None
    paths: dict[str, Trajectories] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)

    def stopping(self, threshold: float) -> Stopping:
        """Return the stopping rule for a threshold."""
        if self.rule is not None:
            return own_stopping(self.rule, threshold, self.max_views)
        rule = Stopping.of(
            self.specs.predictions.calibration,
            threshold,
            max_views=self.max_views,
        )
        return (
            rule
            if self.threshold_decay is None
            else replace(rule, threshold_decay=self.threshold_decay)
        )

    def ends(self, name: str, threshold: float | None) -> Outcome:
        """Return the outcomes of an entry at a threshold.

        Args:
            name: of the entry.
            threshold: of the belief; None takes all views.

        Returns:
            Outcomes of the episodes.
        """
        return truncate(
            self.paths[name],
            None if threshold is None else self.stopping(threshold),
        )

    def cells(self) -> Iterator[tuple[str, float | None, Outcome]]:
        """Iterate over every entry under every threshold; fixed views once, with threshold None."""
        for name, paths in self.paths.items():
            for threshold in (None,) if paths.fixed else self.thresholds:
                yield name, threshold, self.ends(name, threshold)

    def right(self, answer: Index) -> Mask:
        """Return which answers, (E,), are the true class, (runs, N)."""
        return (answer == self.specs.labels).reshape(self.runs, -1)


def run_grid(grid: Grid, names: Sequence[str]) -> Iterator[int]:
    """Run all entries; the error message of a failed entry is recorded.

    Args:
        grid: receives paths and failures.
        names: of the entries.

    Yields:
        Number of finished entries.
    """
    for n, name in enumerate(names, 1):
        try:
            grid.paths[name] = replay(
                name,
                grid.specs,
                grid.max_views,
                grid.seed,
                beliefs=grid.rule is not None,
            )
        except NextviewError as error:
            grid.failures[name] = str(error)
        yield n
