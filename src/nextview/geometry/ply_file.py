"""Read PLY files: text and binary, polygons of any size, and triangle strips.

Trimesh does not read binary files in which the polygons have different numbers of corners, and
takes strips for points; meshio does not read strips either. A text file is read as a binary one
whose numbers are all of one kind.
"""

import re
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.errors import MeshError
from nextview.geometry.mesh_text import encoding_of, numbers, plain_text
from nextview.geometry.triangles import MAX_FACES, check_faces, no_faces, triangulate
from nextview.types import Float, Index

NUMBER_KINDS = {  # the format's names of its numbers, and those that are found in the wild
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float16": "f2",
    "float32": "f4",
    "float64": "f8",
}
FORMAT_CODES = {
    "i1": "b",
    "u1": "B",
    "i2": "h",
    "u2": "H",
    "i4": "i",
    "u4": "I",
    "i8": "q",
    "u8": "Q",
    "f8": "d",
}
BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
CORNER_LISTS = ("vertex_indices", "vertex_index")
BYTES_OF_NUMBER = 8  # of a text, all of which are read as doubles
STRIP_END = -1  # among the vertices of a strip: here another one begins

# of polygons, one after the other, and how many each has
Corners = tuple[Index, Index]
Scalars = dict[str, NDArray]  # a number of each row, by the name of the property
# what all the lists of a property hold, and their lengths
Lists = dict[str, tuple[NDArray, Index]]


@dataclass(frozen=True)
class Property:
    """A column of an element.

    Attributes:
        name: its name.
        kind: the type of its numbers.
        count: of a list: the type of its length, which stands before it; None for a single number.
    """

    name: str
    kind: np.dtype
    count: np.dtype | None = None


@dataclass(frozen=True)
class Element:
    """A table of a file.

    Attributes:
        name: "vertex", "face", ...
        rows: how many rows it has.
        properties: its columns.
    """

    name: str
    rows: int
    properties: tuple[Property, ...]

    @property
    def lists(self) -> tuple[Property, ...]:
        """Those of its columns that are lists."""
        return tuple(column for column in self.properties if column.count is not None)


def read_ply(data: bytes, max_faces: int = MAX_FACES) -> tuple[Float, Index]:
    """Read a PLY file.

    Args:
        data: the file's bytes. What follows the last row is not looked at.
        max_faces: how many triangles there may be.

    Returns:
        Vertices, (V, 3), and triangles, (F, 3).

    Raises:
        MeshError, ValueError: what is wrong with the file, or what it holds instead of faces.
    """
    is_text, elements, body = _open(data)
    row_bytes = None
    if is_text:
        body, row_bytes = _numbers_of_rows(
            body,
            sum(element.rows for element in elements),
        )

    at = 0
    row = 0
    scalars: dict[str, Scalars] = {}
    lists: dict[str, Lists] = {}
    for element in elements:
        scalars[element.name], lists[element.name], sizes = _read_element(
            body,
            at,
            element,
        )
        sizes = np.broadcast_to(sizes, element.rows)
        if row_bytes is not None:
            _check_rows(element, row_bytes[row : row + element.rows], sizes)
        at += int(sizes.sum())
        row += element.rows

    vertices = _vertices(scalars.get("vertex", {}))
    faces = triangulate(vertices, *_corners("face", lists), max_faces)
    strips = triangulate(
        vertices,
        *_strips(*_corners("tristrips", lists), max_faces),
        max_faces,
    )
    if len(faces) + len(strips) == 0 and len(vertices):
        _say_what_it_is(elements, len(vertices))
    return vertices, np.concatenate([faces, strips])


def _check_rows(element: Element, there: Index, wanted: Index) -> None:
    """Refuse rows with more or fewer numbers than the header announces."""
    wrong = np.flatnonzero(there != wanted)
    if len(wrong):
        row = int(wrong[0])
        numbers_there = there[row] // BYTES_OF_NUMBER
        numbers_wanted = wanted[row] // BYTES_OF_NUMBER
        said = f"row {row} of element {element.name} has {numbers_there} numbers"
        raise MeshError(f"{said}, not {numbers_wanted} as the header says")


