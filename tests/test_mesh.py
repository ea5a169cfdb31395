"""Meshes: every format gives the same shape, and every broken file one clear sentence, in memory
as of its size.
"""

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
from nextview.geometry.mesh import BYTES_PER_FACE, FORMATS, Mesh, load_mesh, make_mesh
from nextview.geometry.mesh_file import read_off

SQUARE = [[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]
PYRAMID = (
    "OFF\n5 6 9\n0 0 0\n2 0 0\n2 2 0\n0 2 0\n1 1 3\n3 0 2 1\n3 0 3 2\n3 0 1 4\n3 1 2 4\n3 2 3 4\n3"
    " 3 0 4\n"
)
GOOD = "0 0 0\n1 0 0\n0 1 1"
FACET = (
    "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 "
    "0 0\nvertex 0 1 1\nendloop\nendfacet\n"
)
TRIANGLE = (
    np.array([[0, 0, 0], [1, 0, 0], [0, 1, 1]], "<f4").tobytes()
    + np.arange(3, dtype="<u4").tobytes()
)
BIG = 150_000_000


def wedge() -> trimesh.Trimesh:
    """A shape without any symmetry, far from the origin."""
    box = trimesh.creation.box((2, 3, 5))
    box.vertices[box.vertices[:, 2] > 0] *= (0.5, 0.7, 1.4)
    box.vertices += (10, -20, 30)
    return box


def exported(shape: trimesh.Trimesh, kind: str) -> bytes:
    kind, *text = kind.split()
    content = shape.export(file_type=kind, **({"encoding": "ascii"} if text else {}))
    return content.encode() if isinstance(content, str) else content


def triangles(mesh: Mesh) -> np.ndarray:
    """The corners of every triangle in an order that depends on the shape alone."""
    corners = np.round(mesh.vertices[mesh.faces] + 0.0, 5)
    first = np.lexsort(corners.transpose(2, 0, 1)[::-1], axis=-1)[:, 0]
    rotated = np.take_along_axis(
        corners,
        ((first[:, None] + np.arange(3)) % 3)[..., None],
        1,
    ).reshape(-1, 9)
    return rotated[np.lexsort(rotated.T[::-1])]


def write(folder: Path, name: str, content: bytes | str) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def off(vertices: str, faces: str) -> str:
    count = [len(part.strip().splitlines()) for part in (vertices, faces)]
    return f"OFF\n{count[0]} {count[1]} 0\n{vertices}\n{faces}\n"


def vertices_edited(replacement: str) -> str:
    """The pyramid with every line of three numbers replaced but the counts."""
    return re.sub(
        r"(?m)^(\d) (\d) (\d)$",
        replacement,
        PYRAMID.replace("5 6 9", "counts"),
    ).replace("counts", "5 6 9")


def ply(faces: int, body: str) -> str:
    return (
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty"
        f" float z\nelement face {faces}\nproperty list uchar int"
        f" vertex_indices\nend_header\n{body}"
    )


def glb(gltf: dict, binary: bytes = b"") -> bytes:
    text = json.dumps(gltf).encode()
    text += b" " * (-len(text) % 4)
    chunks = (
        struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(binary), b"BIN\0")
        + binary
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def one_triangle(positions=None, view=None, **changes) -> dict:
    """The JSON of a GLB of one triangle, some of whose parts are replaced; its binary part is
    TRIANGLE.
    """
    accessor = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"} | (
        positions or {}
    )
    return {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {key: value for key, value in accessor.items() if value is not None},
            {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36} | (view or {}),
            {"buffer": 0, "byteOffset": 36, "byteLength": 12},
        ],
        "buffers": [{"byteLength": len(TRIANGLE)}],
    } | changes


# Reading


