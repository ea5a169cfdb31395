"""Compute something of every rendered object of a store, into the store; resumable by object."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.data.lock import only_one
from nextview.data.pool import WorkerDied, each
from nextview.data.rendering import writing
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
    v = len(store.sphere)
    yield from keep(path, {f"measures/{n}": (v,) for n in names}, partial(_measure, tuple(names)), workers, scheduler)


def _measure(names: tuple[str, ...], store: ViewStore, i: int) -> dict[str, NDArray[np.float32]]:
    depth = store.read("depth", i) * DEPTH_UNIT  # float64, as when it was rendered
    return {f"measures/{name}": np.array([MEASURES[name](d) for d in depth], np.float32) for name in names}


def keep(
    path: Path,
    shapes: dict[str, tuple[int, ...]],
    function: Callable[[ViewStore, int], dict[str, NDArray[np.float32]]],
    workers: int | None = None,
    scheduler: str | None = None,
) -> Iterator[tuple[int, int]]:
    """Call ``function(store, i)`` for the objects that lack one of the arrays, and keep what it returns, by array.

    Args:
        path: the store.
        shapes: of the arrays for one object; new ones hold NaN where nothing is kept.
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
        for name, shape in shapes.items():
            if name not in store.group:
                store.add(name, shape, "float32", fill=float("nan"))
        lacking = np.zeros(len(done), bool)
        for name in shapes:
            lacking |= np.isnan(store.array(name)[:].reshape(len(store), -1)[done]).any(1)
        items = [int(i) for i in done[lacking]]
        yield len(done) - len(items), len(done)
        finished = len(done) - len(items)
        for i, died in each(partial(_keep_object, store.path, function), items, workers, scheduler):
            if isinstance(died, WorkerDied):
                raise DatasetError(f"{path}: object {store.names[i]} cannot be computed ({died})")
            finished += 1
            yield finished, len(done)


def _keep_object(path: Path, function: Callable[[ViewStore, int], dict[str, NDArray[np.float32]]], i: int) -> None:
    store = ViewStore.open(path)
    for name, values in function(store, i).items():
        store.group[name][i] = values
