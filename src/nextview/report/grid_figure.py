"""Recognisers of several depths and batch sizes beside the published ones (thesis, table 6)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure

from nextview.report.style import ACCENT, BLUE, legend, new_figure, percent_axis


def grid_figure(rows: Sequence[dict[str, Any]]) -> Figure:
    """Accuracy from one view of the test split, a line for each network.

    Args:
        rows: with "depth", "batch_size", "accuracy" and "published" (None where nothing was); a network may have
            several published accuracies, each in a row of its own.
    """
    networks = list(dict.fromkeys((row["depth"], row["batch_size"]) for row in rows))
    line = {network: y for y, network in enumerate(networks)}
    figure, axes = new_figure(4.6, 0.9 + 0.3 * len(networks))
    ours = {line[row["depth"], row["batch_size"]]: row["accuracy"] for row in rows}
    axes.plot(list(ours.values()), list(ours), "o", color=BLUE, markersize=6, label="ours")
    published = [(row["published"], line[row["depth"], row["batch_size"]]) for row in rows if row["published"]]
    if published:
        axes.plot(*zip(*published, strict=True), "D", color=ACCENT, markersize=5, label="published")
    axes.set_yticks(range(len(networks)), [f"ResNet-{depth}, batch {batch}" for depth, batch in networks])
    axes.set_ylim(len(networks) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    percent_axis(axes.xaxis)
    axes.set_xlabel("accuracy from one view, test split")
    axes.margins(x=0.12)
    legend(axes)
    return figure
