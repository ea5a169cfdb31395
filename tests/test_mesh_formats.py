"""Mesh files as editors save them and exporters write them: encodings, line ends, kinds of PLY
and STL.
"""

import bz2
import codecs
import gzip
import itertools
import lzma
import re

import numpy as np
import pytest

from nextview.errors import MeshError
from nextview.geometry.mesh import load_mesh

# A house: a box with a ridge on it, of triangles, quads and pentagons. Its last vertex is used by
# no face.
POINTS = np.array(
    [(x, y, z) for x in (0.0, 3.0) for y, z in ((0, 0), (2, 0), (2, 1), (1, 2), (0, 1))]
    + [(9.0, 9.0, 9.0)]
)
SIDES = [[k, 5 + k, 5 + (k + 1) % 5, (k + 1) % 5] for k in range(5)]
FACES = [[0, 1, 2, 3, 4], [9, 8, 7, 6, 5], *SIDES[:-1], [4, 9, 5], [4, 5, 0]]
AREA = 2 * 3.0 + 3 * (2 + 1 + 1 + 2 * np.sqrt(2))


def assert_is_the_house(mesh) -> None:
    """See that a mesh is the house, which is closed, in the units of the file."""
    assert len(mesh.vertices) in (10, 3 * len(mesh.faces))
    a, b, c = (mesh.vertices[corner] * mesh.radius for corner in mesh.faces.T)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(
        AREA,
        rel=1e-5,
    )
    np.testing.assert_allclose(mesh.centre, (1.5, 1, 1), atol=1e-6)


def numbers(row) -> str:
    return " ".join(f"{value:g}" for value in row)


def triangles() -> list[list[int]]:
    return [[face[0], b, c] for face in FACES for b, c in itertools.pairwise(face[1:])]


def as_obj(name="") -> str:
    rows = [f"v {numbers(p)}" for p in POINTS] + [f"o {name}"] * bool(name)
    return "\n".join(rows + ["f " + numbers(np.add(face, 1)) for face in FACES]) + "\n"


def as_off(name="") -> str:
    rows = [*map(numbers, POINTS), *(numbers([len(face), *face]) for face in FACES)]
    return "\n".join([f"OFF # {name}", f"{len(POINTS)} {len(FACES)} 0", *rows]) + "\n"


def as_ply(name="") -> str:
    header = [f"ply\nformat ascii 1.0\ncomment {name}\nelement vertex {len(POINTS)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [
        f"element face {len(FACES)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    return (
        "\n".join(
            [
                *header,
                *map(numbers, POINTS),
                *(numbers([len(face), *face]) for face in FACES),
            ]
        )
        + "\n"
    )


def as_stl(name="", end="endsolid", normal="facet normal 0 0 0") -> str:
    loops = [
        "\n".join(f"vertex {numbers(POINTS[i])}" for i in triangle)
        for triangle in triangles()
    ]
    facets = [f"{normal}\nouter loop\n{loop}\nendloop\nendfacet" for loop in loops]
    return "\n".join([f"solid {name}", *facets, f"{end} {name}"]) + "\n"


TEXTS = {"obj": as_obj, "off": as_off, "ply": as_ply, "stl": as_stl}
ENCODINGS = {
    "UTF-8": (b"", "utf-8"),
    "UTF-8 with a mark": (codecs.BOM_UTF8, "utf-8"),
    "UTF-16 LE": (codecs.BOM_UTF16_LE, "utf-16-le"),
    "UTF-16 BE": (codecs.BOM_UTF16_BE, "utf-16-be"),
    "UTF-16 LE without a mark": (b"", "utf-16-le"),
    "UTF-16 BE without a mark": (b"", "utf-16-be"),
    "UTF-32 LE": (codecs.BOM_UTF32_LE, "utf-32-le"),
    "UTF-32 BE": (codecs.BOM_UTF32_BE, "utf-32-be"),
    "Latin-1": (b"", "latin-1"),
}


