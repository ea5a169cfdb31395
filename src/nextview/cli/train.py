"""``nextview train``: recogniser and map networks from a view store."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from nextview.training.recipes import MapRecipe, RecogniserRecipe

if TYPE_CHECKING:
    from nextview.training.targets import Target


def train_recogniser(
    store: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    deformed: Path | None = None,
    folds: int = 0,
    recipe: tyro.conf.OmitArgPrefixes[RecogniserRecipe] = RecogniserRecipe(),
) -> None:
    """Train the recogniser on a store's training split. Resumes if OUT holds a run that was cut off.

    Args:
        store: view store made by nextview render.
        out: folder for checkpoints, logs and network.pt.
        deformed: a store of the same objects, stretched and turned (nextview render --stretch .25 --turn).
        folds: train so many recognisers instead, OUT/fold0 and so on, each without its share of the training objects,
            for evidence from networks that have not seen the object.
        recipe: how to train.
    """
    import numpy as np

    from nextview.cli.progress import track
    from nextview.data.split import split_training
    from nextview.data.store import ViewStore
    from nextview.training import recogniser
    from nextview.training.export import save_weights
    from nextview.training.folds import hold_out
    from nextview.training.inputs import load_inputs, prepare_inputs

    views = ViewStore.open(store)
    training, validation = split_training(views, recipe.validation, recipe.seed)
    sources = []
    for path in filter(None, (store, deformed)):
        other = ViewStore.open(path)
        track(prepare_inputs(path, recipe.size), int(other.done.sum()), f"inputs of {path.name}")
        row = {name: i for i, name in enumerate(other.names)}
        sources.append((load_inputs(path, recipe.size), np.array([row.get(name, -1) for name in views.names])))
        missing = [views.names[i] for i in training if sources[-1][1][i] < 0]
        if missing:
            raise ValueError(f"{path}: lacks {len(missing)} of the training objects, {missing[0]} among them")
    runs = {out: training[:0]}
    if folds:
        runs = {out / f"fold{k}": held for k, held in enumerate(hold_out(views, training, folds, recipe.seed))}
    for run, held in runs.items():
        run.mkdir(parents=True, exist_ok=True)
        (run / "recipe.json").write_text(json.dumps(asdict(recipe), indent=1) + "\n")
        (run / "held_out.json").write_text(json.dumps([views.names[i] for i in held]) + "\n")
        seen = np.setdiff1d(training, held)
        network = recogniser.train(sources, views.labels, seen, validation, recipe, run)
        save_weights(network, run)


def train_lem(
    store: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    recipe: tyro.conf.OmitArgPrefixes[MapRecipe] = MapRecipe(),
) -> None:
    """Train the LEM on a store's training split. Resumes if OUT holds a run that was cut off.

    Args:
        store: view store made by nextview render, with the 40 views.
        out: folder for checkpoints, logs and network.pt.
        recipe: how to train.
    """
    from nextview.data.store import ViewStore
    from nextview.training.targets import entropy_target

    _train_map(store, entropy_target(ViewStore.open(store)), out, recipe)


def train_lcm(
    store: tyro.conf.Positional[Path],
    predictions: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    recipe: tyro.conf.OmitArgPrefixes[MapRecipe] = MapRecipe(),
) -> None:
    """Train the LCM on what recognisers say of a store's training split. Resumes if OUT holds a run that was cut off.

    Args:
        store: view store made by nextview render, with the 40 views.
        predictions: of its training split, from recognisers that have not seen the objects (nextview train recogniser
            --folds, export each, nextview predict --split train --recogniser CARD CARD).
        out: folder for checkpoints, logs and network.pt.
        recipe: how to train.
    """
    from nextview.data.predictions import Predictions
    from nextview.data.store import ViewStore
    from nextview.training.targets import confidence_target

    _train_map(store, confidence_target(ViewStore.open(store), Predictions.load(predictions)), out, recipe)


def _train_map(store: Path, target: Target, out: Path, recipe: MapRecipe) -> None:
    from nextview.data.split import split_training
    from nextview.data.store import ViewStore
    from nextview.training import maps
    from nextview.training.export import save_weights

    views = ViewStore.open(store)
    training, validation = (target.known(part) for part in split_training(views, recipe.validation, recipe.seed))
    out.mkdir(parents=True, exist_ok=True)
    (out / "recipe.json").write_text(json.dumps(asdict(recipe), indent=1) + "\n")
    windows = target.values[:, views.sphere.windows]
    network = maps.train(views.all_points(), windows, views.sphere.poses, training, validation, recipe, out)
    save_weights(network, out)
