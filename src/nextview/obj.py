"""Read the shape in an OBJ file; trimesh counts relative indices from the file's end and takes index 0 for the last."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview.errors import MeshError


def read_obj(data: bytes) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (V, 3) float64 and triangles (F, 3) int64 of an OBJ file; polygons become fans, its parts are joined.

    Raises:
        MeshError: a vertex or a face is cut short or not made of numbers, or a face refers to no vertex.
    """
    vertices: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    highest = 0
    for line in data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines():
        word, *columns = line.partition(b"#")[0].split() or [b""]
        if word == b"v":
            if len(columns) < 3:
                raise MeshError(f"cut short, vertex {len(vertices) + 1} has {len(columns)} of 3 coordinates")
            vertices.append([float(c) for c in columns[:3]])
        elif word == b"f":
            if len(columns) < 3:
                raise MeshError(f"cut short, a face has {len(columns)} of 3 or more corners")
            polygon = []
            for column in columns:
                index = int(column.partition(b"/")[0])  # from 1; below 0 it counts back from the last vertex so far
                if index == 0:
                    raise MeshError("a face refers to vertex 0, the first is 1")
                if index < -len(vertices):
                    raise MeshError(f"a face refers to vertex {index}, but only {len(vertices)} come before it")
                polygon.append(index - 1 if index > 0 else len(vertices) + index)
            highest = max(highest, *polygon)
            triangles += [(polygon[0], polygon[k], polygon[k + 1]) for k in range(1, len(polygon) - 1)]
    if triangles and highest >= len(vertices):
        raise MeshError(f"a face refers to vertex {highest + 1}, but there are only {len(vertices)} vertices")
    return np.array(vertices).reshape(-1, 3), np.array(triangles, np.int64).reshape(-1, 3)