@pytest.mark.parametrize("ends", ["\n", "\r\n", "\r"], ids=["LF", "CRLF", "CR"])
@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("kind", TEXTS)
def test_a_text_in_any_encoding_is_the_same_mesh(tmp_path, kind, encoding, ends):
    mark, codec = ENCODINGS[encoding]
    path = tmp_path / f"house.{kind}"
    path.write_bytes(
        mark + TEXTS[kind]("B\xfcro \xb5").replace("\n", ends).encode(codec)
    )
    assert_is_the_house(load_mesh(path))


@pytest.mark.parametrize("kind", TEXTS)
def test_a_text_in_another_encoding_than_declared_is_rejected(
    tmp_path,
    kind,
):
    path = tmp_path / f"house.{kind}"
    path.write_bytes(
        codecs.BOM_UTF16_LE + TEXTS[kind]().encode("utf-16-le") + b"\x00\xd8\x20"
    )
    with pytest.raises(MeshError, match="begins as UTF-16-LE text, but is none"):
        load_mesh(path)


# PLY


def binary_ply(
    order="<",
    count="u1",
    index="i4",
    extra=(),
    lists=(),
    faces=FACES,
    points=POINTS,
) -> bytes:
    """The house in binary, with columns beside those that are needed, and lists of three floats
    before the corners.
    """
    names = {
        "u1": "uchar",
        "i1": "char",
        "u2": "ushort",
        "i2": "short",
        "u4": "uint",
        "i4": "int",
        "f4": "float",
    }
    names |= {"u8": "uint64", "f8": "double"}
    header = [
        f"ply\nformat binary_{'little' if order == '<' else 'big'}_endian 1.0\nobj_info made by a"
        " test"
    ]
    header += [
        f"element camera 2\nproperty list {names[count]} short pixels\nproperty double focal"
    ]
    header += [
        f"element vertex {len(points)}",
        *(f"property float {axis}" for axis in "xyz"),
    ]
    header += [f"property uchar {name}" for name in extra] + [
        f"element face {len(faces)}"
    ]
    header += [f"property list {names[count]} float {name}" for name in lists]
    header += [f"property list {names[count]} {names[index]} vertex_index"]
    header += [f"property uchar {name}" for name in extra] + ["end_header\n"]

    def column(values, kind):
        return np.array(values, order + kind).tobytes()

    body = b"".join(
        column([n], count) + column(range(n), "i2") + column([1.5], "f8")
        for n in (2, 3)
    )
    body += b"".join(column(point, "f4") + bytes(len(extra)) for point in points)
    for face in faces:
        body += len(lists) * (column([3], count) + column([7, 8, 9], "f4"))
        body += column([len(face)], count) + column(face, index) + bytes(len(extra))
    return "\n".join(header).encode() + body


@pytest.mark.parametrize("order", ["<", ">"], ids=["little endian", "big endian"])
@pytest.mark.parametrize(
    "how",
    [
        {},
        {"count": "i4", "index": "u4"},
        {"count": "u2", "index": "i2"},
        {"count": "i1", "index": "u1"},
        {"count": "u4", "index": "u8"},
        {"extra": ("red", "green", "blue")},
        {"lists": ("texcoord",)},
        {"count": "u4", "extra": ("quality",), "lists": ("texcoord", "weights")},
        {"faces": triangles()},
        {"faces": triangles(), "extra": ("red",), "lists": ("texcoord",)},
    ],
    ids=str,
)
def test_every_kind_of_binary_ply(tmp_path, order, how):
    path = tmp_path / "house.ply"
    path.write_bytes(binary_ply(order, **how))
    assert_is_the_house(load_mesh(path))
    path.write_bytes(binary_ply(order, **how) + b"\0 what a program puts at the end")
    assert_is_the_house(load_mesh(path))


def test_a_binary_ply_cut_anywhere_in_its_rows_is_refused(tmp_path):
    path = tmp_path / "house.ply"
    whole = binary_ply(extra=("red",))
    for length in range(whole.index(b"end_header") + 11, len(whole) - 1, 3):
        path.write_bytes(whole[:length])
        with pytest.raises(MeshError, match="cut short"):
            load_mesh(path)


