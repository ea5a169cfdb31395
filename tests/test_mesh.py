"""Meshes: every format gives the same shape, and every broken file one clear sentence."""

import json
import os
import re
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from nextview.errors import MeshError
from nextview.mesh import FORMATS, Mesh, load_mesh, make_mesh
from nextview.off import read_off

SQUARE = [[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]
PYRAMID = """OFF
5 6 9
0 0 0
2 0 0
2 2 0
0 2 0
1 1 3
3 0 2 1
3 0 3 2
3 0 1 4
3 1 2 4
3 2 3 4
3 3 0 4
"""


def wedge() -> trimesh.Trimesh:
    """A shape without any symmetry, far from the origin."""
    box = trimesh.creation.box((2, 3, 5))
    box.vertices[box.vertices[:, 2] > 0] *= (0.5, 0.7, 1.4)
    box.vertices += (10, -20, 30)
    return box


def triangles(mesh: Mesh) -> np.ndarray:
    """The corners of every triangle in an order that depends on the shape alone."""
    corners = np.round(mesh.vertices[mesh.faces] + 0.0, 5)
    first = np.lexsort(corners.transpose(2, 0, 1)[::-1], axis=-1)[:, 0]
    turned = np.take_along_axis(corners, ((first[:, None] + np.arange(3)) % 3)[..., None], 1).reshape(-1, 9)
    return turned[np.lexsort(turned.T[::-1])]


def write(folder: Path, name: str, content: bytes | str) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def off(vertices: str, faces: str) -> str:
    count = [len(part.strip().splitlines()) for part in (vertices, faces)]
    return f"OFF\n{count[0]} {count[1]} 0\n{vertices}\n{faces}\n"


def vertices_edited(replacement: str) -> str:
    """The pyramid with every line of three numbers replaced but the counts."""
    return re.sub(r"(?m)^(\d) (\d) (\d)$", replacement, PYRAMID.replace("5 6 9", "counts")).replace("counts", "5 6 9")


# Reading


@pytest.mark.parametrize("encoding", ["off", "obj", "ply", "ply ascii", "stl", "stl_ascii", "glb"])
def test_every_format_gives_the_same_mesh(tmp_path, encoding):
    shape = wedge()
    kind, *ascii_ = encoding.split()
    if kind == "glb":  # y up: x stays, the height is y, and -y is the depth z
        shape.vertices = shape.vertices[:, [0, 2, 1]] * (1, 1, -1)
    content = shape.export(file_type=kind, **({"encoding": "ascii"} if ascii_ else {}))
    mesh = load_mesh(write(tmp_path, f"wedge.{kind.removesuffix('_ascii')}", content))
    expected = make_mesh(wedge().vertices, wedge().faces)
    np.testing.assert_allclose(triangles(mesh), triangles(expected), atol=2e-5)
    np.testing.assert_allclose(mesh.centre, expected.centre, atol=1e-4)
    assert mesh.radius == pytest.approx(expected.radius, rel=1e-5)


@pytest.mark.parametrize(
    "text",
    [
        PYRAMID.replace("OFF\n", "OFF"),  # ModelNet: OFF490926 662722 0
        PYRAMID.replace("OFF\n", "OFF "),
        PYRAMID.replace("\n", "\r\n"),
        PYRAMID.replace("\n", "\r"),
        PYRAMID.replace("\n", "\n\n"),
        PYRAMID.replace("\n", " \t\n  "),
        PYRAMID.rstrip("\n"),
        "# made by hand\n" + PYRAMID,
        PYRAMID.replace("\n", " # 7 8 9\n"),
        PYRAMID.replace("5 6 9", "5 6"),
        PYRAMID.replace("3 0 2 1\n3 0 3 2\n", "4 0 3 2 1\n").replace("5 6 9", "5 5 9"),
        re.sub(r"(?m)^(3 \d \d \d)$", r"\1 255 128 0", PYRAMID),
        re.sub(r"(?m)^(3 \d \d \d)$", r"\1 0.5 0.1 0.2 1.0", PYRAMID),
        vertices_edited(r"\1 \2 \3 255 128 0 255").replace("OFF", "COFF"),
        vertices_edited(r"\1 \2 \3 0 0 1").replace("OFF", "NOFF"),
        vertices_edited(r"\1.0 \2e0 +\3."),
        PYRAMID + "\n \n",
    ],
    ids=lambda text: repr(text[:24]),
)
def test_off_as_it_is_found_in_the_wild(text):
    vertices, faces = read_off(text.encode())
    read = make_mesh(vertices, faces)
    apex, base = (1, 1, 3), SQUARE
    azimuth_bins = [(base[i], base[(i + 1) % 4], apex) for i in range(4)]
    assert read.radius == pytest.approx(np.sqrt(1 + 1 + 1.5**2))
    assert {tuple(map(tuple, f)) for f in vertices[faces][-4:].astype(int)} == {
        tuple(map(tuple, f)) for f in np.array(azimuth_bins)
    }
    closed = trimesh.Trimesh(vertices, faces)
    assert closed.is_watertight
    assert closed.volume == pytest.approx(4 * 3 / 3)


@given(st.integers(3, 9), st.sampled_from(["", " 10 20 30"]))
def test_polygons_keep_their_area(corners, colour):
    around = 2 * np.pi * np.arange(corners) / corners
    vertices = "\n".join(f"{np.cos(a)!s} {np.sin(a)!s} 0" for a in around)
    text = off(vertices, f"{corners} " + " ".join(map(str, range(corners))) + colour)
    mesh = trimesh.Trimesh(*read_off(text.encode()), process=False)
    assert len(mesh.faces) == corners - 2
    assert mesh.area == pytest.approx(corners / 2 * np.sin(2 * np.pi / corners))


@given(st.data())
def test_the_fast_and_the_tolerant_way_of_reading_off_agree(data):
    count = data.draw(st.integers(3, 8))
    numbers = st.floats(-1e6, 1e6)
    vertices = data.draw(st.lists(st.tuples(numbers, numbers, numbers), min_size=count, max_size=count))
    corner = st.integers(0, count - 1)
    faces = data.draw(st.lists(st.tuples(corner, corner, corner), min_size=1, max_size=6))
    text = off(
        "\n".join(f"{x!r} {y!r} {z!r}" for x, y, z in vertices), "\n".join("3 {} {} {}".format(*f) for f in faces)
    )
    plain = read_off(text.encode())
    coloured = read_off(re.sub(r"(?m)^(3 \d \d \d)$", r"\1 1 2 3", text).encode())
    for read in (plain, coloured):
        np.testing.assert_array_equal(read[0], vertices)
        np.testing.assert_array_equal(read[1], faces)


@pytest.mark.parametrize("kind", ["obj", "ply"])
def test_polygons_in_obj_and_ply(tmp_path, kind):
    rows = "\n".join(" ".join(map(str, v)) for v in SQUARE)
    text = {
        "obj": re.sub("(?m)^", "v ", rows) + "\nf 1 2 3 4\n",
        "ply": "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face 1\nproperty list uchar int vertex_indices\nend_header\n{rows}\n4 0 1 2 3\n",
    }[kind]
    mesh = load_mesh(write(tmp_path, f"square.{kind}", text))
    assert trimesh.Trimesh(mesh.vertices, mesh.faces).area * mesh.radius**2 == pytest.approx(4)


def test_parts_of_an_obj_and_of_a_scene_are_joined(tmp_path):
    two = [trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 1, 1)).apply_translation((3, 0, 0))]
    scene = trimesh.Scene(two).export(file_type="glb")
    parts = "o a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\no b\nv 0 0 1\nv 1 0 1\nv 0 1 1\nf -3 -2 -1\n"
    assert len(load_mesh(write(tmp_path, "scene.glb", scene)).faces) == 24
    assert load_mesh(write(tmp_path, "scene.glb", scene)).radius == pytest.approx(np.sqrt(2**2 + 0.5**2 + 0.5**2))
    assert len(load_mesh(write(tmp_path, "parts.obj", parts)).faces) == 2


