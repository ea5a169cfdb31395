"""The recogniser's inputs for a whole store, computed once and kept beside the store, packed."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from nextview.arguments import takes_paths
from nextview.data.lock import only_one
from nextview.data.pool import WorkerDied, each
from nextview.data.store import ViewStore
from nextview.errors import DatasetError
from nextview.models.network_input import CHANNELS_OF, InputKind, InputSpec, from_store
from nextview.tracking import Track, silently
from nextview.training.packed import PackedViews, load_packed, pack, save_packed


def inputs_path(store: Path, size: int, kind: InputKind = "geometry") -> Path:
    """The folder where the inputs of a store are kept."""
    store = Path(os.path.realpath(store)) if store.name in ("", "..") else store  # "." has no name
    return store.with_name(f"{store.name}.{'inputs' if kind == 'geometry' else kind}{size}")


@takes_paths("path")
def prepare_inputs(path: Path, size: int, kind: InputKind = "geometry", workers: int | None = None) -> Iterator[int]:
    """Compute the inputs of every object, (N, V, C, size, size) uint8, unless they are there.

    Yields:
        Objects done so far.

    Raises:
        ObservationError: the views cannot be brought to this size.
    """
    target = inputs_path(path, size, kind)
    if target.exists():
        return
    store = ViewStore.open(path)
    chosen = np.flatnonzero(store.done).tolist()
    for first in chosen[:1]:  # a size that the views do not have is refused before anything is made
        from_store(InputSpec(kind, size), store, first)
    shape = (len(store), len(store.sphere), CHANNELS_OF[kind], size, size)
    yield from save_packed(target, shape, _all_packed(path, chosen, size, kind, workers))


def _all_packed(
    path: Path, chosen: list[int], size: int, kind: InputKind, workers: int | None
) -> Iterator[tuple[int, list[bytes]]]:
    for i, packed in each(partial(_packed, path, size=size, kind=kind), chosen, workers):
        if isinstance(packed, WorkerDied):
            raise DatasetError(f"{path}: the inputs of {ViewStore.open(path).names[i]} cannot be computed: {packed}")
        yield i, packed


def ready_inputs(path: Path, size: int, kind: InputKind = "geometry", track: Track = silently) -> PackedViews:
    """The inputs of a store, (N, V, C, size, size) uint8, computed if they are not there.

    Of the processes of one training, the first computes them and the others wait.

    Args:
        path: the view store.
        size: side of the inputs, pixels.
        kind: geometry or image.
        track: follows the work.

    Raises:
        ObservationError: the views cannot be brought to this size.
        DatasetError: another run computes them.
    """
    from nextview.training.loop import is_first  # not above: the processes that prepare inputs need no torch

    target = inputs_path(path, size, kind)
    if is_first() and not target.exists():
        with only_one(target):
            track(prepare_inputs(path, size, kind), int(ViewStore.open(path).done.sum()), f"inputs of {path.name}")
    while not target.exists():
        time.sleep(1)
    return load_inputs(path, size, kind)


def load_inputs(path: Path, size: int, kind: InputKind = "geometry") -> PackedViews:
    """The inputs of a store, (N, V, C, size, size) uint8, as ``prepare_inputs`` made them.

    Raises:
        DatasetError: they are damaged, or the store has been rendered further since.
    """
    target, store = inputs_path(path, size, kind), ViewStore.open(path)
    views = load_packed(target)
    there = views.places[..., 1].all(1)
    if there.shape != (len(store),) or (store.done & ~there).any():
        raise DatasetError(f"{target}: lacks objects that {path} holds by now; delete it, and it is made again")
    return views


def _packed(path: Path, i: int, size: int, kind: InputKind) -> list[bytes]:
    return pack(from_store(InputSpec(kind, size), ViewStore.open(path), i))