@pytest.mark.parametrize("order", ["<", ">"], ids=["little endian", "big endian"])
def test_numbers_beside_lists_of_different_lengths(tmp_path, order):
    header = (
        f"ply\nformat binary_{'little' if order == '<' else 'big'}_endian 1.0\nelement vertex"
        f" {len(POINTS)}\n"
    )
    header += (
        "property float x\nproperty list uchar short faces\n"
        "property double y\nproperty float z\n"
    )
    header += f"element face {len(FACES)}\nproperty list int ushort vertex_indices\nend_header\n"
    body = b""
    for k, (x, y, z) in enumerate(POINTS):
        body += (
            np.array([x], f"{order}f4").tobytes()
            + bytes([k % 3])
            + np.arange(k % 3, dtype=f"{order}i2").tobytes()
        )
        body += (
            np.array([y], f"{order}f8").tobytes()
            + np.array([z], f"{order}f4").tobytes()
        )
    for face in FACES:
        body += (
            np.array([len(face)], f"{order}i4").tobytes()
            + np.array(face, f"{order}u2").tobytes()
        )
    path = tmp_path / "house.ply"
    path.write_bytes(header.encode() + body)
    assert_is_the_house(load_mesh(path))


# the second one turns: it names a vertex twice
STRIPS = [[0, 1, 2, 3, -1, 3, 2, 4], [4, 5, 4, 6, 7]]
STRIP_TRIANGLES = [(0, 1, 2), (2, 1, 3), (3, 2, 4), (4, 5, 6), (4, 6, 7)]


@pytest.mark.parametrize("text", [True, False])
def test_triangle_strips(tmp_path, text):
    points = np.array([(k, k % 2, k * k / 9) for k in range(8)], float)
    header = f"ply\nformat {'ascii' if text else 'binary_little_endian'} 1.0\nelement vertex 8\n"
    header += (
        "property double x\nproperty double y\nproperty double z\nelement tristrips 2\n"
    )
    header += "property list int int vertex_indices\nend_header\n"
    body = "\n".join(
        [*map(numbers, points), *(numbers([len(s), *s]) for s in STRIPS)]
    ).encode()
    if not text:
        body = points.tobytes() + b"".join(
            np.array([len(s), *s], "<i4").tobytes() for s in STRIPS
        )
    path = tmp_path / "strips.ply"
    path.write_bytes(header.encode() + body)
    mesh = load_mesh(path)
    found = (mesh.vertices * mesh.radius + mesh.centre)[mesh.faces]
    for triangle, corners in zip(STRIP_TRIANGLES, found, strict=True):
        np.testing.assert_allclose(
            corners,
            [(k, k % 2, round(k * k / 9, 5)) for k in triangle],
            atol=1e-4,
        )


def header_of(*lines: str) -> str:
    return (
        "\n".join(
            [
                "ply",
                "format ascii 1.0",
                "element vertex 3",
                *lines,
                "end_header",
                "0 0 0\n1 0 0\n0 1 0",
            ]
        )
        + "\n"
    )


