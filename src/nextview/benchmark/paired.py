"""Several ways to say something of the same views, side by side: what they are compared on, and Markdown rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.belief import Calibration
from nextview.benchmark.evaluation import fused_views
from nextview.benchmark.statistics import interval, ratio, resample
from nextview.data.predictions import Predictions
from nextview.errors import PredictionsError

Float = NDArray[np.float64]
VIEW_COUNTS = (1, 2, 3, 5, 8, 15, 40)


def of_the_same(paths: Sequence[Path]) -> list[Predictions]:
    """Several predictions of the same objects, classes and views.

    Raises:
        PredictionsError: they are of others.
    """
    tables = [Predictions.load(path) for path in paths]
    of = [(p.names, p.classes, p.sphere) for p in tables]
    for path, others in zip(paths, of, strict=True):
        if others != of[0]:
            raise PredictionsError(f"{path}: is not of the same objects, classes and views as {paths[0]}")
    return tables


def accuracy_after_views(p: Predictions, calibration: Calibration) -> Float:
    """How often each object is named right after 1, 2, ... views, over a random order of views turned round, (V, N)."""
    return fused_views(p.log_evidence, p.labels, calibration, np.random.default_rng(0), len(p.classes))[0].mean(2)


def in_points(before: Float, after: Float, samples: int = 2000) -> str:
    """The difference of two accuracies of the same objects, each (N,), in points, with its 95 % bootstrap interval."""
    points = 100 * (after - before)
    weights = resample(len(points), samples, np.random.default_rng(1))
    low, high = interval(ratio(points[:, None], np.ones((len(points), 1)), weights))
    return f"{points.mean():+.1f} ({low[0]:+.1f} to {high[0]:+.1f})"


def rows(before: Float, after: Float, labels: NDArray[np.int64]) -> Iterator[str]:
    """Views, accuracy both ways (class mean in brackets), and the difference where there is one.

    Args:
        before: of ``accuracy_after_views``, (V, N).
        after: the other way, (V, N).
        labels: of the objects, (N,).
    """
    for k in [k for k in VIEW_COUNTS if k <= len(before)]:
        both = before[k - 1], after[k - 1]
        cells = [f"{r.mean():.3f} ({np.mean([r[labels == c].mean() for c in np.unique(labels)]):.3f})" for r in both]
        yield f"| {k} | {cells[0]} | {cells[1]} | {in_points(*both) if (both[0] != both[1]).any() else ''} |"
