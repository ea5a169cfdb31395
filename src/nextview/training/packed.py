"""Views of many objects in one file, each packed for itself, so that any of them is read without the others."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numcodecs import Blosc
from numpy.typing import NDArray

from nextview.errors import DatasetError
from nextview.outputs import written_whole

PACKING = Blosc("lz4", 5, Blosc.NOSHUFFLE)
"""Views of objects are mostly background and flat faces: a sixth is left or less, which fits into memory."""

AHEAD = 4
"""So many batches before a view is trained on, the disk is asked for it."""


@dataclass(frozen=True)
class PackedViews:
    """Views of all objects, read like an array (N, V, C, H, W) of uint8.

    ``views[i]`` and ``views[i, 2:5]`` are some views of one object, ``views[i, v]`` is one.

    Attributes:
        file: holds the packed views one after another.
        packed: its bytes, memory-mapped.
        places: first byte and number of bytes of each view, (N, V, 2); none for views that are not there, which are 0.
        size: of a view, (C, H, W).
        checksums: CRC-32 of each packed view, (N, V) uint32.

    Raises:
        DatasetError: when a view is read whose bytes have changed.
    """

    file: Path
    packed: NDArray[np.uint8]
    places: NDArray[np.int64]
    size: tuple[int, ...]
    checksums: NDArray[np.uint32]

    @property
    def shape(self) -> tuple[int, ...]:
        """N, V, C, H, W."""
        return (*self.places.shape[:2], *self.size)

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, at: int | tuple[int, int | slice]) -> NDArray[np.uint8]:
        places, checksums = self.places[at], self.checksums[at]
        views = np.zeros((*places.shape[:-1], *self.size), np.uint8)
        for (start, count), checksum, view in zip(
            places.reshape(-1, 2), np.ravel(checksums), views.reshape(-1, *self.size), strict=True
        ):
            if count:
                packed = self.packed[start : start + count]
                if zlib.crc32(packed.data) != checksum:
                    raise DatasetError(f"{self.file.parent}: is damaged; delete it, and it is made again")
                PACKING.decode(packed, view)
        return views


def pack(views: NDArray[np.uint8]) -> list[bytes]:
    """The views of an object, (V, C, H, W), each packed for itself."""
    return [PACKING.encode(np.ascontiguousarray(view)) for view in views]


def save_packed(folder: Path, shape: tuple[int, ...], objects: Iterable[tuple[int, list[bytes]]]) -> Iterator[int]:
    """Write views as they come. The folder appears under its name only when it is whole.

    Args:
        folder: that ``load_packed`` reads.
        shape: (N, V, C, H, W).
        objects: some of them, each with its views packed, (i, V packed views).

    Yields:
        Objects written so far.
    """
    places, checksums = np.zeros((*shape[:2], 2), np.int64), np.zeros(shape[:2], np.uint32)
    with written_whole(folder) as part:
        part.mkdir()
        with open(part / "views.lz4", "wb") as file:
            for total, (i, packed) in enumerate(objects, 1):
                counts = np.array([len(view) for view in packed])
                places[i] = np.stack([file.tell() + np.cumsum(counts) - counts, counts], 1)
                checksums[i] = [zlib.crc32(view) for view in packed]
                file.writelines(packed)
                yield total
        np.savez(part / "index.npz", places=places, size=shape[2:], checksums=checksums)


def load_packed(folder: Path) -> PackedViews:
    """Views that ``save_packed`` wrote.

    Raises:
        DatasetError: the file of the views is not as long as it was, or its index cannot be read. Bytes that changed
            are noticed when their view is read.
    """
    try:
        with open(folder / "index.npz", "rb") as file, np.load(file) as index:
            places, checksums, size = index["places"], index["checksums"], tuple(index["size"].tolist())
    except Exception as error:  # zip files and NumPy raise whatever a damaged file makes them raise
        again = "is damaged, or of an earlier nextview; delete it, and it is made again"
        raise DatasetError(f"{folder}: index.npz {again} ({error})") from None
    views, total = folder / "views.lz4", int(places[..., 1].sum())
    if views.stat().st_size != total:
        raise DatasetError(f"{folder}: is damaged; delete it, and it is made again")
    packed = np.memmap(views, np.uint8, "r") if total else np.zeros(0, np.uint8)
    return PackedViews(views, packed, places, size, checksums)


def ask_for(views: NDArray | PackedViews, places: Iterable[tuple[int, ...]]) -> None:
    """Have the disk fetch views that are read soon, all at once and nothing else.

    Left to page faults, they come one after the other, each with much around it. Views in memory are let be.

    Args:
        views: of all objects.
        places: leading indices: (object, view), or (object,) for all views of it.
    """
    if not isinstance(views, PackedViews) or not hasattr(os, "posix_fadvise"):
        return
    with open(views.file, "rb") as file:
        for place in places:
            wanted = views.places[place].reshape(-1, 2)
            os.posix_fadvise(file.fileno(), wanted[0, 0], int(wanted[:, 1].sum()), os.POSIX_FADV_WILLNEED)
