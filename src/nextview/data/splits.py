"""Which objects train and which validate: by object, stratified by class, identical meshes together. And samples."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.data.store import ViewStore
from nextview.errors import DatasetError, UsageError
from nextview.models.model_card import find_card


def duplicate_groups(measured: NDArray[np.floating]) -> NDArray[np.int64]:
    """Which objects look the same from every view: a number for each, shared by those that do, (N,).

    Copies of a mesh, be they byte for byte or moved and scaled, have identical depth-entropies from all views, and
    different meshes hardly ever do.

    Args:
        measured: depth-entropy from every view, (N, V).
    """
    return np.unique(measured, axis=0, return_inverse=True)[1].ravel()


def deduplicated(labels: NDArray[np.int64], measured: NDArray[np.floating]) -> NDArray[np.int64]:
    """One object of each shape and label, the first: indices, sorted.

    What is judged or fitted counts every shape once, so that one that was copied often does not rule.

    Args:
        labels: (N,).
        measured: depth-entropy from every view, (N, V).
    """
    _, first = np.unique(np.stack([duplicate_groups(measured), labels], 1), axis=0, return_index=True)
    return np.sort(first)


def divide(
    labels: NDArray[np.int64], measured: NDArray[np.floating], share: float, seed: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Divide objects into those that train and those that validate.

    What looks the same stays on one side, whatever its labels: objects are drawn, and their copies follow them. So a
    shape that was copied often is drawn more often than others; see ``deduplicated``.

    Args:
        labels: (N,).
        measured: depth-entropy from every view, (N, V).
        share: part of every class that validates.
        seed: decides which.

    Returns:
        Indices of either, sorted.
    """
    group = duplicate_groups(measured)
    rng = np.random.default_rng(seed)
    validates = np.zeros(len(labels), bool)
    for label in np.unique(labels):
        members = rng.permutation(np.flatnonzero(labels == label))
        validates[members[: round(share * len(members))]] = True
    validates = np.isin(group, group[validates])
    return np.flatnonzero(~validates), np.flatnonzero(validates)


def split_training(store: ViewStore, share: float = 0.1, seed: int = 0) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Divide the rendered objects of the training split, see ``divide``.

    Objects of a store without a training split all count as training.

    Args:
        store: the views.
        share: part of every class that validates.
        seed: decides which.

    Returns:
        Indices of the objects that train and of those that validate, sorted.
    """
    usable = np.flatnonzero(store.done & (store.splits != "test"))
    if len(usable) == 0:
        raise DatasetError(f"{store.path}: holds no rendered object of the training split")
    training, validation = divide(store.labels[usable], store.measure()[usable], share, seed)
    return usable[training], usable[validation]


def check_any(store: ViewStore, training: NDArray[np.int64], validation: NDArray[np.int64], lacking: str = "") -> None:
    """Refuse to train on nothing, or to judge by nothing.

    Args:
        store: the views.
        training: objects that train.
        validation: objects that validate.
        lacking: why objects of the training split may be missing among them.

    Raises:
        DatasetError: there are none of one or the other.
    """
    for objects, what in ((training, "to train on"), (validation, "to validate with (see --validation)")):
        if len(objects) == 0:
            raise DatasetError(f"{store.path}: no object is left {what}{lacking}")


def deduplicate(store: ViewStore, objects: NDArray[np.int64]) -> NDArray[np.int64]:
    """One object of each shape and label among some of a store, see ``deduplicated``."""
    return objects[deduplicated(store.labels[objects], store.measure()[objects])]


def test_objects(store: ViewStore) -> NDArray[np.int64]:
    """Indices of the rendered objects of the test split."""
    return np.flatnonzero(store.done & (store.splits == "test"))


def sample(objects: NDArray[np.int64], count: int | None = None) -> NDArray[np.int64]:
    """So many of some objects, in even steps from the first one; all if there are no more. Twice as many hold the same.

    Raises:
        UsageError: less than one is asked for.
    """
    if count is not None and count < 1:
        raise UsageError(f"a sample holds at least one object, not {count}")
    n = len(objects)
    return objects if count is None or count >= n else objects[np.arange(count) * n // count]


def some_objects(
    store: ViewStore, split: str | None = None, held_out: str | Path | None = None, count: int | None = None
) -> NDArray[np.int64]:
    """Indices of the rendered objects of a store that are asked for, sorted.

    Args:
        store: the views.
        split: only this split.
        held_out: only those that this model, bundled or of this card, calls held out of its training.
        count: only so many of these, see ``sample``.

    Raises:
        DatasetError: there are none.
        ModelError: the card is none.
    """
    chosen = store.done & (True if split is None else store.splits == split)
    if held_out is not None:
        targets = [name.partition("@")[0] for name in store.names]  # in worlds; all of the name for others
        chosen &= np.isin(targets, find_card(held_out).held_out)
    if not chosen.any():
        of = (f" of the split {split!r}" if split else "") + (f" that {held_out} calls held out" if held_out else "")
        raise DatasetError(f"{store.path}: holds no rendered object{of}")
    return sample(np.flatnonzero(chosen), count)
