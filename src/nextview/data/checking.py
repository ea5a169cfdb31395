"""Whether every rendered object of a store can be read."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from nextview.data.pool import each
from nextview.data.store import ViewStore, opened
from nextview.errors import DatasetError


def check(path: Path, workers: int | None = None, scheduler: str | None = None) -> Iterator[tuple[str, str | None]]:
    """Read every array of every rendered object: every chunk is there and has its checksum.

    Yields:
        (name, None) for each sound object, (name, what is wrong with it) for a damaged one.
    """
    store = ViewStore.open(path)
    for name in store.rendered:
        store.array(name)  # says what is wrong
    items = np.flatnonzero(store.done).tolist()
    for i, problem in each(partial(_check_object, Path(path).absolute()), items, workers, scheduler):
        yield store.names[i], None if problem is None else f"{problem}"


def incomplete(path: Path) -> dict[str, int]:
    """The arrays that were added to a store and lack some of the rendered objects, and how many objects they hold."""
    store = ViewStore.open(path)
    done = store.done
    held = {name: int((store.held(name) & done).sum()) for name in store.added}
    return {name: n for name, n in held.items() if n < done.sum()}


def _check_object(path: Path, i: int) -> str | None:
    store = opened(path)
    try:
        for name in (*store.rendered, *(name for name in store.added if store.has(name, i))):
            store.read(name, i)
    except DatasetError as error:
        return str(error)
    return None
