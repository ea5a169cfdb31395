"""``nextview train grid``: the published comparison of recognisers, in one command."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from nextview.cli.train import train_recogniser
from nextview.errors import ModelError
from nextview.outputs import written_whole
from nextview.training.hardware import Hardware
from nextview.training.recipes import THESIS_RECOGNISER, RecogniserRecipe

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from nextview.data.store import ViewStore


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
    test split is looked at once they all are done.

    Args:
        store: view store made by nextview render.
        out: folder for the runs, grid.csv and grid.png.
        depths: train only networks of these depths.
        batches: train only networks with these batch sizes.
        recipe: how to train; network, depth and batch are those of the table.
        hardware: on what.
    """
    from nextview.cli.progress import console
    from nextview.data.store import ViewStore
    from nextview.report.grid_figure import grid_figure
    from nextview.report.style import to_png
    from nextview.training.grid import published_cells
    from nextview.training.loop import is_first

    views = ViewStore.open(store)
    cells = {
        (depth, batch): published
        for (depth, batch), published in published_cells(tuple(views.classes), len(views.sphere)).items()
        if depth in (depths or (depth,)) and batch in (batches or (batch,))
    }
    if not cells:
        raise ModelError("table 6 holds no network of these depths and batch sizes")
    recipes = {}
    for depth, batch in cells:
        changes: dict[str, Any] = {"network": "resnet", "depth": depth, "batch": batch}
        recipes[out / f"resnet{depth}-batch{batch}"] = replace(recipe, **changes)
    for run, own in recipes.items():
        console.print(str(run), soft_wrap=True)
        train_recogniser(store, run, recipe=own, hardware=hardware)
    if not is_first():
        return
    rows: list[dict[str, Any]] = []
    for (run, own), published in zip(recipes.items(), cells.values(), strict=True):
        cell = {"depth": own.depth, "batch_size": own.batch} | _scores(run, store, views, own)
        rows += [cell | {"published": accuracy} for accuracy in (published or (None,))]
    with written_whole(out / "grid.csv") as part, part.open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    to_png(grid_figure(rows), out / "grid.png")


def _scores(run: Path, store: Path, views: ViewStore, recipe: RecogniserRecipe) -> dict[str, float]:
    """Accuracy from one view of the test split, over objects and over classes, kept in the run's folder."""
    import numpy as np

    from nextview.cli.progress import track
    from nextview.data.splits import test_objects
    from nextview.report.training_curves import read_log
    from nextview.training.grid import count_right
    from nextview.training.inputs import load_inputs
    from nextview.training.members import run_network

    kept = run / "scores.json"
    if kept.exists():
        return json.loads(kept.read_text())
    network = run_network(run, recipe, views)
    objects, labels = test_objects(views), views.labels
    right: list[int] = []

    def judged() -> Any:
        for count in count_right(network, load_inputs(store, recipe.size, recipe.input), objects, labels):
            right.append(count)
            yield len(right)

    track(judged(), len(objects), f"test of {run.name}")
    share = np.array(right) / len(views.sphere)
    scores = {
        "accuracy": round(float(share.mean()), 4),
        "class_accuracy": round(_over_classes(share, labels[objects]), 4),
        "validation_class_accuracy": round(max(read_log(run)["class_accuracy"]), 4),
    }
    with written_whole(kept) as part:
        part.write_text(json.dumps(scores) + "\n")
    return scores


def _over_classes(share: NDArray[np.floating], labels: NDArray[np.int64]) -> float:
    import numpy as np

    return float(np.mean([share[labels == label].mean() for label in np.unique(labels)]))
