"""Network inputs of a whole store, computed once and stored next to it."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numcodecs import Blosc
from numpy.typing import NDArray

from nextview.data.pool import WorkerDied, each
from nextview.data.progress import TrackProgress, silently
from nextview.errors import DAMAGED, DatasetError
from nextview.files import new_folder, only_one
from nextview.recognition.network_input import (
    CHANNELS_OF,
    InputKind,
    InputSpec,
    from_store,
)
from nextview.types import Index
from nextview_lab.data.store import ViewStore

# views are mostly background and flat faces, and compress to a sixth or less
PACKING = Blosc("lz4", 5, Blosc.NOSHUFFLE)
AGAIN = "delete it, and it is made again"


@dataclass(frozen=True)
class PackedViews:
    """Views of all objects, (N, V, C, H, W) uint8, read like an array: ``views[i, 2:5]``.

    Attributes:
        packed: compressed views, one after another, (bytes,).
        places: start and length of each view in ``packed``, (N, V, 2); length 0 for an empty view.
        size: C, H, W.
    """

    packed: NDArray[np.uint8]
    places: Index
    size: tuple[int, ...]

    @property
    def shape(self) -> tuple[int, ...]:
        """N, V, C, H, W."""
        return (*self.places.shape[:2], *self.size)

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, at: int | tuple[int, int | slice]) -> NDArray[np.uint8]:
        places = self.places[at]
        views = np.zeros((*places.shape[:-1], *self.size), np.uint8)
        for (start, count), view in zip(
            places.reshape(-1, 2),
            views.reshape(-1, *self.size),
            strict=True,
        ):
            if count:
                PACKING.decode(self.packed[start : start + count], view)
        return views


def inputs_path(store: Path, size: int, kind: InputKind = "geometry") -> Path:
    """Return the folder with the inputs of a store.

    Args:
        store: path of the view store.
        size: side of the inputs, pixels.
        kind: of the inputs.

    Returns:
        The folder.
    """
    # "." has no name
    store = Path(os.path.realpath(store)) if store.name in ("", "..") else store
    return store.with_name(
        f"{store.name}.{'inputs' if kind == 'geometry' else kind}{size}"
    )


def ready_inputs(
    path: Path,
    size: int,
    kind: InputKind = "geometry",
    track: TrackProgress = silently,
) -> PackedViews:
    """Return the inputs of a store, which are computed if they do not exist.

    Args:
        path: of the view store.
        size: side of the inputs, pixels.
        kind: of the inputs.
        track: callable that shows progress.

    Returns:
        Inputs, (N, V, C, size, size) uint8.
    """
    target = inputs_path(path, size, kind)
    if not target.exists():
        with only_one(target):
            objects = int(ViewStore.open(path).done.sum())
            track(
                _compute(path, target, InputSpec(kind, size)),
                objects,
                f"inputs of {path.name}",
            )
    return load_inputs(path, size, kind)


def _compute(path: Path, target: Path, spec: InputSpec) -> Iterator[int]:
    """Compute and write the inputs of all objects; yields the number of finished ones."""
    store = ViewStore.open(path)
    chosen = np.flatnonzero(store.done).tolist()

    for first in chosen[
        :1
    ]:  # raises an error for an unsupported size before any file is written
        from_store(spec, store, first)
    places = np.zeros((len(store), len(store.sphere), 2), np.int64)
    with new_folder(target) as part:
        with open(part / "views.lz4", "wb") as file:
            for done, (i, packed) in enumerate(
                each(partial(_packed, path, spec), chosen),
                1,
            ):
                if isinstance(packed, WorkerDied):
                    raise DatasetError(
                        f"{path}: the inputs of {store.names[i]} cannot be computed: {packed}"
                    )
                counts = np.array([len(view) for view in packed])
                places[i] = np.stack(
                    [file.tell() + np.cumsum(counts) - counts, counts],
                    1,
                )
                file.writelines(packed)
                yield done
        size = (CHANNELS_OF[spec.kind], spec.size, spec.size)
        np.savez(part / "index.npz", places=places, size=size)


def _packed(path: Path, spec: InputSpec, i: int) -> list[bytes]:
    return [
        PACKING.encode(np.ascontiguousarray(view))
        for view in from_store(spec, ViewStore.open(path), i)
    ]


def load_inputs(path: Path, size: int, kind: InputKind = "geometry") -> PackedViews:
    """Load the inputs of a store that ``ready_inputs`` has computed.

    Args:
        path: of the view store.
        size: side of the inputs, pixels.
        kind: of the inputs.

    Returns:
        Inputs, (N, V, C, size, size) uint8.

    Raises:
        DatasetError: they are damaged, or lack objects of the store.
    """
    target = inputs_path(path, size, kind)
    store = ViewStore.open(path)
    file = target / "views.lz4"

    try:
        with np.load(target / "index.npz") as index:
            places = index["places"]
            shape = tuple(index["size"].tolist())
        packed = (
            np.memmap(file, np.uint8, "r")
            if file.stat().st_size
            else np.zeros(0, np.uint8)
        )
        if len(packed) != places[..., 1].sum():
            raise ValueError(f"{len(packed)} bytes of {places[..., 1].sum()}")
    except DAMAGED as error:
        raise DatasetError(f"{target}: is damaged ({error}); {AGAIN}") from None

    there = places[..., 1].all(1)
    if there.shape != (len(store),) or (store.done & ~there).any():
        raise DatasetError(f"{target}: lacks objects that {path} holds by now; {AGAIN}")
    return PackedViews(packed, places, shape)
