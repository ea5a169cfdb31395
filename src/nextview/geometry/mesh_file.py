"""Read mesh files: OFF and OBJ here, PLY and STL in files of their own, GLB by trimesh.

ModelNet's OFF files break the standard (``OFF490926 662722 0`` on one line), and trimesh takes a
truncated one for whole; its OBJ reader counts relative indices from the end of the file, and cuts
polygons into fans.
"""

import io
import json
import re
from array import array
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any

import numpy as np

from nextview.errors import DAMAGED, MeshError
from nextview.geometry.mesh_text import (
    lines_of_words,
    numbers,
    plain_text,
    whole_numbers,
)
from nextview.geometry.ply_file import read_ply
from nextview.geometry.stl_file import read_stl
from nextview.geometry.triangles import MAX_FACES, check_faces, triangulate
from nextview.types import Float, Index

# The letters before OFF announce texture coordinates, colours and normals, which follow each
# vertex's position. Four coordinates a vertex (4OFF), any number of them (nOFF) and binary files
# are not read.
OFF_HEADER = re.compile(
    rb"\s*(?:(?P<unread>(?:ST|C|N)*(?:4n?|(?-i:n)(?=OFF))OFF|\w*OFF["
    rb" \t]+BINARY)\b|(?:ST|C|N)*OFF(?:\b|(?=[0-9])))",
    re.IGNORECASE,
)
# Of vertices, faces and edges, on one line or on three; the last is often missing.
OFF_COUNTS = re.compile(rb"\s*(\d+)\s+(\d+)(?:\s+\d+(?=[ \t]*(?:\n|$)))?[ \t]*(?=\n|$)")
MeshArrays = tuple[Float, Index]  # vertices, (V, 3), and triangles, (F, 3)
GLB_TRIANGLES = 4
GLB_FAN = 6
GLB_NODES = 20_000  # Trimesh takes some seconds to place so many


def read_off(data: bytes, max_faces: int = MAX_FACES) -> MeshArrays:
    """Read an OFF file, strictly; with comments, blank lines, polygons and colour columns.

    Args:
        data: the file's bytes, in any encoding.
        max_faces: how many triangles there may be.

    Raises:
        MeshError, ValueError: what is wrong with the file.
    """
    text = plain_text(data)
    if b"#" in text:
        text = re.sub(rb"#[^\n]*", b"", text)

    header = OFF_HEADER.match(text)
    if header is None:
        raise MeshError("it does not begin with OFF")
    if header["unread"]:
        raise MeshError(
            f"it begins with {header[0].strip().decode()}, a kind of OFF that is not read here"
        )

    counts = OFF_COUNTS.match(text, header.end())
    if counts is None:
        raise MeshError("the counts of vertices and faces are missing")
    n_vertices = int(counts[1])
    n_faces = int(counts[2])

    body = text[counts.end() :]
    plain = _plain_off(body, n_vertices, n_faces)
    return plain or _off_by_lines(body, n_vertices, n_faces, max_faces)


def _plain_off(body: bytes, n_vertices: int, n_faces: int) -> MeshArrays | None:
    """The usual case at full speed: three numbers a line, then triangles alone.

    None if the file is anything else.
    """
    body = body.strip()
    ends = np.flatnonzero(np.frombuffer(body, np.uint8) == ord("\n"))
    if (
        min(n_vertices, n_faces) == 0
        or len(ends) != n_vertices + n_faces - 1
        or re.search(rb"\n[ \t]*\n", body)
    ):
        return None

    middle = int(ends[n_vertices - 1])
    try:
        vertices = numbers(body[:middle])
        faces = whole_numbers(body[middle:])
    except ValueError:
        return None

    if (
        len(vertices) != 3 * n_vertices
        or len(faces) != 4 * n_faces
        or (faces[::4] != 3).any()
    ):
        return None

    triangles = faces.reshape(-1, 4)[:, 1:]
    return (
        None if triangles.max() >= n_vertices else (vertices.reshape(-1, 3), triangles)
    )


def _off_by_lines(
    body: bytes,
    n_vertices: int,
    n_faces: int,
    max_faces: int,
) -> MeshArrays:
    lines = lines_of_words(body)
    positions = array("d")
    corners = array("q")
    sizes = array("q")
    for i, words in enumerate(islice(lines, n_vertices)):
        positions.extend(_coordinates(words, i))

    for words in islice(lines, n_faces):
        sides = int(words[0])
        if sides < 0 or len(words) < 1 + sides:
            raise MeshError(
                f"face {len(sizes)} has {len(words) - 1} of {sides} corners"
            )
        polygon = list(map(int, words[1 : 1 + sides]))
        if polygon and not 0 <= min(polygon) <= max(polygon) < n_vertices:
            raise MeshError(
                f"face {len(sizes)} refers to a vertex outside of the {n_vertices} that there are"
            )
        corners.extend(polygon)
        sizes.append(sides)

    if (len(positions), len(sizes)) != (3 * n_vertices, n_faces):
        what = f"the file is cut short, {n_vertices} vertices and {n_faces} faces announced"
        raise MeshError(f"{what}, {len(positions) // 3} and {len(sizes)} found")
    return _shape(positions, corners, sizes, max_faces)