def _open(data: bytes) -> tuple[bool, list[Element], bytes]:
    """Return whether a file is text, its elements that have rows, and its body."""
    encoding, mark = encoding_of(data)
    data = data[mark:] if encoding == "utf-8" else plain_text(data)
    first = re.match(rb"ply[ \t]*(\r?\n|\r)", data)
    if first is None:
        raise MeshError("it does not begin with ply")
    # The line ends of the first line are those of the header's last one: a byte of what follows may
    # look like one.
    ending = rb"\r" if first[1] == b"\r" else rb"\r?\n"
    end = re.compile(rb"[\r\n]end_header[ \t]*" + ending).search(data)
    if end is None:
        raise MeshError("its header does not end with end_header")
    lines = [
        line.decode("latin-1").split() for line in data[: end.start()].splitlines()
    ]
    order = next(
        (words[1] for words in lines if words[:1] == ["format"] and len(words) > 1),
        "missing",
    )
    if order not in BYTE_ORDERS:
        raise MeshError(f"its format is one of {', '.join(BYTE_ORDERS)}, not {order}")
    is_text = order == "ascii"
    if encoding != "utf-8" and not is_text:
        raise MeshError(
            f"it is a binary file that was saved as {encoding.upper()} text, by an editor"
        )

    body = data[end.end() :]
    elements = [
        element
        for element in _elements(lines, is_text, BYTE_ORDERS[order])
        if element.rows
    ]
    if sum(element.rows for element in elements) > len(body):
        raise MeshError(
            "the file is cut short, its header announces more rows than there are"
        )
    return is_text, elements, body


def _elements(lines: list[list[str]], is_text: bool, order: str) -> list[Element]:
    """The elements that a header announces, without those that have no columns.

    Args:
        lines: the words of each line of the header.
        is_text: whether the rows are text, of which all numbers are read as doubles.
        order: of the bytes, as NumPy has it.
    """
    found: list[tuple[str, int, list[Property]]] = []
    for words in lines:
        if words[:1] == ["element"]:
            name, rows = _name_and_rows(words)
            if name in (earlier for earlier, _, _ in found):
                raise MeshError(f"its header has two elements {name}")
            found.append((name, rows, []))
        elif words[:1] == ["property"]:
            if not found:
                raise MeshError(
                    f"its header has the line {' '.join(words)!r} before any element"
                )
            found[-1][2].append(_property(words, is_text, order))
    return [
        Element(name, rows, tuple(properties))
        for name, rows, properties in found
        if properties
    ]


def _name_and_rows(words: list[str]) -> tuple[str, int]:
    """What a line "element NAME ROWS" says."""
    if len(words) != 3 or not words[2].lstrip("-").isdecimal():
        raise _bad_line(words)
    rows = int(words[2])
    if rows < 0:
        raise MeshError(f"its header announces {rows} rows of element {words[1]}")
    return words[1], rows


def _property(words: list[str], is_text: bool, order: str) -> Property:
    """What a line "property KIND NAME" or "property list KIND KIND NAME" says."""
    is_list = words[1:2] == ["list"]
    kinds = words[2:-1] if is_list else words[1:-1]
    if len(kinds) != (2 if is_list else 1) or not NUMBER_KINDS.keys() >= set(kinds):
        raise _bad_line(words)
    types = [
        np.dtype("f8" if is_text else order + NUMBER_KINDS[kind]) for kind in kinds
    ]
    return Property(words[-1], types[-1], types[0] if is_list else None)


def _bad_line(words: list[str]) -> MeshError:
    return MeshError(
        f"its header has the line {' '.join(words)!r}, which is none of a PLY file"
    )


def _numbers_of_rows(body: bytes, rows: int) -> tuple[bytes, Index]:
    """Return the numbers of a text file's rows, and the bytes of each row, (rows,).

    The numbers are doubles, a line for each row.
    """
    text = plain_text(body)
    characters = np.frombuffer(text, np.uint8)
    white = characters <= ord(" ")
    begins = np.flatnonzero(~white & np.concatenate([[True], white[:-1]]))  # of words
    line_ends = np.append(np.flatnonzero(characters == ord("\n")), len(text))
    words = np.diff(np.searchsorted(begins, line_ends), prepend=0)
    words = words[words > 0][:rows]
    if len(words) < rows:
        raise MeshError(
            "the file is cut short, its header announces more rows than there are"
        )
    total = int(words.sum())
    found = numbers(text if total == len(begins) else text[: begins[total]])
    if len(found) != total:
        raise MeshError("its rows contain something other than numbers")
    return found.tobytes(), BYTES_OF_NUMBER * words


