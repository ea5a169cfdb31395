"""``nextview train lem`` and ``nextview train lcm``: the map networks, from a view store."""

from __future__ import annotations

from pathlib import Path

import tyro

from nextview.training.hardware import Hardware
from nextview.training.recipes import MapRecipe


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
            knows of shapes and azimuth bins is of use; or a map network's, to go on with it.
        recipe: how to train.
        hardware: on what.
    """
    from nextview.cli.progress import track
    from nextview.cli.training_log import show_trained
    from nextview.training.maps import map_training as stage

    show_trained([stage.train_lem(store, out, recipe, weights=weights, hardware=hardware, track=track)])


def train_lcm(
    store: tyro.conf.Positional[Path],
    predictions: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    weights: Path | None = None,
    recipe: tyro.conf.OmitArgPrefixes[MapRecipe] = MapRecipe(),
    hardware: tyro.conf.OmitArgPrefixes[Hardware] = Hardware(),
) -> None:
    """Train the LCM on a recogniser's predictions of a training split. Resumes if OUT holds a run that was cut off.

    Args:
        store: view store made by nextview render, with the 40 views.
        predictions: of its training split, by the recogniser whose confidence is to be predicted; or out-of-fold ones
            (nextview train recogniser --folds, export each, nextview predict --held-out --recogniser CARD CARD).
        out: as for nextview train lem.
        weights: as for nextview train lem.
        recipe: how to train.
        hardware: on what.
    """
    from nextview.cli.progress import track
    from nextview.cli.training_log import show_trained
    from nextview.training.maps import map_training as stage

    show_trained([stage.train_lcm(store, predictions, out, recipe, weights=weights, hardware=hardware, track=track)])
