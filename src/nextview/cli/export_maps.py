"""``nextview export map``, and ``export lem`` and ``export lcm``, which are short for two measures' maps."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro

from nextview.cli.export import say_exported


def export_map(
    run: tyro.conf.Positional[Path],
    store: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    /,
    predictions: Path | None = None,
    bits: Literal[8, 16] = 16,
    name: str | None = None,
    note: str = "",
) -> None:
    """Export a trained map network: ONNX, with a card of its validation scores.

    Args:
        run: folder made by nextview train map.
        store: the store that it was trained on.
        out: folder for NAME.onnx and NAME.json.
        predictions: those that a map of the confidence was trained on.
        bits: that a weight takes in the file.
        name: what to call the model; by default MEASURE-DATASET, after the mesh folder of the store.
        note: what else the card should say.
    """
    _export(run, store, out, predictions, None, bits, name, note)


def export_lem(
    run: tyro.conf.Positional[Path],
    store: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    /,
    bits: Literal[8, 16] = 16,
    name: str | None = None,
    note: str = "",
) -> None:
    """Export a trained LEM: nextview export map of a run of nextview train lem.

    Args:
        run: as for nextview export map; so are the others.
        store: that it was trained on.
        out: folder of the model.
        bits: of a weight.
        name: of the model; lem-DATASET by default.
        note: for the card.
    """
    _export(run, store, out, None, "depth_entropy", bits, name, note)


def export_lcm(
    run: tyro.conf.Positional[Path],
    store: tyro.conf.Positional[Path],
    predictions: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    /,
    bits: Literal[8, 16] = 16,
    name: str | None = None,
    note: str = "",
) -> None:
    """Export a trained LCM: nextview export map --predictions PREDICTIONS of a run of nextview train lcm.

    Args:
        run: as for nextview export map; so are the others.
        store: that it was trained on.
        predictions: that it was trained on.
        out: folder of the model.
        bits: of a weight.
        name: of the model; lcm-DATASET by default.
        note: for the card.
    """
    _export(run, store, out, predictions, "confidence", bits, name, note)


def _export(
    run: Path,
    store: Path,
    out: Path,
    predictions: Path | None,
    measure: str | None,
    bits: Literal[8, 16],
    name: str | None,
    note: str,
) -> None:
    from nextview.cli.progress import track
    from nextview.training.export import export_map

    say_exported(export_map(run, store, out, predictions, measure, bits, name, note, track))