def _read_element(
    data: bytes,
    at: int,
    element: Element,
) -> tuple[Scalars, Lists, Index]:
    """Read the columns of an element, and the bytes of each row.

    These are (rows,), or () if all are equal.

    Args:
        data: the bytes that the rows stand in.
        at: the byte with which they begin.
        element: whose rows they are.

    Raises:
        MeshError: there are fewer bytes than the rows need, or the length of a list is none.
    """
    least = sum(
        column.kind.itemsize if column.count is None else column.count.itemsize
        for column in element.properties
    )
    if at + element.rows * least > len(data):
        raise MeshError(
            "the file is cut short, its header announces more rows than there are"
        )

    first_row, _ = _walk(data, at, element, 1)
    lengths = {name: int(own[0, 1]) for name, own in first_row.items()}
    table = _table(data, at, element, lengths)
    if table is not None:
        return table
    return _columns(data, at, element)


def _columns(data: bytes, at: int, element: Element) -> tuple[Scalars, Lists, Index]:
    """As ``_read_element``, of rows with lists of different lengths."""
    found, ends = _walk(data, at, element, element.rows)
    scalars: Scalars = {}
    lists: Lists = {}
    place = np.append(at, ends[:-1])  # in each row, of the next column

    for column in element.properties:
        if column.count is None:
            scalars[column.name] = _gathered(data, place, column.kind)
            place = place + column.kind.itemsize
            continue
        starts, counts = found[column.name].T
        before = np.cumsum(counts) - counts
        within = np.arange(int(counts.sum())) - np.repeat(before, counts)
        places = np.repeat(starts, counts) + within * column.kind.itemsize
        lists[column.name] = (_gathered(data, places, column.kind), counts)
        place = starts + counts * column.kind.itemsize

    return scalars, lists, np.diff(ends, prepend=at)


def _gathered(data: bytes, places: Index, kind: np.dtype) -> NDArray:
    """The numbers that begin at some bytes, (n,)."""
    held = np.frombuffer(data, np.uint8)
    single_bytes = np.empty((len(places), kind.itemsize), np.uint8)
    # one after the other: an index of all would take eight times the memory
    for byte in range(kind.itemsize):
        single_bytes[:, byte] = held[places + byte]
    return single_bytes.view(kind)[:, 0]


def _table(
    data: bytes,
    at: int,
    element: Element,
    lengths: dict[str, int],
) -> tuple[Scalars, Lists, Index] | None:
    """Read an element whose lists of a column all have one length; None if they do not.

    This is ``_read_element`` at full speed.
    """
    width = sum(
        column.kind.itemsize * lengths.get(column.name, 1)
        for column in element.properties
    )
    width += sum(
        column.count.itemsize for column in element.lists if column.count is not None
    )
    if at + element.rows * width > len(data):
        return None

    scalars: Scalars = {}
    lists: Lists = {}
    for column in element.properties:
        if column.count is None:
            scalars[column.name] = np.ndarray(
                element.rows,
                column.kind,
                data,
                at,
                width,
            )
            at += column.kind.itemsize
            continue

        length = lengths[column.name]
        counts = np.ndarray(element.rows, column.count, data, at, width)
        if (counts != length).any():
            return None
        at += column.count.itemsize

        size = column.kind.itemsize
        held = np.ndarray(
            (element.rows, length),
            column.kind,
            data,
            at if length else 0,
            (width, size),
        )
        lists[column.name] = (held.reshape(-1), counts.astype(np.int64))
        at += size * length

    return scalars, lists, np.array(width)


