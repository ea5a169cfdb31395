"""Read the shape in a PLY file, text or binary; its polygons may be of any number of corners, and mixed.

What the header announces is held against the length of the file before any memory is taken for it.
"""

from __future__ import annotations

import re
import warnings
from array import array
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.errors import MeshError
from nextview.mesh_format import fan

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
CORNERS = ("vertex_indices", "vertex_index")
"""What the list of a face's corners is called."""


@dataclass(frozen=True)
class Property:
    """A number of each row; or a list of numbers, if it has a ``count``: the type of the list's length."""

    name: str
    type: np.dtype
    count: np.dtype | None = None


@dataclass(frozen=True)
class Element:
    """So many rows of the same properties."""

    name: str
    rows: int
    properties: list[Property]


def read_ply(data: bytes) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (V, 3) float64 and triangles (F, 3) int64 of a PLY file; polygons become fans.

    Raises:
        MeshError: the header is not one of PLY, the file is longer or shorter than it announces, or holds something
            that is not a number.
    """
    end = re.search(rb"end_header[ \t]*(\r\n|\n|\r)", data)
    if end is None:
        raise MeshError("it has no header that ends with end_header")
    kind, elements = _header(data[: end.start()].decode("latin-1"))
    body = _as_binary(data[end.end() :]) if kind == "ascii" else data[end.end() :]
    vertices, faces = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    at = 0
    for element in elements:
        if not element.rows or not element.properties:
            continue
        try:
            columns, triangles, at = _read_alike(element, body, at) or _read_rows(element, body, at)
        except IndexError:
            raise MeshError(f"the file is cut short, it ends before its {element.rows} {element.name} rows") from None
        if element.name == "vertex":
            if not {"x", "y", "z"} <= columns.keys():
                raise MeshError("its vertices have no x, y and z")
            with np.errstate(invalid="ignore"):  # some kinds of NaN
                vertices = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], 1)
        elif element.name == "face":
            faces = triangles
    if at < len(body):
        raise MeshError("it goes on after the last row that its header announces")
    return vertices, faces


def _header(header: str) -> tuple[str, list[Element]]:
    """How the numbers are written, one of ORDERS, and what there is of them."""
    lines = [line.split() for line in header.splitlines()]
    if not lines or lines[0] != ["ply"]:
        raise MeshError("it does not begin with ply")
    written, elements = "", list[Element]()
    for words in lines[1:]:
        match words:
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", kind, _] if kind in ORDERS:
                written = kind
            case ["element", name, rows] if rows.isdecimal():
                elements.append(Element(name, int(rows), []))
            case ["property", "list", count, of, name] if elements and count in TYPES and of in TYPES:
                elements[-1].properties.append(Property(name, _type(of, written), _type(count, written)))
            case ["property", of, name] if elements and of in TYPES:
                elements[-1].properties.append(Property(name, _type(of, written)))
            case _:
                raise MeshError(f"a line of its header is not PLY ({' '.join(words)[:60]})")
    return written, elements


def _type(name: str, written: str) -> np.dtype:
    """How a number lies in the file; that of a text becomes float64, see ``_as_binary``."""
    if not written:
        raise MeshError("its header does not begin with the format")
    return np.dtype("<f8" if written == "ascii" else ORDERS[written] + TYPES[name])


def _as_binary(text: bytes) -> bytes:
    """The numbers of a text as float64, one after the other: so both kinds of files are read alike."""
    if not (text := text.strip()):
        return b""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(text, sep=" ").tobytes()
        except (DeprecationWarning, ValueError):
            raise MeshError("it holds something that is not a number") from None


def _read_alike(element: Element, body: bytes, at: int) -> tuple[dict[str, NDArray], NDArray[np.int64], int] | None:
    """The usual case at full speed: lists that are as long in every row. None if they are not.

    Returns:
        The numbers of all rows by name, lists left out; the triangles of the lists of corners; where the element ends.
    """
    fields, lengths, end = list[Any](), dict[int, int](), at
    for i, p in enumerate(element.properties):
        if p.count is not None:
            lengths[i], end = _length(p, body, end)
            fields.append((f"length {i}", p.count))
        fields.append((f"{i}", p.type, (lengths[i],) if i in lengths else ()))
        end += p.type.itemsize * lengths.get(i, 1)
    row = np.dtype(fields)
    if len(body) - at < element.rows * row.itemsize:
        if lengths:
            return None
        raise IndexError
    rows = np.frombuffer(body, row, element.rows, at)
    if any((rows[f"length {i}"] != length).any() for i, length in lengths.items()):
        return None
    numbers = {p.name: rows[f"{i}"] for i, p in enumerate(element.properties)}
    polygons = next((_indices(numbers[name]) for name in CORNERS if name in numbers and numbers[name].ndim == 2), None)
    triangles = np.zeros((0, 3), np.int64)
    if polygons is not None and polygons.shape[1] > 2:
        triangles = polygons[:, fan(list(range(polygons.shape[1])))].reshape(-1, 3)
    return numbers, triangles, at + rows.nbytes


def _read_rows(element: Element, body: bytes, at: int) -> tuple[dict[str, NDArray], NDArray[np.int64], int]:
    """As ``_read_alike``, row by row, and without the numbers."""
    corners = array("q")
    for _ in range(element.rows):
        for p in element.properties:
            length = 1
            if p.count is not None:
                length, at = _length(p, body, at)
            end = at + length * p.type.itemsize
            if end > len(body):
                raise IndexError
            if p.count is not None and p.name in CORNERS:
                corners.extend(fan(_indices(np.frombuffer(body, p.type, length, at)).tolist()))
            at = end
    return {}, np.array(corners).reshape(-1, 3), at


def _length(of: Property, body: bytes, at: int) -> tuple[int, int]:
    """Of the list that begins here, and where its first number is.

    Raises:
        IndexError: the file ends before the list does.
    """
    assert of.count is not None
    first = at + of.count.itemsize
    if first > len(body):
        raise IndexError
    length = int(_indices(np.frombuffer(body, of.count, 1, at))[0])
    if length < 0:
        raise MeshError(f"a list has the length {length}")
    if first + length * of.type.itemsize > len(body):
        raise IndexError
    return length, first


def _indices(numbers: NDArray) -> NDArray[np.int64]:
    """The same as whole numbers.

    Raises:
        MeshError: they are not.
    """
    with np.errstate(invalid="ignore"):
        whole = numbers.astype(np.int64)
    if numbers.dtype.kind == "f" and (whole != numbers).any():
        raise MeshError(f"{numbers[whole != numbers][0]:g} is not the number of a vertex")
    return whole
