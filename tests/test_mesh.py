"""Meshes: every format, encoding and dialect gives the same shape, and polygons fall into triangles
that cover them exactly.
"""

import codecs
import itertools
import re

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from matplotlib.path import Path as Outline
from scipy.spatial.transform import Rotation
from test_broken_files import glb, one_triangle

from nextview.errors import MeshError
from nextview.geometry.mesh import load_mesh, make_mesh
from nextview.geometry.triangles import triangulate

# A house: a box with a ridge on it, of triangles, quads and pentagons. Its last vertex is used by
# no face.
POINTS = np.array(
    [(x, y, z) for x in (0.0, 3.0) for y, z in ((0, 0), (2, 0), (2, 1), (1, 2), (0, 1))]
    + [(9.0, 9.0, 9.0)]
)
SIDES = [[k, 5 + k, 5 + (k + 1) % 5, (k + 1) % 5] for k in range(5)]
FACES = [[0, 1, 2, 3, 4], [9, 8, 7, 6, 5], *SIDES[:-1], [4, 9, 5], [4, 5, 0]]
TRIANGLES = [[face[0], b, c] for face in FACES for b, c in itertools.pairwise(face[1:])]
AREA = 2 * 3.0 + 3 * (2 + 1 + 1 + 2 * np.sqrt(2))


def assert_is_the_house(path, content) -> None:
    """See that a file is the house, which is closed, in the units of the file."""
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    mesh = load_mesh(path, up="z")
    assert len(mesh.vertices) in (10, 3 * len(mesh.faces))
    a, b, c = (mesh.vertices[corner] * mesh.radius for corner in mesh.faces.T)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area == pytest.approx(AREA, rel=1e-5)
    np.testing.assert_allclose(mesh.centre, (1.5, 1, 1), atol=1e-6)


def numbers(row) -> str:
    return " ".join(f"{value:g}" for value in row)


def as_obj(name="") -> str:
    rows = [f"v {numbers(p)}" for p in POINTS] + [f"o {name}"] * bool(name)
    return "\n".join(rows + ["f " + numbers(np.add(face, 1)) for face in FACES]) + "\n"


LISTS = [numbers([len(face), *face]) for face in FACES]
COUNTS = f"{len(POINTS)} {len(FACES)}"
BARE = "\n".join([*map(numbers, POINTS), *LISTS]) + "\n"
COLOURED = "\n".join(
    [
        *(f"{numbers(p)} 0.5 0.25 1 1" for p in POINTS),
        *(f"{row} 9 9 9" for row in LISTS),
    ]
)


def as_off(name="") -> str:
    return f"OFF # {name}\n{COUNTS} 0\n{BARE}"


def as_ply(name="") -> str:
    columns = "".join(f"property float {axis}\n" for axis in "xyz")
    return (
        f"ply\nformat ascii 1.0\ncomment {name}\nelement vertex {len(POINTS)}\n{columns}"
        f"element face {len(FACES)}\nproperty list uchar int vertex_indices\nend_header\n{BARE}"
    )


def as_stl(
    name="", end="endsolid", normal="facet normal 0 0 0", faces=TRIANGLES
) -> str:
    loops = ["\n".join(f"vertex {numbers(POINTS[i])}" for i in face) for face in faces]
    facets = [f"{normal}\nouter loop\n{loop}\nendloop\nendfacet" for loop in loops]
    return "\n".join([f"solid {name}", *facets, f"{end} {name}"]) + "\n"


TEXTS = {"obj": as_obj, "off": as_off, "ply": as_ply, "stl": as_stl}
ENCODINGS = {
    "UTF-8 with a mark": (codecs.BOM_UTF8, "utf-8"),
    "UTF-16 LE": (codecs.BOM_UTF16_LE, "utf-16-le"),
    "UTF-16 BE without a mark": (b"", "utf-16-be"),
    "UTF-32 BE": (codecs.BOM_UTF32_BE, "utf-32-be"),
    "Latin-1": (b"", "latin-1"),
}


@pytest.mark.parametrize("kind", TEXTS)
def test_a_text_in_any_encoding_is_the_same_mesh(tmp_path, kind):
    text = TEXTS[kind]("B\xfcro \xb5")
    for mark, codec in ENCODINGS.values():
        for ends in ("\n", "\r\n", "\r"):
            content = mark + text.replace("\n", ends).encode(codec)
            assert_is_the_house(tmp_path / f"house.{kind}", content)