@pytest.mark.parametrize(
    "kind",
    ["off", "obj", "ply", "ply ascii", "stl", "stl_ascii", "glb"],
)
def test_every_format_gives_the_same_mesh(tmp_path, kind):
    shape = wedge()
    if kind == "glb":  # y up: x stays, the height is y, and -y is the depth z
        shape.vertices = shape.vertices[:, [0, 2, 1]] * (1, 1, -1)
    mesh = load_mesh(write(tmp_path, f"wedge.{kind[:3]}", exported(shape, kind)))
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
        PYRAMID.replace("\n", " \t\n  \n"),
        PYRAMID.rstrip("\n"),
        "# made by hand\n" + PYRAMID.replace("\n", " # 7 8 9\n"),
        PYRAMID.replace("5 6 9", "5 6"),
        PYRAMID.replace("3 0 2 1\n3 0 3 2\n", "4 0 3 2 1\n").replace("5 6 9", "5 5 9"),
        re.sub(r"(?m)^(3 \d \d \d)$", r"\1 255 128 0", PYRAMID),
        vertices_edited(r"\1 \2 \3 255 128 0 255").replace("OFF", "COFF"),
        vertices_edited(r"\1 \2 \3 0 0 1").replace("OFF", "NOFF"),
        vertices_edited(r"\1.0 \2e0 +\3."),
    ],
    ids=lambda text: repr(text[:24]),
)
def test_off_as_it_is_found_in_the_wild(text):
    closed = trimesh.Trimesh(*read_off(text.encode()))
    assert len(closed.faces) == 6
    assert closed.is_watertight
    assert closed.volume == pytest.approx(4 * 3 / 3)


@given(st.data())
def test_the_fast_and_the_tolerant_way_of_reading_off_agree(data):
    count = data.draw(st.integers(3, 8))
    numbers, corner = st.floats(-1e6, 1e6), st.integers(0, count - 1)
    vertices = data.draw(
        st.lists(st.tuples(numbers, numbers, numbers), min_size=count, max_size=count)
    )
    faces = data.draw(
        st.lists(st.tuples(corner, corner, corner), min_size=1, max_size=6)
    )
    text = off(
        "\n".join(f"{x!r} {y!r} {z!r}" for x, y, z in vertices),
        "\n".join("3 {} {} {}".format(*f) for f in faces),
    )
    for read in (
        read_off(text.encode()),
        read_off(re.sub(r"(?m)^(3 \d \d \d)$", r"\1 1 2 3", text).encode()),
    ):
        np.testing.assert_array_equal(read[0], vertices)
        np.testing.assert_array_equal(read[1], faces)


def test_parts_of_an_obj_are_joined_and_relative_indices_count_from_where_they_stand(
    tmp_path,
):
    # The format's own example: every face takes the four vertices just before it.
    squares = [np.add(SQUARE, (0, 0, height)) for height in (0, 1, 5)]
    text = "".join(
        "o a\n" + "".join("v {} {} {}\n".format(*v) for v in s) + "f -4 -3 -2 -1\n"
        for s in squares
    )
    mesh = load_mesh(write(tmp_path, "squares.obj", text))
    found = (mesh.vertices * mesh.radius + mesh.centre)[mesh.faces]
    assert np.ptp(found[..., 2], axis=1).max() < 1e-9
    assert np.round(found[:, 0, 2], 9).tolist() == [0, 0, 1, 1, 5, 5]


@pytest.mark.parametrize(
    "faces",
    [
        "f 1 2 3 # part 0\nf 1 3 4 # 0\nf 4 3 5\nf 1 4 5\nf 2 1 5\nf 3 2 5\n",
        (
            "f 1/1/1 2/1/1 3/1/1 4/1/1\ng sides\nf 4//1 3//1 5//1\nf 1/1 4/1 5/1\ns off\nf 2 1"
            " 5\nusemtl a\nf 3 2 5"
        ),
        "f 1 2 \\\n 3 4\nf -2 3 5\nf 1 4 -1\nf 2 -5 5\nf 3 2 5\n",
    ],
    ids=["comments", "texture, normals and groups", "continued and relative"],
)
@pytest.mark.parametrize("change", [str, lambda text: text.replace("\n", "\r\n")])
def test_obj_as_it_is_found_in_the_wild(tmp_path, faces, change):
    apex = "v 1 1 -3 0.5 0.5 0.5 # with a colour\nvt 0 0\nvn 0 0 1\n"
    text = (
        "mtllib none.mtl\n\n"
        + "".join("v {} {} {}\n".format(*v) for v in SQUARE)
        + apex
        + faces
    )
    mesh = load_mesh(write(tmp_path, "pyramid.obj", change(text)))
    closed = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert len(mesh.faces) == 6
    assert closed.is_watertight
    assert closed.volume * mesh.radius**3 == pytest.approx(4 * 3 / 3)


