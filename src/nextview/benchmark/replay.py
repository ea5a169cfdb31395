"""Replay: run a policy through all episodes at once, from predictions instead of a camera.

A policy chooses in each episode by itself and does not know the threshold, so where it goes does not depend on when it
will be stopped. So every policy is run once, to the last view, through the same loop as live use; an episode under a
threshold is the beginning of that path, up to the first look that is confident enough. A random policy draws once for
all thresholds in this way, which also pairs its episodes. A path ends early only where the belief is exactly 1 in
double precision: no threshold can want more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.benchmark.contestants import TRUE_MAPS, Trials, contestant_policy, fixed_views
from nextview.data.predictions import Predictions
from nextview.episode import run_episodes
from nextview.errors import EntryError, PolicyError, UsageError
from nextview.policies.base import Evidence, maps_among
from nextview.recognition import Stopping
from nextview.viewsphere import ViewSphere


@dataclass(frozen=True)
class Paths:
    """Where E episodes went, up to K looks, and what was believed after each.

    Attributes:
        views: in order, (E, K) int64, -1 after the end.
        answers: most believed class after each look, (E, K) int64.
        confidences: its belief, (E, K) float64, -1 after the end.
        travel: moved so far, grid cells, (E, K) float64.
        arc: moved so far, radians, (E, K) float64.
        fixed: the views were settled beforehand, and no threshold stops them.
    """

    views: NDArray[np.int64]
    answers: NDArray[np.int64]
    confidences: NDArray[np.float64]
    travel: NDArray[np.float64]
    arc: NDArray[np.float64]
    fixed: bool


@dataclass(frozen=True)
class Ends:
    """How E episodes ended under one threshold: as ``nextview.episode.Outcome``, each (E,)."""

    answer: NDArray[np.int64]
    confidence: NDArray[np.float64]
    looks: NDArray[np.int64]
    confident: NDArray[np.bool_]
    travel: NDArray[np.float64]
    arc: NDArray[np.float64]


def make_trials(
    predictions: Predictions, runs: int, seed: int, valley_classes: tuple[int, ...] | None = None
) -> Trials:
    """Every object from ``runs`` random first views: episode = run * objects + object.

    Args:
        predictions: what the models say.
        runs: first views of each object.
        seed: decides them, alone: they are the same for every policy and threshold.
        valley_classes: classes (indices) for the policies that need them; those of each map's card by default.
    """
    if runs < 1:
        raise UsageError(f"at least one run is needed, not {runs}")
    n = len(predictions)

    def on_card(map_name: str) -> tuple[int, ...]:
        named = predictions.valley_classes.get(map_name, ())
        return tuple(predictions.classes.index(name) for name in named if name in predictions.classes)

    lem, lcm = (on_card(name) if valley_classes is None else valley_classes for name in ("lem", "lcm"))
    starts = np.random.default_rng([seed]).integers(len(predictions.sphere), size=runs * n)
    return Trials(predictions, np.tile(np.arange(n), runs), starts, lem, lcm)


def replay(name: str, trials: Trials, max_views: int, seed: int) -> Paths:
    """Run one contestant through all episodes.

    Args:
        name: see ``contestants``.
        trials: the episodes to go through.
        max_views: looks at most; fixed views bring their own number.
        seed: for policies that draw; what a policy draws depends on the seed and its name alone.

    Raises:
        EntryError: it failed, or chose a view that cannot be taken.
    """
    p, objects = trials.predictions, trials.objects
    rng = np.random.default_rng([seed, *name.encode()])
    views = fixed_views(name, trials, rng)
    if views is not None:
        return _look_at(views, trials)
    policy = contestant_policy(name, trials)
    wanted = maps_among(policy.needs)
    maps = {name: TRUE_MAPS[name](p) if name in TRUE_MAPS else p.maps[name] for name in wanted}

    def observe(which: NDArray[np.int64], views: NDArray[np.int64]) -> Evidence:
        rows = objects[which]
        return Evidence(
            p.logits[rows, views],
            {name: values[rows, views] for name, values in maps.items()},
            sides=None if p.sides is None else p.sides[rows, views],
        )

    try:
        done = run_episodes(observe, p.sphere, policy, trials.starts, Stopping(1.0, max_views), rng, p.calibration)
    except PolicyError as error:
        where = "" if error.episode is None else f" (object {p.names[objects[error.episode]]})"
        raise EntryError(f"{name}: {error}{where}") from error
    shape = (len(objects), len(done.steps))
    answers, confidences = np.zeros(shape, np.int64), np.full(shape, -1.0)
    for k, step in enumerate(done.steps):
        answers[step.episodes, k] = step.belief.argmax(1)
        confidences[step.episodes, k] = step.belief.max(1)
    views = done.outcome.views
    return Paths(views, answers, confidences, *_moved(p.sphere, views), fixed=False)


def _look_at(views: NDArray[np.int64], trials: Trials) -> Paths:
    """Take fixed views one after the other."""
    p = trials.predictions
    total = np.zeros((len(views), p.said.shape[2]))
    answers, confidences = np.zeros(views.shape, np.int64), np.zeros(views.shape)
    for k, now in enumerate(views.T):
        total += p.said[trials.objects, now]
        belief = p.calibration.belief(total, k + 1, len(p.classes))
        answers[:, k], confidences[:, k] = belief.argmax(1), belief.max(1)
    return Paths(views, answers, confidences, *_moved(p.sphere, views), fixed=True)


def _moved(sphere: ViewSphere, views: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Travel and arc up to each look, each (E, K)."""
    legs = (views[:, :-1], views[:, 1:])
    still = np.zeros((len(views), 1))
    going = views[:, 1:] >= 0
    travel, arc = (np.hstack([still, np.cumsum(d[legs] * going, axis=1)]) for d in (sphere.travel, sphere.arc))
    return travel, arc


def cut(paths: Paths, threshold: float | None, decline: float = 0.0) -> Ends:
    """The episodes under a threshold, None for one that is never reached, and its decline (see ``Stopping``)."""
    e, last = np.arange(len(paths.views)), (paths.views >= 0).sum(1) - 1
    looks = np.arange(1, paths.views.shape[1] + 1)
    bar = np.inf if threshold is None or paths.fixed else Stopping(threshold, len(looks), decline).bar(looks)
    reached = paths.confidences >= bar
    confident = np.asarray(reached.any(1))
    at = np.where(confident, reached.argmax(1), last)
    return Ends(
        paths.answers[e, at], paths.confidences[e, at], at + 1, confident, paths.travel[e, at], paths.arc[e, at]
    )
