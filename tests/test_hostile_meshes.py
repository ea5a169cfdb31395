"""Small files must not cost much: what they announce is held against what is there; and what other readers refuse."""

import json
import os
import re
import struct
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import trimesh

from nextview.cli.main import main
from nextview.data.predictions import Predictions
from nextview.data.rendering import render
from nextview.data.store import ViewStore
from nextview.errors import MeshError, NextviewError
from nextview.glb import read_glb
from nextview.mesh import load_mesh, make_mesh
from nextview.mesh_format import BYTES_PER_FACE
from nextview.models.model_card import read_card
from nextview.ply import read_ply
from nextview.policies.policy_card import read_policy_card
from nextview.viewsphere import ViewSphere
from nextview.weights_file import checked_content
from nextview.worlds import World

CORNERS = "0 0 0\n1 0 0\n0 1 1\n"
FACET = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 1\nendloop\nendfacet\n"


def glb(gltf: dict | bytes, binary: bytes = b"") -> bytes:
    text = gltf if isinstance(gltf, bytes) else json.dumps(gltf).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 1]], "<f4").tobytes() + np.arange(3, dtype="<u4").tobytes()


def one_triangle(**changes) -> dict:
    """The JSON of a GLB of one triangle, some of whose parts are replaced; its binary part is TRIANGLE."""
    return {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 12},
        ],
        "buffers": [{"byteLength": len(TRIANGLE)}],
    } | changes


def accessor(**changes) -> dict:
    """The same, with the accessor of the positions changed; None takes a fact away."""
    gltf = one_triangle()
    gltf["accessors"][0] |= changes
    gltf["accessors"][0] = {k: v for k, v in gltf["accessors"][0].items() if v is not None}
    return gltf


def view(**changes) -> dict:
    """The same, with the view of the positions changed."""
    gltf = one_triangle()
    gltf["bufferViews"][0] |= changes
    return gltf


def ply(faces: int, body: str, more: str = "", vertices: int = 3) -> str:
    return (
        f"ply\nformat ascii 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {faces}\nproperty list uchar int vertex_indices\n{more}end_header\n{body}"
    )


