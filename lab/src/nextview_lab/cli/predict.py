"""``nextview-lab predict``: run the models over every view of a store and save the outputs."""

from pathlib import Path

import numpy as np

from nextview.cli.common_options import NamedSplit, Workers
from nextview.cli.progress import console, follow
from nextview.errors import ModelError, UsageError
from nextview.recognition.model_card import find_card, find_models
from nextview_lab.data import predicting
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.store import ViewStore


def predict(
    store: Path,
    out: Path,
    /,
    split: NamedSplit | None = None,
    models: str = "modelnet10",
    recogniser: str | None = None,
    held_out: str | None = None,
    maps: tuple[str, ...] | None = None,
    by_shape: bool = False,
    workers: Workers = Workers(),
    overwrite: bool = False,
) -> None:
    """Run the recogniser and the map networks over every view of a store, once.

    An interrupted run resumes.

    Args:
        store: view store made by nextview-lab render.
        out: file of predictions to write (.npz); nextview-lab benchmark classes replays policies on
            it.
        split: predict only this split.
        models: name of bundled models, or folder of your own models.
        recogniser: recogniser to use instead: name of a bundled model, or path of a card.
        held_out: predict only objects that this model (name or card) held out of its training.
        maps: maps to predict with these models, or NAME=CARD for other networks; by default all
            maps of the models that are of the viewpoints of the store; without a value none.
        by_shape: ignore the size of the objects. By default size counts as evidence if the store
            has it (nextview-lab render --unit) and the card of the recogniser has a size model
            (nextview-lab fit size).
        overwrite: replace existing predictions.
    """
    if out.suffix != ".npz":
        raise UsageError(f"{out}: predictions are one .npz file; end the name in .npz")

    found = find_models(models)
    cards = {}
    for item in found.maps if maps is None else maps:
        name, _, card = item.partition("=")
        if not card and name not in found.maps:
            raise ModelError(
                f"no network of {models} predicts the map {name!r}; there are"
                f" {', '.join(found.maps)}"
            )
        cards[name] = find_card(card or found.maps[name])
    if maps is None:
        views = ViewStore.open(store)
        every = list(cards)
        cards = predicting.fitting(cards, views)
        if left_out := ", ".join(name for name in every if name not in cards):
            console.print(
                f"the maps {left_out} of {models} are of other views than the {len(views.sphere)}"
                f" of {store}: they are not predicted",
                style="yellow",
                soft_wrap=True,
            )

    what = (
        find_card(recogniser or found.recogniser),
        cards,
        split,
        held_out,
        not by_shape,
    )
    follow(
        predicting.predict(store, out, *what, **vars(workers), overwrite=overwrite),
        f"predicting {store.name}",
    )

    for line in summed_up(Predictions.load(out)):
        console.print(line)
    console.print(
        f"predictions in {out}; compare policies with: nextview-lab benchmark classes {out}"
        " RESULTS",
        soft_wrap=True,
    )


def summed_up(p: Predictions) -> list[str]:
    """Describe the accuracy in each split, for single views and for all views together."""
    lines: list[str] = []
    answers = p.logits.argmax(2)
    of_all = p.logits.sum(1).argmax(1)
    if p.calibration.hypotheses:  # taught things: sum the belief over azimuths
        classes = len(p.classes)
        answers = p.calibration.log_belief(p.log_evidence, 1, classes).argmax(2)
        of_all = p.calibration.log_belief(
            p.log_evidence.sum(1),
            len(p.sphere),
            classes,
        ).argmax(1)
    right = answers == p.labels[:, None]
    fused = of_all == p.labels

    for split in np.unique(p.splits):
        here = p.splits == split
        shares = (
            f"right from one view {right[here].mean():.3f}, from all {len(p.sphere)}"
            f" {fused[here].mean():.3f}"
        )
        lines.append(f"{here.sum()} {split} objects: {shares}".replace("  ", " "))

    return lines
