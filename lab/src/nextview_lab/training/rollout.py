"""Replay predictions: the states of a policy's episodes, and the value of each next view."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from nextview.policies.base import EpisodeState, Policy
from nextview.policies.baselines import Random
from nextview.policies.gain import INPUTS, VISIBILITY, CellFrame, Gain, maps_of
from nextview.recognition.belief import PLAIN_SUM, FixedLength
from nextview.recognition.map_names import in_order
from nextview.session.episode import Step, run_episodes
from nextview.types import Float, Index, Mask
from nextview_lab.data.predictions import Predictions, of_true_class
from nextview_lab.errors import PredictionsError
from nextview_lab.training.card_fits import fit_temperature
from nextview_lab.training.fitting_set import for_fitting

# belief in the truth, its logarithm, or whether the answer is right
OBJECTIVES = ("belief", "log-belief", "right")


def for_replay(
    predictions: Predictions,
    kept: NDArray,
    rng: Generator,
    sensed: Sequence[Predictions] = (),
) -> Predictions:
    """Select some of the objects of predictions, calibrated.

    If their recogniser has no calibration, it is fitted here.

    Args:
        predictions: of the objects.
        kept: indices of the objects.
        rng: source of all random numbers.
        sensed: predictions of the same objects through sensors.

    Raises:
        PredictionsError: no object is left.
    """
    if len(kept) == 0:
        raise PredictionsError("no object is left to learn from")
    parts = [for_fitting(part.of_objects(kept)) for part in (predictions, *sensed)]
    data = Predictions.joined(parts)
    if data.calibration != PLAIN_SUM:
        return data
    return replace(data, calibration=fit_temperature(data, rng))


def check_inputs(
    p: Predictions, inputs: Sequence[str], frame: CellFrame, before: str = ""
) -> None:
    """Check that predictions hold the inputs of a policy.

    Args:
        p: the predictions.
        inputs: of the policy.
        frame: in which it sees azimuths.
        before: beginning of the sentence of an error.

    Raises:
        PredictionsError: they lack one.
    """
    lacking = [name for name in maps_of(inputs) if name not in p.maps]
    if lacking:
        known = ", ".join((*INPUTS, *in_order(p.maps)))
        raise PredictionsError(
            f"{before}these predictions hold no map {lacking[0]!r}; predict it, or choose inputs"
            f" among {known}"
        )
    if VISIBILITY in inputs:
        raise PredictionsError(
            f"{before}these predictions hold no visibility, as nothing stands around the objects;"
            " choose other inputs"
        )
    if p.azimuth_bins is None and (frame == "object" or "azimuth_bin" in inputs):
        raise PredictionsError(
            f"{before}these predictions hold no azimuth bins; train the recogniser with"
            " --azimuth-bins-weight, or use the frame camera and no azimuth_bin"
        )


@dataclass(frozen=True)
class DecisionState:
    """N episodes, one for each object, when the next view is chosen.

    Attributes:
        state: input of the policy.
        total: sum of the log-evidence so far, (N, D).
        travel: so far, grid cells, (N,).
        seen: number of views with a visible object, (N,).
    """

    state: EpisodeState
    total: Float
    travel: Float
    seen: Float


def rollout(
    data: Predictions,
    policy: Policy,
    n_views: int,
    rng: Generator,
) -> Iterator[DecisionState]:
    """Follow a policy once over every object from a random first view.

    Args:
        data: of the N objects.
        policy: the policy.
        n_views: views of each episode.
        rng: source of all random numbers.

    Yields:
        The state of all episodes after each view.
    """
    sphere = data.sphere

    starts = rng.integers(len(sphere), size=len(data))
    length = FixedLength(max_views=n_views)
    run = run_episodes(
        data.evidence,
        sphere,
        policy,
        starts,
        length,
        rng,
        data.calibration,
    )

    visited = np.zeros((len(data), len(sphere)), bool)
    travel = np.zeros(len(data))
    for k, step in enumerate(run.steps, 1):
        visited[step.episodes, step.views] = True
        state = state_after(step, data, visited.copy(), k)
        yield DecisionState(state, step.total, travel, step.seen)

        if k < len(run.steps):
            travel = travel + sphere.travel[step.views, step.next_views]


def state_after(
    step: Step, data: Predictions, visited: Mask, number: int
) -> EpisodeState:
    """Return the state of B episodes after a view.

    Args:
        step: the view.
        data: of the objects.
        visited: views so far, (B, V).
        number: of views so far.
    """
    azimuth_bins = data.calibration.azimuth_bins(
        step.total,
        np.maximum(step.seen, 1),
        len(data.classes),
        data.sphere.azimuth[step.views],
    )
    return EpisodeState(
        step.views,
        visited,
        step.belief,
        step.evidence,
        number,
        step.episodes,
        azimuth_bins,
    )


def value_after(
    data: Predictions,
    total: Float,
    n_views: NDArray | int,
    kind: str,
) -> Float:
    """Return the value of sums of log-evidence.

    Args:
        data: of the N objects.
        total: sums of the log-evidence of each object, (N, ..., D).
        n_views: number of views in the sums, (N, ...).
        kind: one of OBJECTIVES.

    Returns:
        Values, (N, ...) float64.
    """
    return value_of(
        data.calibration.log_belief(total, n_views, len(data.classes)),
        data.labels,
        kind,
    )


def value_of(logs: Float, labels: Index, kind: str) -> Float:
    """Return the value of log-beliefs.

    Args:
        logs: log-beliefs up to a constant, (N, ..., C).
        labels: true classes, (N,) int64.
        kind: one of OBJECTIVES.

    Returns:
        Values, (N, ...) float64.
    """
    if kind == "right":
        return np.equal(logs.argmax(-1).T, labels).T.astype(np.float64)
    of_truth = of_true_class(logs, labels)
    return of_truth if kind == "log-belief" else np.exp(of_truth)


def candidate_values(data: Predictions, moment: DecisionState, kind: str) -> Float:
    """Return the value of taking each view next.

    Args:
        data: of the N objects.
        moment: the state of the episodes.
        kind: one of OBJECTIVES.

    Returns:
        Values, (N, V) float64.
    """
    # a view without a visible object has no weight in the sum
    counts = data.seen.astype(np.float64)
    n_views = np.maximum(moment.seen[:, None] + counts, 1)
    return value_after(
        data,
        moment.total[:, None] + counts[..., None] * data.log_evidence,
        n_views,
        kind,
    )


class Value(NamedTuple):
    """Mean objective and travel after 2, 3, ... views; classes have equal weight.

    Attributes:
        mean: objective, averaged over classes, (views - 1,).
        travel: grid cells, (views - 1,).
    """

    mean: Float
    travel: Float


def judge(
    data: Predictions,
    policy: Policy,
    n_views: int,
    kind: str,
    rng: Generator,
    rounds: int = 8,
) -> Value:
    """Follow a policy several times over every object and return its value.

    Args:
        data: of the objects.
        policy: the policy.
        n_views: views of each episode.
        kind: one of OBJECTIVES.
        rng: source of all random numbers.
        rounds: episodes with each object.

    Returns:
        Mean value and travel after 2, 3, ... views.
    """
    weights = data.weights / len(data) / rounds
    reached = np.zeros((2, n_views - 1))
    for _ in range(rounds):
        for moment in rollout(data, policy, n_views, rng):
            k = moment.state.step
            if k > 1:
                value = value_after(
                    data,
                    moment.total,
                    np.maximum(moment.seen, 1),
                    kind,
                )
                reached[:, k - 2] += weights @ value, weights @ moment.travel
    return Value(*reached)


# predictions, each with a policy to follow over their objects
Judged = Sequence[tuple[Predictions, Policy]]
TRAVEL_WEIGHTS = (
    0.0,
    0.0005,
    0.001,
    0.002,
    0.003,
    0.005,
    0.007,
    0.01,
    0.012,
    0.015,
    0.02,
    0.03,
    0.05,
    0.1,
)
"""Weights of a grid cell of travel, in the unit of the objective."""


def judge_all(
    judged: Judged,
    n_views: int,
    kind: str,
    seed: int | list[int],
    rounds: int = 8,
) -> Value:
    """Return the mean value over the objects of several predictions; see ``judge``.

    Args:
        judged: predictions, each with its own policy.
        n_views: views of each episode.
        kind: one of OBJECTIVES.
        seed: of the random numbers.
        rounds: episodes with each object.

    Returns:
        Mean value and travel after 2, 3, ... views.
    """
    values = [
        judge(*pair, n_views, kind, np.random.default_rng(seed), rounds)
        for pair in judged
    ]
    return Value(*np.average(values, 0, [len(data) for data, _ in judged]))


def fit_travel_weight(
    judged: Sequence[tuple[Predictions, Gain]],
    n_views: int,
    kind: str,
    seed: int,
) -> float:
    """Choose the lowest travel weight at which policies travel no farther than a random walk.

    The random walk stays in the local window. The choice is among TRAVEL_WEIGHTS.

    Args:
        judged: predictions, each with its own policy.
        n_views: views of each episode.
        kind: one of OBJECTIVES.
        seed: of the random numbers.

    Returns:
        The weight, value per grid cell; the largest one if all travel farther.
    """
    limit = judge_all(
        [(data, Random(data.sphere)) for data, _ in judged],
        n_views,
        kind,
        seed,
    ).travel
    for weight in TRAVEL_WEIGHTS:
        paying = [
            (data, replace(policy, travel_weight=weight)) for data, policy in judged
        ]
        if (judge_all(paying, n_views, kind, seed).travel <= limit).all():
            return weight
    return TRAVEL_WEIGHTS[-1]