EDGES = "element edge 1\nproperty int vertex1\nproperty int vertex2\n"
MANY_TIMES = one_triangle(scenes=[{"nodes": list(range(101))}], nodes=101 * [{"mesh": 0}])
BIG = 150_000_000
HARMLESS = {
    "an edge between distant vertices": ("a.ply", ply(1, CORNERS + "3 0 1 2\n0 100000000\n", EDGES)),
    "a texture that is none": (
        "a.glb",
        glb(one_triangle(images=[{"uri": "x.png"}], textures=[{"source": 0}], materials=[{}]), TRIANGLE),
    ),
    "blank lines": ("a.stl", "solid x\n" + FACET + "endsolid x" + "\n" * 300_000),
    "spaces": ("a.stl", "solid x\n" + FACET + "endsolid x" + " " * 300_000),
    "a Latin-1 name": ("a.stl", f"solid T\xfcr\n{FACET}endsolid T\xfcr\n".encode("latin-1")),
    "copies": ("a.off", "OFF\n3 200000 0\n" + CORNERS + "3 0 1 2\n3 2 1 0\n" * 100_000),
    "copies of the corners too": ("a.stl", "solid x\n" + 20_000 * FACET + "endsolid x\n"),
}
REFUSED = {
    "positions without data": ("a.glb", glb(accessor(bufferView=None, count=BIG), TRIANGLE), "without data"),
    "more positions than bytes": ("a.glb", glb(accessor(count=BIG), TRIANGLE), "more than its bytes hold"),
    "positions that stand still": ("a.glb", glb(view(byteStride=0), TRIANGLE), "more than its bytes hold"),
    "a view beyond the buffer": ("a.glb", glb(view(byteOffset=1 << 40), TRIANGLE), "more than its bytes hold"),
    "sparse positions": ("a.glb", glb(accessor(sparse={}), TRIANGLE), "sparse"),
    "compressed": ("a.glb", glb(one_triangle(extensionsRequired=["KHR_draco_mesh_compression"])), "the extension"),
    "elsewhere": ("a.glb", glb(one_triangle(buffers=[{"uri": "x.bin"}])), "outside of its binary part"),
    "a node in itself": ("a.glb", glb(one_triangle(nodes=[{"children": [0]}])), "node 0 is in the scene twice"),
    "a node before the first": ("a.glb", glb(one_triangle(nodes=[{"children": [-1]}])), "'-1' where it needs"),
    "a list for a scene": ("a.glb", glb(one_triangle(nodes={"0": 1})), "its JSON is not that of a glTF scene"),
    "deep JSON": ("a.glb", glb(b"[" * 5000), "not that of a glTF scene .RecursionError"),
    "the same mesh too often": ("a.glb", glb(MANY_TIMES, TRIANGLE), "101 triangles, more than 100; --max-faces"),
    "more rows than lines": ("a.ply", ply(BIG, CORNERS + "3 0 1 2\n"), f"before its {BIG} face rows"),
    "more vertices than lines": ("a.ply", ply(1, CORNERS + "3 0 1 2\n", "", BIG), f"before its {BIG} vertex rows"),
    "a list longer than the file": ("a.ply", ply(1, CORNERS + f"{BIG} 0 1 2\n"), "before its 1 face rows"),
    "a list of less than nothing": ("a.ply", ply(1, CORNERS + "-1 0 1 2\n"), "a list has the length -1"),
    "a list of NaN": ("a.ply", ply(1, CORNERS + "nan 0 1 2\n"), "nan is not the number of a vertex"),
    "half a corner": ("a.ply", ply(1, CORNERS + "3 0 1 1.5\n"), "1.5 is not the number of a vertex"),
    "rows of nothing": ("a.ply", ply(1, CORNERS + "3 0 1 2\n", f"element x {BIG}\n") + "7", "goes on after the last"),
    "spaces in a header": ("a.ply", "ply\nformat ascii 1.0\nelement face 0 property list" + " " * 5000, "no header"),
    "a facet of two corners": ("a.stl", f"solid x\n{FACET.replace('vertex 1 0 0', '')}endsolid", "three corners"),
    "a long binary STL": ("a.stl", bytes(80) + struct.pack("<I", 1) + bytes(73), "1 faces announced, but"),
    "too many faces": ("a.off", f"OFF\n3 101 0\n{CORNERS}" + "3 0 1 2\n" * 101, "101 triangles, more than 100; --max"),
    "too many vertices": ("a.off", "OFF\n301 1 0\n" + "0 0 0\n" * 301 + "3 0 1 2\n", "301 vertices, more than 300"),
    "too many bytes": ("a.off", "OFF\n" + " " * 100 * BYTES_PER_FACE, "6,004 bytes, more than 6,000; --max-faces"),
    "no area": ("a.off", "OFF\n3 2 0\n0 0 0\n1 0 0\n2 0 0\n3 0 1 2\n3 0 0 0\n", "no area"),
}  # fmt: skip


def write(folder: Path, name: str, content: bytes | str) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


@pytest.mark.parametrize("case", HARMLESS)
def test_a_strange_file_is_read_at_once(tmp_path, case, capfd):
    path = write(tmp_path, *HARMLESS[case])
    began = time.perf_counter()
    tracemalloc.start()
    mesh = load_mesh(path)
    assert tracemalloc.get_traced_memory()[1] < 100e6
    tracemalloc.stop()
    assert len(mesh.faces) == 1
    assert len(mesh.vertices) == 3
    assert time.perf_counter() - began < 10  # it takes 0.1 s to 2 s; it was a minute or more
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("case", REFUSED)
def test_a_file_that_announces_too_much_is_refused_at_once(tmp_path, case, capfd):
    name, content, part = REFUSED[case]
    path = write(tmp_path, name, content)
    tracemalloc.start()
    with pytest.raises(MeshError, match=f"^{re.escape(str(path))}: .*{part}") as refusal:
        load_mesh(path, max_faces=100)
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()
    assert "\n" not in str(refusal.value)
    assert capfd.readouterr() == ("", "")


def test_the_limit_can_be_raised(tmp_path, capsys):
    path = write(tmp_path, "ball.off", trimesh.creation.icosphere(2).export(file_type="off"))
    assert len(load_mesh(path, max_faces=320).faces) == 320
    with pytest.raises(MeshError, match="320 triangles, more than 319"):
        load_mesh(path, max_faces=319)
    with pytest.raises(SystemExit, match="2"):
        main(["recognise", str(path), "--max-faces", "319"])
    assert "320 triangles, more than 319" in capsys.readouterr().err


