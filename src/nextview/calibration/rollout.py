"""States on the way of a policy, and what every choice there would have led to: the predictions know all of it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nextview.belief import PLAIN_SUM, Calibration, FixedLength, of_true_class
from nextview.calibration.fitting_set import FittingSet
from nextview.calibration.temperature import fit_temperature
from nextview.data.predictions import Predictions
from nextview.data.world_sight import WorldSight, sight_of, worlds_of
from nextview.episode import run_episodes
from nextview.errors import PredictionsError
from nextview.policies.base import EpisodeState, Evidence, Policy
from nextview.policies.baselines import Random
from nextview.policies.gain import Gain

Float = NDArray[np.float64]

OBJECTIVES = ("belief", "log-belief", "right")
"""What what was seen is worth: the belief in the true class, its logarithm, or whether the answer is right."""


@dataclass(frozen=True)
class ReplayTable:
    """What held-out models say of N objects, and how far it is to be trusted.

    Attributes:
        data: what the recogniser says, and the truth.
        maps: predicted local maps by name, each (N, V, R, 3).
        calibration: of the belief.
        worlds: that the objects stand in; None if they stand alone.
    """

    data: FittingSet
    maps: dict[str, NDArray[np.float32]]
    calibration: Calibration
    worlds: WorldSight | None = None

    @cached_property
    def weights(self) -> Float:
        """As how much of a view each counts, (N, V); 0 where nothing is seen."""
        shown = None if self.worlds is None or self.calibration.visibility is None else self.worlds.all_shown()
        return self.data.seen * np.asarray(self.calibration.weights(shown))

    @classmethod
    def of(
        cls,
        predictions: Predictions,
        kept: NDArray,
        rng: np.random.Generator,
        sensed: Sequence[Predictions] = (),
        worlds: WorldSight | None = None,
    ) -> ReplayTable:
        """Some of the objects of predictions, by index; calibrated anew where their recogniser is not.

        Args:
            predictions: of the objects.
            kept: some of them.
            rng: for the calibration.
            sensed: the same objects through sensors, in the same order: they come after.
            worlds: that the objects of the predictions stand in. Tables that share them share what was found there.

        Raises:
            PredictionsError: there are test objects among the predictions, or none is kept.
        """
        if len(kept) == 0:
            raise PredictionsError("no object is left to learn from")
        parts = [part.of_objects(kept) for part in (predictions, *sensed)]
        data = FittingSet.joined([FittingSet.of_all(part) for part in parts])
        maps = {name: np.concatenate([part.maps[name] for part in parts]) for name in predictions.maps}
        known = predictions.calibration != PLAIN_SUM
        calibration = predictions.calibration if known else fit_temperature(data, rng)
        worlds = worlds or worlds_of(predictions)
        return cls(data, maps, calibration, None if worlds is None else worlds.of_worlds(np.tile(kept, len(parts))))


@dataclass(frozen=True)
class DecisionState:
    """N episodes, one for each object, when the next view is to be chosen.

    Attributes:
        state: what the policy is shown.
        total: sum of the log-evidence so far, (N, D) float64, see ``log_evidence_of``.
        travel: so far, grid cells, (N,) float64.
        seen: views so far in which anything was seen, each as much as it counts, (N,) float64.
    """

    state: EpisodeState
    total: Float
    travel: Float
    seen: Float


def rollout(
    table: ReplayTable, policy: Policy, n_views: int, rng: np.random.Generator, visibility: bool = False
) -> Iterator[DecisionState]:
    """Every object once, from a random first view to where the policy leads; in worlds where cameras can be.

    Args:
        table: what is seen.
        policy: which is followed.
        n_views: at most.
        rng: draws the first views, and what the policy draws.
        visibility: tell in the states what is expected to show.

    Yields:
        The decision state after each view.
    """
    data, sphere, everything = table.data, table.data.sphere, np.arange(len(table.data))
    starts = rng.integers(len(sphere), size=len(data))
    if table.worlds is not None:
        starts = np.where(table.worlds.reachable, rng.random(table.worlds.reachable.shape), -1).argmax(1)
    constrain, visible = sight_of(table.worlds, everything)
    weigh = None if table.calibration.visibility is None else table.worlds

    def observe(objects: NDArray[np.int64], views: NDArray[np.int64]) -> Evidence:
        return Evidence(
            data.logits[objects, views],
            {name: values[objects, views] for name, values in table.maps.items()},
            azimuth_bins=None if data.azimuth_bins is None else data.azimuth_bins[objects, views],
            seen=data.seen[objects, views],
            shown=None if weigh is None else weigh.shown(objects, views),
        )

    length = FixedLength(max_views=n_views)
    steps = run_episodes(observe, sphere, policy, starts, length, rng, table.calibration, constrain, visible).steps
    visited, travel = np.zeros((len(data), len(sphere)), bool), np.zeros(len(data))
    for k, step in enumerate(steps, 1):
        visited[step.episodes, step.views] = True
        turn, seen = sphere.turn[step.views], np.maximum(step.seen, 1)
        azimuth_bins = table.calibration.azimuth_bins(step.total, seen, len(data.classes), turn)
        state = EpisodeState(step.views, visited.copy(), step.belief, step.evidence, k, step.episodes, azimuth_bins)
        state = constrain(replace(state, visibility=visible(state) if visibility else None))
        yield DecisionState(state, step.total, travel, step.seen)
        if k < len(steps):
            travel = travel + sphere.travel[step.views, step.next_views]


def value_after(table: ReplayTable, total: Float, n_views: NDArray | int, kind: str) -> Float:
    """What sums of the log-evidence of each object are worth.

    Args:
        table: holds the truth.
        total: (N, ..., D), see ``log_evidence_of``.
        n_views: how many were summed, (N, ...) or one number.
        kind: one of OBJECTIVES.

    Returns:
        (N, ...) float64.
    """
    logs = table.calibration.log_belief(total, n_views, len(table.data.classes))
    return value_of(logs, table.data.labels, kind)


def value_of(logs: Float, labels: NDArray[np.int64], kind: str) -> Float:
    """What beliefs are worth.

    Args:
        logs: of the belief in each class, up to a constant, (N, ..., C).
        labels: the truth, (N,).
        kind: one of OBJECTIVES.

    Returns:
        (N, ...) float64.
    """
    if kind == "right":
        return np.equal(logs.argmax(-1).T, labels).T.astype(np.float64)
    of_truth = of_true_class(logs, labels)
    return of_truth if kind == "log-belief" else np.exp(of_truth)


def candidate_values(table: ReplayTable, moment: DecisionState, kind: str) -> Float:
    """The value of looking from every view next, (N, V) float64."""
    n_views = np.maximum(moment.seen[:, None] + table.weights, 1)
    said = table.weights[..., None] * table.data.log_evidence
    return value_after(table, moment.total[:, None] + said, n_views, kind)


@dataclass(frozen=True)
class Value:
    """What a policy reaches on average, classes weighted evenly, after 2, 3, ... views.

    Attributes:
        mean: (views - 1,).
        travel: grid cells, (views - 1,).
    """

    mean: Float
    travel: Float


def judge(
    table: ReplayTable, policy: Policy, n_views: int, kind: str, rng: np.random.Generator, rounds: int = 8
) -> Value:
    """Follow a policy ``rounds`` times over every object; the other arguments as for ``rollout`` and ``objective``."""
    data = table.data
    weights = data.weights / len(data) / rounds
    reached = np.zeros((2, n_views - 1))
    for _ in range(rounds):
        for moment in rollout(table, policy, n_views, rng):
            k = moment.state.step
            if k > 1:
                value = value_after(table, moment.total, np.maximum(moment.seen, 1), kind)
                reached[:, k - 2] += weights @ value, weights @ moment.travel
    return Value(*reached)


TRAVEL_WEIGHTS = (0.0, 0.0005, 0.001, 0.002, 0.003, 0.005, 0.007, 0.01, 0.012, 0.015, 0.02, 0.03, 0.05, 0.1)
"""Of a grid cell of travel, in the unit of the objective."""


def mean_value(parts: Sequence[Value], sizes: Sequence[int]) -> Value:
    """What policies reach on average, each on objects of its own."""
    return Value(*(np.average([getattr(p, name) for p in parts], 0, sizes) for name in ("mean", "travel")))


def fit_travel_weight(judged: Sequence[tuple[ReplayTable, Gain]], n_views: int, kind: str, seed: int) -> float:
    """The lowest of PRICES at which policies travel no farther than a random walk in the local window, at any view.

    Args:
        judged: the policies whose travel weight is set, each with what is seen of the objects that judge it.
        n_views: at most.
        kind: one of OBJECTIVES.
        seed: of the first views.
    """

    def travel(policies: Iterable[Policy]) -> Float:
        tables = [table for table, _ in judged]
        values = [
            judge(table, policy, n_views, kind, np.random.default_rng(seed))
            for table, policy in zip(tables, policies, strict=True)
        ]
        return mean_value(values, [len(table.data) for table in tables]).travel

    limit = travel(Random(table.data.sphere) for table, _ in judged)
    for travel_weight in TRAVEL_WEIGHTS:
        if (travel(replace(policy, travel_weight=travel_weight) for _, policy in judged) <= limit).all():
            return travel_weight
    return TRAVEL_WEIGHTS[-1]
