"""Replay: run policies through all episodes at once, from predictions instead of a camera.

A policy does not know the threshold, so every policy is run once, to the last view, through the
same loop as live use; ``truncate`` ends the episodes where a ``Stopping`` rule does. A path ends
early only where the belief is exactly 1.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from nextview.benchmark.entries import EpisodeSpecs, entry_policy, fixed_views
from nextview.benchmark.true_maps import TRUE, true_map
from nextview.data.predictions import Predictions
from nextview.data.scene_views import scenes_of, sight_of
from nextview.errors import EntryError, NextviewError, PolicyError, UsageError
from nextview.policies.base import Evidence, Policy
from nextview.policies.baselines import ViewList
from nextview.recognition.belief import FixedLength, Stopping
from nextview.recognition.map_names import maps_among
from nextview.recognition.own_stopping import Rule, own_stopping
from nextview.session.episode import Outcome, run_episodes
from nextview.types import Float, Index, Mask

THESIS_THRESHOLDS = (0.85, 0.9, 0.95, 0.97, 0.99)  # the thesis's (section 5.3)
EPISODES_TOGETHER = 4096  # episodes of fixed views that are run at once


@dataclass(frozen=True)
class Trajectories:
    """Where E episodes went, up to K views, and what was believed after each.

    Attributes:
        views: in order, (E, K).
        answers: class that is most likely after each view, (E, K).
        confidences: belief in it, (E, K).
        travel: grid cells until each view, (E, K).
        arc: radians until each view, (E, K).
        seen: views so far that showed anything.
        fixed: whether all episodes take the same moves whatever is seen.
        beliefs: in all classes, (E, K, classes), for rules that look at more than one.
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

    In scenes, first views are reachable. The number of an episode is run * objects + object.

    Args:
        predictions: of the N objects.
        runs: first views of each object.
        seed: of the draw.

    Returns:
        The episodes.

    Raises:
        UsageError: there is no run.
    """
    if runs < 1:
        raise UsageError(f"at least one run is needed, not {runs}")
    n = len(predictions)
    rng = np.random.default_rng([seed])
    scenes = scenes_of(predictions)
    starts = rng.integers(len(predictions.sphere), size=runs * n)
    objects = np.tile(np.arange(n), runs)
    if scenes is not None:
        starts = np.where(
            scenes.reachable[objects],
            rng.random((len(objects), len(predictions.sphere))),
            -1,
        ).argmax(1)
    return EpisodeSpecs(predictions, objects, starts, scenes)


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
        seed: of the entry's draws, together with its name.
        beliefs: whether to keep complete beliefs, for a stopping rule of your own.

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
    # Fixed views draw nothing more and may be long: in parts, whose steps are not all held at once.
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

    sight = sight_of(specs.scenes, objects)
    try:
        done = run_episodes(
            observe,
            p.sphere,
            policy,
            specs.starts,
            stopping,
            rng,
            p.calibration,
            *sight,
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
    """End episodes by a stopping rule, as in live use.

    No episode ends with confidence after a view in which nothing is seen.

    Args:
        paths: of the episodes.
        stopping: the rule; None takes all views.

    Returns:
        How the episodes end.

    Raises:
        UsageError: a rule of your own needs complete beliefs.
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
    """Every entry under every threshold from the same first views, and the results.

    Attributes:
        specs: the episodes.
        runs: episodes of each object.
        thresholds: of the belief, at which an episode stops.
        max_views: at most so many views are taken.
        seed: of the first views and of the policies.
        threshold_decay: by which the threshold falls from view to view; None: as it is by
            default.
        rule: that stops episodes instead of a threshold; None: a threshold does.
        paths: of each entry, by its name.
        failures: why an entry has no results, by its name.
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
        """The rule of a threshold."""
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
        """Return how the episodes of an entry end at a threshold.

        Args:
            name: of the entry.
            threshold: of the belief; None takes all views.

        Returns:
            How the episodes end.
        """
        return truncate(
            self.paths[name],
            None if threshold is None else self.stopping(threshold),
        )

    def cells(self) -> Iterator[tuple[str, float | None, Outcome]]:
        """Every entry under every threshold; fixed views once, with threshold None."""
        for name, paths in self.paths.items():
            for threshold in (None,) if paths.fixed else self.thresholds:
                yield name, threshold, self.ends(name, threshold)

    def right(self, answer: Index) -> Mask:
        """Which answers, (E,), name the true class, (runs, N)."""
        return (answer == self.specs.labels).reshape(self.runs, -1)


def run_grid(grid: Grid, names: Sequence[str]) -> Iterator[int]:
    """Run all entries; an entry that fails leaves its error message.

    Args:
        grid: receives paths and failures.
        names: of the entries.

    Yields:
        Number of entries done.
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
