"""What it would be worth to know how large the object is: a depth camera tells, a mesh of radius 1 does not.

    python benchmarks/size.py data/ModelNet10 VALIDATION.npz TEST.npz

prints Markdown. The logarithm of an object's radius, in the units of its file, has a density for each class, estimated
from the training objects that are not in VALIDATION.npz (Gaussian kernels, Scott's width). Its logarithm is added to
that of the belief, with one weight for all, fitted to VALIDATION.npz by the likelihood of single looks, classes
weighted evenly. Views are fused in a random order and all its rotations, the same for both. In brackets: class means,
and 95 % bootstrap intervals over objects. Files in other units than the training ones would mislead.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.stats import gaussian_kde

from nextview.benchmark.statistics import interval, ratio, resample
from nextview.cli.progress import track
from nextview.data.folders import Entry, list_dataset
from nextview.data.predictions import Predictions
from nextview.fitting.evidence import fitting_set
from nextview.mesh import load_mesh
from nextview.recognition import of_true_class

LOOKS = (1, 2, 3, 5, 8, 15, 40)
Float = NDArray[np.float64]


def radius(entry: Entry) -> float:
    """Of one mesh, in the units of its file."""
    return load_mesh(entry.path).radius


def log_radii(entries: list[Entry]) -> dict[str, float]:
    """Logarithm of every object's radius, by name."""
    found: dict[str, float] = {}

    def read() -> Iterator[int]:
        with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
            for entry, size in zip(entries, pool.map(radius, entries, chunksize=16), strict=True):
                found[entry.name] = float(np.log(size))
                yield len(found)

    track(read(), len(entries), "reading meshes")
    return found


def log_densities(sizes: Float, labels: NDArray[np.int64], classes: int, at: Float) -> Float:
    """Log-density of each class at each size, (len(at), classes)."""
    each = [gaussian_kde(sizes[labels == c]).logpdf(at) for c in range(classes)]
    return np.maximum(np.stack(each, 1), -10)  # no size is out of the question


def log_beliefs(p: Predictions, looks: int, rng: np.random.Generator) -> Float:
    """After so many looks in a random order from each of its places on, (N, V, C)."""
    order = rng.permuted(np.tile(np.arange(len(p.sphere)), (len(p), 1)), axis=1)
    said = np.take_along_axis(p.said, order[:, :, None], 1).astype(np.float64)
    total = sum((np.roll(said, -k, 1) for k in range(1, looks)), said)
    return p.calibration.log_belief(total, looks, len(p.classes))


def lines(p: Predictions, sizes: Float, weight: float, samples: int = 2000) -> Iterator[str]:
    """Rows of a table: accuracy without the size and with it, and the difference."""
    weights = resample(len(p), samples, np.random.default_rng(1))
    there = np.unique(p.labels)
    for k in [k for k in LOOKS if k <= len(p.sphere)]:
        logs = log_beliefs(p, k, np.random.default_rng(0))
        known = logs + weight * sizes[:, None]
        right = [(x.argmax(2) == p.labels[:, None]).mean(1) for x in (logs, known)]
        difference = 100 * (right[1] - right[0])
        low, high = interval(ratio(difference[:, None], np.ones((len(p), 1)), weights))
        cells = [f"{r.mean():.3f} ({np.mean([r[p.labels == c].mean() for c in there]):.3f})" for r in right]
        yield f"| {k} | {cells[0]} | {cells[1]} | {difference.mean():+.1f} ({low[0]:+.1f} to {high[0]:+.1f}) |"


def main(meshes: Path, validation: Path, test: Path) -> None:
    """Print the tables."""
    known, other = Predictions.load(validation), Predictions.load(test)
    if "test" in known.splits:
        raise ValueError(f"{validation}: holds test objects, which choose nothing")
    entries = [entry for entry in list_dataset(meshes) if entry.label in known.classes]
    size = log_radii(entries)
    taught = [e for e in entries if e.split == "train" and e.name not in known.names]
    labels = np.array([known.classes.index(e.label) for e in taught])
    taught_sizes = np.array([size[e.name] for e in taught])
    c = len(known.classes)
    density = [
        log_densities(taught_sizes, labels, c, np.array([size[name] for name in p.names])) for p in (known, other)
    ]
    single = log_beliefs(known, 1, np.random.default_rng(0))
    even = fitting_set(known, 1.0, 0).weights

    def loss(weight: float) -> float:
        of_truth = of_true_class(single + weight * density[0][:, None], known.labels)
        return -float(np.average(of_truth.mean(1), weights=even))

    weight = float(minimize_scalar(loss, bounds=(0, 3), method="bounded").x)
    print(
        f"Weight of the size: {weight:.2f}; log-belief in the truth, single validation looks: {-loss(0):.3f} without,"
    )
    print(f"{-loss(weight):.3f} with it; sizes of {len(taught)} training objects.\n")
    for p, sizes in zip((known, other), density, strict=True):
        print(f"{len(p)} objects, split {p.splits[0]}:\n")
        print("| looks | radius 1 (class mean) | size known | difference, points |\n|---|---|---|---|")
        print("\n".join(lines(p, sizes, weight)) + "\n")


if __name__ == "__main__":
    try:
        main(*map(Path, sys.argv[1:]))
    except (ValueError, TypeError) as error:
        print(f"size.py: {error}", file=sys.stderr)
        sys.exit(2)
