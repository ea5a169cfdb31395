"""How a training went, epoch by epoch (thesis, figure 20)."""

from __future__ import annotations

import csv
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from nextview.arguments import takes_paths
from nextview.report.style import ACCENT, INK, LIGHT_BLUE, STYLE, PlainFigure

TRAINING, VALIDATION = LIGHT_BLUE, ACCENT
SELECTED = {"class_accuracy": max, "validation_mse": min}
"""By which score, and which way, the kept epoch was chosen: the first that a log has."""
WORDS = {"class_accuracy": "class mean accuracy", "mse": "mean squared error", "rate": "learning rate"}


@takes_paths("run")
def read_log(run: Path) -> dict[str, list[float]]:
    """The log of a training run, its columns by name, a value for every epoch."""
    with (run / "log/metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: [float(row[name]) for row in rows] for name in rows[0]}


def training_curves(log: dict[str, list[float]]) -> Figure:
    """A panel for every score, training and validation in one, and one for the learning rate; the kept epoch is marked.

    Args:
        log: columns by name, "epoch" among them; "validation_x" is drawn beside "x".
    """
    epochs = log["epoch"]
    panels = [name for name in log if name not in ("epoch", "step", "seconds") and not _is_twin(name, log)]
    selected = next((name for name in SELECTED if name in log), None)
    with matplotlib.rc_context(STYLE):
        figure = PlainFigure((4.6, 0.4 + 1.5 * len(panels)), layout="constrained")
        for axes, name in zip(figure.subplots(len(panels), sharex=True, squeeze=False)[:, 0], panels, strict=True):
            judged = f"validation_{name}"
            lines = {name: TRAINING} if judged in log else {name: INK if name == "rate" else VALIDATION}
            lines |= {judged: VALIDATION} if judged in log else {}
            for line, colour in lines.items():
                part = "validation" if colour == VALIDATION else "training"
                axes.plot(epochs, log[line], color=colour, marker="o", markersize=2.5, label=part)
            if selected in lines:
                best = SELECTED[selected](log[selected])
                at = epochs[log[selected].index(best)]
                axes.axvline(at, color=INK, linewidth=0.9, linestyle=":")
                text = f"kept: epoch {at:.0f}, {best:.4f}"
                right = at > (epochs[0] + epochs[-1]) / 2
                axes.annotate(text, (at, 0.5), (-4 if right else 4, 0), xycoords=("data", "axes fraction"),
                              textcoords="offset points", ha="right" if right else "left", fontsize=8)  # fmt: skip
            if name != "rate":
                axes.legend(fontsize=8)
            axes.set_ylabel(WORDS.get(name, name))
        axes.set_xlabel("epoch")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def _is_twin(name: str, log: dict[str, list[float]]) -> bool:
    """Whether a score is drawn beside that of the training."""
    return name.removeprefix("validation_") != name and name.removeprefix("validation_") in log