def read_obj(data: bytes, max_faces: int = MAX_FACES) -> MeshArrays:
    """Read an OBJ file; its parts are joined.

    Args:
        data: the file's bytes, in any encoding.
        max_faces: how many triangles there may be.

    Raises:
        MeshError, ValueError: what is wrong with the file.
    """
    text = plain_text(data).replace(b"\\\n", b" ")
    positions = array("d")  # lists of Python's numbers take ten times as much memory
    corners = array("q")
    sizes = array("q")
    count = 0
    for word, *words in lines_of_words(text):
        if word in (b"v", b"V"):
            positions.extend(_coordinates(words, count))
            count += 1
        elif word in (b"f", b"F"):
            if len(words) < 3:
                raise MeshError(
                    f"cut short, a face has {len(words)} of 3 or more corners"
                )
            asked = [int(word.partition(b"/")[0]) for word in words]
            # below 0 from the last so far
            polygon = [index - 1 if index > 0 else count + index for index in asked]
            if 0 in asked or min(polygon) < 0 or max(polygon) >= len(text):
                raise MeshError(
                    f"a face refers to vertices {asked}, but the first is 1 and {count} come"
                    " before it"
                )
            corners.extend(polygon)
            sizes.append(len(polygon))
    named = np.array(corners)
    if named.size and named.max() >= count:
        raise MeshError(
            f"a face refers to vertex {named.max() + 1}, but there are only {count} vertices"
        )
    return _shape(positions, corners, sizes, max_faces)


def _coordinates(words: list[bytes], vertex: int) -> Iterator[float]:
    if len(words) < 3:
        raise MeshError(f"cut short, vertex {vertex} has {len(words)} of 3 coordinates")
    return map(float, words[:3])


def _shape(
    positions: array,
    corners: array,
    sizes: array,
    max_faces: int,
) -> MeshArrays:
    """Return vertices and triangles from flat coordinates and polygons; see ``triangulate``."""
    vertices = np.array(positions).reshape(-1, 3)
    return vertices, triangulate(
        vertices,
        np.array(corners, np.int64),
        np.array(sizes, np.int64),
        max_faces,
    )


def read_glb(data: bytes, max_faces: int = MAX_FACES) -> MeshArrays:
    """Read a GLB file, all its parts in place.

    Args:
        data: the file's bytes.
        max_faces: how many triangles there may be.

    Raises:
        MeshError: what is wrong with the file.
    """
    try:
        _check_glb(data)
        parts = _glb_parts(data)
    except (MeshError, MemoryError):
        raise
    # the last two are what trimesh raises on purpose
    except (*DAMAGED, AssertionError, NameError) as error:
        raise MeshError(f"{type(error).__name__}: {error}") from error
    check_faces(sum(len(shape.faces) for _, shape in parts), max_faces)
    vertices = [np.zeros((0, 3))]
    faces = [np.zeros((0, 3), np.int64)]
    count = 0
    for matrix, shape in parts:
        vertices.append(shape.vertices @ matrix[:3, :3].T + matrix[:3, 3])
        faces.append(shape.faces + count)
        count += len(shape.vertices)
    return np.concatenate(vertices), np.concatenate(faces)


def _glb_parts(data: bytes) -> list[tuple[Float, Any]]:
    """The meshes of a GLB file, each with the matrix, (4, 4), that puts it in its place."""
    import trimesh

    scene = trimesh.load_scene(
        io.BytesIO(data),
        "glb",
        process=False,
        skip_materials=True,
    )
    nodes = [scene.graph.get(node) for node in scene.graph.nodes_geometry]
    placed = [(matrix, scene.geometry[name]) for matrix, name in nodes]
    return [
        (matrix, shape)
        for matrix, shape in placed
        if isinstance(shape, trimesh.Trimesh)
    ]


def _check_glb(data: bytes) -> None:
    """Check what the JSON announces, and refuse what trimesh would misread."""
    if data[:4] != b"glTF" or int.from_bytes(data[8:12], "little") != len(data):
        raise MeshError(
            "it does not begin with glTF, or is not as long as it announces"
        )
    gltf = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    accessors, nodes, views = (
        gltf.get(key, []) for key in ("accessors", "nodes", "bufferViews")
    )

    # what trimesh would allocate without reading it
    taken = [
        a["count"]
        for a in accessors
        if "bufferView" not in a or "byteStride" in views[a["bufferView"]]
    ]
    if sum(taken) > len(data) or sum(view["byteLength"] for view in views) > 2 * len(
        data
    ):
        raise MeshError("it announces more numbers than its bytes hold")

    if any("uri" in buffer for buffer in gltf.get("buffers", [])):
        raise MeshError(
            "it keeps numbers outside of its binary part, which is not read here"
        )

    roots = (
        gltf["scenes"][gltf.get("scene", 0)].get("nodes", [])
        if "scenes" in gltf
        else []
    )
    placed = [*roots, *(child for node in nodes for child in node.get("children", []))]
    if (
        len(placed) != len(set(placed))
        or len(nodes) > GLB_NODES
        or min(placed, default=0) < 0
    ):
        raise MeshError(
            f"a node is in its scene twice, or there are more than {GLB_NODES:,}"
        )

    for part in (
        part for mesh in gltf.get("meshes", []) for part in mesh["primitives"]
    ):
        used = [accessors[part[key]] for key in ("indices",) if key in part]
        used.append(accessors[part["attributes"]["POSITION"]])
        if part.get("mode", GLB_TRIANGLES) == GLB_FAN:
            raise MeshError("it has fans of triangles, which are not read here")
        if any(
            "bufferView" not in accessor or "sparse" in accessor for accessor in used
        ):
            raise MeshError(
                "its positions or faces are compressed, sparse or without data, which is not read"
                " here"
            )
        if any(accessor.get("normalized") for accessor in used):
            raise MeshError(
                "its positions are fractions of whole numbers, which are not read here"
            )
        if min(accessor["count"] for accessor in used) < 0:
            raise MeshError("it announces a negative number of elements")


READERS: dict[
    str,
    Callable[[bytes, int], MeshArrays],
] = {  # by the suffix of a file's name
    ".off": read_off,
    ".obj": read_obj,
    ".ply": read_ply,
    ".stl": read_stl,
    ".glb": read_glb,
}
