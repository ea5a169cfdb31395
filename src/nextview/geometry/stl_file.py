"""Read STL files, binary and text.

Trimesh takes the words "vertex" and "endsolid" in a solid's name for the format's own, does not
know "end solid", refuses bytes after a binary file's end, and logs a traceback where normals are
missing.
"""

import re

import numpy as np

from nextview.errors import MeshError
from nextview.geometry.mesh_text import encoding_of, numbers, plain_text
from nextview.geometry.triangles import MAX_FACES, check_faces, triangulate
from nextview.types import Float, Index

HEADER_BYTES = 84
# 50 bytes
FACET = np.dtype(
    [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
)
# A line that begins or ends a solid; what follows is its name, which may be any text.
SOLID_LINE = re.compile(
    rb"^[ \t]*(end[ \t]*)?solid\b[^\n]*",
    re.MULTILINE | re.IGNORECASE,
)
LOOP_WORDS = re.compile(
    rb"\bvertex\s++(\S++\s++\S++\s++\S++)|\bendloop\b",
    re.IGNORECASE,
)


def read_stl(data: bytes, max_faces: int = MAX_FACES) -> tuple[Float, Index]:
    """Read an STL file.

    Args:
        data: the file's bytes. Which kind it is tells its length: many binary files begin with the
            word solid.
        max_faces: how many triangles there may be.

    Returns:
        Vertices, (V, 3), and triangles, (F, 3). Every triangle has vertices of its own, as in the
        file.

    Raises:
        MeshError, ValueError: what is wrong with the file.
    """
    announced = int.from_bytes(data[HEADER_BYTES - 4 : HEADER_BYTES], "little")
    needed = HEADER_BYTES + FACET.itemsize * announced
    if len(data) != needed and _begins_as_text(data):
        return _read_text(plain_text(data), max_faces)
    if len(data) < max(needed, HEADER_BYTES):
        raise MeshError(
            f"the file is cut short or damaged, {announced} faces do not take {len(data)} bytes"
        )

    held, rest = divmod(len(data) - HEADER_BYTES, FACET.itemsize)
    if held > announced and rest == 0:  # other bytes after the end are somebody's notes
        raise MeshError(f"it announces {announced} faces, but holds {held}")

    check_faces(announced, max_faces)
    facets = np.frombuffer(data, FACET, announced, HEADER_BYTES)

    with np.errstate(
        invalid="ignore"
    ):  # of numbers that are none, which are refused with the mesh
        vertices = facets["corners"].reshape(-1, 3).astype(np.float64)

    return vertices, np.arange(len(vertices)).reshape(-1, 3)


def _begins_as_text(data: bytes) -> bool:
    """Return whether a file begins with the word solid and is not binary."""
    encoding, mark = encoding_of(data)
    head = data[mark : mark + 4 * HEADER_BYTES].decode(encoding, "replace")[
        :HEADER_BYTES
    ]
    return head.lstrip()[:5].lower() == "solid" and "\0" not in head


def _read_text(text: bytes, max_faces: int) -> tuple[Float, Index]:
    """A text file of one solid or of several; a loop of more than three vertices is a polygon."""
    ends = [bool(match[1]) for match in SOLID_LINE.finditer(text)]
    if 2 * sum(ends) != len(ends):
        raise MeshError("the file is cut short, endsolid is missing")
    # three numbers of each vertex, nothing at the end of a loop
    found = LOOP_WORDS.findall(SOLID_LINE.sub(b"", text))
    loops = np.flatnonzero([not vertex for vertex in found])
    if len(found) and (len(loops) == 0 or loops[-1] != len(found) - 1):
        raise MeshError("the file is cut short, endloop is missing")
    coordinates = numbers(b" ".join(found))
    if len(coordinates) != 3 * (len(found) - len(loops)):
        raise MeshError("its vertices contain something other than numbers")
    vertices = coordinates.reshape(-1, 3)
    sizes = np.diff(loops, prepend=-1) - 1
    return vertices, triangulate(vertices, np.arange(len(vertices)), sizes, max_faces)
