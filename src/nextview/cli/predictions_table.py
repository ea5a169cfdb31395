"""What a recogniser and its maps are worth at first sight, as a table in the terminal."""

from __future__ import annotations

import numpy as np
from rich import box
from rich.table import Table

from nextview import metrics
from nextview.cli.terminal import Terminal
from nextview.data.predictions import Predictions

WORST = 3
"""Classes that are shown, the worst first."""


def print_predictions(p: Predictions) -> None:
    """Print, for each split, how often single views and all views fused are right, classes with the worst first."""
    table = Table(title=f"accuracy of {p.models['recogniser'][0]}", title_justify="left", box=box.SIMPLE_HEAD)
    table.add_column("", no_wrap=True)
    for column in ("objects", "one view", f"all {len(p.sphere)} views"):
        table.add_column(column, justify="right", no_wrap=True)
    right = p.logits.argmax(2) == p.labels[:, None]
    fused = p.logits.sum(1).argmax(1) == p.labels
    for split in np.unique(p.splits):
        here = p.splits == split
        table.add_row(*_row(f"{split or 'all'} objects", right[here], fused[here]), style="bold")
        labels = sorted(np.unique(p.labels[here]), key=lambda label: right[here & (p.labels == label)].mean())
        for label in labels[:WORST]:
            these = here & (p.labels == label)
            table.add_row(*_row(f"  {p.classes[label].replace('_', ' ')}", right[these], fused[these]))
        if len(labels) > WORST:
            mean = [f"{metrics.mean_over_classes(x[here], p.labels[here]):.3f}" for x in (right.mean(1), fused)]
            table.add_row(f"  mean of {len(labels)} classes", "", *mean)
    Terminal().print(table)


def _row(name: str, right: np.ndarray, fused: np.ndarray) -> tuple[str, str, str, str]:
    return name, str(len(fused)), f"{right.mean():.3f}", f"{fused.mean():.3f}"
