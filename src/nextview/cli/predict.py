"""``nextview predict``: what the models say of every view of a store, into one file."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro

from nextview.errors import ModelError, UsageError


def predict(
    store: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    /,
    split: Literal["train", "test"] | None = None,
    models: str = "modelnet10",
    recogniser: tuple[str, ...] = (),
    held_out: bool = False,
    maps: tuple[str, ...] | None = None,
    by_shape: bool = False,
    batch: int = 8,
    workers: int | None = None,
    scheduler: str | None = None,
) -> None:
    """Run the recogniser and the map networks over every view of a store, once. Resumes where it was.

    Args:
        store: view store made by nextview render.
        out: predictions to make (.npz), from which nextview benchmark replays policies.
        split: only this split.
        models: bundled models by name, or a folder with models of your own.
        recogniser: instead, name of a bundled model or path of a card. Several with --held-out.
        held_out: let each object be judged by a recogniser from whose training it was held out (nextview train
            recogniser --folds makes such), and leave out those that all were trained on.
        maps: maps to predict with those models, or NAME=CARD for others; all that those models predict by default.
        by_shape: recognise by shape alone. By default the size of the objects counts too, where the store knows it
            (nextview render --unit) and the card of the recogniser says what sizes mean (nextview fit size).
        batch: views a call of the networks.
        workers: processes; one for each core by default.
        scheduler: address of a dask.distributed scheduler, to use its workers instead.
    """
    from nextview.cli.predictions_table import print_predictions
    from nextview.cli.progress import console, track
    from nextview.data import predicting as job
    from nextview.data.predictions import Predictions
    from nextview.data.store import ViewStore
    from nextview.models.collection import find_models
    from nextview.models.model_card import find_card

    if len(recogniser) > 1 and not held_out:
        raise UsageError("several recognisers can only share the work with --held-out")
    if out.suffix != ".npz":
        raise UsageError(f"{out}: predictions are one .npz file; end the name in .npz")
    found, cards = find_models(models), {}
    for item in found.maps if maps is None else maps:
        name, _, card = item.partition("=")
        if not card and name not in found.maps:
            raise ModelError(f"no network of {models} predicts the map {name!r}; there are {', '.join(found.maps)}")
        cards[name] = find_card(card or found.maps[name])
    judges = [find_card(r) for r in recogniser or (found.recogniser,)]
    steps = job.predict(store, out, judges, cards, split, held_out, not by_shape, batch, workers, scheduler)
    before, total = next(steps)
    track((done for done, _ in steps), total, f"predicting {store.name}", before, len(ViewStore.open(store).sphere))
    print_predictions(Predictions.load(out))
    console.print(f"predictions in {out}; compare policies with: nextview benchmark {out}", soft_wrap=True)
