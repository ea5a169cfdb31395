"""Diagrams of answers: which classes are taken for which, and whether confidence is worth its name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from nextview.report.style import INK, new_figure


def confusion_matrix(counts: NDArray, classes: Sequence[str], title: str) -> Figure:
    """Percent of each true class, rows, that was taken for each class (thesis, figure 12).

    Args:
        counts: answers, (classes, classes).
        classes: their names.
        title: above it.
    """
    share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    n = len(classes)
    figure, axes = new_figure(4.6, 4.4)
    axes.imshow(share, cmap="Blues", vmin=0, vmax=1)
    for i, j in np.argwhere(share >= 0.01) if n <= 15 else ():
        colour = "white" if share[i, j] > 0.55 else INK
        axes.text(j, i, f"{100 * share[i, j]:.0f}", ha="center", va="center", fontsize=8, color=colour)
    names = [name.replace("_", " ") for name in classes]
    size = 8.5 if n <= 15 else 5
    axes.set_xticks(np.arange(n), names, rotation=50, ha="right", rotation_mode="anchor", fontsize=size)
    axes.set_yticks(np.arange(n), names, fontsize=size)
    axes.set(xlabel="answer", ylabel="true class")
    axes.set_title(title, fontsize=10, loc="left")
    axes.grid(visible=False)
    axes.tick_params(length=0)
    return figure


def reliability_figure(when: str) -> tuple[Figure, Axes]:
    """An empty reliability diagram: on its diagonal, 90 % sure is right nine times in ten.

    Args:
        when: when the confidence was said.
    """
    figure, axes = new_figure(4.6, 3.9)
    axes.plot([0, 1], [0, 1], color=INK, linewidth=0.9)
    axes.set(xlim=(0, 1.03), ylim=(0, 1.03), xlabel=f"confidence {when}", ylabel="share that was right")
    axes.set_aspect("equal")
    return figure, axes


def draw_reliability(axes: Axes, rows: pd.DataFrame, answers: pd.Series, label: str, color: str, **line: Any) -> None:
    """Share of right answers against confidence, with dots as large as they are many.

    Args:
        axes: of a ``reliability_figure``.
        rows: ``confidence`` and ``accuracy`` of each bin.
        answers: in each bin.
        label: in the legend.
        color: of line and dots.
        line: what else the line looks like.
    """
    axes.plot(rows["confidence"], rows["accuracy"], linewidth=1.1, color=color, label=label, **line)
    size = 8 + 220 * answers / answers.sum()
    axes.scatter(rows["confidence"], rows["accuracy"], s=size, color=color, alpha=0.55, linewidths=0, clip_on=False)
