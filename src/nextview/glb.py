"""Read the shape in a GLB file, binary glTF 2.0: the triangles of all meshes of its scene, each where its node puts it.

Textures, skins and animations are left aside. What the JSON announces is held against the bytes that are there before
any memory is taken for it.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.errors import MeshError
from nextview.mesh_format import check_faces

COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
COLUMNS = {"SCALAR": 1, "VEC3": 3}
TRIANGLES, STRIP, FAN = 4, 5, 6
MOVES = frozenset(("matrix", "rotation", "scale", "translation"))
"""What a node may have that places it."""
UNREAD = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "EXT_mesh_gpu_instancing")
"""Extensions without which the shape would be another one."""
MAX_JSON = 1 << 25
"""Bytes of JSON: as Python's objects it takes up to thirty times as much memory."""
MAX_PARTS = 100_000
"""Parts of meshes, each with arrays of its own: so many take some seconds."""

Part = tuple[NDArray[np.float64], NDArray[np.integer]]
"""Vertices (V, 3) and triangles (F, 3) of a part of a mesh, in the mesh's own frame."""


def read_glb(data: bytes, max_faces: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (V, 3) float64 and triangles (F, 3) int64 of a GLB file.

    Args:
        data: the file.
        max_faces: one mesh may be there many times, so that a small file makes a large one: refused if more than this.

    Raises:
        MeshError: the file is cut short or damaged, needs an extension that changes the shape and is not read here,
            keeps its numbers elsewhere, or has too many faces.
    """
    text, binary = _chunks(data)
    try:
        gltf = json.loads(text)
        for name in gltf.get("extensionsRequired", ()):
            if name in UNREAD:
                raise MeshError(f"it needs the extension {name}, which is not read here")
        meshes: dict[int, list[Part]] = {}
        places: dict[int, list[NDArray[np.float64]]] = {}
        face_count = part_count = 0
        for index, matrix in _placed(gltf):
            if index not in meshes:  # read once, however often it is there
                primitives = _item(gltf["meshes"], index)["primitives"]
                if (part_count := part_count + len(primitives)) > MAX_PARTS:
                    raise MeshError(f"its meshes have more than {MAX_PARTS:,} parts")
                meshes[index] = [_part(gltf, binary, primitive, max_faces) for primitive in primitives]
            check_faces(face_count := face_count + sum(len(corners) for _, corners in meshes[index]), max_faces)
            places.setdefault(index, []).append(matrix)
    except (KeyError, IndexError, TypeError, AttributeError, RecursionError) as error:
        raise MeshError(f"its JSON is not that of a glTF scene ({type(error).__name__}: {error})") from None
    vertices, faces = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)]
    vertex_count = 0
    for index, found in places.items():
        matrices = np.array(found)
        for positions, corners in meshes[index]:
            with np.errstate(all="ignore"):
                placed = positions @ matrices[:, :3, :3].swapaxes(1, 2) + matrices[:, None, :3, 3]
            first = vertex_count + len(positions) * np.arange(len(found))
            vertices.append(placed.reshape(-1, 3))
            faces.append((corners + first[:, None, None]).reshape(-1, 3))
            vertex_count += len(positions) * len(found)
    return np.concatenate(vertices), np.concatenate(faces)


def _part(gltf: dict[str, Any], binary: memoryview, primitive: dict[str, Any], max_faces: int) -> Part:
    """The positions that a part of a mesh uses, and its triangles."""
    corners = _corners(gltf, binary, primitive)
    if not len(corners):
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    check_faces(len(corners), max_faces)
    positions = _accessor(gltf, binary, primitive["attributes"]["POSITION"], "VEC3")
    used, corners = np.unique(corners, return_inverse=True)  # parts often share one long list of positions
    if used[-1] >= len(positions):
        raise MeshError(f"a face refers to vertex {used[-1]}, but there are only {len(positions)} vertices")
    return positions[used].astype(np.float64), corners.reshape(-1, 3)


def _chunks(data: bytes) -> tuple[bytes, memoryview]:
    """The JSON and the binary part, which may be empty."""
    if data[:4] != b"glTF" or len(data) < 12:
        raise MeshError("it does not begin with glTF")
    version, end = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise MeshError(f"it is of version {version} of glTF, only 2 is read here")
    parts: dict[bytes, memoryview] = {}
    at = 12
    while at + 8 <= end and at + 8 <= len(data):
        length, kind = struct.unpack_from("<I4s", data, at)
        at += 8 + length
        parts.setdefault(kind, memoryview(data)[at - length : at])
    if max(at, end) > len(data):
        raise MeshError(f"the file is cut short, {max(at, end)} bytes announced, {len(data)} found")
    if b"JSON" not in parts:
        raise MeshError("it has no JSON")
    if len(parts[b"JSON"]) > MAX_JSON:
        raise MeshError(f"its JSON has {len(parts[b'JSON']):,} bytes, more than {MAX_JSON:,}")
    return bytes(parts[b"JSON"]), parts.get(b"BIN\0", memoryview(b""))


def _placed(gltf: dict[str, Any]) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Every mesh of the scene, as often as it is there, with the (4, 4) matrix from its own frame to the scene's."""
    nodes = gltf.get("nodes", [])
    if "scenes" in gltf:
        roots = _item(gltf["scenes"], gltf.get("scene", 0)).get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", ())}
        roots = [index for index in range(len(nodes)) if index not in children]
    waiting = [(root, np.eye(4)) for root in reversed(roots)]
    seen: set[int] = set()
    while waiting:
        index, above = waiting.pop()
        node = _item(nodes, index)
        if index in seen:
            raise MeshError(f"its node {index} is in the scene twice")
        seen.add(index)
        matrix = above
        if not MOVES.isdisjoint(node):
            with np.errstate(all="ignore"):  # what is not finite is noticed at the vertices
                matrix = above @ _matrix(node)
        if "mesh" in node:
            yield _natural(node["mesh"]), matrix
        waiting += [(child, matrix) for child in reversed(node.get("children", []))]


def _matrix(node: dict[str, Any]) -> NDArray[np.float64]:
    """From the frame of a node to that of the one above it, (4, 4).

    In Python's numbers until the end: a scene may have a great many nodes, and small arrays are slow.
    """
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T  # written column by column
    turn = [float(value) for value in node.get("rotation", (0, 0, 0, 1))]
    length = math.hypot(*turn) or math.nan
    x, y, z, w = (value / length for value in turn)
    a, b, c = (float(value) for value in node.get("scale", (1, 1, 1)))
    p, q, r = (float(value) for value in node.get("translation", (0, 0, 0)))
    return np.array(
        [
            [a * (1 - 2 * (y * y + z * z)), b * 2 * (x * y - z * w), c * 2 * (x * z + y * w), p],
            [a * 2 * (x * y + z * w), b * (1 - 2 * (x * x + z * z)), c * 2 * (y * z - x * w), q],
            [a * 2 * (x * z - y * w), b * 2 * (y * z + x * w), c * (1 - 2 * (x * x + y * y)), r],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _corners(gltf: dict[str, Any], binary: memoryview, primitive: dict[str, Any]) -> NDArray[np.integer]:
    """The vertices of each triangle of a part of a mesh, (F, 3); none if it is made of points or lines."""
    mode = primitive.get("mode", TRIANGLES)
    if mode not in (TRIANGLES, STRIP, FAN):
        return np.zeros((0, 3), np.int64)
    if "indices" in primitive:
        order: NDArray[np.integer] = _accessor(gltf, binary, primitive["indices"], "SCALAR")[:, 0]
        if order.dtype.kind != "u":
            raise MeshError("the corners of its faces are not whole numbers")
    else:
        order = np.arange(len(_accessor(gltf, binary, primitive["attributes"]["POSITION"], "VEC3")))
    if mode == TRIANGLES:
        if len(order) % 3:
            raise MeshError(f"a part of it has {len(order)} corners, which do not make whole triangles")
        return order.reshape(-1, 3)
    if len(order) < 3:
        return np.zeros((0, 3), np.int64)
    return np.stack([order[:-2] if mode == STRIP else np.full(len(order) - 2, order[0]), order[1:-1], order[2:]], 1)


def _accessor(gltf: dict[str, Any], binary: memoryview, index: Any, kind: str) -> NDArray:
    """Numbers as they lie in the file, (count, columns); integers that stand for fractions become these.

    Args:
        gltf: the JSON.
        binary: the bytes beside it.
        index: of the accessor.
        kind: what it has to be, one of COLUMNS.
    """
    accessor = _item(gltf["accessors"], index)
    if accessor["type"] != kind:
        raise MeshError(f"its accessor {index} is {accessor['type']}, not {kind}")
    if "bufferView" not in accessor or "sparse" in accessor:
        raise MeshError(f"its accessor {index} is sparse or without data, which is not read here")
    view = _item(gltf["bufferViews"], accessor["bufferView"])
    if view["buffer"] != 0 or "uri" in gltf["buffers"][0]:
        raise MeshError("it keeps numbers outside of its binary part, which is not read here")
    number, columns = np.dtype(COMPONENTS[accessor["componentType"]]), COLUMNS[kind]
    row = columns * number.itemsize
    count, inner = _natural(accessor["count"]), _natural(accessor.get("byteOffset", 0))
    offset, room = _natural(view.get("byteOffset", 0)), _natural(view["byteLength"])
    stride = _natural(view.get("byteStride", row))
    if stride < row or inner + (count - 1) * stride + row > room or offset + room > len(binary):
        raise MeshError(f"its accessor {index} announces {count} items, more than its bytes hold")
    values = np.ndarray((count, columns), number, binary, offset + inner, (stride, number.itemsize))
    if accessor.get("normalized") and number.kind in "iu":
        return np.maximum(values / np.iinfo(number).max, -1.0)
    return values


def _item(items: list[Any], index: Any) -> Any:
    """One of a list; Python counts negative ones from its end, glTF has none."""
    return items[_natural(index)]


def _natural(value: Any) -> int:
    if type(value) is not int or value < 0:
        raise MeshError(f"its JSON has {str(value)[:40]!r} where it needs a number that counts")
    return value
