"""``nextview train``: recogniser and map networks from a view store."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from nextview.command_line import command_line
from nextview.errors import DatasetError, ModelError
from nextview.training.hardware import Hardware
from nextview.training.recipes import MapRecipe, RecogniserRecipe

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from nextview.data.store import ViewStore
    from nextview.models.network_input import InputKind
    from nextview.training.packed import PackedViews
    from nextview.training.recogniser import Source
    from nextview.training.targets import Target


def train_recogniser(
    store: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    deformed: tuple[Path, ...] = (),
    weights: Path | None = None,
    folds: int = 0,
    fold: int | None = None,
    recipe: tyro.conf.OmitArgPrefixes[RecogniserRecipe] = RecogniserRecipe(),
    hardware: tyro.conf.OmitArgPrefixes[Hardware] = Hardware(),
) -> None:
    """Train the recogniser on a store's training split. Resumes if OUT holds a run that was cut off.

    Args:
        store: view store made by nextview render.
        out: folder for checkpoints, logs, curves.png and network.pt, that of the epoch with the best class mean.
        deformed: stores of the same objects, stretched and turned (nextview render --stretch .25 --turn --seed 1 and so
            on); their views may be others.
        weights: start from a published checkpoint, torchvision's of the same depth or EfficientNet-Lite0's, or go on
            from an exported recogniser (its card, NAME.json) on other data or for longer.
        folds: train so many recognisers instead, OUT/fold0 and so on, each without its share of the training objects,
            for evidence from networks that have not seen the object.
        fold: train only this one of them, 0 the first.
        recipe: how to train.
        hardware: on what.
    """
    import numpy as np

    from nextview.cli.progress import console
    from nextview.data.splits import deduplicate, split_training
    from nextview.data.store import ViewStore
    from nextview.training import recogniser
    from nextview.training.azimuth_bins import mirror_planes
    from nextview.training.checkpoints import refuse_seen
    from nextview.training.folds import hold_out
    from nextview.training.runs import begin, finish, is_done, training_commands

    if fold is not None and not 0 <= fold < folds:
        raise ModelError(f"there is no fold {fold} of {folds}: they are counted from 0")
    if recipe.network != "resnet" and recipe.depth != RecogniserRecipe.depth:
        raise ModelError(f"only a ResNet has a --depth: {recipe.network} is as deep as it is")
    if recipe.network == "resnet" and recipe.dropout:
        raise ModelError("only EfficientNet-Lite0 drops features and blocks: leave --dropout, or take --network lite0")
    if not 0 <= recipe.dropout < 1:
        raise ModelError(f"--dropout is a chance, 0 or more and less than 1, not {recipe.dropout}")
    views = ViewStore.open(store)
    training, validation = split_training(views, recipe.validation, recipe.seed)
    judging = deduplicate(views, validation)
    azimuths = views.sphere.azimuths if recipe.azimuth_bins_weight else 0
    planes = mirror_planes(views, training) if recipe.azimuth_bins_weight else None
    sources = [_source(path, views, training, recipe, planes) for path in (store, *deformed)]
    runs = {out: training[:0]}
    if folds:
        parts = hold_out(views.labels[training], views.measure()[training], folds, recipe.seed)
        runs = {out / f"fold{k}": training[part] for k, part in enumerate(parts)}
    if fold is not None:
        runs = dict([list(runs.items())[fold]])
    if weights and weights.suffix == ".json":
        for held in runs.values():
            refuse_seen(weights, [views.names[i] for i in [*validation, *held]])
    command = command_line(
        "train recogniser",
        store,
        out,
        deformed=deformed,
        weights=weights,
        folds=folds or None,
        fold=fold,
        recipe=recipe,
    )
    commands = training_commands(command, [ViewStore.open(path) for path in (store, *deformed)], weights)
    for run, held in runs.items():
        with begin(run, recipe, weights, commands):
            if is_done(run):
                console.print(f"{run}: is trained already", soft_wrap=True)
                continue
            (run / "held_out.json").write_text(json.dumps([views.names[i] for i in held]) + "\n")
            seen = np.setdiff1d(training, held)
            network = recogniser.train(sources, views.labels, seen, judging, recipe, run, weights, hardware, azimuths)
            _draw_curves(run)
            finish(network, run)


def _source(
    path: Path,
    views: ViewStore,
    needed: NDArray[np.int64],
    recipe: RecogniserRecipe,
    planes: NDArray[np.float64] | None,
) -> Source:
    """Inputs of a store, prepared if they are not yet, and the row of each object of ``views`` in them, -1 for none."""
    import numpy as np

    from nextview.data.store import ViewStore
    from nextview.training.azimuth_bins import azimuth_bins
    from nextview.training.recogniser import Source

    store = ViewStore.open(path)
    row = {name: i for i, name in enumerate(store.names)}
    rows = np.array([row.get(name, -1) for name in views.names])
    missing = [views.names[i] for i in needed if rows[i] < 0]
    if missing:
        raise DatasetError(f"{path}: lacks {len(missing)} of the training objects, {missing[0]} among them")
    inputs = _prepared(path, store, recipe.size, recipe.input)
    return Source(inputs, rows, None if planes is None else azimuth_bins(store, views.sphere.azimuths, planes))


def _prepared(path: Path, store: ViewStore, size: int, kind: InputKind) -> PackedViews:
    """Inputs of a store (N, V, C, size, size), prepared if they are not yet."""
    import time

    from nextview.cli.progress import track
    from nextview.data.lock import only_one
    from nextview.training.inputs import inputs_path, load_inputs, prepare_inputs
    from nextview.training.loop import is_first

    target = inputs_path(path, size, kind)
    if is_first() and not target.exists():
        with only_one(target):
            track(prepare_inputs(path, size, kind), int(store.done.sum()), f"inputs of {path.name}")
    while not target.exists():  # the first process makes it
        time.sleep(1)
    return load_inputs(path, size, kind)


def _draw_curves(run: Path) -> None:
    """Draw how a training went, from its log, as curves.png."""
    from nextview.report.style import to_png
    from nextview.report.training_curves import read_log, training_curves
    from nextview.training.loop import is_first

    if is_first():
        to_png(training_curves(read_log(run)), run / "curves.png")


def train_lem(
    store: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    weights: Path | None = None,
    recipe: tyro.conf.OmitArgPrefixes[MapRecipe] = MapRecipe(),
    hardware: tyro.conf.OmitArgPrefixes[Hardware] = Hardware(),
) -> None:
    """Train the LEM on a store's training split. Resumes if OUT holds a run that was cut off.

    Args:
        store: view store made by nextview render, with the 40 views.
        out: folder for checkpoints, logs, curves.png and network.pt, that of the epoch with the lowest squared error.
        weights: card (NAME.json) of the same depth and input from which a ResNet starts: a recogniser's, as what it
            knows of shapes and of the azimuth bin that is seen is of use; or that of a map network, to go on with it.
        recipe: how to train.
        hardware: on what.
    """
    from nextview.data.store import ViewStore
    from nextview.training.runs import training_commands
    from nextview.training.targets import entropy_target

    views = ViewStore.open(store)
    commands = training_commands(
        command_line("train lem", store, out, weights=weights, recipe=recipe), [views], weights
    )
    _train_map(store, entropy_target(views), out, weights, recipe, hardware, commands)


def train_lcm(
    store: tyro.conf.Positional[Path],
    predictions: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    weights: Path | None = None,
    recipe: tyro.conf.OmitArgPrefixes[MapRecipe] = MapRecipe(),
    hardware: tyro.conf.OmitArgPrefixes[Hardware] = Hardware(),
) -> None:
    """Train the LCM on what recognisers say of a store's training split. Resumes if OUT holds a run that was cut off.

    Args:
        store: view store made by nextview render, with the 40 views.
        predictions: of its training split, by the recogniser whose confidence is to be predicted; or from recognisers
            that have not seen the objects (nextview train recogniser --folds, export each, nextview predict --unseen
            --recogniser CARD CARD).
        out: folder for checkpoints, logs, curves.png and network.pt, that of the epoch with the lowest squared error.
        weights: card (NAME.json) of the same depth and input from which a ResNet starts: a recogniser's, as what it
            knows of shapes and of the azimuth bin that is seen is of use; or that of a map network, to go on with it.
        recipe: how to train.
        hardware: on what.
    """
    from nextview.data.predictions import Predictions
    from nextview.data.store import ViewStore
    from nextview.training.runs import training_commands
    from nextview.training.targets import confidence_target

    views, predicted = ViewStore.open(store), Predictions.load(predictions)
    command = command_line("train lcm", store, predictions, out, weights=weights, recipe=recipe)
    commands = training_commands(command, [views, predicted], weights)
    _train_map(store, confidence_target(views, predicted), out, weights, recipe, hardware, commands)


def _train_map(
    store: Path,
    target: Target,
    out: Path,
    weights: Path | None,
    recipe: MapRecipe,
    hardware: Hardware,
    commands: tuple[str, ...],
) -> None:
    from nextview.cli.progress import console
    from nextview.data.splits import deduplicate, split_training
    from nextview.data.store import ViewStore
    from nextview.training import map_training as maps
    from nextview.training.checkpoints import refuse_seen
    from nextview.training.runs import begin, finish, is_done

    views = ViewStore.open(store)
    training, validation = (target.known(part) for part in split_training(views, recipe.validation, recipe.seed))
    if weights:
        refuse_seen(weights, [views.names[i] for i in validation])
    with begin(out, recipe, weights, commands):
        if is_done(out):
            console.print(f"{out}: is trained already", soft_wrap=True)
            return
        cloud = recipe.input == "cloud"
        seen: NDArray | PackedViews = (
            views.all_points() if cloud else _prepared(store, views, recipe.size, recipe.input)
        )
        judging = deduplicate(views, validation)
        network = maps.train(seen, target.values, views.sphere, training, judging, recipe, out, hardware, weights)
        _draw_curves(out)
        finish(network, out)
