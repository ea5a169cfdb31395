"""``nextview export``: from a training run to an ONNX model with its card."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

if TYPE_CHECKING:
    from nextview.training.export import Exported


def export_recogniser(
    run: tyro.conf.Positional[Path],
    store: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    /,
    also: tuple[Path, ...] = (),
    bits: Literal[8, 16] = 16,
    name: str | None = None,
    note: str = "",
) -> None:
    """Export a trained recogniser: ONNX, with a card of its validation scores. Calibrate it with nextview fit.

    Args:
        run: folder made by nextview train recogniser; or the card of an exported recogniser (NAME.json).
        store: the store that it was trained on.
        out: folder for NAME.onnx and NAME.json.
        also: further runs or cards, of the same store and input; the logits of all are averaged.
        bits: that a weight takes in the file.
        name: what to call the model; by default recogniser-DATASET, after the mesh folder of the store.
        note: what else the card should say.
    """
    from nextview.cli.progress import track
    from nextview.training.export import export_recogniser as export

    _say(export((run, *also), store, out, bits, name, note, track))


def export_lem(
    run: tyro.conf.Positional[Path],
    store: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    /,
    bits: Literal[8, 16] = 16,
    name: str | None = None,
    note: str = "",
) -> None:
    """Export a trained LEM: ONNX, with a card of its validation scores.

    Args:
        run: folder made by nextview train lem.
        store: the store that it was trained on.
        out: folder for NAME.onnx and NAME.json.
        bits: that a weight takes in the file.
        name: what to call the model; by default lem-DATASET, after the mesh folder of the store.
        note: what else the card should say.
    """
    from nextview.cli.progress import track
    from nextview.training.export import export_map

    _say(export_map("lem", run, store, out, None, bits, name, note, track))


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
    """Export a trained LCM: ONNX, with a card of its validation scores.

    Args:
        run: folder made by nextview train lcm.
        store: the store that it was trained on.
        predictions: those that it was trained on.
        out: folder for NAME.onnx and NAME.json.
        bits: that a weight takes in the file.
        name: what to call the model; by default lcm-DATASET, after the mesh folder of the store.
        note: what else the card should say.
    """
    from nextview.cli.progress import track
    from nextview.training.export import export_map

    _say(export_map("lcm", run, store, out, predictions, bits, name, note, track))


def _say(made: Exported) -> None:
    from nextview.cli.progress import console

    console.print(f"{made.card}: largest difference between torch and ONNX on real views {made.difference:.2g}")
