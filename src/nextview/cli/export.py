"""``nextview export recogniser``: from a training run to an ONNX model with its card."""

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

    say_exported(export((run, *also), store, out, bits, name, note, track))


def say_exported(made: Exported) -> None:
    """Print what was made, and how exactly."""
    from nextview.cli.progress import console

    console.print(f"{made.card}: largest difference between torch and ONNX on real views {made.difference:.2g}")