def test_parts_of_a_glb_have_the_transforms_of_their_nodes(tmp_path):
    """A chain of nodes that rotate, scale and move, computed by hand."""
    # x to y, y to z, z to x
    first = {
        "translation": [1, 2, 3],
        "rotation": [0.5, 0.5, 0.5, 0.5],
        "scale": [2, 3, 4],
    }
    nodes = [
        first | {"children": [1, 2]},
        {"mesh": 0},
        {"mesh": 0, "scale": [0.5, 0.5, 0.5]},
    ]
    mesh = load_mesh(
        write(tmp_path, "chain.glb", glb(one_triangle(nodes=nodes), TRIANGLE)),
        up="z",
    )
    plain = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 1.0]])
    expected = [
        np.add(np.roll(scale * plain * (2, 3, 4), 1, axis=1), (1, 2, 3))
        for scale in (1, 0.5)
    ]
    found = (mesh.vertices * mesh.radius + mesh.centre)[mesh.faces]
    np.testing.assert_allclose(
        sorted(found.round(9).tolist()),
        sorted(np.round(expected, 9).tolist()),
        atol=1e-6,
    )


# Normalising


@settings(deadline=None)
@given(
    npst.arrays(np.float64, (8, 3), elements=st.floats(-1, 1, allow_subnormal=False)),
    st.sampled_from([1e-200, 1e-30, 1e-6, 1.0, 1e6, 1e30, 1e200]),
    st.sampled_from([0.0, 1.0, -100.0, 1e5]),
)
def test_the_object_frame(shape, scale, offset):
    positions = (
        np.vstack([shape, np.eye(3)]) + offset
    ) * scale  # one face at least has an area
    mesh = make_mesh(
        positions,
        [[0, 1, 2], [2, 3, 4], [4, 5, 6], [6, 7, 0], [8, 9, 10]],
    )
    assume(len(mesh.vertices) == len(positions))  # no triangle is a copy of another one
    np.testing.assert_allclose(mesh.vertices.min(0), -mesh.vertices.max(0), atol=1e-7)
    assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1)
    rounding = 1e-12 * scale * max(abs(offset), 1)
    np.testing.assert_allclose(
        mesh.vertices * mesh.radius + mesh.centre,
        positions,
        rtol=0,
        atol=rounding,
    )


def test_a_mesh_is_the_same_with_copies_of_its_triangles():
    ball = trimesh.creation.icosphere(2)
    plain = make_mesh(ball.vertices, ball.faces)
    copies = [
        ball.faces,
        ball.faces[:, [1, 2, 0]],
        ball.faces[:, ::-1],
        ball.faces + len(ball.vertices),
    ]
    doubled = make_mesh(
        np.concatenate([ball.vertices, ball.vertices]),
        np.concatenate(copies),
    )
    np.testing.assert_array_equal(doubled.faces, plain.faces)
    np.testing.assert_array_equal(doubled.vertices, plain.vertices)


# Refusing


OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
MANY_TIMES = one_triangle(
    scenes=[{"nodes": list(range(101))}],
    nodes=101 * [{"mesh": 0}],
)
BROKEN = {
    "no faces": ("a.off", "OFF\n3 0 0\n" + GOOD, "holds 3 points and no faces"),
    "index too high": ("a.off", off(GOOD, "3 0 1 3"), "outside of the 3"),
    "too few corners": ("a.off", off(GOOD, "3 0 1"), "face 0 has 2 of 3 corners"),
    "NaN": (
        "a.off",
        off("0 0 nan\n1 0 0\n0 1 0", "3 0 1 2"),
        "1 vertices are NaN or infinite",
    ),
    "too large": (
        "a.off",
        off("-1.7e308 -1.7e308 0\n1.7e308 0 0\n0 1.7e308 0", "3 0 1 2"),
        "too large",
    ),
    "one place": ("a.off", off("5 5 5\n5 5 5\n5 5 5", "3 0 1 2"), "no extent"),
    "a slanted line": (
        "a.off",
        off("0.1 0.1 0.1\n0.2 0.3 0.4\n0.3 0.5 0.7", "3 0 1 2"),
        "no area",
    ),
    "another format": ("a.off", "solid x\nendsolid x\n", "does not begin with OFF"),
    "unknown suffix": ("a.xyz", "0 0 0\n", "not a mesh format"),
    "cut in its faces": (
        "a.off",
        PYRAMID[: PYRAMID.index("3 3 0")],
        "cut short.*6 faces.*5 found",
    ),
    "cut where the numbers come out even": (
        "a.off",
        "COFF\n3 3 0\n3 0 0 1 0 0 0\n1 0 3 0 1 2 3\n0 1 2 3 0 1 2\n",
        "3 faces announced, 3 and 0 found",
    ),
    "huge counts": ("a.off", "OFF\n1 999999999999 0\n1 2 3\n", "cut short"),
    "too many bytes": (
        "a.off",
        "OFF\n" + " " * 100 * BYTES_PER_FACE,
        "has more than 6,000 bytes; max_faces",
    ),
    "too many faces": (
        "a.off",
        off(GOOD, "3 0 1 2\n" * 101),
        "101 triangles, more than 100; max_faces",
    ),
    "OBJ index too high": (
        "a.obj",
        OBJ + "f 1 2 4\n",
        "vertex 4, but there are only 3",
    ),
    "OBJ index of no vertex yet": ("a.obj", f"f -1 1 2\n{OBJ}", "0 come before it"),
    "OBJ cut in a face": ("a.obj", OBJ + "f 1 2 3\nf 1 2", "cut short"),
    "PLY index too high": ("a.ply", ply(1, GOOD + "\n3 0 1 3\n"), "vertex 3"),
    "PLY points": (
        "a.ply",
        trimesh.PointCloud(np.eye(3)).export(file_type="ply"),
        "holds 3 points and no faces",
    ),
    "PLY of more rows than lines": (
        "a.ply",
        ply(BIG, GOOD + "\n3 0 1 2\n"),
        "cut short",
    ),
    "PLY of a list longer than the file": (
        "a.ply",
        ply(1, GOOD + f"\n{BIG} 0 1 2\n"),
        "",
    ),
    "STL cut in its second solid": (
        "a.stl",
        2 * exported(wedge(), "stl_ascii")[:-30] + b"\n",
        "cut short",
    ),
    "GLB without data": (
        "a.glb",
        glb(one_triangle({"bufferView": None, "count": BIG}), TRIANGLE),
        "than its bytes",
    ),
    "GLB of more positions than bytes": (
        "a.glb",
        glb(one_triangle({"count": BIG}), TRIANGLE),
        "",
    ),
    "GLB view beyond the buffer": (
        "a.glb",
        glb(one_triangle(view={"byteOffset": 1 << 40}), TRIANGLE),
        "",
    ),
    "GLB sparse": ("a.glb", glb(one_triangle({"sparse": {}}), TRIANGLE), "sparse"),
    "GLB quantised": (
        "a.glb",
        glb(one_triangle({"normalized": True}), TRIANGLE),
        "fractions",
    ),
    "GLB elsewhere": (
        "a.glb",
        glb(one_triangle(buffers=[{"uri": "x.bin"}])),
        "outside of its binary part",
    ),
    "GLB node in itself": (
        "a.glb",
        glb(one_triangle(nodes=[{"children": [0]}]), TRIANGLE),
        "twice",
    ),
    "GLB mesh too often": (
        "a.glb",
        glb(MANY_TIMES, TRIANGLE),
        "101 triangles, more than 100; max_faces",
    ),
}
for suffix in FORMATS:
    BROKEN[f"empty{suffix}"] = (f"a{suffix}", b" \r\n\n", "the file is empty")
    BROKEN[f"prose{suffix}"] = (f"a{suffix}", "To whom it may concern\n" * 20, "")
    BROKEN[f"noise{suffix}"] = (f"a{suffix}", np.random.default_rng(0).bytes(500), "")


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_file_gets_one_sentence_in_little_memory(tmp_path, case, capfd):
    name, content, part = BROKEN[case]
    path = write(tmp_path, name, content)
    tracemalloc.start()
    with pytest.raises(
        MeshError,
        match=f"^{re.escape(str(path))}: .*{part}",
    ) as refusal:
        load_mesh(path, max_faces=100)
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()
    assert "\n" not in str(refusal.value)
    assert capfd.readouterr() == ("", "")


