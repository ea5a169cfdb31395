"""Read mesh files. PLY, STL and GLB by trimesh, after what they announce was held against their size.

OFF and OBJ are read here. ModelNet's OFF files break the standard (``OFF490926 662722 0`` on one line), and trimesh
takes a truncated one for whole; its OBJ reader counts relative indices from the end of the file.
"""

import io
import json
import re
import warnings
from array import array
from collections.abc import Iterator
from itertools import islice, pairwise

import numpy as np
from numpy.typing import NDArray

from nextview.errors import MeshError

Shape = tuple[NDArray[np.float64], NDArray[np.int64]]  # vertices, (V, 3), and triangles, (F, 3)
STL_HEADER, STL_FACET = 84, 50
GLB_TRIANGLES, GLB_STRIP, GLB_FAN = 4, 5, 6
GLB_NODES = 20_000  # Trimesh takes some seconds to place so many


def read_off(data: bytes) -> Shape:
    """An OFF file, strictly; with comments, blank lines, CRLF, polygons and colour columns. Polygons become fans."""
    if b"#" in data:
        data = re.sub(rb"#[^\r\n]*", b"", data)
    header = re.match(rb"\s*(?:ST)?(?:C|N|CN)?OFF\b|\s*OFF(?=[0-9])", data)
    if header is None:
        raise MeshError("it does not begin with OFF")
    counts = re.compile(rb"\s*(\d+)\s+(\d+)(?:[ \t]+\d+)?[ \t]*(?=[\r\n]|$)").match(data, header.end())
    if counts is None:
        raise MeshError("the counts of vertices and faces are missing")
    n_vertices, n_faces = int(counts[1]), int(counts[2])
    body = data[counts.end() :]
    return _plain_off(body, n_vertices, n_faces) or _off_by_lines(body, n_vertices, n_faces)


def _plain_off(body: bytes, n_vertices: int, n_faces: int) -> Shape | None:
    """The usual case at full speed: three numbers a line, then triangles alone. None if the file is anything else."""
    body = body.strip()
    ends = np.flatnonzero(np.frombuffer(body, np.uint8) == ord("\n"))
    if min(n_vertices, n_faces) == 0 or len(ends) != n_vertices + n_faces - 1 or re.search(rb"\n[ \t\r]*\n", body):
        return None
    middle = int(ends[n_vertices - 1])
    try:
        with _numbers_only():
            vertices, faces = np.fromstring(body[:middle], sep=" "), np.fromstring(body[middle:], np.int64, sep=" ")
    except (DeprecationWarning, ValueError):
        return None
    if len(vertices) != 3 * n_vertices or len(faces) != 4 * n_faces or (faces[::4] != 3).any():
        return None
    triangles = faces.reshape(-1, 4)[:, 1:]
    return None if triangles.max() >= n_vertices else (vertices.reshape(-1, 3), triangles)


def _off_by_lines(body: bytes, n_vertices: int, n_faces: int) -> Shape:
    lines = _lines_of_words(body)
    positions, corners = array("d"), array("q")
    for i, words in enumerate(islice(lines, n_vertices)):
        positions.extend(_coordinates(words, i))
    found = 0
    for words in islice(lines, n_faces):
        sides = int(words[0])
        if sides < 0 or len(words) < 1 + sides:
            raise MeshError(f"face {found} has {len(words) - 1} of {sides} corners")
        polygon = list(map(int, words[1 : 1 + sides]))
        if polygon and not 0 <= min(polygon) <= max(polygon) < n_vertices:
            raise MeshError(f"face {found} refers to a vertex outside of the {n_vertices} that there are")
        corners.extend(_fan(polygon))
        found += 1
    if (len(positions), found) != (3 * n_vertices, n_faces):
        what = f"the file is cut short, {n_vertices} vertices and {n_faces} faces announced"
        raise MeshError(f"{what}, {len(positions) // 3} and {found} found")
    return np.array(positions).reshape(-1, 3), np.array(corners).reshape(-1, 3)


