"""What the training commands show once their networks are trained."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path


def show_trained(folders: Iterable[Path]) -> None:
    """Name the runs among some folders that are done, and draw the log of each as its curves.png."""
    from nextview.cli.progress import console
    from nextview.report.style import to_png
    from nextview.report.training_curves import read_log, training_curves
    from nextview.training.loop import is_first
    from nextview.training.runs import is_done

    if not is_first():  # of the processes of a training on several devices, one draws
        return
    for run in sorted(filter(is_done, folders)):
        to_png(training_curves(read_log(run)), run / "curves.png")
        console.print(f"{run}: is trained", soft_wrap=True, highlight=False)
