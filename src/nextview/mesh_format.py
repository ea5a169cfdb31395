"""What the mesh formats share: lines of words, polygons as fans of triangles, and how many of these there may be."""

from __future__ import annotations

import io
from collections.abc import Iterator

from nextview.errors import MeshError

MAX_FACES = 10_000_000
"""Triangles that a mesh may have if nothing else is asked for."""
VERTICES_PER_FACE, BYTES_PER_FACE = 3, 60
"""How many vertices, and how many bytes of its file, a mesh may have for each triangle that it may have."""


def lines_of_words(data: bytes) -> Iterator[list[bytes]]:
    r"""The words of each line that has any, without comments (#); a line ends in ``\n``, ``\r\n`` or ``\r``.

    One line at a time: a list of all of them takes twenty times as much memory as the file.
    """
    for line in io.BytesIO(data.replace(b"\r", b"\n") if b"\r" in data else data):
        if words := line.partition(b"#")[0].split():
            yield words


def fan(polygon: list[int]) -> list[int]:
    """The corners of the triangles that a polygon falls into, three after three; none if it has less than three.

    >>> fan([5, 6, 7, 8])
    [5, 6, 7, 5, 7, 8]
    """
    corners = [0] * (3 * max(len(polygon) - 2, 0))
    if corners:
        corners[0::3] = polygon[:1] * (len(polygon) - 2)
        corners[1::3] = polygon[1:-1]
        corners[2::3] = polygon[2:]
    return corners


def check_faces(faces: int, max_faces: int) -> None:
    """Refuse more triangles than are wanted.

    Raises:
        MeshError: says how to have more.
    """
    if faces > max_faces:
        raise MeshError(f"it has {faces:,} triangles, more than {max_faces:,}; --max-faces (max_faces) allows more")
