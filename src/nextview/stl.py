"""Read STL, binary or text: the corners of each triangle in turn, so that no two triangles share a vertex."""

from __future__ import annotations

from array import array

import numpy as np
from numpy.typing import NDArray

from nextview.errors import MeshError
from nextview.mesh_format import lines_of_words

HEADER = 84
"""Bytes before the first facet of a binary file; the last four are the number of facets."""
FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(data: bytes) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (3 F, 3) float64 and triangles (F, 3) int64 of an STL file. A binary one may begin with "solid" too.

    Raises:
        MeshError: the file is cut short, is not STL, or holds something that is not a number.
    """
    if b"\0" in data[: HEADER + 1] or data.lstrip()[:5].lower() != b"solid":
        corners = _read_binary(data)
    else:
        corners = _read_text(data)
    return corners, np.arange(len(corners)).reshape(-1, 3)


def _read_binary(data: bytes) -> NDArray[np.float64]:
    if len(data) < HEADER:
        raise MeshError("the file is cut short in its header")
    announced, found = int.from_bytes(data[HEADER - 4 : HEADER], "little"), (len(data) - HEADER) / FACET.itemsize
    if announced > found:
        raise MeshError(f"the file is cut short, {announced} faces announced, {int(found)} found")
    if announced < found:
        raise MeshError(f"it is damaged, {announced} faces announced, but it is as long as {found:.10g}")
    with np.errstate(invalid="ignore"):  # some kinds of NaN
        return np.frombuffer(data, FACET, announced, HEADER)["corners"].reshape(-1, 3).astype(np.float64)


def _read_text(data: bytes) -> NDArray[np.float64]:
    corners = array("d")
    open_solids = 0
    for word, *columns in lines_of_words(data):
        word = word.lower()
        if word == b"vertex":
            if len(columns) < 3:
                raise MeshError(f"vertex {len(corners) // 3} has {len(columns)} of 3 coordinates")
            corners.extend(map(float, columns[:3]))
        elif word in (b"endloop", b"endfacet") and len(corners) % 9:
            raise MeshError(f"face {len(corners) // 9} has not three corners")
        elif word in (b"solid", b"endsolid"):
            open_solids += 1 if word == b"solid" else -1
    if open_solids or len(corners) % 9:
        raise MeshError("the file is cut short, endsolid is missing")
    return np.array(corners).reshape(-1, 3)
