"""``nextview train gain``: learn the value of the next views."""

from __future__ import annotations

from pathlib import Path

import tyro

from nextview.training.recipes import GainRecipe


def train_gain(
    predictions: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    /,
    validation: Path | None = None,
    folds: int = 20,
    travel_weight: float | None = None,
    local: bool = False,
    sensed: tuple[Path, ...] = (),
    recipe: tyro.conf.OmitArgPrefixes[GainRecipe] = GainRecipe(),
) -> None:
    """Train the gain policy on predictions of objects that the recogniser was not trained on. Takes a few minutes.

    Args:
        predictions: of such objects of the training split: those that validated the recogniser, or out-of-fold
            predictions (nextview predict --held-out).
        out: card of the policy (.json), the weights beside it (.onnx); run it with --policy OUT, or OUT@WEIGHT for
            another travel weight.
        validation: predictions of other objects of the training split, which choose the epoch and the travel weight;
            those among them are left out of the training. By default PREDICTIONS choose them, in folds.
        folds: without VALIDATION, so many policies are trained, each without its share of the objects, which validate
            it; the result is the mean of all.
        travel_weight: of a grid cell of travel; by default the lowest at which the policy travels no farther than a
            random walk in the local window.
        local: let it choose in the local window only.
        sensed: predictions of the same objects through sensors (nextview render --sensor mix), to learn from as well.
        recipe: how to train.
    """
    from nextview.cli.progress import console, track
    from nextview.training.gain import gain_training as stage

    made = stage.train_gain(
        predictions, out, recipe,
        validation=validation, folds=folds, travel_weight=travel_weight, local=local, sensed=sensed, track=track,
    )  # fmt: skip
    console.print(
        f"learned from {made.objects} objects; on {made.validated_on} the {recipe.objective} after 2, 3, ... views is "
        f"{', '.join(f'{x:.4f}' for x in made.value)} at travel weight 0; travel weight {made.travel_weight:g}: {out}"
    )
    console.print(
        f"weights: {out.with_suffix('.onnx')}; in {made.states} states its answers differ from the networks' by "
        f"{made.difference:.1g} at most"
    )
