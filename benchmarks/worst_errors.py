"""Draw the views that are named wrong with the most confidence, those of each file of predictions in a block.

    python benchmarks/worst_errors.py worst_errors.png validation.npz sensed.npz [--titles clean "through sensors"]

One view of an object at most, as the recogniser saw it, with its class, what it was called and how sure that was.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
import tyro
from scipy.special import softmax

from nextview.cli.ending import orderly_end
from nextview.data.predictions import Predictions
from nextview.data.store import ViewStore
from nextview.errors import UsageError
from nextview.report.style import STYLE, PlainFigure, to_png

ACROSS = 5
"""Pictures in a row."""


def worst(p: Predictions, count: int) -> list[tuple[int, int, int, float]]:
    """Object, view, class that it is called, and belief in it, the surest error first."""
    belief = softmax(p.logits / p.calibration.temperature, axis=2)
    called, sure = belief.argmax(2), belief.max(2)
    sure[called == p.labels[:, None]] = 0
    view = sure.argmax(1)
    most = sure.max(1)
    order = np.argsort(-most, kind="stable")[:count]
    return [(i, int(view[i]), int(called[i, view[i]]), float(most[i])) for i in order if most[i] > 0]


def main(
    out: tyro.conf.Positional[Path],
    predictions: tyro.conf.Positional[tuple[Path, ...]],
    titles: tuple[str, ...] = (),
    count: int = 20,
) -> None:
    """Draw it.

    Args:
        out: the picture to make.
        predictions: files of them, whose stores are where they say.
        titles: of the blocks; the names of the files by default.
        count: views of each.
    """
    if titles and len(titles) != len(predictions):
        raise UsageError(f"{len(predictions)} files have as many titles, not {len(titles)}")
    rows = -(-count // ACROSS)
    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        figure = PlainFigure((1.5 * ACROSS, (1.75 * rows + 0.3) * len(predictions)), layout="constrained")
        for block, path, title in zip(
            np.atleast_1d(figure.subfigures(len(predictions))),
            predictions,
            titles or map(str, predictions),
            strict=True,
        ):
            p = Predictions.load(path)
            store = ViewStore.open(p.store)
            row = {name: i for i, name in enumerate(store.names)}
            block.suptitle(title)
            axes = block.subplots(rows, ACROSS).ravel()
            for place in axes:
                place.axis("off")
            for place, (i, view, called, sure) in zip(axes, worst(p, count), strict=False):
                place.imshow(store.read("image", row[p.names[i]])[view], cmap="gray", vmin=0, vmax=255)
                place.set_title(
                    f"{p.classes[p.labels[i]]}:\n{p.classes[called]} {sure:.2f}".replace("_", " "), fontsize=8
                )
    to_png(figure, out)


if __name__ == "__main__":
    with orderly_end("run it again"):
        tyro.cli(main)