def test_a_binary_stl_may_begin_with_solid(tmp_path):
    content = b"solid" + wedge().export(file_type="stl")[5:]
    assert len(load_mesh(write(tmp_path, "wedge.stl", content)).faces) == 12


def test_the_up_axis_can_be_told(tmp_path):
    pole = trimesh.creation.box((1, 4, 2))  # tall along y
    for name, kind in (("pole.obj", "obj"), ("pole.glb", "glb")):
        path = write(tmp_path, name, pole.export(file_type=kind))
        extents = {up: np.ptp(load_mesh(path, up).vertices, axis=0) for up in "yz"}
        assert extents["y"].argmax() == 2
        assert extents["z"].argmax() == 1
    with pytest.raises(MeshError, match="up axis is y or z, not 'x'"):
        load_mesh(path, "x")


@pytest.mark.parametrize(
    "faces",
    [
        "f 1 2 3\nf 1 3 4\nf 4 3 5\nf 1 4 5\nf 2 1 5\nf 3 2 5\n",
        "f 1 2 3 4\nf 4 3 5\nf 1 4 5\nf 2 1 5\nf 3 2 5\n",
        "f 1 2 3 # part 0\nf 1 3 4 # 0\nf 4 3 5\nf 1 4 5\nf 2 1 5\nf 3 2 5\n",
        "f 1/1/1 2/1/1 3/1/1 4/1/1\ng azimuth bins\nf 4//1 3//1 5//1\nf 1/1 4/1 5/1\ns off\nf 2 1 5\nusemtl a\nf 3 2 5",
        "f 1 2 \\\n 3 4\nf -2 3 5\nf 1 4 -1\nf 2 -5 5\nf 3 2 5\n",
    ],
    ids=["triangles", "polygon", "comments", "texture, normals and groups", "continued and relative"],
)
@pytest.mark.parametrize(
    "change", [str, lambda text: text.replace("\n", "\r\n"), lambda text: text.replace(" ", "\t ")]
)
def test_obj_as_it_is_found_in_the_wild(tmp_path, faces, change):
    apex = "v 1 1 -3 0.5 0.5 0.5 # with a colour\nvt 0 0\nvn 0 0 1\n"
    text = "mtllib none.mtl\n\n" + "".join("v {} {} {}\n".format(*v) for v in SQUARE) + apex + faces
    mesh = load_mesh(write(tmp_path, "pyramid.obj", change(text)))
    closed = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert len(mesh.faces) == 6
    assert closed.is_watertight
    assert closed.volume * mesh.radius**3 == pytest.approx(4 * 3 / 3)


