"""How well a map network does on objects of classes that it has never seen (the thesis's third
research question).

    nextview render data/PSB unseen.zarr
    python -m benchmarks.unseen_classes unseen.zarr [--model lem-modelnet10]

The store's classes are up to you. Prints the scores beside those of the mean map of these very
objects, over all views.
"""

from __future__ import annotations

from pathlib import Path

from nextview.cli.exit_status import require

require("benchmark")

import numpy as np
import tyro

from nextview.benchmark.evaluation import baselines
from nextview.benchmark.statistics import interval, resample
from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import track
from nextview.data.measures import normalise_per_object
from nextview.data.metrics import map_scores, ratio
from nextview.data.store import ViewStore
from nextview.recognition.inference import MapNetwork
from nextview.recognition.network_input import from_store

PUBLISHED = (
    "published LEM, trained on 10 classes, tested on its own "
    "unseen ones (table 4): d <= 1 0.364"
)


def main(
    store: tyro.conf.Positional[Path],
    model: str = "lem-modelnet10",
    samples: int = 2000,
    seed: int = 0,
) -> None:
    """Print the table.

    Args:
        store: views of objects of unseen classes.
        model: the map network, by name or card.
        samples: of the bootstrap over objects.
        seed: of the bootstrap.
    """
    views = ViewStore.open(store)
    network = MapNetwork(model)
    objects = np.flatnonzero(views.done)
    maps = np.empty(
        (len(objects), len(views.sphere), views.sphere.rings, 3),
        np.float32,
    )

    def predict() -> object:
        for row, i in enumerate(objects):
            maps[row] = network.from_inputs(
                from_store(network.card.input, views, int(i))
            )[network.card.kind]
            yield row + 1

    track(predict(), len(objects), f"maps of {views.path.name}")
    true = normalise_per_object(views.measure()[objects])[:, views.sphere.windows]
    labels = views.labels[objects]

    def flat(values: np.ndarray) -> np.ndarray:
        return values.reshape(-1, *values.shape[2:])

    print(
        f"{len(objects)} objects of {len(views.classes)} classes, {len(views.sphere)} views each;"
        f" {PUBLISHED}\n"
    )
    print(
        f"{'':22}{'objects':>8}{'MSE':>9}{'d = 0':>8}{'d <= 1':>8}{'d < 2':>8}{'regret':>8}"
    )
    rows = {"all": (maps, true)}
    rows["baselines: mean map"] = (baselines(true, labels)["mean map"], true)
    for name, (log_evidence, right) in rows.items():
        scores = map_scores(flat(log_evidence), flat(right))
        print(
            f"{name:22}{len(right):8}{scores['mse']:9.4f}",
            *(f"{v:7.3f}" for k, v in scores.items() if k != "mse"),
        )
    near = np.array(
        [map_scores(m, t)["d_le_1"] for m, t in zip(maps, true, strict=True)]
    )
    weights = resample(len(objects), samples, np.random.default_rng(seed))
    (low,), (high,) = interval(ratio(near[:, None], np.ones((len(near), 1)), weights))
    print(
        f"\nd <= 1 of all: {near.mean():.3f}, 95 % of the bootstrap over objects {low:.3f} .."
        f" {high:.3f}"
    )


if __name__ == "__main__":
    with orderly_end("run it again"):
        tyro.cli(main)
