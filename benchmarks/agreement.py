"""What it is worth that looks have to agree on the side: belief with it and without, after so many looks.

    python benchmarks/agreement.py VALIDATION.npz TEST.npz [STORE]

prints Markdown. Both calibrations are fitted to VALIDATION.npz (objects of the training split that the recogniser has
not seen); views are fused in a random order and all its rotations, the same for both. In brackets: 95 % bootstrap
intervals over objects. With the store of which the predictions are, how often the side is right is added: the planes
from which sides are counted come from its training split.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.benchmark.paired import accuracy_after_looks, rows
from nextview.data.predictions import Predictions
from nextview.data.split import split_training
from nextview.data.store import ViewStore
from nextview.fitting.calibration import fit_temperature, loss
from nextview.fitting.evidence import FittingSet


def told(p: Predictions, store: ViewStore) -> str:
    """How often the likeliest side of the true class is the true one, and up to a half turn."""
    from nextview.training.sides import mirror_planes, sides

    assert p.sides is not None
    n, v = p.sides.shape[3], len(p.sphere)
    rows = np.array([store.names.index(name) for name in p.names])
    true = np.rint(sides(store, n, mirror_planes(store, split_training(store)[0]))[rows])
    said = p.sides[np.arange(len(p))[:, None], np.arange(v), p.labels[:, None]].argmax(2)
    off = (said - true) % n

    def share(hit: NDArray) -> str:
        each = [f"{name} {hit[p.labels == c].mean():.2f}" for c, name in enumerate(p.classes) if (p.labels == c).any()]
        return f"{hit.mean():.3f} of the views ({', '.join(each)})"

    return f"Side right in {share(off == 0)}; up to a half turn in {share(off % (n / 2) == 0)}."


def main(validation: Path, test: Path, store: Path | None = None) -> None:
    """Print both tables."""
    known, other = Predictions.load(validation).each_shape_once(), Predictions.load(test)
    data = FittingSet.of_all(known)
    both = [replace(data, sides=None), data]
    calibrations = [fit_temperature(d, np.random.default_rng([0, 0]), walks=1 + 8000 // len(data)) for d in both]
    for what, d, c in zip(("logits alone", "agreeing on the side"), both, calibrations, strict=True):
        likelihood = -loss(d, c, np.random.default_rng([0, 2]), walks=1 + 8000 // len(data))
        numbers = f"temperature {c.temperature_of_one}, correlation {c.correlation}, of sides {c.side_correlation}"
        print(f"{what}: {numbers}; mean log-belief in the truth over 1 to 5 looks {likelihood:.3f}\n")
    for p in (known, other):
        print(f"{len(p)} objects, split {p.splits[0]}:\n")
        print("| looks | logits alone (class mean) | agreeing on the side | difference, points |\n|---|---|---|---|")
        plain, agreeing = (accuracy_after_looks(p, c) for c in calibrations)
        print("\n".join(rows(plain, agreeing, p.labels)) + "\n")
        if store is not None:
            print(told(p, ViewStore.open(store)) + "\n")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
