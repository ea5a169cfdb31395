"""Compute something of every rendered object of a store, into the store; resumable by object."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import zarr
from numpy.typing import NDArray

from nextview.data.lock import only_one, writing
from nextview.data.pool import WorkerDied, each
from nextview.data.store import DEPTH_UNIT, ViewStore
from nextview.errors import DatasetError
from nextview.measures.registry import MEASURES


def measure(
    path: Path,
    names: Sequence[str] = tuple(MEASURES),
    workers: int | None = None,
    scheduler: str | None = None,
) -> Iterator[tuple[int, int]]:
    """Put view measures into a store, as ``measures/NAME`` (N, V) float32.

    Args:
        path: the store.
        names: of the measures; all that are known by default.
        workers: processes; one for each core by default; 0 to work in this one.
        scheduler: address of a dask.distributed scheduler, to use instead.

    Yields:
        Objects done so far, and how many there are.

    Raises:
        DatasetError: there is no store, no such measure, or the store cannot be written.
    """
    for name in names:
        if name not in MEASURES:
            raise DatasetError(f"no measure is called {name!r}; there are {', '.join(MEASURES)}")
    store = ViewStore.open(path)
    store.array("depth")  # says if it is missing, before anything is begun
    yield from keep(path, [f"measures/{name}" for name in names], partial(_measure, tuple(names)), workers, scheduler)


def _measure(names: tuple[str, ...], store: ViewStore, i: int) -> dict[str, NDArray[np.float32]]:
    depth = store.read("depth", i) * DEPTH_UNIT  # float64, as when it was rendered
    return {f"measures/{name}": np.array([MEASURES[name](d) for d in depth], np.float32) for name in names}


def keep(
    path: Path,
    names: Sequence[str],
    function: Callable[[ViewStore, int], dict[str, NDArray[np.float32]]],
    workers: int | None = None,
    scheduler: str | None = None,
) -> Iterator[tuple[int, int]]:
    """Call ``function(store, i)`` for the objects that lack a sound row of the arrays, and keep what it returns.

    Args:
        path: the store.
        names: of the arrays; one that is missing or cannot be opened is made.
        function: returns one array of finite numbers for each name.
        workers: processes; one for each core by default; 0 to work in this one.
        scheduler: address of a dask.distributed scheduler, to use instead.

    Yields:
        Objects done so far, and how many there are.

    Raises:
        DatasetError: there is no store, another run is writing it, or it cannot be written.
    """
    with only_one(path), writing(path):
        store = ViewStore.open(path.absolute())
        done = np.flatnonzero(store.done)
        for name in names:
            if not store.sound(name):
                store.add(name)
        lacking: set[int] = set()
        for name in names:
            values, wrong = store.scan(name, done.tolist())
            blank = np.isnan(values.reshape(len(store), -1)[done]).any(1)
            lacking |= {*wrong, *done[blank].tolist()}  # what is damaged is made anew
        items = sorted(lacking)
        yield len(done) - len(items), len(done)
        finished = len(done) - len(items)
        for i, died in each(partial(_keep_object, store.path, function), items, workers, scheduler):
            if isinstance(died, WorkerDied):
                raise DatasetError(f"{path}: object {store.names[i]} cannot be computed ({died})")
            finished += 1
            yield finished, len(done)


def _keep_object(path: Path, function: Callable[[ViewStore, int], dict[str, NDArray[np.float32]]], i: int) -> None:
    store = ViewStore.open(path)
    found = function(store, i)
    with zarr.config.set({"array.write_empty_chunks": True}):  # zeros too: an object without a chunk is a damaged one
        for name, values in found.items():
            store.group[name][i] = values