XYZ = ("property float x", "property float y", "property float z")
CORNERS = "property list uchar int vertex_indices"
REFUSED = {
    "points": (header_of(*XYZ), "holds 3 points and no faces; .*Compute Normals"),
    "points and an empty table of faces": (
        header_of(*XYZ, "element face 0", CORNERS),
        "holds 3 points and no faces",
    ),
    "points with normals": (
        re.sub(
            r"(?m)^(\d \d \d)$",
            r"\1 0 0 1",
            header_of(*XYZ, *(f"property float n{axis}" for axis in "xyz")),
        ),
        "holds 3 points with normals and no faces; .*Screened Poisson",
    ),
    "splats": (
        re.sub(r"(?m)^(\d \d \d)$", r"\1 9", header_of(*XYZ, "property float f_dc_0")),
        "Gaussian splats",
    ),
    "a range grid": (
        header_of(*XYZ, "element range_grid 2", CORNERS) + "1 0\n0\n",
        "range grid.* one depth image",
    ),
    "no positions": (
        header_of("property float u", "property float v", "property float w"),
        "have no x, y, z",
    ),
    "an unknown type": (header_of("property quad x"), "property quad x"),
    "an index that is none": (
        header_of(*XYZ, "element face 1", CORNERS) + "3 0 1 1.5\n",
        "not a whole number",
    ),
    "a row too long": (
        header_of(*XYZ, "element face 1", CORNERS) + "3 0 1 2 7\n",
        "row 0 of element face has 5",
    ),
    "a list of less than nothing": (
        header_of(*XYZ, "element face 1", CORNERS) + "-3 0 1 2\n",
        "a list of -3",
    ),
    "a word": (
        header_of(*XYZ, "element face 1", CORNERS) + "3 0 one 2\n",
        "something other than numbers",
    ),
    "less than no rows": (
        header_of(*XYZ, "element face -1", CORNERS),
        "announces -1 rows",
    ),
    "rows that are no number": (
        header_of(*XYZ, "element face many", CORNERS),
        "the line 'element face many'",
    ),
    "an element without rows": (
        header_of(*XYZ, "element face", CORNERS),
        "the line 'element face'",
    ),
    "two elements of one name": (
        header_of(*XYZ, "element vertex 3", *XYZ),
        "two elements vertex",
    ),
    "a column of nothing": (
        "ply\nformat ascii 1.0\nproperty float x\nend_header\n0\n",
        "before any element",
    ),
    "a list of one type": (
        header_of(*XYZ, "element face 1", "property list int vertex_indices"),
        "property list int",
    ),
    "no format": (
        "ply\nelement vertex 1\nend_header\n0\n",
        "binary_big_endian, not missing",
    ),
    "a binary file saved as text": (
        codecs.BOM_UTF16_LE + binary_ply().decode("latin-1").encode("utf-16-le"),
        "binary file that was saved as UTF-16-LE text",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_ply_that_is_no_mesh_is_called_what_it_is(tmp_path, case, capfd):
    content, sentence = REFUSED[case]
    path = tmp_path / "a.ply"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(MeshError, match=f"a.ply: .*{sentence}"):
        load_mesh(path)
    assert capfd.readouterr() == ("", "")


# STL


@pytest.mark.parametrize("end", ["endsolid", "end solid", "  ENDSOLID", "EndSolid"])
@pytest.mark.parametrize(
    "name",
    ["", "vertex", "a vertex 1 2 3", "endsolid", "my endsolid endloop", "solid solid"],
)
@pytest.mark.parametrize(
    "normal",
    ["facet normal 0 0 1", "facet normal nan nan nan", "facet", ""],
)
def test_stl_texts_with_any_name_and_without_normals(
    tmp_path,
    name,
    end,
    normal,
    capfd,
):
    path = tmp_path / "house.stl"
    path.write_text(as_stl(name, end, normal))
    assert_is_the_house(load_mesh(path))
    path.write_text(as_stl(name, end, normal).upper().replace("NAN", "nan"))
    assert_is_the_house(load_mesh(path))
    assert capfd.readouterr() == ("", "")


def binary_stl(header=b"", after=b"", announced=None) -> bytes:
    facets = b"".join(
        np.array([(0, 0, 0), *POINTS[triangle]], "<f4").tobytes() + b"\0\0"
        for triangle in triangles()
    )
    count = len(triangles()) if announced is None else announced
    return header.ljust(80, b"\0") + np.uint32(count).tobytes() + facets + after


@pytest.mark.parametrize(
    "header",
    [b"", b"solid", b"solid with a vertex", b"\xfe\xff", b"s\0o\0l\0i\0d\0"],
)
@pytest.mark.parametrize("after", [b"", b"\n", b"end of the file"])
def test_binary_stl_with_any_header_and_bytes_after_its_end(tmp_path, header, after):
    path = tmp_path / "house.stl"
    path.write_bytes(binary_stl(header, after))
    assert_is_the_house(load_mesh(path))


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (binary_stl(announced=3), "announces 3 faces, but holds 16"),
        (binary_stl(announced=0), "announces 0 faces, but holds 16"),
        (binary_stl(announced=17), "cut short"),
        (binary_stl()[:60], "cut short"),
        (as_stl().replace("endsolid", "").encode(), "endsolid is missing"),
        (as_stl().replace("endloop", "").encode(), "endloop is missing"),
        (as_stl().replace("vertex 0 0 0", "vertex 0 0", 1).encode(), "numbers"),
        (as_stl().replace("vertex 0 0 0", "vertex 0 0 0x", 1).encode(), "numbers"),
    ],
)
def test_a_damaged_stl_is_refused(tmp_path, content, sentence):
    path = tmp_path / "a.stl"
    path.write_bytes(content)
    with pytest.raises(MeshError, match=f"a.stl: .*{sentence}"):
        load_mesh(path)


