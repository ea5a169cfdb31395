"""Replay: run a policy through all episodes at once, from predictions instead of a camera.

A policy chooses in each episode by itself and does not know the threshold, so where it goes does not depend on when it
will be stopped. So every policy is run once, to the last view, through the same loop as live use; an episode under a
threshold is the beginning of that path, up to the first view that is confident enough. A random policy draws once for
all thresholds in this way, which also pairs its episodes. A path ends early only where the belief is exactly 1 in
double precision: no threshold can want more.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from nextview.belief import FixedLength, Stopping
from nextview.benchmark.entries import EpisodeSpecs, entry_policy, fixed_views
from nextview.benchmark.true_maps import TRUE, true_map
from nextview.data.predictions import Predictions
from nextview.data.world_sight import sight_of, worlds_of
from nextview.episode import run_episodes
from nextview.errors import EntryError, PolicyError, UsageError
from nextview.policies.base import Evidence, Policy, maps_among
from nextview.policies.fixed import ViewList
from nextview.viewsphere import ViewSphere


@dataclass(frozen=True)
class Trajectories:
    """Where E episodes went, up to K views, and what was believed after each.

    Attributes:
        views: in order, (E, K) int64, -1 after the end.
        answers: most believed class after each view, (E, K) int64.
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
class Outcomes:
    """How E episodes ended under one threshold: as ``nextview.episode.Outcome``, each (E,)."""

    answer: NDArray[np.int64]
    confidence: NDArray[np.float64]
    n_views: NDArray[np.int64]
    confident: NDArray[np.bool_]
    travel: NDArray[np.float64]
    arc: NDArray[np.float64]


def make_specs(
    predictions: Predictions, runs: int, seed: int, valley_classes: tuple[int, ...] | None = None
) -> EpisodeSpecs:
    """Every object from ``runs`` random first views: episode = run * objects + object.

    Args:
        predictions: what the models say.
        runs: first views of each object.
        seed: decides them, alone: they are the same for every policy and threshold. In worlds they are drawn among
            those that can be reached.
        valley_classes: classes (indices) for the policies that need them; those of each map's card by default.
    """
    if runs < 1:
        raise UsageError(f"at least one run is needed, not {runs}")
    n, rng, worlds = len(predictions), np.random.default_rng([seed]), worlds_of(predictions)
    starts = rng.integers(len(predictions.sphere), size=runs * n)
    objects = np.tile(np.arange(n), runs)
    if worlds is not None:
        draws = rng.random((len(objects), len(predictions.sphere)))
        starts = np.where(worlds.reachable[objects], draws, -1).argmax(1)
    return EpisodeSpecs(predictions, objects, starts, valley_classes, worlds)


def replay(name: str, specs: EpisodeSpecs, max_views: int, seed: int) -> Trajectories:
    """Run one entry through all episodes.

    Args:
        name: see ``entries``.
        specs: the episodes to go through.
        max_views: views at most; fixed views bring their own number.
        seed: for policies that draw; what a policy draws depends on the seed and its name alone.

    Raises:
        EntryError: it failed, or chose a view that cannot be taken.
    """
    rng = np.random.default_rng([seed, *name.encode()])
    views = fixed_views(name, specs, rng)
    if views is None:
        return _run(name, entry_policy(name, specs), specs, Stopping(1.0, max_views), rng)
    # These draw nothing more and may be long: in parts, whose steps do not all have to be held at once.
    done = []
    for start in range(0, len(views), PART):
        part = slice(start, start + PART)
        here = replace(specs, objects=specs.objects[part], starts=views[part, 0])
        done.append(_run(name, ViewList(views[part]), here, FixedLength(max_views=views.shape[1]), rng))
    names = [f.name for f in fields(Trajectories) if f.name != "fixed"]
    whole = {name: np.concatenate([getattr(part, name) for part in done]) for name in names}
    return replace(done[0], **whole, fixed=True)


PART = 4096
"""Episodes of fixed views that are run at once."""


def _run(name: str, policy: Policy, specs: EpisodeSpecs, stopping: Stopping, rng: np.random.Generator) -> Trajectories:
    """Follow a policy through all episodes."""
    p, objects = specs.predictions, specs.objects
    maps = {
        name: true_map(p, name.removeprefix(TRUE)) if name.startswith(TRUE) else p.maps[name]
        for name in maps_among(policy.needs)
    }
    p = replace(p, maps=maps)

    def observe(which: NDArray[np.int64], views: NDArray[np.int64]) -> Evidence:
        evidence = p.evidence(objects[which], views)
        if specs.worlds is None or p.calibration.visibility is None:
            return evidence
        return replace(evidence, shown=specs.worlds.shown(objects[which], views))

    sight = sight_of(specs.worlds, objects)
    try:
        done = run_episodes(observe, p.sphere, policy, specs.starts, stopping, rng, p.calibration, *sight)
    except PolicyError as error:
        where = "" if error.episode is None else f" (object {p.names[objects[error.episode]]})"
        raise EntryError(f"{name}: {error}{where}") from error
    shape = (len(objects), len(done.steps))
    answers, confidences = np.zeros(shape, np.int64), np.full(shape, -1.0)
    for k, step in enumerate(done.steps):
        answers[step.episodes, k] = step.belief.argmax(1)
        confidences[step.episodes, k] = step.belief.max(1)
    views = done.outcome.views
    return Trajectories(views, answers, confidences, *_moved(p.sphere, views), fixed=False)


def _moved(sphere: ViewSphere, views: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Travel and arc up to each view, each (E, K)."""
    legs = (views[:, :-1], views[:, 1:])
    still = np.zeros((len(views), 1))
    going = views[:, 1:] >= 0
    travel, arc = (np.hstack([still, np.cumsum(d[legs] * going, axis=1)]) for d in (sphere.travel, sphere.arc))
    return travel, arc


def truncate(paths: Trajectories, threshold: float | None, threshold_decay: float = 0.0) -> Outcomes:
    """The episodes under a threshold (None: never reached) and its decay, see ``Stopping``."""
    e, last = np.arange(len(paths.views)), (paths.views >= 0).sum(1) - 1
    n_views = np.arange(1, paths.views.shape[1] + 1)
    threshold_at = (
        np.inf
        if threshold is None or paths.fixed
        else Stopping(threshold, len(n_views), threshold_decay).threshold_at(n_views)
    )
    reached = paths.confidences >= threshold_at
    confident = np.asarray(reached.any(1))
    at = np.where(confident, reached.argmax(1), last)
    return Outcomes(
        paths.answers[e, at], paths.confidences[e, at], at + 1, confident, paths.travel[e, at], paths.arc[e, at]
    )