def _walk(
    data: bytes,
    at: int,
    element: Element,
    rows: int,
) -> tuple[dict[str, Index], Index]:
    """Return start and length of each list, (rows, 2) by column, and the end of each row."""
    steps = []
    skipped = 0
    for column in element.properties:
        if column.count is None:
            skipped += column.kind.itemsize
            continue
        code = FORMAT_CODES.get(column.count.str[1:])
        if code is None:
            raise MeshError(
                f"the lengths of its lists {column.name} are not whole numbers"
            )
        order = column.count.str[0].replace("|", "=")
        count = struct.Struct(order + code)
        steps.append((skipped, count.unpack_from, count.size, column.kind.itemsize))
        skipped = 0

    found = np.empty((rows, len(steps), 2), np.int64)
    ends = np.empty(rows, np.int64)
    for row in range(rows):
        for which, (before, count_at, count_bytes, item_bytes) in enumerate(steps):
            at += before
            if at + count_bytes > len(data):
                raise MeshError(
                    f"the file is cut short in row {row:,} of element {element.name}"
                )
            (length,) = count_at(data, at)
            if not 0 <= length <= len(data) or length != int(length):
                raise MeshError(
                    f"row {row:,} of element {element.name} announces a list of {length:g} numbers"
                )
            at += count_bytes
            found[row, which] = at, length
            at += int(length) * item_bytes
        at += skipped
        ends[row] = at
    if at > len(data):
        raise MeshError(
            f"the file is cut short, the rows of its element {element.name} need more bytes"
        )
    return {
        column.name: found[:, which] for which, column in enumerate(element.lists)
    }, ends


def _vertices(columns: Scalars) -> Float:
    """Positions, (V, 3)."""
    if not columns:
        return np.zeros((0, 3))
    missing = [axis for axis in "xyz" if axis not in columns]
    if missing:
        raise MeshError(f"its vertices have no {', '.join(missing)}")
    with np.errstate(
        invalid="ignore"
    ):  # of numbers that are none, which are refused with the mesh
        return np.stack([columns[axis].astype(np.float64) for axis in "xyz"], 1)


def _corners(element: str, lists: dict[str, Lists]) -> Corners:
    """Return the vertices that the rows of an element name, and how many each names."""
    columns = lists.get(element, {})
    if not columns:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    name = next((name for name in CORNER_LISTS if name in columns), None)
    if name is None and len(columns) > 1:
        raise MeshError(
            f"none of the lists of its element {element} is called {' or '.join(CORNER_LISTS)}"
        )
    named, sizes = columns[name or next(iter(columns))]
    with np.errstate(invalid="ignore"):
        corners = named.astype(np.int64)
    if (corners != named).any():
        raise MeshError(f"an index of its element {element} is not a whole number")
    return corners, sizes


def _strips(corners: Index, sizes: Index, max_faces: int) -> Corners:
    """Return the triangles of strips, with every second one wound the other way."""
    check_faces(
        int(np.maximum(sizes - 2, 0).sum()) - 3 * int((corners == STRIP_END).sum()),
        max_faces,
    )
    row = np.repeat(np.arange(len(sizes)), sizes)
    place = np.arange(len(corners))
    begins = np.diff(row, prepend=-1) > 0
    begins[1:] |= corners[:-1] == STRIP_END
    odd = (place - np.maximum.accumulate(np.where(begins, place, 0)))[
        : max(len(place) - 2, 0)
    ] % 2 == 1

    threes = np.stack([corners[:-2], corners[1:-1], corners[2:]], 1)
    threes[odd] = threes[odd][:, [1, 0, 2]]
    whole = (row[:-2] == row[2:]) & (threes != STRIP_END).all(1)
    # a strip turns by naming a vertex twice
    distinct = (threes != np.roll(threes, 1, axis=1)).all(1)
    threes = threes[whole & distinct]
    return threes.reshape(-1), np.full(len(threes), 3)


def _say_what_it_is(elements: list[Element], n_vertices: int) -> None:
    """Raise a MeshError that tells what a file without faces holds, and what to do about it."""
    names = {element.name for element in elements}
    columns = {
        column.name
        for element in elements
        if element.name == "vertex"
        for column in element.properties
    }

    if "range_grid" in names:
        one_side = (
            "a range grid, which is one depth image: it shows the object from one side"
        )
        raise MeshError(
            f"it holds {one_side}; merge the grids of all sides to a mesh, or teach depth frames"
        )

    if "f_dc_0" in columns:
        raise MeshError(
            f"it holds {n_vertices:,} Gaussian splats and no faces; export a mesh from the splats"
            " first"
        )

    raise MeshError(no_faces(n_vertices, {"nx", "ny", "nz"} <= columns))
