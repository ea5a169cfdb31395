"""What two parts of the recogniser's belief are worth: views fused with them and without.

    python -m benchmarks.ablations agreement VALIDATION.npz TEST.npz [--store STORE]
    python -m benchmarks.ablations size PREDICTIONS.npz

Prints Markdown. Views are fused in a random order and all its rotations, the same with and without.
In brackets: class means, and 95 % bootstrap intervals over objects.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from nextview.cli.exit_status import require

require("train")
require("benchmark")

import numpy as np
import tyro
from numpy.typing import NDArray

from nextview.benchmark.evaluation import fused_views
from nextview.benchmark.statistics import interval, resample
from nextview.cli.exit_status import orderly_end
from nextview.data.metrics import mean_over_classes, ratio
from nextview.data.predictions import Predictions
from nextview.data.splits import split_training
from nextview.data.store import ViewStore
from nextview.errors import PredictionsError
from nextview.recognition.belief import Calibration
from nextview.training.card_fits import fit_temperature
from nextview.training.fitting_set import for_fitting

Float = NDArray[np.float64]
VIEWS = (1, 2, 3, 5, 8, 15, 40)


def accuracies(p: Predictions, calibration: Calibration) -> Float:
    """How often each object is named right after 1, 2, ... views, (V, N)."""
    return fused_views(
        p.log_evidence,
        p.labels,
        calibration,
        np.random.default_rng(0),
        len(p.classes),
    )[0].mean(2)


def in_points(before: Float, after: Float, samples: int = 2000) -> str:
    """The difference of two accuracies of the same objects, (N,) each, in points, with its
    interval.
    """
    points = 100 * (after - before)
    weights = resample(len(points), samples, np.random.default_rng(1))
    low, high = interval(ratio(points[:, None], np.ones((len(points), 1)), weights))
    return f"{points.mean():+.1f} ({low[0]:+.1f} to {high[0]:+.1f})"


def table(
    before: Float,
    after: Float,
    labels: NDArray[np.int64],
    ways: tuple[str, str],
) -> Iterator[str]:
    """Accuracies (V, N) after some numbers of views, both ways, and their difference where there
    is one.
    """
    yield f"| views | {ways[0]} (class mean) | {ways[1]} | difference, points |"
    yield "|---|---|---|---|"
    for k in [k for k in VIEWS if k <= len(before)]:
        both = before[k - 1], after[k - 1]
        cells = [f"{r.mean():.3f} ({mean_over_classes(r, labels):.3f})" for r in both]
        yield (
            f"| {k} | {cells[0]} | {cells[1]} |"
            f" {in_points(*both) if (both[0] != both[1]).any() else ''} |"
        )


def bins_told(p: Predictions, store: ViewStore) -> tuple[float, float]:
    """In which share of the views the likeliest azimuth bin of the true class is the true one; and
    up to a half turn.

    Args:
        p: of a recogniser that tells azimuth bins.
        store: that they are of. The planes from which bins are counted come from its training
            split.
    """
    from nextview.training.recogniser_training import azimuth_bins, mirror_planes

    if p.azimuth_bins is None:
        raise PredictionsError(
            "these predictions tell no azimuth bins: their recogniser was not taught them"
        )
    n = p.azimuth_bins.shape[3]
    v = len(p.sphere)
    rows = np.array([store.names.index(name) for name in p.names])
    true = np.rint(
        azimuth_bins(store, n, mirror_planes(store, split_training(store)[0]))[rows]
    )
    features = p.azimuth_bins[
        np.arange(len(p))[:, None],
        np.arange(v),
        p.labels[:, None],
    ].argmax(2)
    off = (features - true) % n
    return float((off == 0).mean()), float((off % (n / 2) == 0).mean())


def agreement(
    validation: tyro.conf.Positional[Path],
    test: tyro.conf.Positional[Path],
    store: Path | None = None,
) -> None:
    """Is a belief better when views have to agree on where the object's azimuth bin 0 points?

    Args:
        validation: predictions of objects of the training split that the recogniser has not seen,
            to which both ways are calibrated.
        test: predictions of others, to judge them by.
        store: that the predictions are of; with it, how often the azimuth bin is right is added.
    """
    known = Predictions.load(validation).deduplicate()
    other = Predictions.load(test)
    data = for_fitting(known)
    alone, agreeing = (
        fit_temperature(way, np.random.default_rng([0, 0]), walks=1 + 8000 // len(data))
        for way in (replace(data, azimuth_bins=None), data)
    )
    for p in (known, other):
        print(f"{len(p)} objects, split {p.splits[0]}:\n")
        before = accuracies(p, alone)
        after = accuracies(p, agreeing)
        print(
            "\n".join(
                table(
                    before,
                    after,
                    p.labels,
                    ("logits alone", "agreeing on the azimuth bin"),
                )
            )
            + "\n"
        )
        if store is not None:
            right, turned = bins_told(p, ViewStore.open(store))
            print(
                f"Azimuth bin right in {right:.3f} of the views, up to a half turn in"
                f" {turned:.3f}.\n"
            )


def size(predictions: tyro.conf.Positional[Path]) -> None:
    """Is a belief better when the recogniser knows how large the object is, as a depth camera does?

    Args:
        predictions: of a store that knows the unit of its meshes (nextview render --unit), by a
            recogniser that was told what sizes mean (nextview fit size).
    """
    p = Predictions.load(predictions)
    if p.of_size is None:
        raise PredictionsError(
            f"{predictions}: nothing is said of sizes; see nextview render --unit and fit size"
        )
    if (
        "test" not in p.splits
    ):  # the test split counts as it is published, copies and all
        p = p.deduplicate()
    before, after = (accuracies(x, x.calibration) for x in (p.by_shape(), p))
    print(f"{len(p)} objects, split {p.splits[0]}:\n")
    print("\n".join(table(before, after, p.labels, ("by shape alone", "size known"))))


if __name__ == "__main__":
    with orderly_end("run it again"):
        tyro.extras.subcommand_cli_from_dict(
            {"agreement": agreement, "size": size},
            description=__doc__,
        )
