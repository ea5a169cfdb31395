"""What it is worth to know how large the object is: a depth camera tells, a mesh of radius 1 does not.

    python benchmarks/size.py PREDICTIONS.npz [--figure SIZES.png] [--card CARD.json]

prints Markdown, and draws what the bundled recogniser, or that of the card, knows of sizes. The predictions come from a
store that knows the unit of its meshes (nextview render --unit) and a recogniser that was told what sizes mean (fit
size). Views are fused in a random order and all its rotations, the same with the size and without. In brackets: class
means, and 95 % bootstrap intervals over objects.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import matplotlib
import numpy as np
import tyro
from matplotlib.figure import Figure

from nextview.benchmark.paired import accuracy_after_views, in_points, rows
from nextview.data.predictions import Predictions
from nextview.models.inference import RECOGNISER, size_evidence
from nextview.models.model_card import find_card
from nextview.models.size_evidence import SizeEvidence
from nextview.report.style import INK, STYLE, new_figure, to_png


def lines(p: Predictions) -> Iterator[str]:
    """Two tables: accuracy without the size and with it, and the difference; by views, and of one view by class."""
    before, after = (accuracy_after_views(x, x.calibration) for x in (p.by_shape(), p))
    yield "| looks | by shape alone (class mean) | size known | difference, points |"
    yield "|---|---|---|---|"
    yield from rows(before, after, p.labels)
    yield "\n| class, one view | by shape alone | size known | difference, points |"
    yield "|---|---|---|---|"
    for c in np.unique(p.labels):
        alone, features = before[0, p.labels == c], after[0, p.labels == c]
        name = p.classes[c].replace("_", " ")
        yield f"| {name} | {alone.mean():.3f} | {features.mean():.3f} | {in_points(alone, features)} |"


def sizes_figure(evidence: SizeEvidence, classes: tuple[str, ...]) -> Figure:
    """The density of each class over the radius, one above the other, the smaller ones on top."""
    density = np.exp(evidence.log_density)
    order = np.argsort((density * np.log(evidence.radii)).sum(1) / density.sum(1))[::-1]
    with matplotlib.rc_context(STYLE):
        figure, axes = new_figure(6.4, 3.8)
        for row, c in enumerate(order):
            top = row + 1.6 * density[c] / density.max()
            axes.fill_between(evidence.radii, row, top, color=f"C{c}", alpha=0.75, linewidth=0, zorder=30 - row)
            axes.plot(evidence.radii, top, color=INK, linewidth=0.8, zorder=30 - row)
        axes.set_xscale("log")
        axes.set_xlim(0.08, 8)
        axes.set_xticks([0.1, 0.2, 0.5, 1, 2, 5], ["0.1", "0.2", "0.5", "1", "2", "5"])
        axes.minorticks_off()
        axes.set_yticks(range(len(order)), [classes[c].replace("_", " ") for c in order])
        axes.set_xlabel("object radius, metres")
    return figure


def main(path: Path, figure: Path | None = None, card: str = RECOGNISER) -> None:
    """Print the tables.

    Args:
        path: predictions of a store that knows the unit of its meshes.
        figure: where to draw what the recogniser knows of sizes.
        card: of which recogniser, for the figure.
    """
    if figure is not None:
        known = find_card(card)
        evidence = size_evidence(known)
        if evidence is None:
            raise ValueError(f"{card}: knows nothing of sizes; see nextview fit size")
        to_png(sizes_figure(evidence, tuple(known.facts["classes"])), figure)
    p = Predictions.load(path)
    if "test" not in p.splits:  # the test split counts as it is published, copies and all
        p = p.deduplicate()
    if p.of_size is None:
        raise ValueError(f"{path}: nothing is said of sizes; see nextview render --unit and nextview fit size")
    print(f"{len(p)} objects, split {p.splits[0]}:\n")
    print("\n".join(lines(p)))


if __name__ == "__main__":
    try:
        tyro.cli(main, config=(tyro.conf.PositionalRequiredArgs,))
    except ValueError as error:
        sys.exit(f"size.py: {error}")
