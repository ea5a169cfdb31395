"""True maps beside predicted ones, of five objects of each class from the best to the worst
(thesis, figures 24 to 28).

python -m nextview_lab.thesis.example_maps test.npz lem lem.png [--split test]
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from nextview_lab.extras import require

if __name__ == "__main__":
    require("benchmark")

import matplotlib
import numpy as np
import tyro
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import console
from nextview.errors import ResultsError
from nextview.files import check_new, new_file
from nextview.session import style
from nextview.session.style import ACCENT, INK
from nextview_lab.benchmark.classes import chosen_split
from nextview_lab.benchmark.evaluation import judged_objects
from nextview_lab.benchmark.page import words
from nextview_lab.benchmark.true_maps import known_maps, true_map
from nextview_lab.data.predictions import Predictions

EXAMPLES = 5
ROWS = 12
"""Examples of maps of each class, and classes at most."""
TRUE_PEAK: dict[str, Any] = {
    "marker": "o",
    "color": "white",
    "markeredgecolor": INK,
    "markersize": 6.5,
}
PREDICTED_PEAK: dict[str, Any] = {
    "marker": "x",
    "color": ACCENT,
    "markeredgewidth": 1.8,
    "markersize": 5,
}


def example_maps(p: Predictions, name: str, rng: np.random.Generator) -> Figure:
    """True maps (left) beside predicted ones (thesis, figures 25 to 28), a row a class, from the
    best to the worst.

    One random view of every object is drawn; those shown stand at equal steps of its squared error.
    Of many classes, those shown stand at equal steps of the class's mean error.
    """
    kept = judged_objects(p, name)
    view = rng.integers(len(p.sphere), size=len(kept))
    labels = p.labels[kept]
    true = true_map(p, name)[kept, view]
    predicted = p.maps[name][kept, view]
    error = ((true.astype(np.float64) - predicted) ** 2).mean((1, 2))
    classes = np.unique(labels)
    order = np.argsort(
        [error[labels == index].mean() for index in classes],
        kind="stable",
    )
    classes = classes[np.sort(order[_steps(len(classes), ROWS)])]
    gap = np.full((true.shape[1], 1), np.nan)
    with matplotlib.rc_context(style.FIGURE_STYLE):
        figure = style.PlainFigure((9.6, 0.6 + 1.3 * len(classes)))
        grid = figure.subplots(
            len(classes),
            EXAMPLES,
            squeeze=False,
            gridspec_kw={"hspace": 0.35, "wspace": 0.12},
        )
    for axes in grid.flat:
        axes.set_axis_off()
    for row, index in zip(grid, classes, strict=True):
        row[0].text(
            -0.1,
            0.5,
            words(p.classes[index]),
            ha="right",
            va="center",
            transform=row[0].transAxes,
        )
        here = np.flatnonzero(labels == index)
        here = here[np.argsort(error[here], kind="stable")]
        for axes, at in zip(row, here[_steps(len(here), EXAMPLES)], strict=False):
            pair = np.hstack([true[at], gap, predicted[at]])
            axes.imshow(
                pair,
                cmap="viridis",
                vmin=0,
                vmax=1,
                origin="lower",
                aspect="auto",
            )
            for values, look in (
                (true[at], TRUE_PEAK),
                (predicted[at], PREDICTED_PEAK),
            ):
                ring, column = np.unravel_index(values.argmax(), values.shape)
                axes.plot(
                    [column, column + values.shape[1] + 1],
                    [ring, ring],
                    linestyle="",
                    **look,
                )
            thing = (
                p.names[kept[at]].removeprefix(p.classes[index]).strip("_")
                or p.names[kept[at]]
            )
            axes.set_title(
                f"{thing[-12:]} view {view[at]}: {error[at]:.3f}",
                fontsize=7.5,
            )
    marks = [
        Line2D([], [], linestyle="", **look) for look in (TRUE_PEAK, PREDICTED_PEAK)
    ]
    figure.legend(
        marks,
        ["true peak", "predicted peak"],
        loc="upper right",
        ncols=2,
        bbox_to_anchor=(0.9, 1),
    )
    return figure


def _steps(n: int, most: int) -> NDArray[np.int64]:
    return np.unique(np.rint(np.linspace(0, n - 1, min(n, most))).astype(np.int64))


def draw(
    predictions: Path,
    name: str,
    out: Path,
    /,
    split: Literal["train", "test", "val"] | None = None,
    seed: int = 0,
    overwrite: bool = False,
) -> None:
    """Draw examples of a map: one random view of each object, the true map left, the predicted one
    right.

    Args:
        predictions: made by nextview-lab predict.
        name: of the map, as lem.
        out: the PNG file.
        split: take only the objects of this one; needed where the predictions hold several.
        seed: decides the views.
        overwrite: replace the picture if it exists.
    """
    check_new(out, overwrite)
    p = chosen_split(Predictions.load(predictions), predictions, split)
    if (
        name not in p.maps
        or name not in known_maps(p)
        or len(judged_objects(p, name)) == 0
    ):
        raise ResultsError(f"{predictions}: holds no map {name!r} whose truth is known")
    with new_file(out, overwrite) as part:
        style.to_png(example_maps(p, name, np.random.default_rng([seed, 1])), part)
    console.print(f"{out}")


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(draw)