NAMES = {"u1": "uchar", "i1": "char", "u2": "ushort", "i2": "short", "u4": "uint"}
NAMES |= {"i4": "int", "f4": "float", "u8": "uint64", "f8": "double"}


def binary_ply(
    order="<", count="u1", index="i4", extra=(), lists=(), faces=FACES
) -> bytes:
    """The house in binary, with columns beside those that are needed, and lists of three floats
    before the corners.
    """
    more = [f"property uchar {name}" for name in extra]
    header = [
        "ply",
        f"format binary_{'little' if order == '<' else 'big'}_endian 1.0",
        "element camera 2",
        f"property list {NAMES[count]} short pixels",
        "property double focal",
        f"element vertex {len(POINTS)}",
        *(f"property float {axis}" for axis in "xyz"),
        *more,
        f"element face {len(faces)}",
        *(f"property list {NAMES[count]} float {name}" for name in lists),
        f"property list {NAMES[count]} {NAMES[index]} vertex_index",
        *more,
        "end_header\n",
    ]

    def column(values, kind):
        return np.array(values, order + kind).tobytes()

    body = b"".join(
        column([n], count) + column(range(n), "i2") + column([1.5], "f8")
        for n in (2, 3)
    )
    body += b"".join(column(point, "f4") + bytes(len(extra)) for point in POINTS)
    for face in faces:
        body += len(lists) * (column([3], count) + column([7, 8, 9], "f4"))
        body += column([len(face)], count) + column(face, index) + bytes(len(extra))
    return "\n".join(header).encode() + body


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"count": "i4", "index": "u4"},
        {"count": "u4", "index": "u8"},
        {"count": "i1", "index": "u1", "extra": ("red", "green", "blue")},
        {"count": "u2", "extra": ("quality",), "lists": ("texcoord", "weights")},
        {"faces": TRIANGLES, "extra": ("red",), "lists": ("texcoord",)},
    ],
    ids=str,
)
def test_every_kind_of_binary_ply(tmp_path, how):
    for order in "<>":
        content = binary_ply(order, **how)
        assert_is_the_house(tmp_path / "house.ply", content)
        assert_is_the_house(tmp_path / "house.ply", content + b"\0 of a program")


# the second one turns: it names a vertex twice
STRIPS = [[0, 1, 2, 3, -1, 3, 2, 4], [4, 5, 4, 6, 7]]
STRIP_TRIANGLES = [(0, 1, 2), (2, 1, 3), (3, 2, 4), (4, 5, 6), (4, 6, 7)]


@pytest.mark.parametrize("text", [True, False])
def test_triangle_strips(tmp_path, text):
    points = np.array([(k, k % 2, k * k / 9) for k in range(8)], float)
    header = f"ply\nformat {'ascii' if text else 'binary_little_endian'} 1.0\nelement vertex 8\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz")
    header += "element tristrips 2\nproperty list int int vertex_indices\nend_header\n"
    rows = [*map(numbers, points), *(numbers([len(s), *s]) for s in STRIPS)]
    packed = [np.array([len(s), *s], "<i4").tobytes() for s in STRIPS]
    body = "\n".join(rows).encode() if text else points.tobytes() + b"".join(packed)
    (tmp_path / "strips.ply").write_bytes(header.encode() + body)
    mesh = load_mesh(tmp_path / "strips.ply")
    found = (mesh.vertices * mesh.radius + mesh.centre)[mesh.faces]
    np.testing.assert_allclose(found, points[np.array(STRIP_TRIANGLES)], atol=1e-4)


@pytest.mark.parametrize("name", ["", "vertex 1 2 3", "my endsolid endloop", "solid"])
def test_stl_texts_with_any_name_and_without_normals(tmp_path, name):
    for end in ("endsolid", "end solid", "  ENDSOLID"):
        for normal in ("facet normal 0 0 1", "facet normal nan nan nan", "facet", ""):
            text = as_stl(name, end, normal)
            assert_is_the_house(tmp_path / "house.stl", text)
            assert_is_the_house(tmp_path / "house.stl", text.upper())


