"""The published comparison of recognisers (thesis, table 6): train them all, and judge them on the
test split.

python -m nextview_lab.thesis.train_grid views.zarr runs/table6 [--depths 18] [--batches 4]
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from nextview_lab.extras import extras, require

if __name__ == "__main__":
    require("train")
    require("benchmark")

import numpy as np
import tyro
from matplotlib.figure import Figure

from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import track
from nextview.errors import UsageError
from nextview.files import new_file
from nextview.session.style import (
    ACCENT,
    BLUE,
    legend,
    new_figure,
    percent_axis,
    to_png,
)
from nextview_lab.benchmark.published import published_recognisers, read_rows
from nextview_lab.data.store import ViewStore
from nextview_lab.thesis.training_curves import draw_curves
from nextview_lab.training.export import run_network
from nextview_lab.training.inputs import load_inputs
from nextview_lab.training.recipes import THESIS_RECOGNISER, Hardware, RecogniserRecipe
from nextview_lab.training.recogniser_training import train_recogniser
from nextview_lab.training.runs import is_first

with extras():
    import torch

TABLE = "grid.csv"
FIGURE = "grid.png"


def published_cells(
    classes: tuple[str, ...],
    views: int,
) -> dict[tuple[int, int], list[float]]:
    """Depth and batch size of the networks of table 6, with their published accuracies; two are
    given for one of them.

    For a data set that table 6 does not have, all of its networks, without accuracies.

    Args:
        classes: of the data.
        views: of each object.
    """
    cells: dict[tuple[int, int], list[float]] = {}
    for model, batch, accuracy in published_recognisers(classes, views):
        cells.setdefault((_depth(model), batch), []).append(accuracy)
    if not cells:
        cells = {
            (_depth(row["model"]), int(row["batch_size"])): []
            for row in read_rows("table6_resnet")
        }
    return dict(sorted(cells.items()))


def _scores(
    run: Path,
    store: Path,
    views: ViewStore,
    recipe: RecogniserRecipe,
) -> dict[str, float]:
    """Accuracy from one view of the test split, over objects and over classes, kept in the run's
    folder.
    """
    kept = run / "scores.json"
    if kept.exists():
        return json.loads(kept.read_text())
    device = "cuda" if torch.cuda.is_available() else "cpu"
    network = run_network(run, recipe, views).eval().to(device)
    inputs = load_inputs(store, recipe.size, recipe.input)
    objects = np.flatnonzero(views.done & (views.splits == "test"))
    labels = views.labels[objects]
    right: list[int] = []

    def judged() -> Iterator[int]:
        for i, label in zip(objects, labels, strict=True):
            with torch.inference_mode():
                x = torch.from_numpy(inputs[int(i)]).to(device).float() / 255
                right.append(int((network(x)[0].argmax(1) == int(label)).sum()))
            yield len(right)

    track(judged(), len(objects), f"test of {run.name}")
    share = np.array(right) / len(views.sphere)
    by_class = [share[labels == label].mean() for label in np.unique(labels)]
    with (run / "log/metrics.csv").open(newline="") as file:
        validated = max(float(row["class_accuracy"]) for row in csv.DictReader(file))
    scores = {
        "accuracy": round(float(share.mean()), 4),
        "class_accuracy": round(float(np.mean(by_class)), 4),
        "validation_class_accuracy": round(validated, 4),
    }
    with new_file(kept, True) as part:
        part.write_text(json.dumps(scores) + "\n")
    return scores


def grid_figure(rows: Sequence[dict[str, Any]]) -> Figure:
    """Accuracy from one view of the test split, a line for each network.

    Args:
        rows: with "depth", "batch_size", "accuracy" and "published" (None where nothing was); a
            network may have several published accuracies, each in a row of its own.
    """
    networks = list(dict.fromkeys((row["depth"], row["batch_size"]) for row in rows))
    line = {network: y for y, network in enumerate(networks)}
    figure, axes = new_figure(4.6, 0.9 + 0.3 * len(networks))
    ours = {line[row["depth"], row["batch_size"]]: row["accuracy"] for row in rows}
    axes.plot(
        list(ours.values()),
        list(ours),
        "o",
        color=BLUE,
        markersize=6,
        label="ours",
    )
    published = [
        (row["published"], line[row["depth"], row["batch_size"]])
        for row in rows
        if row["published"]
    ]
    if published:
        axes.plot(
            *zip(*published, strict=True),
            "D",
            color=ACCENT,
            markersize=5,
            label="published",
        )
    axes.set_yticks(
        range(len(networks)),
        [f"ResNet-{depth}, batch {batch}" for depth, batch in networks],
    )
    axes.set_ylim(len(networks) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    percent_axis(axes.xaxis)
    axes.set_xlabel("accuracy from one view, test split")
    axes.margins(x=0.12)
    legend(axes)
    return figure


def _depth(model: str) -> int:
    return int(model.removeprefix("ResNet"))


def main(
    store: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    depths: tuple[int, ...] = (),
    batches: tuple[int, ...] = (),
    recipe: tyro.conf.OmitArgPrefixes[RecogniserRecipe] = THESIS_RECOGNISER,
    hardware: tyro.conf.OmitArgPrefixes[Hardware] = Hardware(),
) -> None:
    """Train the recognisers of the thesis's table 6 and set them beside the published ones. Resumes
    if it was cut off.

    Every network is trained in a folder of its own by the published recipe; its best epoch is
    chosen on validation. The test split is used once they all are trained.

    Args:
        store: view store made by nextview-lab render.
        out: folder for the runs, grid.csv and grid.png.
        depths: train only networks of so many layers.
        batches: train only networks with these batch sizes.
        recipe: how to train; network, layers and batch are those of the table.
        hardware: on what.

    Raises:
        UsageError: the table holds no network of these depths and batch sizes.
    """
    views = ViewStore.open(store)
    cells = {
        (depth, batch): published
        for (depth, batch), published in published_cells(
            tuple(views.classes),
            len(views.sphere),
        ).items()
        if depth in (depths or (depth,)) and batch in (batches or (batch,))
    }
    if not cells:
        raise UsageError("table 6 holds no network of these depths and batch sizes")
    recipes = {}
    for depth, batch in cells:
        changes: dict[str, Any] = {"network": "resnet", "layers": depth, "batch": batch}
        recipes[out / f"resnet{depth}-batch{batch}"] = replace(recipe, **changes)
    for run, own in recipes.items():
        train_recogniser(store, run, recipe=own, hardware=hardware, track=track)
    if not is_first():
        return
    rows: list[dict[str, Any]] = []
    for (run, own), published in zip(recipes.items(), cells.values(), strict=True):
        cell: dict[str, Any] = {"depth": own.layers, "batch_size": own.batch}
        cell |= _scores(run, store, views, own)
        rows += [cell | {"published": accuracy} for accuracy in (published or (None,))]
    with new_file(out / TABLE, True) as part, part.open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    draw_curves(list(recipes))
    with new_file(out / FIGURE, True) as part:
        to_png(grid_figure(rows), part)


if __name__ == "__main__":
    with orderly_end("run the same command again; it resumes"):
        tyro.cli(main)
