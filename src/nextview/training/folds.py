"""Cross-fitting: every object is kept from one of several networks, which then judges it without having seen it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview.data.splits import duplicate_groups
from nextview.errors import DatasetError


def hold_out(
    labels: NDArray[np.int64], measured: NDArray[np.floating], folds: int, seed: int
) -> list[NDArray[np.int64]]:
    """Divide objects into parts, each to be kept from one network; every class is spread evenly.

    Objects that look the same are kept together.

    Args:
        labels: class of each object, (N,).
        measured: depth-entropy from every view, (N, V).
        folds: how many parts, at least 2.
        seed: decides which object goes where.

    Returns:
        ``folds`` sorted arrays of indices that together are all objects.

    Raises:
        DatasetError: fewer than two folds, or fewer objects than folds.
    """
    if not 2 <= folds <= len(labels):
        raise DatasetError(f"{len(labels)} objects cannot be divided into {folds} folds")
    rng = np.random.default_rng([seed, folds])
    duplicate = duplicate_groups(measured)
    _, first = np.unique(duplicate, return_index=True)  # one object stands for all that look the same
    first = rng.permutation(first)
    first = first[np.argsort(labels[first], kind="stable")]  # dealt out class by class
    fold_of_twin = np.empty(len(first), np.int64)
    fold_of_twin[duplicate[first]] = np.arange(len(first)) % folds
    fold = fold_of_twin[duplicate]
    return [np.flatnonzero(fold == k) for k in range(folds)]