@pytest.mark.parametrize("kind", ["stl", "ply"])
def test_a_signalling_nan_in_single_precision_is_refused_like_any_other(tmp_path, kind):
    numbers = np.zeros(9, "<f4")
    numbers[[3, 7]] = 1
    # converting it sets the processor's flag of invalid operations
    numbers.view("<u4")[5] = 0x7F81_0000
    if kind == "stl":
        data = (
            bytes(80)
            + (1).to_bytes(4, "little")
            + bytes(12)
            + numbers.tobytes()
            + bytes(2)
        )
    else:
        columns = "".join(f"property float {axis}\n" for axis in "xyz")
        header = (
            "ply\nformat binary_little_endian 1.0\nelement "
            f"vertex 3\n{columns}element face 1\n"
        )
        header += "property list uchar int vertex_indices\nend_header\n"
        data = (
            header.encode()
            + numbers.tobytes()
            + b"\3"
            + np.arange(3, dtype="<i4").tobytes()
        )
    path = tmp_path / f"nan.{kind}"
    path.write_bytes(data)
    with pytest.raises(MeshError, match="finite"):
        load_mesh(path)


# Dialects, and files that are something else


BARE = "\n".join(
    [*map(numbers, POINTS), *(numbers([len(face), *face]) for face in FACES)]
)
COLOURED = "\n".join(
    [
        *(f"{numbers(p)} 0.5 0.25 1 1" for p in POINTS),
        *(f"{numbers([len(face), *face])} 9 9 9" for face in FACES),
    ]
)
COUNTS = f"{len(POINTS)} {len(FACES)}"
OFF_DIALECTS = {
    "lower case": f"off\n{COUNTS} 0\n{BARE}\n",
    "mixed case": f"Off {COUNTS} 0\n{BARE}\n",
    "counts on three lines": f"OFF\n{len(POINTS)}\n{len(FACES)}\n0\n{BARE}\n",
    "counts on three lines, the first beside OFF": (
        f"OFF {len(POINTS)}\n{len(FACES)}\n  17 \n{BARE}\n"
    ),
    "counts on two lines": f"OFF\n{len(POINTS)}\n{len(FACES)} 0\n{BARE}\n",
    "no count of edges": f"OFF\n{COUNTS}\n{BARE}\n",
    "counts beside OFF without a gap": f"OFF{COUNTS} 0\n{BARE}\n",
    "colours": f"COFF\n{COUNTS} 0\n{COLOURED}\n",
    "colours in lower case": f"coff {COUNTS} 0\n{COLOURED}\n",
    "colours without a gap": f"COFF{COUNTS} 0\n{COLOURED}\n",
    "normals": f"NOFF\n{COUNTS} 0\n{COLOURED}\n",
    "normals and colours": f"NCOFF\n{COUNTS} 0\n{COLOURED}\n",
    "all of them": f"STCNOFF\n{COUNTS} 0\n{COLOURED}\n",
}


