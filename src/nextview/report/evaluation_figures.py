"""The figures of an evaluation: how often the recogniser is right, and how well maps are predicted."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from nextview.benchmark.evaluate import TRUTHS, Evaluation, judged_objects
from nextview.data.predictions import Predictions
from nextview.report.diagrams import confusion_matrix, draw_reliability, reliability_figure
from nextview.report.style import INK, STYLE, legend, new_figure

ONE, ALL, PUBLISHED, FAINT_INK = "#38a0d9", "#0b5fa5", "#d1495b", "#8a949e"
BLUES = ("#7cc4ec", "#38a0d9", "#0b5fa5", "#1f2933")
MEASURES = {
    "mse": "mean squared error",
    "d0": "peak exact (d = 0)",
    "d_le_1": "peak within one cell (d ≤ 1)",
    "d_lt_2": "peak within a diagonal (d < 2)",
    "regret": "regret",
}
"""The scores of maps in words."""
EXAMPLES = 5
"""Examples of each class, from the best to the worst."""
ROWS = 12
"""Classes at most in a figure of examples."""
HEAD = 1.15
"""Height of what is above them, inches."""


def confusion(e: Evaluation, looks: int, classes: Sequence[str]) -> Figure:
    """Confusion matrix of that many looks."""
    table = e.confusion[e.confusion["looks"] == looks].pivot(index="label", columns="answer", values="answers")
    title = "one view" if looks == 1 else f"all {looks} views fused"
    return confusion_matrix(table.loc[list(classes), list(classes)].to_numpy(), classes, title)


def fusion_curve(e: Evaluation) -> Figure:
    """Accuracy against the number of random views fused, with 95 % intervals."""
    figure, axes = new_figure(4.6, 3.5)
    table = e.fusion
    axes.fill_between(table["looks"], table["low"], table["high"], color=ALL, alpha=0.15, linewidth=0)
    axes.plot(table["looks"], table["accuracy"], color=ALL, label="over objects, 95 % interval")
    axes.plot(table["looks"], table["class_accuracy"], color=INK, linestyle="--", linewidth=1.1, label="over classes")
    published = e.accuracy.query("looks == 1 and label == '' and measure == 'accuracy'")["published"].iloc[0]
    if np.isfinite(published):
        axes.plot(1, published, "D", color=PUBLISHED, markersize=5, clip_on=False, label="published, one view")
    last = int(table["looks"].iloc[-1])
    axes.set_xscale("log")
    ticks = [k for k in (1, 2, 3, 5, 10, 20, 40, 80) if k <= last]
    axes.set_xticks(ticks, [str(k) for k in ticks])
    axes.minorticks_off()
    axes.set_xlim(1 / last**0.02, last * last**0.02)
    axes.set_xlabel("random views fused")
    axes.set_ylabel("accuracy")
    axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    legend(axes)
    return figure


def class_accuracies(e: Evaluation) -> Figure:
    """Accuracy of each class, from one view and from all of them."""
    table = e.accuracy.query("measure == 'accuracy' and label != ''")
    series = {
        "one view" if looks == 1 else f"all {looks} views fused": (colour, rows.set_index("label"))
        for (looks, rows), colour in zip(table.groupby("looks"), (ONE, ALL), strict=False)
    }
    figure, axes = _class_figure(series, list(dict.fromkeys(table["label"])))
    axes.set_xlabel("accuracy")
    axes.xaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    legend(axes)
    return figure


def reliability(e: Evaluation) -> Figure:
    """Reliability after one look and more, in random order; bins of fewer than 20 answers are left out."""
    figure, axes = reliability_figure("in the answer")
    errors = e.fusion.set_index("looks")["calibration_error"]
    for looks, colour in zip(e.reliability["looks"].unique().tolist(), BLUES, strict=False):
        rows = e.reliability.query("looks == @looks and answers >= 20")
        name = f"{looks} view{'s' * (looks > 1)}"
        draw_reliability(axes, rows, rows["answers"], f"{name}  {errors[looks]:.3f}", colour)
    legend(axes, "calibration error")
    return figure


def map_classes(e: Evaluation, name: str, measure: str) -> Figure:
    """A score of the predicted maps of each class, beside what was published and the mean map of the class."""
    table = e.maps[(e.maps["map"] == name) & (e.maps["measure"] == measure) & (e.maps["label"] != "")]
    rows = table[table["by"] == "network"].set_index("label")
    series = {"network": (ALL, rows)}
    figure, axes = _class_figure(series, list(rows.index))
    y = np.arange(len(rows))
    yardstick = table[table["by"] == "mean map of the class"].set_index("label").loc[rows.index, "value"]
    axes.plot(yardstick, y, "|", color=FAINT_INK, markersize=11, markeredgewidth=1.8, label="mean map of the class")
    if rows["published"].notna().any():
        axes.plot(rows["published"], y, "D", color=PUBLISHED, markersize=4.5, label="published")
    axes.set_xlabel(MEASURES[measure])
    if measure.startswith("d"):
        axes.xaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    legend(axes)
    return figure


def _class_figure(series: dict[str, tuple[str, pd.DataFrame]], classes: list[str]) -> tuple[Figure, Axes]:
    """Values with their intervals, a row for each class, the first on top."""
    figure, axes = new_figure(4.6, max(1.8, 0.8 + 0.27 * len(classes)))
    for k, (name, (colour, rows)) in enumerate(series.items()):
        rows = rows.loc[classes]
        y = np.arange(len(classes)) + 0.26 * (k - (len(series) - 1) / 2)
        axes.hlines(y, rows["low"], rows["high"], color=colour, linewidth=1.5)
        axes.plot(rows["value"], y, "o", color=colour, markersize=5, label=name)
    axes.set_yticks(np.arange(len(classes)), [name.replace("_", " ") for name in classes])
    axes.set_ylim(len(classes) - 0.5, -0.5)
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="y", length=0)
    return figure, axes


def example_maps(p: Predictions, name: str, rng: np.random.Generator) -> Figure:
    """Predicted maps beside the true ones (thesis, figures 25 to 28), a row for each class, from the best to the worst.

    One random view of every object is drawn; those shown stand at equal steps of its squared error. Where there are
    many classes, those shown stand at equal steps of the class's mean error.

    Args:
        p: the predictions.
        name: of the map.
        rng: draws the views.
    """
    kept = judged_objects(p, name)
    view = rng.integers(len(p.sphere), size=len(kept))
    true, predicted = TRUTHS[name](p)[kept, view], p.maps[name][kept, view]
    error = ((true.astype(np.float64) - predicted) ** 2).mean((1, 2))
    labels = p.labels[kept]
    classes = np.unique(labels)
    if len(classes) > ROWS:
        order = np.argsort([error[labels == index].mean() for index in classes], kind="stable")
        classes = classes[order[_steps(len(classes), ROWS)]]
    window = p.sphere.rings / 3
    height = min(1.25, max(0.55, 0.62 * window)) + 0.36
    with matplotlib.rc_context(STYLE | {"axes.grid": False, "axes.spines.top": True, "axes.spines.right": True}):
        figure = Figure((9.6, height * len(classes) + HEAD))
        grid = figure.add_gridspec(
            len(classes), EXAMPLES * 3, width_ratios=[1, 1, 0.55] * EXAMPLES, wspace=0.12,
            hspace=0.36 / (height - 0.36), left=0.1, right=1.0, bottom=0.02,
            top=1 - 0.9 / (height * len(classes) + HEAD),
        )  # fmt: skip
        for row, index in enumerate(classes):
            here = np.flatnonzero(labels == index)
            here = here[np.argsort(error[here], kind="stable")]
            for column, at in enumerate(here[_steps(len(here), EXAMPLES)]):
                pair = [figure.add_subplot(grid[row, 3 * column + k]) for k in range(2)]
                for axes, values in zip(pair, (true[at], predicted[at]), strict=True):
                    axes.imshow(values, cmap="viridis", vmin=0, vmax=1, origin="lower", aspect="auto")
                    axes.set(xticks=[], yticks=[])
                    _mark(axes, true[at], "o", "white", 6.5)
                    _mark(axes, predicted[at], "x", PUBLISHED, 5)
                thing = p.names[kept[at]].removeprefix(p.classes[index]).strip("_") or p.names[kept[at]]
                pair[0].set_title(f"{thing[-12:]} view {view[at]}", fontsize=7.5, loc="left", pad=3)
                pair[1].set_title(f"{error[at]:.3f}", fontsize=7.5, loc="right", pad=3, color=ALL)
                if column == 0:
                    pair[0].set_ylabel(p.classes[index].replace("_", " "), rotation=0, ha="right", va="center")
        _explain(figure, height * len(classes) + HEAD)
    return figure


def _explain(figure: Figure, height: float) -> None:
    marks = [
        Line2D([], [], marker="o", color="none", markeredgecolor="#8a949e", markerfacecolor="white", label="true peak"),
        Line2D(
            [], [], marker="x", color="none", markeredgecolor=PUBLISHED, markeredgewidth=1.6, label="predicted peak"
        ),
    ]
    top = 1 - 0.12 / height
    figure.legend(handles=marks, loc="upper right", ncols=2, bbox_to_anchor=(0.97, top + 0.08 / height), fontsize=8.5)
    words = (
        "In each pair the true map left, the predicted one right; in blue the squared error.\n"
        "From the best (left) to the worst (right) of each class.\n"
        "Rows of a map are rings, the lowest below; dark is 0, yellow 1."
    )
    figure.text(0.1, top, words, fontsize=8.5, va="top")


def _steps(n: int, most: int) -> NDArray[np.int64]:
    """At most so many of n ranks, at equal steps from the first to the last."""
    return np.unique(np.rint(np.linspace(0, n - 1, min(n, most))).astype(np.int64))


def _mark(axes: Axes, values: NDArray[np.floating], marker: str, colour: str, size: float) -> None:
    ring, column = np.unravel_index(values.argmax(), values.shape)
    edge, width = (INK, 0.8) if marker == "o" else (colour, 1.8)
    axes.plot(column, ring, marker, color=colour, markersize=size, markeredgecolor=edge, markeredgewidth=width)
