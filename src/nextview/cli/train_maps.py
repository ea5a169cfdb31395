"""``nextview train map``, and ``train lem`` and ``train lcm``, which are short for two measures' maps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import tyro

from nextview.errors import UsageError
from nextview.training.hardware import Hardware
from nextview.training.recipes import MapRecipe


def train_map(
    store: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    predictions: Path | None = None,
    weights: Path | None = None,
    recipe: tyro.conf.OmitArgPrefixes[MapRecipe] = MapRecipe(),
    hardware: tyro.conf.OmitArgPrefixes[Hardware] = Hardware(),
) -> None:
    """Train a network that predicts a measure of the views around one. Resumes if OUT holds a run that was cut off.

    Args:
        store: view store made by nextview render, with the 40 views and the measure (nextview measure).
        out: folder for checkpoints, logs, curves.png and network.pt, that of the epoch with the lowest squared error.
        predictions: for --measure confidence, of the store's training split, by the recogniser whose confidence is to
            be predicted; or out-of-fold ones (nextview train recogniser --folds, export each, nextview predict
            --held-out --recogniser CARD CARD).
        weights: card (NAME.json) of the same depth and input from which a ResNet starts: a recogniser's, as what it
            knows of shapes and azimuth bins is of use; or a map network's, to go on with it.
        recipe: how to train.
        hardware: on what.
    """
    from nextview.cli.progress import track
    from nextview.cli.training_log import show_trained
    from nextview.training.maps import map_training as stage

    made = stage.train_map(store, out, recipe, predictions=predictions, weights=weights, hardware=hardware, track=track)
    show_trained([made])


def train_lem(
    store: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    weights: Path | None = None,
    recipe: tyro.conf.OmitArgPrefixes[MapRecipe] = MapRecipe(),
    hardware: tyro.conf.OmitArgPrefixes[Hardware] = Hardware(),
) -> None:
    """Train the LEM: nextview train map STORE OUT --measure depth_entropy.

    Args:
        store: as for nextview train map; so are the others.
        out: folder of the run.
        weights: to start from.
        recipe: how to train.
        hardware: on what.
    """
    train_map(store, out, None, weights, _of("depth_entropy", recipe), hardware)


def train_lcm(
    store: tyro.conf.Positional[Path],
    predictions: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    weights: Path | None = None,
    recipe: tyro.conf.OmitArgPrefixes[MapRecipe] = MapRecipe(),
    hardware: tyro.conf.OmitArgPrefixes[Hardware] = Hardware(),
) -> None:
    """Train the LCM: nextview train map STORE OUT --measure confidence --predictions PREDICTIONS.

    Args:
        store: as for nextview train map; so are the others.
        predictions: of its training split.
        out: folder of the run.
        weights: to start from.
        recipe: how to train.
        hardware: on what.
    """
    train_map(store, out, predictions, weights, _of("confidence", recipe), hardware)


def _of(measure: str, recipe: MapRecipe) -> MapRecipe:
    if recipe.measure not in (MapRecipe.measure, measure):
        raise UsageError(f"this trains the map of {measure}; nextview train map takes --measure {recipe.measure}")
    return replace(recipe, measure=measure)
