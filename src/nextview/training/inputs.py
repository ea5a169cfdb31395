"""The recogniser's inputs for a whole store, computed once and kept beside the store as one array."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.data.seen import seen_views
from nextview.data.store import ViewStore
from nextview.models.geometry_input import CHANNELS

CHANNELS_OF = {"geometry": len(CHANNELS), "image": 1}
"""Channels of what a recogniser may see."""

AHEAD = 4
"""So many batches before a view is trained on, the disk is asked for it."""


def inputs_path(store: Path, size: int, kind: str = "geometry") -> Path:
    """Where the inputs of a store are kept."""
    return store.with_name(f"{store.name}.{'inputs' if kind == 'geometry' else kind}{size}.npy")


def prepare_inputs(path: Path, size: int, kind: str = "geometry", workers: int | None = None) -> Iterator[int]:
    """Compute the inputs of every object (N, V, C, size, size) uint8, unless they are there.

    Yields:
        Objects done so far. The file appears under its name only when it is whole.

    Raises:
        ValueError: the views cannot be brought to this size.
    """
    target = inputs_path(path, size, kind)
    if target.exists():
        return
    store = ViewStore.open(path)
    chosen = np.flatnonzero(store.done)
    for first in chosen[:1]:  # a size that the views do not have is refused before anything is made
        seen_views(store, int(first), kind, size)
    shape = (len(store), len(store.sphere), CHANNELS_OF[kind], size, size)
    part = target.with_suffix(".part")
    np.lib.format.open_memmap(part, "w+", np.uint8, shape).flush()
    with ProcessPoolExecutor(workers or os.cpu_count(), get_context("spawn")) as pool:
        jobs = [
            pool.submit(_prepare, path, part, objects, size, kind)
            for objects in np.array_split(chosen, max(1, len(store) // 25))
        ]
        total = 0
        for job in as_completed(jobs):
            total += job.result()
            yield total
    part.rename(target)


def load_inputs(path: Path, size: int, kind: str = "geometry") -> NDArray[np.uint8]:
    """The inputs of a store, memory-mapped, (N, V, C, size, size) uint8."""
    return np.load(inputs_path(path, size, kind), mmap_mode="r")


def ask_for(inputs: NDArray[np.uint8], places: Iterable[tuple[int, ...]]) -> None:
    """Have the disk fetch parts of memory-mapped inputs that are read soon, all at once and nothing else.

    Left to page faults, they come one after the other, each with megabytes around it. Inputs in memory are let be.

    Args:
        inputs: (N, V, C, S, S), as ``load_inputs`` gives them.
        places: leading indices: (object, view), or (object,) for all views of it.
    """
    if not isinstance(inputs, np.memmap) or inputs.filename is None or not hasattr(os, "posix_fadvise"):
        return
    with open(inputs.filename, "rb") as file:
        for place in places:
            start = inputs.offset + sum(int(i) * step for i, step in zip(place, inputs.strides, strict=False))
            os.posix_fadvise(file.fileno(), start, inputs.strides[len(place) - 1], os.POSIX_FADV_WILLNEED)


def _prepare(path: Path, part: Path, objects: NDArray[np.int64], size: int, kind: str) -> int:
    store, inputs = ViewStore.open(path), np.lib.format.open_memmap(part, "r+")
    for i in objects:
        inputs[i] = seen_views(store, int(i), kind, size)
    return len(objects)