def test_relative_indices_of_an_obj_count_from_where_they_stand(tmp_path):
    # The format's own example: every face takes the four vertices just before it.
    squares = [np.add(SQUARE, (0, 0, height)) for height in (0, 1, 5)]
    text = "".join("".join("v {} {} {}\n".format(*v) for v in square) + "f -4 -3 -2 -1\n" for square in squares)
    mesh = load_mesh(write(tmp_path, "squares.obj", text))
    found = (mesh.vertices * mesh.radius + mesh.centre)[mesh.faces]
    assert np.ptp(found[..., 2], axis=1).max() < 1e-9
    assert np.round(found[:, 0, 2], 9).tolist() == [0, 0, 1, 1, 5, 5]


def test_obj_is_read_as_trimesh_reads_it(tmp_path):
    shape = trimesh.creation.icosphere(subdivisions=2).export(file_type="obj")
    path = write(tmp_path, "ball.obj", shape)
    other = trimesh.load(path, process=False)
    mesh = load_mesh(path)
    np.testing.assert_array_equal(mesh.faces, other.faces)
    np.testing.assert_allclose(mesh.vertices * mesh.radius + mesh.centre, other.vertices, atol=1e-12)


# Normalising


coordinates = npst.arrays(np.float64, (8, 3), elements=st.floats(-1, 1, allow_subnormal=False))


@settings(deadline=None)
@given(
    coordinates,
    st.sampled_from([1e-200, 1e-30, 1e-6, 1.0, 1e6, 1e30, 1e200]),
    st.sampled_from([0.0, 1.0, -100.0, 1e5]),
)
def test_the_object_frame(shape, scale, offset):
    positions = (np.vstack([shape, np.eye(3)]) + offset) * scale  # one face at least has an area
    mesh = make_mesh(positions, [[0, 1, 2], [2, 3, 4], [4, 5, 6], [6, 7, 0], [8, 9, 10]])
    assume(len(mesh.vertices) == len(positions))  # no triangle is a copy of another one
    np.testing.assert_allclose(mesh.vertices.min(0), -mesh.vertices.max(0), atol=1e-7)
    assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1)
    rounding = 1e-12 * scale * max(abs(offset), 1)
    np.testing.assert_allclose(mesh.vertices * mesh.radius + mesh.centre, positions, rtol=0, atol=rounding)


def test_a_box_by_hand():
    box = trimesh.creation.box((2, 4, 4)).apply_translation((100, 200, 300))
    mesh = make_mesh(box.vertices, box.faces)
    np.testing.assert_allclose(mesh.centre, (100, 200, 300))
    assert mesh.radius == pytest.approx(3)  # the half diagonal of 2 x 4 x 4
    np.testing.assert_allclose(np.unique(np.abs(mesh.vertices), axis=0), [[1 / 3, 2 / 3, 2 / 3]])


