"""How trainings went, epoch by epoch (thesis, figure 20): the log of each run is drawn as its
curves.png.

python -m nextview_lab.thesis.training_curves runs/lem [runs/other ...]
"""

from __future__ import annotations

import csv
from pathlib import Path

import matplotlib
import tyro
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from nextview.cli.exit_status import orderly_end
from nextview.errors import ResultsError
from nextview.files import new_file
from nextview.session.style import (
    ACCENT,
    FIGURE_STYLE,
    INK,
    LIGHT_BLUE,
    PlainFigure,
    to_png,
)

SELECTED = {"class_accuracy": max, "validation_mse": min}
"""By which score, and which way, the kept epoch was chosen: the first that a log has."""
VALIDATION = "validation_"


def read_log(run: Path) -> dict[str, list[float]]:
    """The log of a training run, its columns by name, a value for every epoch."""
    try:
        with (run / "log/metrics.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
    except FileNotFoundError:
        raise ResultsError(f"{run}: holds no log of a training") from None
    return {name: [float(row[name]) for row in rows] for name in rows[0]}


def training_curves(log: dict[str, list[float]]) -> Figure:
    """A panel for every score, training and validation in one; the kept epoch is marked.

    Args:
        log: columns by name, "epoch" among them; "validation_x" is drawn beside "x".
    """
    twins = {f"{VALIDATION}{name}" for name in log}
    panels = [name for name in log if name not in ("epoch", "step", "seconds", *twins)]
    selected = next((name for name in SELECTED if name in log), None)
    with matplotlib.rc_context(FIGURE_STYLE):
        figure = PlainFigure((4.6, 0.4 + 1.5 * len(panels)), layout="constrained")
        for axes, name in zip(
            figure.subplots(len(panels), sharex=True, squeeze=False)[:, 0],
            panels,
            strict=True,
        ):
            for line, colour in ((name, LIGHT_BLUE), (f"{VALIDATION}{name}", ACCENT)):
                if line in log:
                    part = (
                        "validation"
                        if line != name
                        else "training"
                        if f"{VALIDATION}{name}" in log
                        else None
                    )
                    axes.plot(
                        log["epoch"],
                        log[line],
                        color=colour,
                        marker="o",
                        markersize=2.5,
                        label=part,
                    )
                if selected == line:
                    best = SELECTED[line](log[line])
                    epoch = log["epoch"][log[line].index(best)]
                    axes.axvline(epoch, color=INK, linewidth=0.9, linestyle=":")
                    axes.set_title(f"kept: epoch {epoch:.0f}, {best:.4f}", fontsize=8)
            if f"{VALIDATION}{name}" in log:
                axes.legend(fontsize=8)
            axes.set_ylabel(name.replace("_", " "))
        axes.set_xlabel("epoch")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def draw_curves(runs: list[Path], /) -> None:
    """Draw the log of each run that was trained as its curves.png."""
    for run in runs:
        with new_file(run / "curves.png", overwrite=True) as part:
            to_png(training_curves(read_log(run)), part)


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(draw_curves)
