"""Read the shape in an OBJ file; relative indices count back from where they stand, and index 0 is refused."""

from __future__ import annotations

from array import array

import numpy as np
from numpy.typing import NDArray

from nextview.errors import MeshError
from nextview.mesh_format import fan, lines_of_words


def read_obj(data: bytes) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (V, 3) float64 and triangles (F, 3) int64 of an OBJ file; polygons become fans, its parts are joined.

    Raises:
        MeshError: a vertex or a face is cut short or not made of numbers, or a face refers to no vertex.
    """
    positions, corners = array("d"), array("q")  # lists of Python's numbers take ten times as much memory
    count = highest = 0
    for word, *columns in lines_of_words(data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")):
        if word == b"v":
            count += 1
            if len(columns) < 3:
                raise MeshError(f"cut short, vertex {count} has {len(columns)} of 3 coordinates")
            positions.extend(map(float, columns[:3]))
        elif word == b"f":
            if len(columns) < 3:
                raise MeshError(f"cut short, a face has {len(columns)} of 3 or more corners")
            polygon = []
            for column in columns:
                index = int(column.partition(b"/")[0])  # from 1; below 0 it counts back from the last vertex so far
                if index == 0:
                    raise MeshError("a face refers to vertex 0, the first is 1")
                if index < -count:
                    raise MeshError(f"a face refers to vertex {index}, but only {count} come before it")
                polygon.append(index - 1 if index > 0 else count + index)
            highest = max(highest, *polygon)
            if highest >= len(data):  # it may not even fit into 64 bits
                raise MeshError(f"a face refers to vertex {highest + 1}, but there are only {count} before it")
            corners.extend(fan(polygon))
    if corners and highest >= count:
        raise MeshError(f"a face refers to vertex {highest + 1}, but there are only {count} vertices")
    return np.array(positions).reshape(-1, 3), np.array(corners).reshape(-1, 3)
