"""What it is worth that views have to agree on the side: belief with it and without, after so many views.

    python benchmarks/agreement.py VALIDATION.npz TEST.npz [STORE]

prints Markdown. Both calibrations are fitted to VALIDATION.npz (objects of the training split that the recogniser has
not seen); views are fused in a random order and all its rotations, the same for both. In brackets: 95 % bootstrap
intervals over objects. With the store of which the predictions are, how often the side is right is added: the planes
from which azimuth bins are counted come from its training split.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.benchmark.paired import accuracy_after_views, rows
from nextview.calibration.fitting_set import FittingSet
from nextview.calibration.temperature import fit_temperature, loss
from nextview.data.predictions import Predictions
from nextview.data.splits import split_training
from nextview.data.store import ViewStore


def features(p: Predictions, store: ViewStore) -> str:
    """How often the likeliest side of the true class is the true one, and up to a half turn."""
    from nextview.training.azimuth_bins import azimuth_bins, mirror_planes

    assert p.azimuth_bins is not None
    n, v = p.azimuth_bins.shape[3], len(p.sphere)
    rows = np.array([store.names.index(name) for name in p.names])
    true = np.rint(azimuth_bins(store, n, mirror_planes(store, split_training(store)[0]))[rows])
    log_evidence = p.azimuth_bins[np.arange(len(p))[:, None], np.arange(v), p.labels[:, None]].argmax(2)
    off = (log_evidence - true) % n

    def share(hit: NDArray) -> str:
        each = [f"{name} {hit[p.labels == c].mean():.2f}" for c, name in enumerate(p.classes) if (p.labels == c).any()]
        return f"{hit.mean():.3f} of the views ({', '.join(each)})"

    return f"Side right in {share(off == 0)}; up to a half turn in {share(off % (n / 2) == 0)}."


def main(validation: Path, test: Path, store: Path | None = None) -> None:
    """Print both tables."""
    known, other = Predictions.load(validation).deduplicate(), Predictions.load(test)
    data = FittingSet.of_all(known)
    both = [replace(data, azimuth_bins=None), data]
    calibrations = [fit_temperature(d, np.random.default_rng([0, 0]), walks=1 + 8000 // len(data)) for d in both]
    for what, d, c in zip(("logits alone", "agreeing on the side"), both, calibrations, strict=True):
        likelihood = -loss(d, c, np.random.default_rng([0, 2]), walks=1 + 8000 // len(data))
        numbers = f"temperature {c.temperature}, correlation {c.correlation}, of azimuth bins {c.bin_correlation}"
        print(f"{what}: {numbers}; mean log-belief in the truth over 1 to 5 views {likelihood:.3f}\n")
    for p in (known, other):
        print(f"{len(p)} objects, split {p.splits[0]}:\n")
        print("| looks | logits alone (class mean) | agreeing on the side | difference, points |\n|---|---|---|---|")
        plain, agreeing = (accuracy_after_views(p, c) for c in calibrations)
        print("\n".join(rows(plain, agreeing, p.labels)) + "\n")
        if store is not None:
            print(features(p, ViewStore.open(store)) + "\n")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
