"""How likely recognisers, alone or averaged, hold the truth, on objects of the training split that they have not seen.

    python benchmarks/voices.py PREDICTIONS.npz [PREDICTIONS.npz+PREDICTIONS.npz ...]

prints Markdown, duplicates left out. A + averages what recognisers say of the same objects. Every entry is calibrated
anew; what the later ones gain over the first has a bootstrap interval over shapes. By shape alone.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_softmax

from nextview.belief import of_true_class
from nextview.benchmark.paired import of_the_same
from nextview.benchmark.statistics import class_mean, interval, resample
from nextview.calibration.fitting_set import FittingSet
from nextview.calibration.temperature import fit_temperature
from nextview.data.predictions import Predictions

Float = NDArray[np.float64]
VIEW_COUNTS, WALKS = 5, 20


def averaged(paths: list[Path]) -> Predictions:
    """The mean of logits and azimuth bins over predictions of the same objects; duplicates left out."""
    tables = [p.by_shape() for p in of_the_same(paths)]
    features = [p.azimuth_bins for p in tables if p.azimuth_bins is not None]
    azimuth_bins = log_softmax(np.mean(features, 0), axis=-1) if len(features) == len(tables) else None
    return replace(tables[0], logits=np.mean([p.logits for p in tables], 0), azimuth_bins=azimuth_bins).deduplicate()


def log_beliefs(p: Predictions) -> Float:
    """In the true class after 1 to LOOKS views in random order, calibrated, the mean over WALKS orders, (N, LOOKS)."""
    data = FittingSet.of_all(p)
    calibration = fit_temperature(data, np.random.default_rng(0), VIEW_COUNTS, 1 + 8000 // len(data))
    rng, numbers, total = np.random.default_rng(1), np.arange(1, VIEW_COUNTS + 1), np.zeros((len(p), VIEW_COUNTS))
    for _ in range(WALKS):
        order = rng.permuted(np.tile(np.arange(len(p.sphere)), (len(p), 1)), axis=1)[:, :VIEW_COUNTS]
        log_evidence = np.cumsum(data.log_evidence[np.arange(len(p))[:, None], order].astype(np.float64), axis=1)
        total += of_true_class(calibration.log_belief(log_evidence, numbers, len(p.classes)), p.labels)
    return total / WALKS


def over_classes(values: Float, labels: NDArray[np.int64], weights: Float) -> Float:
    """The class mean of a value of each object, (N,), for each row of weights of the objects, (S, N): (S,)."""
    return class_mean(values[:, None], np.ones((len(values), 1)), labels, weights)[:, 0]


def gained(difference: Float, labels: NDArray[np.int64], samples: int = 4000) -> str:
    """The class mean of a difference, and its 95 % bootstrap interval."""
    of_all = over_classes(difference, labels, np.ones((1, len(labels))))[0]
    drawn = over_classes(difference, labels, resample(len(labels), samples, np.random.default_rng(2)))
    low, high = interval(drawn[:, None])
    return f"{of_all:+.3f} ({low[0]:+.3f} to {high[0]:+.3f})"


def main(*entries: str) -> None:
    """Print it."""
    print(
        f"| | single view | all fused | log-belief, 1 view | mean of 2 to {VIEW_COUNTS} | gain, 1 view | 2 to {VIEW_COUNTS} |"
    )
    print("|---|---|---|---|---|---|---|")
    first = None
    for name in entries:
        p = averaged([Path(part) for part in name.split("+")])
        single = (p.logits.argmax(2) == p.labels[:, None]).mean(1)
        fused = (p.logits.sum(1).argmax(1) == p.labels).astype(float)
        beliefs, once = log_beliefs(p), np.ones((1, len(p)))
        parts = [beliefs[:, 0], beliefs[:, 1:].mean(1)]
        cells = [f"{x.mean():.3f} ({over_classes(x, p.labels, once)[0]:.3f})" for x in (single, fused)]
        cells += [f"{over_classes(x, p.labels, once)[0]:.3f}" for x in parts]
        cells += ["", ""] if first is None else [gained(a - b, p.labels) for a, b in zip(parts, first, strict=True)]
        first = first or parts
        print(f"| {name.replace('.npz', '')} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except (OSError, ValueError) as error:
        sys.exit(f"voices.py: {error}")
