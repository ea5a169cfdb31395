"""The stage from a view store to a trained recogniser, or to one for each fold."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import takes_paths
from nextview.command_line import command_line
from nextview.data.splits import check_any, deduplicate, split_training
from nextview.data.store import ViewStore
from nextview.errors import DatasetError, UsageError
from nextview.outputs import written_whole
from nextview.tracking import Track, silently
from nextview.training.checkpoints import refuse_seen
from nextview.training.folds import hold_out
from nextview.training.hardware import Hardware
from nextview.training.inputs import ready_inputs
from nextview.training.recipes import RecogniserRecipe
from nextview.training.recogniser.azimuth_bins import azimuth_bins, mirror_planes
from nextview.training.recogniser.recogniser_module import Source, fit_recogniser
from nextview.training.runs import begin, finish, is_done, training_commands


@takes_paths("store", "out", "weights", many=("deformed",))
def train_recogniser(
    store: Path,
    out: Path,
    recipe: RecogniserRecipe = RecogniserRecipe(),
    *,
    deformed: Sequence[Path] = (),
    weights: Path | None = None,
    folds: int = 0,
    fold: int | None = None,
    hardware: Hardware = Hardware(),
    track: Track = silently,
) -> Path:
    """Train the recogniser on a store's training split. A second call resumes what was cut off.

    Args:
        store: the view store.
        out: folder for checkpoints, logs and network.pt, the network of the epoch with the best class mean.
        recipe: how to train.
        deformed: stores of the same objects or some of them, deformed; their views may be others.
        weights: a published checkpoint, or the card (.json) of an exported recogniser, to start from.
        folds: train so many recognisers instead, in OUT/fold0 and so on, each without its share of the training
            objects; 0 trains one on all of them.
        fold: train only this one of them, 0 the first.
        hardware: on what.
        track: follows the preparation of the inputs.

    Returns:
        ``out``.

    Raises:
        UsageError: there is no such fold.
        DatasetError: a store cannot be used, or another process trains in the same folder.
        ModelError: the weights cannot be used, or have seen what is held out; or ``out`` holds another run.
    """
    if fold is not None and not 0 <= fold < folds:
        raise UsageError(f"there is no fold {fold} of {folds}: they are counted from 0")
    views = ViewStore.open(store)
    training, validation = split_training(views, recipe.validation, recipe.seed)
    check_any(views, training, validation)
    held_out = {out: training[:0]}
    if folds:
        parts = hold_out(views.labels[training], views.measure()[training], folds, recipe.seed)
        held_out = {out / f"fold{k}": training[part] for k, part in enumerate(parts) if fold in (None, k)}
    azimuths = views.sphere.azimuths if recipe.azimuth_bins_weight else 0
    planes = mirror_planes(views, training) if recipe.azimuth_bins_weight else None
    sources = [_source(path, views, training, recipe, planes, track) for path in (store, *deformed)]
    if weights and weights.suffix == ".json":
        for held in held_out.values():
            refuse_seen(weights, [views.names[i] for i in [*validation, *held]])
    command = command_line(
        "train recogniser",
        store,
        out,
        deformed=tuple(deformed),
        weights=weights,
        folds=folds or None,
        fold=fold,
        recipe=recipe,
    )
    commands = training_commands(command, [ViewStore.open(path) for path in (store, *deformed)], weights)
    validating = deduplicate(views, validation)  # copies of one mesh count once
    for run, held in held_out.items():
        with begin(run, recipe, weights, commands):
            if is_done(run):
                continue
            with written_whole(run / "held_out.json") as part:
                part.write_text(json.dumps([views.names[i] for i in held]) + "\n")
            learning = np.setdiff1d(training, held)
            network = fit_recogniser(
                sources, views.labels, learning, validating, recipe, run, weights, hardware, azimuths
            )
            finish(network, run)
    return out


def _source(
    path: Path,
    views: ViewStore,
    needed: NDArray[np.int64],
    recipe: RecogniserRecipe,
    planes: NDArray[np.float64] | None,
    track: Track,
) -> Source:
    """Inputs of a store, and the row of each object of ``views`` in them, -1 for none."""
    store = ViewStore.open(path)
    row = {name: i for i, name in enumerate(store.names)}
    rows = np.array([row.get(name, -1) for name in views.names])
    if (rows[needed] < 0).all():
        raise DatasetError(f"{path}: holds none of the training objects")
    inputs = ready_inputs(path, recipe.size, recipe.input, track)
    return Source(inputs, rows, None if planes is None else azimuth_bins(store, views.sphere.azimuths, planes))
