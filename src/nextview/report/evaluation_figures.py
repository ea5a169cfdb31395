"""The figures of an evaluation: how often the recogniser is right, and how well maps are predicted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from nextview.benchmark.evaluation import Evaluation, judged_objects
from nextview.benchmark.true_maps import true_map
from nextview.data.predictions import Predictions
from nextview.report.diagrams import confusion_matrix, draw_reliability, reliability_figure
from nextview.report.style import (
    ACCENT,
    BLUE,
    GREY,
    INK,
    LIGHT_BLUE,
    STYLE,
    PlainFigure,
    legend,
    new_figure,
    percent_axis,
)

ONE, ALL, PUBLISHED = LIGHT_BLUE, BLUE, ACCENT
BLUES = ("#7cc4ec", LIGHT_BLUE, BLUE, INK)
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
LEFT, HEAD, PITCH, WIDE, BETWEEN = 1.0, 1.0, 1.72, 0.62, 0.36
"""Inches left of the examples and above them, from one to the next, of a map, and between rows."""
TRUE_PEAK: dict[str, Any] = {
    "marker": "o", "linestyle": "", "color": "white", "markeredgecolor": INK, "markeredgewidth": 0.8, "markersize": 6.5,
}  # fmt: skip
PREDICTED_PEAK: dict[str, Any] = {
    "marker": "x", "linestyle": "", "color": PUBLISHED, "markeredgewidth": 1.8, "markersize": 5,
}  # fmt: skip


def confusion(e: Evaluation, n_views: int, classes: Sequence[str]) -> Figure:
    """Confusion matrix of that many views."""
    table = e.confusion[e.confusion["n_views"] == n_views].pivot(index="label", columns="answer", values="answers")
    title = "one view" if n_views == 1 else f"all {n_views} views fused"
    return confusion_matrix(table.loc[list(classes), list(classes)].to_numpy(), classes, title)


def fusion_curve(e: Evaluation) -> Figure:
    """Accuracy against the number of random views fused, with 95 % intervals."""
    figure, axes = new_figure(4.6, 3.5)
    table = e.fusion
    axes.fill_between(table["n_views"], table["low"], table["high"], color=ALL, alpha=0.15, linewidth=0)
    axes.plot(table["n_views"], table["accuracy"], color=ALL, label="over objects, 95 % interval")
    axes.plot(table["n_views"], table["class_accuracy"], color=INK, linestyle="--", linewidth=1.1, label="over classes")
    published = e.accuracy.query("n_views == 1 and label == '' and measure == 'accuracy'")["published"].iloc[0]
    if np.isfinite(published):
        axes.plot(1, published, "D", color=PUBLISHED, markersize=5, clip_on=False, label="published, one view")
    axes.set_ylabel("accuracy")
    _views_axis(axes, len(table))
    legend(axes)
    return figure


def confidence_curve(e: Evaluation) -> Figure:
    """Mean confidence and accuracy against the number of random views fused: the gap is misplaced trust."""
    figure, axes = new_figure(4.6, 3.9)
    table = e.fusion
    axes.fill_between(
        table["n_views"], table["accuracy"], table["confidence"], color=PUBLISHED, alpha=0.12, linewidth=0
    )
    axes.plot(table["n_views"], table["confidence"], color=PUBLISHED, label="mean confidence")
    axes.plot(table["n_views"], table["accuracy"], color=ALL, label="accuracy")
    _views_axis(axes, len(table))
    legend(axes)
    return figure


def _views_axis(axes: Axes, most: int) -> None:
    """Shares against numbers of views, from 1 to ``most``."""
    axes.set_xscale("log")
    ticks = [k for k in (1, 2, 3, 5, 10, 20, 40, 80) if k <= most]
    axes.set_xticks(ticks, [str(k) for k in ticks])
    axes.minorticks_off()
    axes.set_xlim(1 / most**0.02, most * most**0.02)
    axes.set_xlabel("random views fused")
    percent_axis(axes.yaxis)


def class_accuracies(e: Evaluation) -> Figure:
    """Accuracy of each class, from one view and from all of them."""
    table = e.accuracy.query("measure == 'accuracy' and label != ''")
    series = {
        "one view" if n_views == 1 else f"all {n_views} views fused": (colour, rows.set_index("label"))
        for (n_views, rows), colour in zip(table.groupby("n_views"), (ONE, ALL), strict=False)
    }
    figure, axes = _class_figure(series, list(dict.fromkeys(table["label"])))
    axes.set_xlabel("accuracy")
    percent_axis(axes.xaxis)
    legend(axes)
    return figure


def reliability(e: Evaluation) -> Figure:
    """Reliability after one view and more, in random order; bins of fewer than 20 answers are left out."""
    figure, axes = reliability_figure("in the answer")
    errors = e.fusion.set_index("n_views")["calibration_error"]
    for n_views, colour in zip(e.reliability["n_views"].unique().tolist(), BLUES, strict=False):
        rows = e.reliability.query("n_views == @n_views and answers >= 20")
        name = f"{n_views} view{'s' * (n_views > 1)}"
        draw_reliability(axes, rows, rows["answers"], f"{name}  {errors[n_views]:.3f}", colour)
    legend(axes, "calibration error")
    return figure


def map_classes(e: Evaluation, name: str, measure: str) -> Figure:
    """A score of the predicted maps of each class, beside what was published and the mean map of the class."""
    table = e.maps[(e.maps["map"] == name) & (e.maps["measure"] == measure) & (e.maps["label"] != "")]
    rows = table[table["by"] == "network"].set_index("label")
    series = {"network": (ALL, rows)}
    figure, axes = _class_figure(series, list(rows.index))
    y = np.arange(len(rows))
    baseline = table[table["by"] == "mean map of the class"].set_index("label").loc[rows.index, "value"]
    axes.plot(baseline, y, "|", color=GREY, markersize=11, markeredgewidth=1.8, label="mean map of the class")
    if rows["published"].notna().any():
        axes.plot(rows["published"], y, "D", color=PUBLISHED, markersize=4.5, label="published")
    axes.set_xlabel(MEASURES[measure])
    if measure.startswith("d"):
        percent_axis(axes.xaxis)
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
    true, predicted = true_map(p, name)[kept, view], p.maps[name][kept, view]
    error = ((true.astype(np.float64) - predicted) ** 2).mean((1, 2))
    labels = p.labels[kept]
    classes = np.unique(labels)
    if len(classes) > ROWS:
        order = np.argsort([error[labels == index].mean() for index in classes], kind="stable")
        classes = classes[order[_steps(len(classes), ROWS)]]
    tall = min(1.25, max(0.45, 0.2 * p.sphere.rings))  # of a map, inches, as all lengths here
    width, height = LEFT + EXAMPLES * PITCH, HEAD + len(classes) * (tall + BETWEEN)
    with matplotlib.rc_context(STYLE):
        figure = PlainFigure((width, height))
        axes = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(0, height))
        axes.axis("off")
        for row, index in enumerate(classes):
            below = height - HEAD - row * (tall + BETWEEN) - tall
            axes.text(LEFT - 0.08, below + tall / 2, p.classes[index].replace("_", " "), ha="right", va="center")
            here = np.flatnonzero(labels == index)
            here = here[np.argsort(error[here], kind="stable")]
            for column, at in enumerate(here[_steps(len(here), EXAMPLES)]):
                left = LEFT + column * PITCH
                for x, values in ((left, true[at]), (left + WIDE + 0.07, predicted[at])):
                    _draw_map(axes, values, (x, below, tall), true[at], predicted[at])
                thing = p.names[kept[at]].removeprefix(p.classes[index]).strip("_") or p.names[kept[at]]
                text: dict[str, Any] = {"y": below + tall + 0.05, "fontsize": 7.5}
                axes.text(left, s=f"{thing[-12:]} view {view[at]}", **text)
                axes.text(left + 2 * WIDE + 0.07, s=f"{error[at]:.3f}", ha="right", color=ALL, **text)
        _explain(axes)
    return figure


def _draw_map(
    axes: Axes,
    values: NDArray[np.floating],
    place: tuple[float, float, float],
    true: NDArray[np.floating],
    predicted: NDArray[np.floating],
) -> None:
    """One map at (left, below, height), with the peaks of the true and the predicted one."""
    left, below, tall = place
    extent = (left, left + WIDE, below, below + tall)
    axes.imshow(values, cmap="viridis", vmin=0, vmax=1, origin="lower", extent=extent, aspect="auto")
    for peak_of, style in ((true, TRUE_PEAK), (predicted, PREDICTED_PEAK)):
        ring, column = divmod(int(peak_of.argmax()), peak_of.shape[1])
        x, y = (column + 0.5) / peak_of.shape[1], (ring + 0.5) / peak_of.shape[0]
        axes.plot(left + x * WIDE, below + y * tall, **style)


def _explain(axes: Axes) -> None:
    width, height = axes.get_xlim()[1], axes.get_ylim()[1]
    axes.set(xlim=(0, width), ylim=(0, height))  # pictures and marks leave them alone
    marks = [Line2D([], [], label="true peak", **TRUE_PEAK), Line2D([], [], label="predicted peak", **PREDICTED_PEAK)]
    axes.legend(handles=marks, loc="upper right", ncols=2, bbox_to_anchor=(0.97, 1 - 0.05 / height))
    words = (
        "In each pair the true map left, the predicted one right; in blue the squared error.\n"
        "From the best (left) to the worst (right) of each class.\n"
        "Rows of a map are rings, the lowest below; dark is 0, yellow 1."
    )
    axes.text(LEFT, height - 0.12, words, fontsize=8.5, va="top")


def _steps(n: int, most: int) -> NDArray[np.int64]:
    """At most so many of n ranks, at equal steps from the first to the last."""
    return np.unique(np.rint(np.linspace(0, n - 1, min(n, most))).astype(np.int64))