def read_obj(data: bytes) -> Shape:
    """An OBJ file; polygons become fans, its parts are joined."""
    positions, corners = array("d"), array("q")  # lists of Python's numbers take ten times as much memory
    count = 0
    for word, *words in _lines_of_words(data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")):
        if word == b"v":
            positions.extend(_coordinates(words, count))
            count += 1
        elif word == b"f":
            if len(words) < 3:
                raise MeshError(f"cut short, a face has {len(words)} of 3 or more corners")
            asked = [int(word.partition(b"/")[0]) for word in words]
            polygon = [index - 1 if index > 0 else count + index for index in asked]  # below 0 from the last so far
            if 0 in asked or min(polygon) < 0 or max(polygon) >= len(data):
                raise MeshError(f"a face refers to vertices {asked}, but the first is 1 and {count} come before it")
            corners.extend(_fan(polygon))
    faces = np.array(corners).reshape(-1, 3)
    if faces.size and faces.max() >= count:
        raise MeshError(f"a face refers to vertex {faces.max() + 1}, but there are only {count} vertices")
    return np.array(positions).reshape(-1, 3), faces


def _lines_of_words(data: bytes) -> Iterator[list[bytes]]:
    """The words of each line that has any, without comments (#), one line at a time for the sake of memory."""
    for line in io.BytesIO(data.replace(b"\r", b"\n") if b"\r" in data else data):
        if words := line.partition(b"#")[0].split():
            yield words


def _coordinates(words: list[bytes], vertex: int) -> Iterator[float]:
    if len(words) < 3:
        raise MeshError(f"cut short, vertex {vertex} has {len(words)} of 3 coordinates")
    return map(float, words[:3])


def _fan(polygon: list[int]) -> list[int]:
    """The corners of the triangles that a polygon falls into, three after three; none if it has less than three."""
    return [corner for b, c in pairwise(polygon[1:]) for corner in (polygon[0], b, c)]


def _numbers_only() -> warnings.catch_warnings:
    """While this runs, a text that is not made of numbers is an error for NumPy."""
    return warnings.catch_warnings(action="error", category=DeprecationWarning)


def read_by_trimesh(data: bytes, kind: str, max_faces: int) -> Shape:
    """A PLY, STL or GLB file, all its parts in place. Trimesh raises whatever a broken file leads to."""
    import trimesh

    checked = _GUARDS[kind](data)
    with _numbers_only():
        scene = trimesh.load_scene(io.BytesIO(checked), kind, process=False, skip_materials=True)
    nodes = [(matrix, scene.geometry[name]) for matrix, name in map(scene.graph.get, scene.graph.nodes_geometry)]
    parts = [(matrix, shape) for matrix, shape in nodes if isinstance(shape, trimesh.Trimesh)]
    check_faces(sum(len(shape.faces) for _, shape in parts), max_faces)
    vertices, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
    for matrix, shape in parts:
        vertices.append(shape.vertices @ matrix[:3, :3].T + matrix[:3, 3])
        faces.append(shape.faces + count)
        count += len(shape.vertices)
    return np.concatenate(vertices), np.concatenate(faces)


def check_faces(faces: int, max_faces: int) -> None:
    """Refuse more triangles than are wanted."""
    if faces > max_faces:
        raise MeshError(f"it has {faces:,} triangles, more than {max_faces:,}; --max-faces (max_faces) allows more")


def _guard_ply(data: bytes) -> bytes:
    end = re.search(rb"\bend_header[ \t]*(?:\r\n|\n|\r)", data)
    if end is None or not data.startswith(b"ply"):
        raise MeshError("it has no header from ply to end_header")
    elements: list[tuple[int, list[bool]]] = []  # rows, and for each property whether it is a list
    for words in map(bytes.split, data[: end.start()].splitlines()):
        if words[:1] == [b"element"]:
            elements.append((int(words[2]), []))
        elif words[:1] == [b"property"]:
            elements[-1][1].append(words[1] == b"list")
    text = re.search(rb"^format[ \t]+ascii", data[: end.start()], re.MULTILINE)
    lines = data[end.end() :].splitlines() if text else []
    if sum(rows for rows, _ in elements) > (len(lines) if text else len(data)):
        raise MeshError("the file is cut short, its header announces more rows than there are")
    row = iter(lines)
    for rows, properties in elements if text else ():
        for words in map(bytes.split, islice(row, rows)):
            at = 0
            for is_list in properties:
                at += 1 + (int(words[at]) if is_list and at < len(words) else 0)
            if at != len(words):
                raise MeshError(f"a row of {len(words)} words needs {at}: the file is cut short or damaged")
    # Of edges trimesh makes paths, with memory for all vertices up to the highest that they name.
    data = data.replace(b"\nelement edge ", b"\nelement rims ", 1)
    return data.decode("latin-1").encode() if text else data


def _guard_stl(data: bytes) -> bytes:
    if b"\0" in data[: STL_HEADER + 1] or data.lstrip()[:5].lower() != b"solid":
        announced = int.from_bytes(data[STL_HEADER - 4 : STL_HEADER], "little")
        if len(data) != STL_HEADER + STL_FACET * announced:
            raise MeshError(f"the file is cut short or damaged, {announced} faces do not take {len(data)} bytes")
        return data
    ends = [bool(end) for end in re.findall(rb"^[ \t]*(end)?solid\b", data, re.MULTILINE | re.IGNORECASE)]
    if 2 * sum(ends) != len(ends):
        raise MeshError("the file is cut short, endsolid is missing")
    return data.decode("latin-1").encode()  # trimesh reads other encodings only where a library guesses them


def _guard_glb(data: bytes) -> bytes:
    """Hold what the JSON announces against the file's size, and refuse what trimesh would read as another shape."""
    if data[:4] != b"glTF" or int.from_bytes(data[8:12], "little") != len(data):
        raise MeshError("it does not begin with glTF, or is not as long as it announces")
    gltf = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    accessors, nodes, views = (gltf.get(key, []) for key in ("accessors", "nodes", "bufferViews"))
    taken = [a["count"] for a in accessors if "bufferView" not in a or "byteStride" in views[a["bufferView"]]]
    if sum(taken) > len(data) or sum(view["byteLength"] for view in views) > 2 * len(data):
        raise MeshError("it announces more numbers than its bytes hold")
    if any("uri" in buffer for buffer in gltf.get("buffers", [])):
        raise MeshError("it keeps numbers outside of its binary part, which is not read here")
    roots = gltf["scenes"][gltf.get("scene", 0)].get("nodes", []) if "scenes" in gltf else []
    placed = [*roots, *(child for node in nodes for child in node.get("children", []))]
    if len(placed) != len(set(placed)) or len(nodes) > GLB_NODES or min(placed, default=0) < 0:
        raise MeshError(f"a node is in its scene twice, or there are more than {GLB_NODES:,}")
    for part in (part for mesh in gltf.get("meshes", []) for part in mesh["primitives"]):
        used = [accessors[part[key]] for key in ("indices",) if key in part]
        used.append(accessors[part["attributes"]["POSITION"]])
        if part.get("mode", GLB_TRIANGLES) == GLB_FAN:
            raise MeshError("it has fans of triangles, which are not read here")
        if any("bufferView" not in accessor or "sparse" in accessor for accessor in used):
            raise MeshError("its positions or faces are compressed, sparse or without data, which is not read here")
        if any(accessor.get("normalized") for accessor in used):
            raise MeshError("its positions are fractions of whole numbers, which are not read here")
        if min(accessor["count"] for accessor in used) < 0:
            raise MeshError("it announces fewer than no numbers")
    return data


_GUARDS = {"ply": _guard_ply, "stl": _guard_stl, "glb": _guard_glb}
