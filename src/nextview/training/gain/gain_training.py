"""The stage from predictions to the gain policy: its card, and its networks as ONNX beside it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import takes_paths
from nextview.calibration.fitting_set import load_sensed
from nextview.calibration.rollout import ReplayTable, Value, fit_travel_weight
from nextview.command_line import command_line
from nextview.data.predictions import Predictions
from nextview.data.world_sight import worlds_of
from nextview.errors import PredictionsError, UsageError
from nextview.measures.map_names import in_order
from nextview.models.model_card import file_hash
from nextview.policies.gain import INPUTS, VISIBILITY, Gain, maps_of
from nextview.policies.policy_card import LearnedFrom, PolicyCard
from nextview.tracking import Track, silently
from nextview.training.folds import hold_out
from nextview.training.gain.gain_networks import averaged, best_epoch, train, walk
from nextview.training.gain_export import write_gain
from nextview.training.recipes import GainRecipe


@dataclass(frozen=True)
class TrainedGain:
    """A gain policy that was trained and written.

    Attributes:
        card: its card (.json); the networks are the .onnx beside it.
        objects: from how many it learned.
        validated_on: which objects chose the epoch and the travel weight, in words.
        value: the mean value of 2, 3, ... views on those at travel weight 0, see ``GainRecipe.objective``.
        travel_weight: that of the policy.
        states: in so many the ONNX file was compared with the networks.
        difference: by which its answers differ from theirs at most.
    """

    card: Path
    objects: int
    validated_on: str
    value: NDArray[np.float64]
    travel_weight: float
    states: int
    difference: float


@takes_paths("predictions", "card", "validation", many=("sensed",))
def train_gain(
    predictions: Path,
    card: Path,
    recipe: GainRecipe = GainRecipe(),
    *,
    validation: Path | None = None,
    folds: int = 20,
    travel_weight: float | None = None,
    local: bool = False,
    sensed: Sequence[Path] = (),
    track: Track = silently,
) -> TrainedGain:
    """Train the gain policy on predictions of objects that the recogniser was not trained on.

    Args:
        predictions: of such objects of the training split.
        card: the card to write (.json); the networks are written beside it (.onnx).
        recipe: how to train.
        validation: predictions of other objects of the training split, which choose the epoch and the travel weight;
            those among them are left out of the training. By default ``predictions`` choose them, in folds.
        folds: without ``validation``, so many policies are trained, each without its share of the objects, which
            validate it; the result is the mean of all.
        travel_weight: of a grid cell of travel; by default the lowest at which the policy travels no farther than a
            random walk in the local window.
        local: let it choose in the local window only.
        sensed: predictions of the objects of ``predictions`` through sensors: it learns from these too, and they choose
            with them.
        track: follows the epochs.

    Raises:
        UsageError: the card is not called NAME.json.
        PredictionsError: the predictions lack what the recipe takes, are of the test split or do not belong together.
        DatasetError: the objects cannot be divided into so many folds.
        ModelError: the ONNX file does not answer as the networks do; nothing is written then.
    """
    if card.suffix != ".json":
        raise UsageError(f"{card}: the card of a policy is called NAME.json")
    table = Predictions.load(predictions).deduplicate()
    other = table if validation is None else Predictions.load(validation).deduplicate()
    if (other.classes, other.sphere) != (table.classes, table.sphere):
        raise PredictionsError(f"{validation}: is of other classes or viewpoints than {predictions}")
    sources = [(path, p) for path, p in ((predictions, table), (validation, other)) if path is not None]
    if sensed and validation is not None:
        raise UsageError("predictions through sensors choose with those that are learned from: no --validation")
    variants = load_sensed(sensed, table)
    sources += list(zip(sensed, variants, strict=True))
    for path, p in sources:
        _check(path, p, recipe)
    everything = np.arange(len(table))
    if validation is None:
        validating = hold_out(table.labels, _shapes(table), folds, recipe.seed)
        learning = [np.setdiff1d(everything, part) for part in validating]
        validated_on = f"the same, each judged by networks of {folds - 1} other folds"
    else:
        validating, learning = [np.arange(len(other))], [everything[~np.isin(_targets(table), _targets(other))]]
        validated_on = f"{len(other)} others"
    rng = np.random.default_rng([recipe.seed, 1])
    worlds = worlds_of(table)
    others = worlds if validation is None else worlds_of(other)
    learned = [ReplayTable.of(table, part, rng, variants, worlds) for part in learning]
    validated = [ReplayTable.of(other, part, rng, variants, others) for part in validating]
    best, value = _best_epoch(learned, validated, recipe, track)
    policies = [replace(policy, scope="local" if local else "global") for policy in best]
    asked_travel_weight = travel_weight
    if travel_weight is None:
        judged = list(zip(validated, policies, strict=True))
        travel_weight = fit_travel_weight(judged, recipe.n_views, recipe.objective, recipe.seed)
    policy = averaged(policies)
    objects = len(np.unique(np.concatenate(learning)))
    command = command_line(
        "train gain", predictions, card,
        validation=validation, folds=folds, travel_weight=asked_travel_weight, local=local, sensed=tuple(sensed),
        recipe=recipe,
    )  # fmt: skip
    about = PolicyCard(
        "gain",
        policy.scope,
        table.sphere.elevations,
        table.sphere.azimuths,
        table.classes,
        {},
        f"{objects} objects of the training split{', clean and through sensors' * bool(sensed)}, classes weighted "
        f"evenly; epoch and travel weight chosen on {validated_on}",
        tuple(LearnedFrom(file_hash(path), p.models) for path, p in sources),
        tuple((part.calibration.temperature, part.calibration.correlation) for part in learned),
        asdict(recipe),
        tuple(dict.fromkeys((*(line for _, p in sources for line in p.commands), command))),
    )
    states = np.concatenate([walk(part, [policy], recipe, rng).features for part in validated])
    card.parent.mkdir(parents=True, exist_ok=True)
    difference = write_gain(card, replace(policy, travel_weight=travel_weight), about, states)
    return TrainedGain(card, objects, validated_on, value.mean, travel_weight, len(states), difference)


def _targets(p: Predictions) -> list[str]:
    """What the objects are called, whichever world they stand in."""
    return [name.partition("@")[0] for name in p.names]


def _shapes(p: Predictions) -> NDArray[np.floating]:
    """Rows that are the same where the shape is, (N, ...): by what is seen of it, or in worlds by its name."""
    if worlds_of(p) is None:
        return p.depth_entropy
    return np.unique(_targets(p), return_inverse=True)[1][:, None].astype(np.float64)


def _check(path: Path, p: Predictions, recipe: GainRecipe) -> None:
    """Refuse predictions without what the policy is to take from them."""
    lacking = [name for name in maps_of(recipe.inputs) if name not in p.maps]
    if lacking:
        known = ", ".join((*INPUTS, VISIBILITY, *in_order(p.maps)))
        raise PredictionsError(f"{path}: holds no map {lacking[0]!r}; predict it, or choose --inputs among {known}")
    if VISIBILITY in recipe.inputs and worlds_of(p) is None:
        raise PredictionsError(f"{path}: is of no worlds, in which all would show; choose other --inputs")
    if p.azimuth_bins is None and (recipe.frame == "object" or "azimuth_bin" in recipe.inputs):
        raise PredictionsError(
            f"{path}: holds no azimuth bins; train the recogniser with --azimuth-bins-weight, or give --frame camera "
            "and --inputs without azimuth_bin"
        )


def _best_epoch(
    learned: list[ReplayTable], validated: list[ReplayTable], recipe: GainRecipe, track: Track
) -> tuple[tuple[Gain, ...], Value]:
    """Train on each table; the policies of the best epoch by their value on the table of the same place."""
    found: list[tuple[tuple[Gain, ...], Value]] = []

    def epochs() -> Iterator[int]:
        trainings = [train(part, recipe, fold) for fold, part in enumerate(learned)]
        for best in best_epoch(trainings, validated, recipe):
            found.append(best)
            yield len(found)

    track(epochs(), recipe.epochs, "training")
    return found[-1]