HARMLESS = {
    "a texture that is none": (
        "a.glb",
        glb(
            one_triangle(
                images=[{"uri": "x.png"}],
                textures=[{"source": 0}],
                materials=[{}],
            ),
            TRIANGLE,
        ),
    ),
    "a Latin-1 name": (
        "a.stl",
        f"solid T\xfcr\n{FACET}endsolid T\xfcr\n".encode("latin-1"),
    ),
    "copies": (
        "a.off",
        "OFF\n3 200000 0\n" + GOOD + "\n" + "3 0 1 2\n3 2 1 0\n" * 100_000,
    ),
    "a binary STL that begins with solid": (
        "a.stl",
        b"solid".ljust(80)
        + struct.pack("<I12f2x", 1, *[0, 0, 1], *np.frombuffer(TRIANGLE, "<f4", 9)),
    ),
}


@pytest.mark.parametrize("case", HARMLESS)
def test_a_strange_file_is_read_in_memory_as_of_its_size(tmp_path, case, capfd):
    path = write(tmp_path, *HARMLESS[case])
    tracemalloc.start()
    mesh = load_mesh(path)
    assert tracemalloc.get_traced_memory()[1] < 100e6
    tracemalloc.stop()
    assert mesh.faces.shape == mesh.vertices.shape == (1, 3) or (
        len(mesh.faces),
        len(mesh.vertices),
    ) == (1, 3)
    assert capfd.readouterr() == ("", "")


def test_only_regular_files_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe.off")
    (tmp_path / "endless.off").symlink_to("/dev/zero")
    (tmp_path / "folder.off").mkdir()
    for name in ("pipe.off", "endless.off", "folder.off", "none.off"):
        with pytest.raises(MeshError, match=rf"{name}: (is no|no such) file"):
            load_mesh(tmp_path / name)


@pytest.mark.parametrize("kind", ["off", "stl", "stl_ascii", "ply", "ply ascii", "glb"])
def test_a_file_cut_anywhere_is_refused(tmp_path, kind):
    content = exported(wedge(), kind).rstrip(b"\n")
    path = tmp_path / f"cut.{kind[:3]}"
    for length in range(1, len(content), 5):
        path.write_bytes(content[:length])
        with pytest.raises(MeshError):
            load_mesh(path)


@settings(
    deadline=None,
    max_examples=80,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(st.sampled_from(["off", "obj", "ply", "ply ascii", "stl", "glb"]), st.data())
def test_damaged_bytes_never_give_another_error(tmp_path, kind, data):
    content = bytearray(exported(wedge(), kind))
    at = data.draw(st.integers(0, len(content) - 1))
    content[at : at + 1] = data.draw(st.binary(max_size=3))
    try:
        mesh = load_mesh(write(tmp_path, f"fuzz.{kind[:3]}", bytes(content)))
    except MeshError:
        return
    assert np.isfinite(mesh.vertices).all()
    assert 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices)