@pytest.mark.parametrize(
    "header", [b"", b"solid with a vertex", b"\xfe\xff", b"s\0o\0l"]
)
def test_binary_stl_with_any_header_and_bytes_after_its_end(tmp_path, header):
    facets = b"".join(
        np.array([(0, 0, 0), *POINTS[triangle]], "<f4").tobytes() + b"\0\0"
        for triangle in TRIANGLES
    )
    count = np.uint32(len(TRIANGLES)).tobytes()
    content = header.ljust(80, b"\0") + count + facets
    for after in (b"", b"\n", b"end of the file"):
        assert_is_the_house(tmp_path / "house.stl", content + after)


DIALECTS = {
    "lower case": f"off\n{COUNTS} 0\n{BARE}",
    "ModelNet": f"OFF{COUNTS} 0\n{BARE}",
    "counts on three lines": f"OFF {len(POINTS)}\n{len(FACES)}\n  17 \n{BARE}",
    "no count of edges": f"OFF\n{COUNTS}\n{BARE}",
    "comments": "# made by hand\n" + as_off().replace("\n", " # 7 8 9\n"),
    "blank lines": as_off().replace("\n", " \t\n  \n"),
    "colours": f"COFF\n{COUNTS} 0\n{COLOURED}\n",
    "colours without a gap": f"COFF{COUNTS} 0\n{COLOURED}\n",
    "normals and colours": f"NCOFF\n{COUNTS} 0\n{COLOURED}\n",
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_dialects_of_off(tmp_path, dialect):
    assert_is_the_house(tmp_path / "house.off", DIALECTS[dialect])


OBJS = {
    "capitals": as_obj("house").upper(),
    "texture, normals and groups": "mtllib none.mtl\nvt 0 0\nvn 0 0 1\n"
    + re.sub(r"(?<=\nf )(\d+) (\d+)", r"\1/1/1 \2//1", as_obj("a")).replace(
        "\nf 1/", "\ng sides\ns off\nusemtl a\nf 1/"
    ),
    "colours and comments": as_obj().replace("\nv ", " 0.5 0.5 0.5 # c\nv "),
    "continued": as_obj().replace("f 1 2 3", "f 1 2 \\\n 3"),
    "relative": as_obj().replace("f 1 2 3 4 5", f"f {numbers(np.arange(-11, -6))}"),
}


@pytest.mark.parametrize("dialect", OBJS)
def test_dialects_of_obj(tmp_path, dialect):
    assert_is_the_house(tmp_path / "house.obj", OBJS[dialect])


def test_a_house_in_glb(tmp_path):
    content = trimesh.Trimesh(POINTS, TRIANGLES).export(file_type="glb")
    assert_is_the_house(tmp_path / "house.glb", content)


def test_parts_of_a_glb_have_the_transforms_of_their_nodes(tmp_path):
    """A chain of nodes that rotate, scale and move, computed by hand."""
    # x to y, y to z, z to x
    turn = {"rotation": [0.5, 0.5, 0.5, 0.5], "scale": [2, 3, 4]}
    nodes = [
        {"translation": [1, 2, 3], "children": [1, 2]} | turn,
        {"mesh": 0},
        {"mesh": 0, "scale": [0.5, 0.5, 0.5]},
    ]
    (tmp_path / "chain.glb").write_bytes(glb(one_triangle(nodes=nodes)))
    mesh = load_mesh(tmp_path / "chain.glb", up="z")
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


# Damage, beyond the table of broken files


EXPORTS = ("off", "stl", "ply", "glb")


@pytest.mark.parametrize("kind", EXPORTS)
def test_a_file_cut_anywhere_is_refused(tmp_path, kind):
    content = trimesh.creation.box((2, 3, 5)).export(file_type=kind)
    data = (content.encode() if isinstance(content, str) else content).rstrip(b"\n")
    path = tmp_path / f"cut.{kind}"
    for length in range(1, len(data), 7):
        path.write_bytes(data[:length])
        with pytest.raises(MeshError):
            load_mesh(path)


@settings(
    deadline=None,
    max_examples=60,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(st.sampled_from([*EXPORTS, "obj"]), st.data())
def test_damaged_bytes_never_give_another_error(tmp_path, kind, data):
    content = trimesh.creation.box((2, 3, 5)).export(file_type=kind)
    damaged = bytearray(content.encode() if isinstance(content, str) else content)
    at = data.draw(st.integers(0, len(damaged) - 1))
    damaged[at : at + 1] = data.draw(st.binary(max_size=3))
    path = tmp_path / f"fuzz.{kind}"
    path.write_bytes(damaged)
    try:
        mesh = load_mesh(path)
    except MeshError:
        return
    assert np.isfinite(mesh.vertices).all()
    assert 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices)


# Normalising


@settings(deadline=None)
@given(
    npst.arrays(np.float64, (8, 3), elements=st.floats(-1, 1, allow_subnormal=False)),
    st.sampled_from([1e-200, 1e-6, 1.0, 1e30, 1e200]),
    st.sampled_from([0.0, 1.0, -100.0, 1e5]),
)
def test_the_object_frame(shape, scale, offset):
    # one face at least has an area
    positions = (np.vstack([shape, np.eye(3)]) + offset) * scale
    faces = [[0, 1, 2], [2, 3, 4], [4, 5, 6], [6, 7, 0], [8, 9, 10]]
    mesh = make_mesh(positions, faces)
    assume(len(mesh.vertices) == len(positions))  # no triangle is a copy of another one
    np.testing.assert_allclose(mesh.vertices.min(0), -mesh.vertices.max(0), atol=1e-7)
    assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1)
    rounding = 1e-12 * scale * max(abs(offset), 1)
    back = mesh.vertices * mesh.radius + mesh.centre
    np.testing.assert_allclose(back, positions, rtol=0, atol=rounding)


