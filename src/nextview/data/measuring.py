"""Compute something of every rendered object of a store, into the store; resumable by object."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.checks import plugin_errors
from nextview.data.measures import MEASURES, MeasuredView, find_measure, names_of
from nextview.data.pool import counted
from nextview.data.store import DEPTH_UNIT, ViewStore, opened, writing
from nextview.errors import MeasureError

Made = dict[str, NDArray[np.float32]]  # the values of one object, by the names of their arrays


def depth_views(store: ViewStore, i: int) -> Iterator[MeasuredView]:
    """Object i of a store as measures see it, from all its views."""
    for depth, pose in zip(store.read("depth", i), store.sphere.poses, strict=True):
        yield MeasuredView(depth * DEPTH_UNIT, pose, store.intrinsics)  # float64, as when it was rendered


def measure(
    path: Path,
    names: Sequence[str] = (),
    workers: int | None = None,
    scheduler: str | None = None,
    objects: NDArray[np.int64] | None = None,
    overwrite: bool = False,
    views: Callable[[ViewStore, int], Iterator[MeasuredView]] = depth_views,
) -> Iterator[tuple[int, int]]:
    """Put view measures of rendered objects, or of some rows, into a store: ``measures/NAME`` (N, V) float32.

    ``names`` as ``find_measure`` takes them, or "all"; by default all that can be had from what ``views`` hands them.
    ``workers`` and ``scheduler`` as of ``pool.each``; ``overwrite`` measures anew what is there. Yields objects done so
    far, and how many there are.
    """
    names = names_of(names, views is not depth_views)
    ViewStore.open(path).array("depth")  # says if it is missing, before anything is begun
    function = partial(_measure, names, views)
    yield from keep(path, [f"measures/{name}" for name in names], function, workers, scheduler, objects, overwrite)


def _measure(
    names: tuple[str, ...], views: Callable[[ViewStore, int], Iterator[MeasuredView]], store: ViewStore, i: int
) -> Made:
    object_name, functions = store.names[i], {name: find_measure(name) for name in names}
    values = {name: np.empty(len(store.sphere), np.float32) for name in names}
    for k, view in enumerate(views(store, i)):
        for name, function in functions.items():
            with _guard(name, object_name), np.errstate(over="ignore"):  # what is too large for float32 is told below
                values[name][k] = function(view)
    for name, found in values.items():
        if not np.isfinite(found).all():
            raise MeasureError(f"measure {name} of {object_name}, view {np.isfinite(found).argmin()}, is not finite")
    return {f"measures/{name}": found for name, found in values.items()}


def _guard(name: str, of: str) -> AbstractContextManager[None]:
    """What a measure of a plugin raises becomes one sentence."""
    return nullcontext() if name in MEASURES else plugin_errors(lambda s: MeasureError(f"measure {name} of {of}: {s}"))


def keep(
    path: Path,
    names: Sequence[str],
    function: Callable[[ViewStore, int], Made],
    workers: int | None = None,
    scheduler: str | None = None,
    objects: NDArray[np.int64] | None = None,
    overwrite: bool = False,
) -> Iterator[tuple[int, int]]:
    """Call ``function(store, i)`` for the objects that lack values in the arrays, and keep what it returns."""
    with writing(path):
        store = ViewStore.open(Path(path).absolute())
        wanted = store.done & (True if objects is None else np.isin(np.arange(len(store)), objects))
        for name in names:
            if overwrite:
                store.remove(name)
            store.add(name)
        held = np.all([store.held(name) for name in names], axis=0)
        items, total = np.flatnonzero(wanted & ~held).tolist(), int(wanted.sum())
        work = partial(_keep_object, store.path, function)
        try:
            yield from counted(work, items, total, lambda i: f"{path}: {store.names[i]}", workers, scheduler)
        finally:  # nothing is left of what failed at once
            for name in names:
                if not store.held(name).any():
                    store.remove(name)


def _keep_object(path: Path, function: Callable[[ViewStore, int], Made], i: int) -> None:
    store = opened(path)
    store.write(i, function(store, i))