@pytest.mark.parametrize("dialect", OFF_DIALECTS)
def test_dialects_of_off(tmp_path, dialect):
    path = tmp_path / "house.off"
    path.write_text(OFF_DIALECTS[dialect])
    assert_is_the_house(load_mesh(path))


def test_an_obj_in_capitals(tmp_path):
    path = tmp_path / "house.obj"
    path.write_text(as_obj("house").upper())
    assert_is_the_house(load_mesh(path))


WEB_PAGE = "<html><head><title>Sign in</title></head></html>"
FOREIGN = {
    "OFF with four coordinates": (
        "a.off",
        f"4OFF\n{COUNTS} 0\n{COLOURED}",
        "begins with 4OFF, a kind of OFF that",
    ),
    "OFF of any dimension": (
        "a.off",
        f"nOFF 3\n{COUNTS} 0\n{BARE}",
        "begins with nOFF",
    ),
    "OFF in binary": ("a.off", b"OFF BINARY\n" + bytes(60), "begins with OFF BINARY"),
    "gzip": ("a.obj", gzip.compress(as_obj().encode()), "packed with gzip; unpack"),
    "bzip2": ("a.ply", bz2.compress(as_ply().encode()), "packed with bzip2"),
    "xz": ("a.off", lzma.compress(as_off().encode()), "packed with xz"),
    "ZIP": ("a.stl", b"PK\x03\x04" + bytes(200), "ZIP archive"),
    "a picture": ("a.glb", b"\x89PNG\r\n\x1a\n" + bytes(20), "a PNG picture"),
    "a web page": ("a.obj", f"\n<!DOCTYPE html>\n{WEB_PAGE}", "a web page"),
    "a web page in XML, in UTF-16": (
        "a.ply",
        codecs.BOM_UTF16_LE + f'<?xml version="1.0"?>\n{WEB_PAGE}'.encode("utf-16-le"),
        "a web page",
    ),
    "a pointer": (
        "a.ply",
        "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 9\n",
        "git lfs pull",
    ),
    "COLLADA": (
        "a.obj",
        '<?xml version="1.0"?>\n<COLLADA version="1.4.1"></COLLADA>',
        "a COLLADA file",
    ),
    "glTF": ("a.glb", '{\n  "asset": {"version": "2.0"}}', "export it as GLB"),
    "OFF called OBJ": ("a.obj", as_off(), "content is that of an OFF file"),
    "OBJ called PLY": (
        "a.ply",
        f"# by hand\n\n\nmtllib a.mtl\n{as_obj()}",
        "content is that of an OBJ file",
    ),
    "PLY called STL": ("a.stl", as_ply("x"), "content is that of a PLY file"),
    "PLY called OBJ": ("a.obj", binary_ply(), "content is that of a PLY file"),
    "STL called OFF": ("a.off", as_stl("x"), "content is that of an STL file"),
    "GLB called OBJ": ("a.obj", b"glTF" + bytes(50), "content is that of a GLB file"),
}


@pytest.mark.parametrize("case", FOREIGN)
def test_a_file_that_is_something_else_is_called_what_it_is(tmp_path, case):
    name, content, sentence = FOREIGN[case]
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(
        MeshError,
        match=f"{name}: not a readable .*{re.escape(sentence)}",
    ):
        load_mesh(path)


@pytest.mark.parametrize("kind", TEXTS)
def test_decimal_commas_are_named(tmp_path, kind):
    path = tmp_path / f"house.{kind}"
    halves = re.sub(
        r"(?m)^(v |vertex )?(\d) (\d) (\d)$",
        r"\g<1>\2,5 \3,0 \4,0",
        TEXTS[kind](),
    )
    assert ",5 " in halves
    path.write_text(halves)
    with pytest.raises(
        MeshError,
        match=r"decimal commas \(\d,5\); export it with points",
    ):
        load_mesh(path)
