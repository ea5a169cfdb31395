"""What it is worth to know how large the object is: a depth camera tells, a mesh of radius 1 does not.

    python benchmarks/size.py PREDICTIONS.npz

prints Markdown. The predictions come from a store that knows the unit of its meshes (nextview render --unit) and a
recogniser that was told what sizes mean (nextview fit size). Views are fused in a random order and all its rotations,
the same with the size and without. In brackets: class means, and 95 % bootstrap intervals over objects.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.benchmark.statistics import interval, ratio, resample
from nextview.data.predictions import Predictions

LOOKS = (1, 2, 3, 5, 8, 15, 40)


def right(p: Predictions, looks: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Whether the answer is right after so many looks in a random order from each of its places on, (N, V)."""
    order = rng.permuted(np.tile(np.arange(len(p.sphere)), (len(p), 1)), axis=1)
    said = np.take_along_axis(p.said, order[:, :, None], 1).astype(np.float64)
    total = sum((np.roll(said, -k, 1) for k in range(1, looks)), said)
    return p.calibration.log_belief(total, looks, len(p.classes)).argmax(2) == p.labels[:, None]


def difference(before: NDArray[np.float64], after: NDArray[np.float64], weights: NDArray[np.float64]) -> str:
    """Of two accuracies of the same objects, each (N,), in points."""
    points = 100 * (after - before)
    low, high = interval(ratio(points[:, None], np.ones((len(points), 1)), weights))
    return f"{points.mean():+.1f} ({low[0]:+.1f} to {high[0]:+.1f})"


def lines(p: Predictions, samples: int = 2000) -> Iterator[str]:
    """Two tables: accuracy without the size and with it, and the difference; by looks, and of one look by class."""
    weights = resample(len(p), samples, np.random.default_rng(1))
    there = np.unique(p.labels)
    yield "| looks | by shape alone (class mean) | size known | difference, points |"
    yield "|---|---|---|---|"
    of_one = []
    for k in [k for k in LOOKS if k <= len(p.sphere)]:
        both = [right(x, k, np.random.default_rng(0)).mean(1) for x in (p.by_shape(), p)]
        of_one = of_one or both
        cells = [f"{r.mean():.3f} ({np.mean([r[p.labels == c].mean() for c in there]):.3f})" for r in both]
        yield f"| {k} | {cells[0]} | {cells[1]} | {difference(*both, weights)} |"
    yield "\n| class, one look | by shape alone | size known | difference, points |"
    yield "|---|---|---|---|"
    for c in there:
        before, after = (r[p.labels == c] for r in of_one)
        drawn = resample(len(before), samples, np.random.default_rng(1))
        name = p.classes[c].replace("_", " ")
        yield f"| {name} | {before.mean():.3f} | {after.mean():.3f} | {difference(before, after, drawn)} |"


def main(path: Path) -> None:
    """Print the tables."""
    p = Predictions.load(path)
    if p.of_size is None:
        raise ValueError(f"{path}: nothing is said of sizes; see nextview render --unit and nextview fit size")
    print(f"{len(p)} objects, split {p.splits[0]}:\n")
    print("\n".join(lines(p)))


if __name__ == "__main__":
    try:
        main(*map(Path, sys.argv[1:]))
    except (ValueError, TypeError) as error:
        print(f"size.py: {error}", file=sys.stderr)
        sys.exit(2)
