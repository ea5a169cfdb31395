"""Read OFF, ModelNet's format, strictly: a truncated file is refused, which general readers let pass.

ModelNet's own files break the standard in known ways (the counts on the first line, as in ``OFF490926 662722 0``);
those, comments, blank lines, CRLF, polygons and colour columns are all read.
"""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from nextview.errors import MeshError


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
    lines = [line for line in body.splitlines() if line.strip()]
    if len(lines) < vertex_count + face_count:
        found = max(len(lines) - vertex_count, 0)
        raise MeshError(
            f"the file is cut short, {vertex_count} vertices and {face_count} faces announced, "
            f"{min(len(lines), vertex_count)} and {found} found"
        )
    vertices = np.empty((vertex_count, 3))
    for i, line in enumerate(lines[:vertex_count]):
        columns = line.split()
        if len(columns) < 3:
            raise MeshError(f"vertex {i} has {len(columns)} of 3 coordinates")
        vertices[i] = [float(c) for c in columns[:3]]
    triangles: list[tuple[int, int, int]] = []
    for i, line in enumerate(lines[vertex_count : vertex_count + face_count]):
        columns = line.split()
        corners = int(columns[0])
        if corners < 0 or len(columns) < 1 + corners:
            raise MeshError(f"face {i} has {len(columns) - 1} of {corners} corners")
        polygon = [int(c) for c in columns[1 : 1 + corners]]
        if max(polygon, default=0) >= vertex_count:
            raise MeshError(f"face {i} refers to vertex {max(polygon)}, but there are only {vertex_count} vertices")
        triangles += [(polygon[0], polygon[k], polygon[k + 1]) for k in range(1, corners - 1)]
    return vertices, np.array(triangles, np.int64).reshape(-1, 3)
