"""``nextview train grid``: the published comparison of recognisers, in one command."""

from __future__ import annotations

from pathlib import Path

import tyro

from nextview.training.hardware import Hardware
from nextview.training.recipes import THESIS_RECOGNISER, RecogniserRecipe


def train_grid(
    store: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    depths: tuple[int, ...] = (),
    batches: tuple[int, ...] = (),
    recipe: tyro.conf.OmitArgPrefixes[RecogniserRecipe] = THESIS_RECOGNISER,
    hardware: tyro.conf.OmitArgPrefixes[Hardware] = Hardware(),
) -> None:
    """Train the recognisers of the thesis's table 6 and set them beside the published ones. Resumes if it was cut off.

    Every network is trained in a folder of its own by the published recipe; its best epoch is chosen on validation. The
    test split is used once they all are trained.

    Args:
        store: view store made by nextview render.
        out: folder for the runs, grid.csv and grid.png; such files are replaced only if nextview wrote them.
        depths: train only networks of these depths.
        batches: train only networks with these batch sizes.
        recipe: how to train; network, depth and batch are those of the table.
        hardware: on what.
    """
    from nextview.cli.progress import track
    from nextview.cli.training_log import show_trained
    from nextview.outputs import added_file
    from nextview.report.grid_figure import grid_figure
    from nextview.report.style import to_png
    from nextview.training.loop import is_first
    from nextview.training.recogniser import grid_training as stage

    table = stage.train_grid(store, out, recipe, depths=depths, batches=batches, hardware=hardware, track=track)
    show_trained(out.glob("resnet*-batch*"))
    if is_first():
        with added_file(out, stage.FIGURE, stage.KIND) as part:
            to_png(grid_figure(stage.read_grid(table)), part)