def test_rendering_leaves_out_what_is_too_large(tmp_path):
    for kind, subdivisions in (("small", 1), ("large", 2)):
        (tmp_path / "meshes/ball").mkdir(parents=True, exist_ok=True)
        trimesh.creation.icosphere(subdivisions).export(tmp_path / f"meshes/ball/{kind}.off")
    list(render(tmp_path / "meshes", tmp_path / "v.zarr", ViewSphere.named("12"), 16, workers=1, max_faces=200))
    store = ViewStore.open(tmp_path / "v.zarr")
    assert store.done.tolist() == [False, True]
    assert "320 triangles, more than 200" in store.failures["large"]


def test_only_regular_files_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe.off")
    (tmp_path / "endless.off").symlink_to("/dev/zero")
    for name in ("pipe.off", "endless.off"):
        with pytest.raises(MeshError, match=rf"{name}: is a pipe or a device"):
            load_mesh(tmp_path / name)


def test_cards_and_predictions_are_regular_files_too(tmp_path):
    os.mkfifo(tmp_path / "pipe.json")
    (tmp_path / "endless.json").symlink_to("/dev/zero")
    for name in ("pipe.json", "endless.json"):
        path = tmp_path / name
        for read in (read_card, read_policy_card, World.load, Predictions.load, lambda p: checked_content(p, "")):
            with pytest.raises(NextviewError, match=rf"{name}: is a pipe or a device"):
                read(path)


def test_a_mesh_is_the_same_with_copies_of_its_triangles(tmp_path):
    ball = trimesh.creation.icosphere(2)
    plain = make_mesh(ball.vertices, ball.faces)
    turned = np.concatenate(
        [ball.faces, ball.faces[:, [1, 2, 0]], ball.faces[:, ::-1], ball.faces + len(ball.vertices)]
    )
    doubled = make_mesh(np.concatenate([ball.vertices, ball.vertices]), turned)
    np.testing.assert_array_equal(doubled.faces, plain.faces)
    np.testing.assert_array_equal(doubled.vertices, plain.vertices)


# What the readers make of sound files, beside trimesh or by hand


def mixed_ply(encoding: str) -> bytes:
    """A pyramid of one square and four triangles, with other elements, properties and comments around its shape."""
    order = "<" if "little" in encoding else ">"
    vertices = [(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0), (1, 1, 3)]
    faces = [(0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)]
    head = (
        f"ply\nformat {encoding} 1.0\ncomment made by hand\nobj_info none\nelement camera 2\nproperty double f\n"
        "element vertex 5\nproperty uchar red\nproperty float x\nproperty double y\nproperty short z\n"
        "element face 5\nproperty uchar flag\nproperty list uchar uint vertex_index\n"
        "property list int float weights\nelement edge 1\nproperty int vertex1\nproperty int vertex2\nend_header\n"
    )
    if encoding == "ascii":
        rows = ["1.5 2.5", *(f"255 {x} {y}.0 {z}" for x, y, z in vertices)]
        rows += [f"1 {len(f)} {' '.join(map(str, f))} {k} {'0.5 ' * k}" for k, f in enumerate(faces)]
        return (head + "\n".join([*rows, "0 1\n"])).encode()
    body = struct.pack(order + "dd", 1.5, 2.5)
    body += b"".join(struct.pack(order + "Bfdh", 255, *v) for v in vertices)
    for k, f in enumerate(faces):
        body += struct.pack(f"{order}BB{len(f)}Ii{k}f", 1, len(f), *f, k, *[0.5] * k)
    return head.encode() + body + struct.pack(order + "ii", 0, 1)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_of_mixed_polygons(encoding):
    content = mixed_ply(encoding)
    closed = trimesh.Trimesh(*read_ply(content), process=False)
    assert len(closed.faces) == 6
    assert closed.is_watertight
    assert closed.volume == pytest.approx(2 * 2 * 3 / 3)
    for length in range(content.index(b"end_header") + 11, len(content.rstrip())):
        with pytest.raises(MeshError):
            read_ply(content[:length] if encoding != "ascii" else content[:length].rpartition(b" ")[0])


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_ply_is_read_as_trimesh_reads_it(encoding):
    shape = trimesh.creation.icosphere(2)
    shape.visual.face_colors = np.random.default_rng(0).integers(255, size=(len(shape.faces), 4))
    vertices, faces = read_ply(shape.export(file_type="ply", encoding=encoding, vertex_normal=True))
    np.testing.assert_array_equal(faces, shape.faces)
    np.testing.assert_allclose(vertices, shape.vertices, atol=1e-6)


