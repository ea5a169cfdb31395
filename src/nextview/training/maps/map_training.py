"""The stages from a view store to a trained map network, LEM or LCM."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from nextview.command_line import command_line
from nextview.data.predictions import Predictions
from nextview.data.splits import check_any, deduplicate, split_training
from nextview.data.store import ViewStore
from nextview.tracking import Track, silently
from nextview.training.checkpoints import refuse_seen
from nextview.training.hardware import Hardware
from nextview.training.inputs import ready_inputs
from nextview.training.maps.map_module import fit_map
from nextview.training.maps.map_targets import Target, confidence_target, entropy_target
from nextview.training.packed import PackedViews
from nextview.training.recipes import MapRecipe
from nextview.training.runs import begin, finish, is_done, training_commands


def train_lem(
    store: Path,
    out: Path,
    recipe: MapRecipe = MapRecipe(),
    *,
    weights: Path | None = None,
    hardware: Hardware = Hardware(),
    track: Track = silently,
) -> Path:
    """Train the LEM, the local map of the depth-entropy, on a store's training split; see ``train_map``."""
    views = ViewStore.open(store)
    command = command_line("train lem", store, out, weights=weights, recipe=recipe)
    commands = training_commands(command, [views], weights)
    target = entropy_target(views)
    return train_map(store, target, out, recipe, weights=weights, hardware=hardware, commands=commands, track=track)


def train_lcm(
    store: Path,
    predictions: Path,
    out: Path,
    recipe: MapRecipe = MapRecipe(),
    *,
    weights: Path | None = None,
    hardware: Hardware = Hardware(),
    track: Track = silently,
) -> Path:
    """Train the LCM, the local map of a recogniser's confidence, on a store's training split; see ``train_map``.

    Args:
        store: the view store.
        predictions: of its training split, by the recogniser whose confidence is to be predicted.
        out: see ``train_map``; so are the others.
        recipe: how to train.
        weights: to start from.
        hardware: on what.
        track: follows the preparation of the inputs.

    Raises:
        PredictionsError: the predictions are of other views.
    """
    views, predicted = ViewStore.open(store), Predictions.load(predictions)
    command = command_line("train lcm", store, predictions, out, weights=weights, recipe=recipe)
    commands = training_commands(command, [views, predicted], weights)
    target = confidence_target(views, predicted)
    return train_map(store, target, out, recipe, weights=weights, hardware=hardware, commands=commands, track=track)


def train_map(
    store: Path,
    target: Target,
    out: Path,
    recipe: MapRecipe = MapRecipe(),
    *,
    weights: Path | None = None,
    hardware: Hardware = Hardware(),
    commands: Sequence[str] = (),
    track: Track = silently,
) -> Path:
    """Train a network that predicts the local map of a target. A second call resumes what was cut off.

    Args:
        store: the view store.
        target: the value of every view.
        out: folder for checkpoints, logs and network.pt, the network of the epoch with the lowest squared error.
        recipe: how to train.
        weights: card (.json) of the same depth and input from which a ResNet starts, a recogniser's or a map network's.
        hardware: on what.
        commands: that lead to this training, its own last; noted in the folder.
        track: follows the preparation of the inputs.

    Returns:
        ``out``.

    Raises:
        DatasetError: the store cannot be used or has nothing to train on, or another process trains in the same folder.
        ModelError: the weights cannot be used, or have seen what validates; or ``out`` holds another run.
    """
    views = ViewStore.open(store)
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
