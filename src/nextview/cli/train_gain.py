"""``nextview train gain``: learn what a view from each view is worth."""

from __future__ import annotations

from pathlib import Path

import tyro

from nextview.errors import PredictionsError, UsageError
from nextview.training.recipes import GainRecipe


def train_gain(
    predictions: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    /,
    validation: Path | None = None,
    folds: int = 20,
    travel_weight: float | None = None,
    local: bool = False,
    recipe: tyro.conf.OmitArgPrefixes[GainRecipe] = GainRecipe(),
) -> None:
    """Train the gain policy on what a recogniser says of objects that it has not seen. Takes a few minutes.

    Args:
        predictions: of objects of the training split that the recogniser was not trained on, those that validated it or
            those that were kept from it in folds (nextview predict --unseen).
        out: card of the policy (.json), the weights beside it (.onnx); run it with --policy OUT, or OUT@PRICE for
            another travel weight.
        validation: predictions of other objects of the training split, which choose the epoch and the travel weight;
            those among them are left out of the training. By default PREDICTIONS choose them, in folds.
        folds: without VALIDATION, so many policies are trained, each without its share of the objects, which judge it;
            the result is the mean of all.
        travel_weight: of a grid cell of travel; by default the lowest at which the policy travels no farther than a
            random walk in the local window.
        local: let it choose in the local window only.
        recipe: how to train.
    """
    from collections.abc import Iterator
    from dataclasses import asdict, replace

    import numpy as np

    from nextview.calibration.rollout import ReplayTable, Value, fit_travel_weight
    from nextview.cli.progress import console, track
    from nextview.command_line import command_line
    from nextview.data.predictions import Predictions
    from nextview.models.model_card import file_hash
    from nextview.policies.gain import MAPS, Gain
    from nextview.policies.policy_card import LearnedFrom, PolicyCard
    from nextview.training.folds import hold_out
    from nextview.training.gain_export import write_gain
    from nextview.training.gain_training import averaged, best_epoch, train, walk

    if out.suffix != ".json":
        raise UsageError(f"{out}: the card of a policy is called NAME.json")
    table = Predictions.load(predictions).deduplicate()
    other = table if validation is None else Predictions.load(validation).deduplicate()
    if (other.classes, other.sphere) != (table.classes, table.sphere):
        raise PredictionsError(f"{validation}: is of other classes or viewpoints than {predictions}")
    for path, source in ((predictions, table), (validation, other)):
        lacking = [name for name in recipe.inputs if name in MAPS and name not in source.maps]
        if lacking:
            raise PredictionsError(f"{path}: holds no map {lacking[0]!r}; predict it, or choose other --inputs")
        if source.azimuth_bins is None and (recipe.frame == "object" or "azimuth_bin" in recipe.inputs):
            raise PredictionsError(
                f"{path}: says nothing of azimuth bins; teach the recogniser (--azimuth-bins-weight), or do without"
            )
    everything = np.arange(len(table))
    if validation is None:
        checking = hold_out(table.labels, table.depth_entropy, folds, recipe.seed)
        learning = [np.setdiff1d(everything, part) for part in checking]
    else:
        checking, learning = [np.arange(len(other))], [everything[~np.isin(table.names, other.names)]]
    rng = np.random.default_rng([recipe.seed, 1])
    learned = [ReplayTable.of(table, part, rng) for part in learning]
    checked = [ReplayTable.of(other, part, rng) for part in checking]
    found: list[tuple[tuple[Gain, ...], Value]] = []

    def epochs() -> Iterator[int]:
        trainings = [train(part, recipe, k) for k, part in enumerate(learned)]
        for best in best_epoch(trainings, checked, recipe):
            found.append(best)
            yield len(found)

    track(epochs(), recipe.epochs, "training")
    best, value = found[-1]
    policies = [replace(policy, scope="local" if local else "global") for policy in best]
    asked_travel_weight = travel_weight
    if travel_weight is None:
        judged = list(zip(checked, policies, strict=True))
        travel_weight = fit_travel_weight(judged, recipe.n_views, recipe.outcome, recipe.seed)
    policy = averaged(policies)
    learners = len(np.unique(np.concatenate(learning)))
    chosen = f"{len(other)} others" if validation else f"the same, each judged by networks of {folds - 1} other folds"
    out.parent.mkdir(parents=True, exist_ok=True)
    sources = [(path, source) for path, source in ((predictions, table), (validation, other)) if path is not None]
    command = command_line(
        "train gain",
        predictions,
        out,
        validation=validation,
        folds=folds,
        travel_weight=asked_travel_weight,
        local=local,
        recipe=recipe,
    )
    about = PolicyCard(
        "gain",
        policy.scope,
        table.sphere.elevations,
        table.sphere.azimuths,
        table.classes,
        {},
        f"{learners} objects of the training split, classes weighted evenly; epoch and travel weight "
        f"chosen on {chosen}",
        tuple(LearnedFrom(file_hash(path), source.models) for path, source in sources),
        tuple((part.calibration.temperature, part.calibration.correlation) for part in learned),
        asdict(recipe),
        tuple(dict.fromkeys((*(line for _, source in sources for line in source.commands), command))),
    )
    seen = np.concatenate([walk(part, [policy], recipe, rng).features for part in checked])
    difference = write_gain(out, replace(policy, travel_weight=travel_weight), about, seen)
    console.print(
        f"learned from {learners} objects; on {chosen} the {recipe.outcome} after 2, 3, ... views is "
        f"{', '.join(f'{x:.4f}' for x in value.outcome)} at travel weight 0; travel weight {travel_weight:g}: {out}"
    )
    console.print(
        f"weights: {out.with_suffix('.onnx')}; in {len(seen)} states its answers differ from the networks' by "
        f"{difference:.1g} at most"
    )
