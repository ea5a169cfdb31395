"""Split objects into training and validation; draw samples.

Splits are stratified by class, and copies of a mesh stay together.
"""

from pathlib import Path

import numpy as np

from nextview.checks import whole
from nextview.errors import DatasetError
from nextview.recognition.model_card import ModelCard, find_card
from nextview.types import Floats, Index
from nextview_lab.data.store import ViewStore


def duplicate_groups(measured: Floats) -> Index:
    """Return a group number for each object, (N,), shared by its copies.

    Copies have the same depth entropies, (N, V).
    """
    return np.unique(measured, axis=0, return_inverse=True)[1].ravel()


def deduplicated(labels: Index, measured: Floats) -> Index:
    """Return the first object of each shape and label.

    Args:
        labels: class of each object, (N,).
        measured: depth entropy of the views, (N, V), which identifies copies.

    Returns:
        Index, ascending.
    """
    _, first = np.unique(
        np.stack([duplicate_groups(measured), labels], 1),
        axis=0,
        return_index=True,
    )
    return np.sort(first)


def divide(
    labels: Index,
    measured: Floats,
    share: float,
    seed: int,
) -> tuple[Index, Index]:
    """Divide objects into a training and a validation part; copies stay together.

    Args:
        labels: class of each object, (N,).
        measured: depth entropy of the views, (N, V), which identifies copies.
        share: of each class for validation.
        seed: of the random division.

    Returns:
        Index of the training and of the validation objects.
    """
    group = duplicate_groups(measured)
    rng = np.random.default_rng(seed)
    validates = np.zeros(len(labels), bool)
    for label in np.unique(labels):
        members = rng.permutation(np.flatnonzero(labels == label))
        validates[members[: round(share * len(members))]] = True
    validates = np.isin(group, group[validates])
    return np.flatnonzero(~validates), np.flatnonzero(validates)


def split_training(
    store: ViewStore,
    share: float = 0.1,
    seed: int = 0,
) -> tuple[Index, Index]:
    """Divide the rendered objects of the training split; see ``divide``.

    Args:
        store: the view store; without splits all of its objects are divided.
        share: of each class for validation.
        seed: of the random division.

    Returns:
        Rows of the training and of the validation objects.

    Raises:
        DatasetError: the store has no rendered object of the training split.
    """
    usable = np.flatnonzero(store.done & np.isin(store.splits, ("train", "")))
    if len(usable) == 0:
        raise DatasetError(
            f"{store.path}: holds no rendered object of the training split"
        )
    training, validation = divide(
        store.labels[usable],
        store.measure()[usable],
        share,
        seed,
    )
    return usable[training], usable[validation]


def check_any(
    store: ViewStore,
    training: Index,
    validation: Index,
    lacking: str = "",
) -> None:
    """Check that there are objects for training and for validation.

    Args:
        store: the view store, for messages.
        training: rows of the training objects.
        validation: rows of the validation objects.
        lacking: why some may be missing, for messages.

    Raises:
        DatasetError: one of the parts is empty.
    """
    for objects, what in (
        (training, "to train on"),
        (validation, "to validate with (see --validation-share)"),
    ):
        if len(objects) == 0:
            raise DatasetError(f"{store.path}: no object is left {what}{lacking}")


def deduplicate(store: ViewStore, objects: Index) -> Index:
    """Return one of each shape and label among objects of a store; see ``deduplicated``.

    Args:
        store: the view store.
        objects: rows of the objects.

    Returns:
        Rows, in the order given.
    """
    return objects[deduplicated(store.labels[objects], store.measure()[objects])]


def sample(objects: Index, count: int | None = None) -> Index:
    """Select evenly spaced objects, starting with the first.

    Args:
        objects: indices.
        count: number of objects; None for all.

    Returns:
        The selected indices; all if there are not more.
    """
    if count is not None:
        whole(count, "the number of objects", 1)
    n = len(objects)
    return (
        objects
        if count is None or count >= n
        else objects[np.arange(count) * n // count]
    )


def some_objects(
    store: ViewStore,
    split: str | None = None,
    held_out: ModelCard | str | Path | None = None,
    count: int | None = None,
) -> Index:
    """Select rendered objects of a store.

    Args:
        store: the view store.
        split: name of the split; None for all.
        held_out: card, or its name or path, whose held-out objects are selected; None
            for all.
        count: number of evenly spaced objects; None for all.

    Returns:
        Rows, ascending.

    Raises:
        DatasetError: there is no such object.
    """
    chosen = store.done & (True if split is None else store.splits == split)
    of = "" if split is None else f" of the split {split!r}"
    if held_out is not None:
        card = held_out if isinstance(held_out, ModelCard) else find_card(held_out)
        chosen &= np.isin(store.names, card.held_out)
        of += f" that {card.name} calls held out"
    if not chosen.any():
        raise DatasetError(f"{store.path}: holds no rendered object{of}")
    return sample(np.flatnonzero(chosen), count)
