"""Read OFF, ModelNet's format, strictly: a truncated file is refused, which general readers let pass.

ModelNet's own files break the standard in known ways (the counts on the first line, as in ``OFF490926 662722 0``);
those, comments, blank lines, CRLF, polygons and colour columns are all read.
"""

from __future__ import annotations

import re
from array import array
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from nextview.errors import MeshError
from nextview.mesh_format import fan, lines_of_words


def read_off(data: bytes) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (V, 3) float64 and triangles (F, 3) int64 of an OFF file; polygons become fans.

    Raises:
        MeshError: the file is not OFF, is cut short or holds something that is not a number.
    """
    if b"#" in data:
        data = re.sub(rb"#[^\r\n]*", b"", data)
    header = re.match(rb"\s*(?:ST)?(?:C|N|CN)?OFF\b|\s*OFF(?=[0-9])", data)
    if header is None:
        raise MeshError("it does not begin with OFF")
    body = data[header.end() :]
    counts = re.match(rb"\s*(\d+)\s+(\d+)(?:[ \t]+\d+)?[ \t]*(?=[\r\n]|$)", body)
    if counts is None:
        raise MeshError("the counts of vertices and faces are missing")
    vertex_count, face_count = int(counts[1]), int(counts[2])
    body = body[counts.end() :]
    plain = _read_plain(body, vertex_count, face_count)
    return plain if plain is not None else _read_lines(body, vertex_count, face_count)


def _read_plain(body: bytes, vertex_count: int, face_count: int) -> tuple[NDArray, NDArray] | None:
    """The usual case at full speed: three numbers a line, then triangles alone. None if the file is anything else."""
    body = body.strip()
    ends = np.flatnonzero(np.frombuffer(body, np.uint8) == ord("\n"))
    if min(vertex_count, face_count) == 0 or len(ends) != vertex_count + face_count - 1:
        return None
    if re.search(rb"\n[ \t\r]*\n", body):  # a blank line may hide that another one holds too much
        return None
    import warnings

    middle = int(ends[vertex_count - 1])
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            vertices = np.fromstring(body[:middle], sep=" ")
            faces = np.fromstring(body[middle:], np.int64, sep=" ")
        except (DeprecationWarning, ValueError):
            return None
    if len(vertices) != 3 * vertex_count or len(faces) != 4 * face_count or (faces[::4] != 3).any():
        return None
    indices = faces.reshape(-1, 4)[:, 1:]
    if indices.max() >= vertex_count:
        return None  # an index beyond 64 bits has been cut; the other way gives it as it is
    return vertices.reshape(-1, 3), indices


def _read_lines(body: bytes, vertex_count: int, face_count: int) -> tuple[NDArray, NDArray]:
    lines = lines_of_words(body)
    positions, corners = array("d"), array("q")
    found = [0, 0]
    for columns in islice(lines, vertex_count):
        if len(columns) < 3:
            raise MeshError(f"vertex {found[0]} has {len(columns)} of 3 coordinates")
        positions.extend(map(float, columns[:3]))
        found[0] += 1
    for columns in islice(lines, face_count):
        sides = int(columns[0])
        if sides < 0 or len(columns) < 1 + sides:
            raise MeshError(f"face {found[1]} has {len(columns) - 1} of {sides} corners")
        polygon = list(map(int, columns[1 : 1 + sides]))
        if polygon and not 0 <= min(polygon) <= max(polygon) < vertex_count:
            worst = min(polygon) if min(polygon) < 0 else max(polygon)
            raise MeshError(f"face {found[1]} refers to vertex {worst}, but there are only {vertex_count} vertices")
        corners.extend(fan(polygon))
        found[1] += 1
    if found != [vertex_count, face_count]:
        raise MeshError(
            f"the file is cut short, {vertex_count} vertices and {face_count} faces announced, "
            f"{found[0]} and {found[1]} found"
        )
    return np.array(positions).reshape(-1, 3), np.array(corners).reshape(-1, 3)
