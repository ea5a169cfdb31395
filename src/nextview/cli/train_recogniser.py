"""``nextview train recogniser``: the recogniser, from a view store."""

from __future__ import annotations

from pathlib import Path

import tyro

from nextview.training.hardware import Hardware
from nextview.training.recipes import RecogniserRecipe


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
        deformed: stores of the same objects or some of them, stretched and turned (nextview render --stretch .25 --turn
            --seed 1 and so on) or through sensors (--sensor mix); their views may be others.
        weights: start from a published checkpoint, torchvision's of the same depth or EfficientNet-Lite0's, or go on
            from an exported recogniser (its card, NAME.json) on other data or for longer.
        folds: train so many recognisers instead, OUT/fold0 and so on, each without its share of the training objects,
            for out-of-fold predictions.
        fold: train only this one of them, 0 the first.
        recipe: how to train.
        hardware: on what.
    """
    from nextview.cli.progress import track
    from nextview.cli.training_log import show_trained
    from nextview.training.recogniser import recogniser_training as stage

    stage.train_recogniser(
        store, out, recipe, deformed=deformed, weights=weights, folds=folds, fold=fold, hardware=hardware, track=track
    )
    show_trained([out, *out.glob("fold*")])
