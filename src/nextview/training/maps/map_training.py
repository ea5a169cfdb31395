"""The stage from a view store to a trained map network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from nextview.arguments import takes_paths
from nextview.command_line import command_line
from nextview.data.predictions import Predictions
from nextview.data.splits import check_any, deduplicate, split_training
from nextview.data.store import ViewStore
from nextview.tracking import Track, silently
from nextview.training.checkpoints import refuse_seen
from nextview.training.hardware import Hardware
from nextview.training.inputs import ready_inputs
from nextview.training.maps.map_module import fit_map
from nextview.training.maps.map_targets import target_of
from nextview.training.packed import PackedViews
from nextview.training.recipes import MapRecipe
from nextview.training.runs import begin, finish, is_done, training_commands


@takes_paths("store", "out", "predictions", "weights")
def train_map(
    store: Path,
    out: Path,
    recipe: MapRecipe = MapRecipe(),
    *,
    predictions: Path | None = None,
    weights: Path | None = None,
    hardware: Hardware = Hardware(),
    track: Track = silently,
) -> Path:
    """Train a network that predicts the local map of a measure, on a store's training split.

    A second call resumes what was cut off.

    Args:
        store: the view store, with the recipe's measure in it.
        out: folder for checkpoints, logs and network.pt, the network of the epoch with the lowest squared error.
        recipe: of which measure, and how to train.
        predictions: for the confidence: of the store's training split, by the recogniser whose confidence it is.
        weights: card (.json) of the same depth and input from which a ResNet starts, a recogniser's or a map network's.
        hardware: on what.
        track: follows the preparation of the inputs.

    Returns:
        ``out``.

    Raises:
        DatasetError: the store cannot be used, lacks the measure or has nothing to train on, or another process trains
            in the same folder.
        PredictionsError: the predictions are of other views.
        ModelError: the weights cannot be used, or have seen what validates; or ``out`` holds another run.
    """
    views = ViewStore.open(store)
    predicted = None if predictions is None else Predictions.load(predictions)
    target = target_of(recipe.measure, views, predicted)
    command = command_line("train map", store, out, predictions=predictions, weights=weights, recipe=recipe)
    commands = training_commands(command, [views] if predicted is None else [views, predicted], weights)
    training, validation = (target.known(part) for part in split_training(views, recipe.validation, recipe.seed))
    check_any(views, training, validation, "" if target.there.all() else ": of the others no map is known")
    if weights:
        refuse_seen(weights, [views.names[i] for i in validation])
    with begin(out, recipe, weights, commands):
        if is_done(out):
            return out
        inputs: NDArray[Any] | PackedViews
        if recipe.input == "cloud":
            inputs = views.all_points()
        else:
            inputs = ready_inputs(store, recipe.size, recipe.input, track)
        validating = deduplicate(views, validation)  # copies of one mesh count once
        network = fit_map(inputs, target.values, views.sphere, training, validating, recipe, out, hardware, weights)
        finish(network, out)
    return out
