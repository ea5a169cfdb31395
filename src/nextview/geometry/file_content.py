"""Recognise files that are not meshes: packed files, web pages, other formats."""

import re

from nextview.errors import MeshError
from nextview.geometry.mesh_text import plain_text

LOOKED_AT = 4096  # bytes at the beginning of a text that tell what it is

BINARY_BEGINNINGS = (  # of files that are often found under the name of another kind
    (b"\x1f\x8b", "it is packed with gzip; unpack it first"),
    (b"BZh", "it is packed with bzip2; unpack it first"),
    (b"\xfd7zXZ\x00", "it is packed with xz; unpack it first"),
    (b"\x28\xb5\x2f\xfd", "it is packed with zstd; unpack it first"),
    (b"PK\x03\x04", "it is a ZIP archive; unpack it first"),
    (b"7z\xbc\xaf\x27\x1c", "it is a 7z archive; unpack it first"),
    (b"Rar!", "it is a RAR archive; unpack it first"),
    (b"%PDF", "it is a PDF document"),
    (b"\x89PNG", "it is a PNG picture"),
    (b"\xff\xd8\xff", "it is a JPEG picture"),
    (b"Kaydara FBX", "it is an FBX file; export it as OBJ, PLY or STL"),
    (b"BLENDER", "it is a file of Blender; export it as OBJ, PLY or STL"),
)
TEXT_BEGINNINGS = (  # patterns in lower case, likewise
    (
        rb"<!doctype html|(<\?xml[^>]*>\s*)?<html",
        "it is a web page (HTML), not what was to be downloaded",
    ),
    (
        rb"(<\?xml[^>]*>\s*)?(<!--.*?-->\s*)?<collada",
        "it is a COLLADA file; export it as OBJ, PLY or STL",
    ),
    (rb"<\?xml", "it is an XML file"),
    (
        rb"version https://git-lfs",
        "it is a pointer of Git LFS; git lfs pull fetches the file itself",
    ),
    (
        rb"\S*/annex/objects/",
        "it is a pointer of git-annex; git annex get fetches the file itself",
    ),
    (
        rb"\{\s*\"",
        "it is a JSON file, as glTF is that keeps its numbers elsewhere; export it as GLB",
    ),
)
MESH_BEGINNINGS = (  # of the formats that are read
    (".ply", rb"ply[ \t]*\n(comment.*\n|obj_info.*\n)*format[ \t]"),
    (".off", rb"(st|c|n)*off\b"),
    (".stl", rb"solid\b.*\n\s*facet\b"),
    (".obj", rb"((#|[gos]\b|vn\b|vt\b|mtllib\b|usemtl\b).*\n|[ \t]*\n)*v[ \t]+[-+.\d]"),
)
GLB_BEGINNING = b"glTF"
# Two numbers after each other that each have a comma where a point is meant.
DECIMAL_COMMAS = re.compile(
    rb"(?<![\d.,])[-+]?\d+,\d+([eE][-+]?\d+)?[ \t]+[-+]?\d+,\d+([eE][-+]?\d+)?(?![\d.,])"
)


def foreign_content(data: bytes, suffix: str) -> str | None:
    """What is likely to be wrong with a file that could not be read as a mesh.

    Args:
        data: the file's bytes.
        suffix: that of its name, in lower case.

    Returns:
        A phrase that says what it is instead, or that its numbers have decimal commas; None if
        nothing of that is seen.
    """
    for beginning, said in BINARY_BEGINNINGS:
        if data.startswith(beginning):
            return said
    if data.startswith(GLB_BEGINNING):
        return None if suffix == ".glb" else _other_format(".glb")

    try:
        text = plain_text(data)
    except MeshError:  # which the reader has said already
        return None
    start = text[:LOOKED_AT].lstrip().lower()
    for pattern, said in TEXT_BEGINNINGS:
        if re.match(pattern, start, re.DOTALL):
            return said
    for other, pattern in MESH_BEGINNINGS:
        if re.match(pattern, start):
            return _decimal_commas(text) if other == suffix else _other_format(other)
    return _decimal_commas(text)


def _other_format(suffix: str) -> str:
    return (
        f"its content is that of {'an' if suffix[1] in 'os' else 'a'} {suffix[1:].upper()} file;"
        " name it so"
    )


def _decimal_commas(text: bytes) -> str | None:
    found = DECIMAL_COMMAS.search(text)
    if found is None:
        return None
    number = found[0].split()[0].decode()
    return f"its numbers have decimal commas ({number}); export it with points"