def test_parts_of_a_glb_stand_where_its_nodes_put_them():
    rng = np.random.default_rng(0)
    scene, node = trimesh.Scene(), None
    for k in range(6):  # a chain of nodes and, in two places, the same mesh
        matrix = trimesh.transformations.random_rotation_matrix(rng.random(3))
        matrix[:3] *= rng.uniform(0.5, 2)
        matrix[:3, 3] = rng.normal(size=3)
        shape = trimesh.creation.box(rng.uniform(1, 2, 3)) if k % 2 else trimesh.creation.cone(1, 2)
        node = scene.add_geometry(shape, transform=matrix, parent_node_name=node if k % 3 else None)
    first = next(iter(scene.geometry))
    scene.graph.update("again", matrix=trimesh.transformations.translation_matrix((9, 0, 0)), geometry=first)
    vertices, faces = read_glb(scene.export(file_type="glb"), 10_000)
    expected = scene.to_mesh()
    assert len(faces) == len(expected.faces)
    ours, theirs = (
        np.round(np.sort(corners.reshape(-1, 9), 0), 4) for corners in (vertices[faces], expected.triangles)
    )
    np.testing.assert_allclose(ours, theirs, atol=2e-4)


@pytest.mark.parametrize("turn", [[0, 0, 0, 1], [0, 0, 3, 4], [0.5, 0.5, 0.5, 0.5]])
def test_translation_rotation_and_scale_of_a_node(turn):
    node = {"mesh": 0, "translation": [1, 2, 3], "rotation": turn, "scale": [2, 3, 4]}
    vertices, _ = read_glb(glb(one_triangle(nodes=[node]), TRIANGLE), 10)
    rotation = trimesh.transformations.quaternion_matrix([turn[3], *turn[:3]])[:3, :3]
    expected = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 1]]) * (2, 3, 4) @ rotation.T + (1, 2, 3)
    np.testing.assert_allclose(vertices, expected, atol=1e-12)


def test_a_mesh_that_is_there_a_great_many_times_is_read_soon():
    """Turning the 200,000 matrices of such a file of 18 MB by NumPy took half a minute and more."""
    count = 200_000
    nodes = [{"mesh": 0, "translation": [k, 0, 0], "rotation": [0, 0, 1, 0], "scale": [1, 2, 1]} for k in range(count)]
    file = glb(one_triangle(scenes=[{"nodes": list(range(count))}], nodes=nodes), TRIANGLE)
    began = time.process_time()
    vertices, faces = read_glb(file, count)
    assert time.process_time() - began < 10  # 2 s
    turned = np.array([[0, 0, 0], [-1, 0, 0], [0, -2, 1]])
    np.testing.assert_allclose(
        vertices[faces], turned + np.arange(count)[:, None, None] * np.array([1, 0, 0]), atol=1e-9
    )


def test_parts_of_no_end_are_refused():
    part = {"attributes": {"POSITION": 0}, "indices": 1}
    with pytest.raises(MeshError, match="more than 100,000 parts"):
        read_glb(glb(one_triangle(meshes=[{"primitives": 100_001 * [part]}]), TRIANGLE), 10**6)


def test_strips_fans_and_whole_numbers_in_a_glb():
    square = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [2, 2, 0]], "<f4")
    for mode, order in ((5, (0, 1, 2, 3)), (6, (0, 1, 3, 2))):
        gltf = one_triangle(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": mode}]}])
        gltf["accessors"][0]["count"], gltf["bufferViews"][0]["byteLength"] = 4, 48
        vertices, faces = read_glb(glb(gltf, square[list(order)].tobytes()), 10)
        assert trimesh.Trimesh(vertices, faces).area == pytest.approx(4)
    quantised = np.array([[0, 0, 0, 0], [32767, 0, 0, 0], [0, -32768, 16384, 0]], "<i2")  # in steps of eight bytes
    gltf = accessor(componentType=5122, normalized=True)
    gltf["bufferViews"][0] = {"buffer": 0, "byteLength": 24, "byteStride": 8}
    gltf["bufferViews"][1]["byteOffset"] = 24
    vertices, _ = read_glb(glb(gltf, quantised.tobytes() + TRIANGLE[36:]), 10)
    np.testing.assert_allclose(vertices, [[0, 0, 0], [1, 0, 0], [0, -1, 16384 / 32767]])