def test_vertices_that_no_face_uses_do_not_count():
    mesh = make_mesh([[1e9, np.nan, 0], *SQUARE, [-1e9, 0, 0]], [[1, 2, 3], [1, 3, 4]])
    np.testing.assert_allclose(mesh.vertices * mesh.radius + mesh.centre, SQUARE)
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3]])


# Refusing


@pytest.mark.parametrize(
    ("vertices", "faces", "part"),
    [
        (SQUARE, [[0, 1, 2, 3]] * 3, r"faces have the shape \(3, 4\)"),  # twelve numbers, but no four triangles
        (np.ones((3, 2)), [[0, 1, 2]], r"vertices have the shape \(3, 2\)"),
        (SQUARE, [0, 1, 2], r"faces have the shape \(3,\)"),
        (SQUARE, [], "no faces"),
        ([], [[0, 1, 2]], "no vertices"),
    ],
)
def test_arrays_that_are_no_triangle_mesh(vertices, faces, part):
    with pytest.raises(MeshError, match=f"^thing: .*{part}"):
        make_mesh(vertices, faces, "thing")


GOOD = "0 0 0\n1 0 0\n0 1 0"


def broken_files() -> dict[str, tuple[str, bytes | str, str]]:
    """Name of the case: file name, content, part of the sentence."""
    box = wedge()
    binary = {kind: box.export(file_type=kind) for kind in ("stl", "ply", "glb", "obj", "stl_ascii")}
    text_ply = box.export(file_type="ply", encoding="ascii")
    cases: dict[str, tuple[str, bytes | str, str]] = {
        "no faces": ("a.off", "OFF\n3 0 0\n" + GOOD, "no faces"),
        "no vertices": ("a.off", "OFF\n0 0 0\n", "no vertices"),
        "edges only": ("a.off", off(GOOD, "2 0 1"), "no faces"),
        "index too high": ("a.off", off(GOOD, "3 0 1 3"), "vertex 3, but there are only 3"),
        "index absurd": ("a.off", off(GOOD, "3 0 1 " + "9" * 30), "refers to vertex 9+, but there are only 3"),
        "index below zero": ("a.off", off(GOOD, "3 0 1 -1"), "vertex -1"),
        "index not a number": ("a.off", off(GOOD, "3 0 1 inf"), "inf"),
        "index with a fraction": ("a.off", off(GOOD, "3 0 1 1.5"), "1.5"),
        "too few corners": ("a.off", off(GOOD, "3 0 1"), "face 0 has 2 of 3 corners"),
        "too few coordinates": ("a.off", off("0 0 0\n1 0\n0 1 0", "3 0 1 2"), "vertex 1 has 2 of 3 coordinates"),
        "NaN": ("a.off", off("0 0 nan\n1 0 0\n0 1 0", "3 0 1 2"), "1 vertices are NaN or infinite"),
        "infinite": ("a.off", off("0 0 inf\n1 0 -inf\n0 1 0", "3 0 1 2"), "2 vertices are NaN or infinite"),
        "overflow": ("a.off", off("0 0 1e999\n1 0 0\n0 1 0", "3 0 1 2"), "1 vertices are NaN or infinite"),
        "too large": ("a.off", off("-1.7e308 -1.7e308 0\n1.7e308 0 0\n0 1.7e308 0", "3 0 1 2"), "too large"),
        "one place": ("a.off", off("5 5 5\n5 5 5\n5 5 5", "3 0 1 2"), "no extent"),
        "a line": ("a.off", off("0 0 0\n1 2 3\n3 6 9", "3 0 1 2"), "no area"),
        "a slanted line": ("a.off", off("0.1 0.1 0.1\n0.2 0.3 0.4\n0.3 0.5 0.7", "3 0 1 2"), "no area"),
        "corners in one place": ("a.off", off("0 0 0\n1 2 3", "3 0 1 1"), "no area"),
        "rounding apart": ("a.off", off("1e6 1 0\n1e6 1.0000001 0\n1000000.0000001 1 0", "3 0 1 2"), "no extent"),
        "no counts": ("a.off", "OFF\nhello\n", "counts"),
        "binary OFF": ("a.off", b"OFF BINARY\n\0\0\0\3\0\0\0\1", "counts"),
        "another format": ("a.off", "solid x\nendsolid x\n", "does not begin with OFF"),
        "a picture": ("a.off", b"\x89PNG\r\n\x1a\n\0\0", "does not begin with OFF"),
        "unknown suffix": ("a.xyz", "0 0 0\n", "not a mesh format"),
        "OFF cut in its faces": ("a.off", PYRAMID[: PYRAMID.index("3 3 0")], "cut short.*6 faces.*5 found"),
        "OFF cut in its vertices": ("a.off", PYRAMID[: PYRAMID.index("2 2 0")], "cut short.*5 vertices.*2 and 0 found"),
        # Three coloured vertices, no face: 21 numbers, as many as three vertices and three triangles have.
        "OFF cut where the numbers come out even": (
            "a.off",
            "COFF\n3 3 0\n3 0 0 1 0 0 0\n1 0 3 0 1 2 3\n0 1 2 3 0 1 2\n",
            "cut short, 3 vertices and 3 faces announced, 3 and 0 found",
        ),
        "huge vertex count": ("a.off", "OFF\n999999999999 5 0\n1 2 3\n", "cut short"),
        "huge face count": ("a.off", "OFF\n1 999999999999 0\n1 2 3\n", "cut short"),
        "absurd count": ("a.off", "OFF\n" + "9" * 6000 + " 1 0\n", "not a readable OFF mesh"),
        "huge face": ("a.off", off(GOOD, "999999999999 0 1 2"), "3 of 999999999999 corners"),
        "OBJ index too high": ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "vertex 4, but there are only 3"),
        "OBJ index absurd": (
            "a.obj",
            "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 " + "9" * 30,
            "vertex 9+, but there are only 3",
        ),
        "OBJ index too low": ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -4 2 3\n", "vertex -4, but only 3 come before"),
        "OBJ index of no vertex yet": (
            "a.obj",
            "f -1 1 2\nv 0 0 0\nv 1 0 0\nv 0 1 0\n",
            "vertex -1, but only 0 come before",
        ),
        "OBJ index zero": ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "vertex 0, the first is 1"),
        "OBJ NaN": ("a.obj", "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "NaN or infinite"),
        "OBJ no faces": ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no faces"),
        "OBJ cut in a face": ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 2", "cut short"),
        "OBJ damaged inside": ("a.obj", "v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3\n", "vertex 2 has 2 of 3 coordinates"),
        "OBJ vertex not a number": ("a.obj", "v 0 0 zero\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "zero"),
        "OBJ index not a number": ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 two 3\n", "two"),
        "OBJ cut in a vertex": ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1", "cut short"),
        "PLY index too high": ("a.ply", text_ply.replace(b"3 1 3 0", b"3 1 33 0"), "vertex 33"),
        "PLY index below zero": ("a.ply", text_ply.replace(b"3 1 3 0", b"3 1 -3 0"), "vertex -3"),
        "PLY text cut in a line": ("a.ply", text_ply.rstrip()[:-2], "cut short"),
        "PLY text cut in its vertices": ("a.ply", text_ply[: len(text_ply) // 2], "cut short"),
        "PLY points": ("a.ply", trimesh.PointCloud(np.eye(3)).export(file_type="ply"), "no faces"),
        "STL cut in its header": ("a.stl", binary["stl"][:60], "cut short"),
        "STL header only": ("a.stl", binary["stl"][:84], "cut short, 12 faces announced, 0 found"),
        "STL cut": ("a.stl", binary["stl"][:400], "cut short, 12 faces announced, 6 found"),
        "STL named solid, cut": ("a.stl", b"solid" + binary["stl"][5:400], "cut short"),
        "STL text cut": ("a.stl", binary["stl_ascii"][:-30], "cut short"),
        "STL text cut in its second solid": (
            "a.stl",
            (2 * binary["stl_ascii"])[:-30] + "\n",
            "cut short",
        ),
        "STL NaN": ("a.stl", binary["stl"][:96] + struct.pack("<f", np.nan) + binary["stl"][100:], "NaN or infinite"),
    }
    for kind in ("ply", "glb"):
        for share in (0.1, 0.4, 0.7, 0.99):
            content = binary[kind][: int(len(binary[kind]) * share)]
            cases[f"{kind} cut at {share}"] = (f"a.{kind}", content, f"not a readable {kind.upper()} mesh")
    for suffix in FORMATS:
        cases[f"empty{suffix}"] = (f"a{suffix}", b"", "the file is empty")
        cases[f"blank{suffix}"] = (f"a{suffix}", b" \r\n\n", "the file is empty")
        cases[f"zeros{suffix}"] = (f"a{suffix}", bytes(300), "")
        cases[f"prose{suffix}"] = (f"a{suffix}", "To whom it may concern\n" * 20, "")
        cases[f"noise{suffix}"] = (f"a{suffix}", np.random.default_rng(0).bytes(500), "")
    return cases


BROKEN = broken_files()


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_file_gets_one_sentence(tmp_path, case):
    name, content, part = BROKEN[case]
    path = write(tmp_path, name, content)
    tracemalloc.start()
    with pytest.raises(MeshError, match=f"{re.escape(str(path))}: .*{part}") as refusal:
        load_mesh(path)
    assert tracemalloc.get_traced_memory()[1] < 50e6
    tracemalloc.stop()
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("suffix", FORMATS)
def test_no_file_and_a_folder(tmp_path, suffix):
    with pytest.raises(MeshError, match="there is no such file"):
        load_mesh(tmp_path / f"none{suffix}")
    (tmp_path / f"folder{suffix}").mkdir()
    with pytest.raises(MeshError, match="is a folder"):
        load_mesh(tmp_path / f"folder{suffix}")


@settings(deadline=None, max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.one_of(
        st.binary(max_size=200),
        st.binary(max_size=100).map(lambda tail: b"OFF\n3 1 0\n" + tail),
        st.text("OF0123456789-+.einfa#\n\r\t ", max_size=80).map(lambda tail: b"OFF" + tail.encode()),
        st.tuples(st.integers(0, len(PYRAMID) - 1), st.binary(max_size=3)).map(
            lambda edit: PYRAMID[: edit[0]].encode() + edit[1] + PYRAMID[edit[0] + 1 :].encode()
        ),
    )
)
def test_any_bytes_are_a_mesh_or_a_mesh_error(tmp_path, content):
    path = write(tmp_path, "fuzz.off", content)
    try:
        mesh = load_mesh(path)
    except MeshError:
        return
    assert np.isfinite(mesh.vertices).all()
    assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1)


def as_bytes(content: bytes | str) -> bytes:
    return content.encode() if isinstance(content, str) else content


SOUND = {kind: as_bytes(wedge().export(file_type=kind)) for kind in ("obj", "stl", "glb")}
SOUND["ply"] = wedge().export(file_type="ply", encoding="ascii")


@pytest.mark.parametrize("kind", ["off", "stl", "stl_ascii", "ply", "ply ascii", "glb"])
def test_a_file_cut_anywhere_is_refused(tmp_path, kind):
    kind, *ascii_ = kind.split()
    content = as_bytes(wedge().export(file_type=kind, **({"encoding": "ascii"} if ascii_ else {}))).rstrip(b"\n")
    path = tmp_path / f"cut.{kind.removesuffix('_ascii')}"
    for length in range(1, len(content), 5):
        path.write_bytes(content[:length])
        with pytest.raises(MeshError):
            load_mesh(path)


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(["obj", "ply", "stl", "glb"]), st.data())
def test_one_damaged_byte_never_gives_another_error(tmp_path, kind, data):
    content = bytearray(SOUND[kind])
    content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    try:
        mesh = load_mesh(write(tmp_path, f"fuzz.{kind}", bytes(content)))
    except MeshError:
        return
    assert np.isfinite(mesh.vertices).all()
    assert 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices)


def test_a_glb_without_a_mesh(tmp_path):
    facts = json.dumps({"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}]}).encode()
    facts += b" " * (-len(facts) % 4)
    glb = struct.pack("<4sII", b"glTF", 2, 20 + len(facts)) + struct.pack("<I4s", len(facts), b"JSON") + facts
    with pytest.raises(MeshError, match=r"empty\.glb"):
        load_mesh(write(tmp_path, "empty.glb", glb))


@pytest.mark.skipif("NEXTVIEW_DATA" not in os.environ, reason="NEXTVIEW_DATA names no folder of real meshes")
def test_real_meshes_as_trimesh_reads_them():
    paths = sorted(Path(os.environ["NEXTVIEW_DATA"]).glob("ModelNet10/*/test/*.off"))[::150]
    paths += sorted(Path(os.environ["NEXTVIEW_DATA"]).glob("PSB/*/*.off"))[::60]
    assert paths
    for path in paths:
        vertices, faces = read_off(path.read_bytes())
        other = trimesh.load(path, process=False)
        assert trimesh.Trimesh(vertices, faces, process=False).area == pytest.approx(other.area, rel=1e-6), path
        mesh = load_mesh(path)
        assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1)
