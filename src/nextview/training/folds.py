"""Cross-fitting: every object is held out from one of several networks, which then predicts it out of fold.

Not by scikit-learn's StratifiedGroupKFold: the bundled gain policy was learned in the folds that are made here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview.data.splits import duplicate_groups
from nextview.errors import DatasetError


def hold_out(
    labels: NDArray[np.int64], measured: NDArray[np.floating], folds: int, seed: int
) -> list[NDArray[np.int64]]:
    """Divide objects into parts, each to be held out from one network; every class is spread evenly.

    Duplicate groups, objects that look the same, stay together.

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
    group = duplicate_groups(measured)
    _, first = np.unique(group, return_index=True)  # one object stands for its group
    first = rng.permutation(first)
    first = first[np.argsort(labels[first], kind="stable")]  # dealt out class by class
    fold_of_group = np.empty(len(first), np.int64)
    fold_of_group[group[first]] = np.arange(len(first)) % folds
    fold = fold_of_group[group]
    return [np.flatnonzero(fold == k) for k in range(folds)]