# Polygons


BENCH = [
    (0, 0),
    (0.1, 0),
    (0.1, 0.6),
    (1.1, 0.6),
    (1.1, 0),
    (1.2, 0),
    (1.2, 0.7),
    (0, 0.7),
]
TURNS = np.linspace(0, 2 * np.pi, 12, endpoint=False)
COMB = [(x, 5 * (x % 2)) for x in range(20)] + [(19, 6), (0, 6)]
OUTLINES = {
    "square": [(0, 0), (1, 0), (1, 1), (0, 1)],
    "a U from a reflex corner": BENCH[2:] + BENCH[:2],
    "a U clockwise": BENCH[::-1],
    "an arrow of four corners": [(0, 0), (2, 1), (0, 2), (0.5, 1)],
    "a star": [
        ((1 + k % 2) * np.cos(a), (1 + k % 2) * np.sin(a)) for k, a in enumerate(TURNS)
    ],
    "a comb": COMB,
    "corners twice": [p for p in BENCH for _ in range(2)],
    "a frame with a slit": [
        *((0, 0), (4, 0), (4, 4), (0, 4), (0, 0)),
        *((1, 1), (1, 3), (3, 3), (3, 1), (1, 1)),
    ],
}


def shoelace(outline: np.ndarray) -> float:
    x, y = outline.T
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2)


def cut(points: np.ndarray) -> np.ndarray:
    return triangulate(points, np.arange(len(points)), np.array([len(points)]))


def areas(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area vectors of triangles, (F, 3)."""
    a, b, c = (points[corner] for corner in faces.T)
    return np.cross(b - a, c - a) / 2


@pytest.mark.parametrize("name", OUTLINES)
def test_the_triangles_cover_the_polygon_and_nothing_else(name):
    for first in range(4):
        outline = np.roll(np.array(OUTLINES[name], float), -2 * first, axis=0)
        turn = Rotation.random(rng=first).as_matrix()
        flat = np.column_stack([outline, np.zeros(len(outline))])
        points = flat @ turn.T + (100, -200, 300)
        faces = cut(points)
        found = areas(points, faces)
        # All of them are wound as the polygon is, and none lies over another one: then the areas
        # add up to the polygon's.
        area = shoelace(outline)
        assert np.linalg.norm(found, axis=1).sum() == pytest.approx(abs(area))
        np.testing.assert_allclose(found.sum(0), area * turn[:, 2], atol=1e-9)
        middles = outline[faces[np.linalg.norm(found, axis=1) > 1e-9]].mean(1)
        assert Outline(outline).contains_points(middles).all()
