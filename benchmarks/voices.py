"""How likely recognisers, alone or averaged, hold the truth, on objects of the training split that they have not seen.

    python benchmarks/voices.py PREDICTIONS.npz [PREDICTIONS.npz+PREDICTIONS.npz ...]

prints Markdown, each shape once. A + averages what recognisers say of the same objects. Every contestant is calibrated
anew; what the later ones gain over the first has a bootstrap interval over shapes within classes. By shape alone.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_softmax

from nextview.data.predictions import Predictions
from nextview.fitting.calibration import fit_temperature
from nextview.fitting.evidence import FittingSet
from nextview.recognition import of_true_class

LOOKS, WALKS = 5, 20


def averaged(paths: list[Path]) -> Predictions:
    """The mean of the logits, and of what is said of sides, over predictions of the same objects; each shape once."""
    tables = [Predictions.load(path).by_shape() for path in paths]
    first = tables[0]
    for path, p in zip(paths, tables, strict=True):
        if (p.names, p.classes, p.sphere) != (first.names, first.classes, first.sphere):
            raise ValueError(f"{path}: is not of the same objects, classes and views as {paths[0]}")
    told = [p.sides for p in tables if p.sides is not None]
    sides = log_softmax(np.mean(told, 0), axis=-1) if len(told) == len(tables) else None
    return replace(first, logits=np.mean([p.logits for p in tables], 0), sides=sides).each_shape_once()


def log_beliefs(p: Predictions) -> NDArray[np.float64]:
    """In the true class after 1 to LOOKS views in random order, calibrated, the mean over WALKS orders, (N, LOOKS)."""
    data = FittingSet.of_all(p)
    calibration = fit_temperature(data, np.random.default_rng(0), LOOKS, 1 + 8000 // len(data))
    rng, numbers, total = np.random.default_rng(1), np.arange(1, LOOKS + 1), np.zeros((len(p), LOOKS))
    for _ in range(WALKS):
        order = rng.permuted(np.tile(np.arange(len(p.sphere)), (len(p), 1)), axis=1)[:, :LOOKS]
        said = np.cumsum(data.said[np.arange(len(p))[:, None], order].astype(np.float64), axis=1)
        total += of_true_class(calibration.log_belief(said, numbers, len(p.classes)), p.labels)
    return total / WALKS


def class_mean(values: NDArray[np.floating], labels: NDArray[np.int64]) -> float:
    """The mean over classes of the mean over their objects, (N,)."""
    return float(np.mean([values[labels == c].mean() for c in np.unique(labels)]))


def gained(difference: NDArray[np.floating], labels: NDArray[np.int64], samples: int = 4000) -> str:
    """Mean over classes, and its 95 % interval over objects drawn again within their classes."""
    rng, drawn = np.random.default_rng(2), []
    rows = [np.flatnonzero(labels == c) for c in np.unique(labels)]
    for _ in range(samples):
        drawn.append(np.mean([difference[rng.choice(of, len(of))].mean() for of in rows]))
    low, high = np.percentile(drawn, (2.5, 97.5))
    return f"{class_mean(difference, labels):+.3f} ({low:+.3f} to {high:+.3f})"


def main(*contestants: str) -> None:
    """Print it."""
    print(f"| | single view | all fused | log-belief, 1 look | mean of 2 to {LOOKS} | gain, 1 look | 2 to {LOOKS} |")
    print("|---|---|---|---|---|---|---|")
    first = None
    for name in contestants:
        p = averaged([Path(part) for part in name.split("+")])
        single = (p.logits.argmax(2) == p.labels[:, None]).mean(1)
        fused = (p.logits.sum(1).argmax(1) == p.labels).astype(float)
        beliefs = log_beliefs(p)
        parts = [beliefs[:, 0], beliefs[:, 1:].mean(1)]
        cells = [f"{x.mean():.3f} ({class_mean(x, p.labels):.3f})" for x in (single, fused)]
        cells += [f"{class_mean(x, p.labels):.3f}" for x in parts]
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
