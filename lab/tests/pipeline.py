"""What the tests of the laboratory share: made-up predictions, and stores of views.

``conftest.py`` makes fixtures of whole pipelines from it.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from nextview.geometry.camera import pinhole
from nextview.geometry.viewsphere import ViewSphere, look_at_origin
from nextview_lab.data.measures import MeasuredView
from nextview_lab.data.predictions import Predictions

SPHERE = ViewSphere.named("40")
CLASSES = ["ball", "box", "pillar"]
"""Of ``some_predictions``."""


def some_predictions(n: int = 6, seed: int = 0) -> Predictions:
    """Random logits and maps of ``n`` objects of three classes."""
    rng = np.random.default_rng(seed)
    return Predictions(
        rng.normal(size=(n, 40, 3)).astype(np.float32),
        {"lem": rng.random((n, 40, 5, 3)).astype(np.float32)},
        rng.random((n, 40)).astype(np.float32),
        tuple(f"thing_{i}" for i in range(n)),
        np.arange(n) % 3,
        tuple(CLASSES),
        np.array(["test"] * n),
        np.zeros(n, bool),
        SPHERE,
        {"recogniser": ("r", "0" * 64), "lem": ("l", "1" * 64)},
        {"lem": ("box",)},
    )


def train_predictions(
    logits, labels, sphere, classes, azimuth_bins=None, **fields
) -> Predictions:
    """Predictions of objects of the training split of which nothing but this is known."""
    n, v, _ = logits.shape
    entropy = np.zeros((n, v), np.float32)
    splits = np.array(["train"] * n)
    conflicting = np.zeros(n, bool)
    given = (
        logits,
        {},
        entropy,
        tuple(map(str, range(n))),
        labels,
        classes,
        splits,
        conflicting,
        sphere,
        {},
        {},
    )
    return replace(Predictions(*given, azimuth_bins=azimuth_bins), **fields)


def benchmark(predictions: Path, out: Path, **settings):
    from nextview_lab.benchmark.classes import ClassSettings, benchmark_classes

    return benchmark_classes(predictions, out, ClassSettings(**settings))


def of_depth(depth, distance=3.0) -> MeasuredView:
    """What a measure is handed where the depth alone is known, from straight ahead."""
    depth = np.asarray(depth)
    return MeasuredView(
        depth, look_at_origin(0, 0, distance), pinhole(max(depth.shape), distance)
    )
