"""Broken, hostile and foreign files: one table of what is wrong, for every reader.

Each is refused by the error of its reader, in one sentence that names the file, and before memory
is spent on it. ``broken_files.txt`` holds the sentences for a reader to judge; NEXTVIEW_UPDATE=1
writes it anew.
"""

import codecs
import gzip
import json
import os
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from factories import run_python
from recordings import (
    CAMERA,
    SHAPE,
    START,
    points_of,
    said_at,
    views_around,
    write_bop,
    write_folder,
    write_graspnet,
    write_pcd,
    write_recording,
    write_seven,
    write_tum,
    write_ycb_video,
)
from ros_messages import (
    CAMERA_INFO,
    DEPTH,
    compressed_message,
    info_message,
    message,
    tf_message,
    transform_message,
    write_bag,
)

from nextview.captured.camera_file import read_camera_file
from nextview.captured.folders import read_capture
from nextview.errors import DatasetError, MeshError, NextviewError
from nextview.geometry.mesh import FORMATS, load_mesh

SENTENCES = Path(__file__).with_name("broken_files.txt")
MEGABYTE = 2**20
BIG = 150_000_000
VIEWS = views_around()
Maker = Callable[[Path], Path]
ROWS: dict[str, tuple[str, Maker]] = {}
"""Of the table: the reader, and what makes the file in an empty folder, by what is wrong."""


def row(reader: str, what: str, make: Maker) -> None:
    assert f"{reader}: {what}" not in ROWS
    ROWS[f"{reader}: {what}"] = reader, make


def file(name: str, content: bytes | str) -> Maker:
    def make(folder: Path) -> Path:
        data = content.encode() if isinstance(content, str) else content
        (folder / name).write_bytes(data)
        return folder / name

    return make


# Meshes


GOOD = "0 0 0\n1 0 0\n0 1 1"
SPLATS = "0 0 0 9\n1 0 0 9\n0 1 1 9"
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 1]], "<f4")
TRIANGLE = CORNERS.tobytes() + np.arange(3, dtype="<u4").tobytes()


def off(vertices: str, faces: str, announced: str = "") -> str:
    count = [len(part.strip().splitlines()) for part in (vertices, faces)]
    return f"OFF\n{announced or f'{count[0]} {count[1]} 0'}\n{vertices}\n{faces}\n"


XYZ = tuple(f"property float {axis}" for axis in "xyz")
LIST = "property list uchar int vertex_indices"


def ply(*lines: str, rows: str = "", kind: str = "ascii") -> str:
    top = ["ply", f"format {kind} 1.0", "element vertex 3", *lines, "end_header"]
    return "\n".join([*top, GOOD, rows]).rstrip("\n") + "\n"


def stl(
    facets: int = 2, facet: str = "vertex 0 0 0\nvertex 1 0 0\nvertex 0 1 1\n"
) -> str:
    one = f"facet normal 0 0 1\nouter loop\n{facet}endloop\nendfacet\n"
    return f"solid a\n{facets * one}endsolid a\n"


def binary_stl(announced: int, corners: np.ndarray = CORNERS) -> bytes:
    facet = bytes(12) + corners.astype("<f4").tobytes() + bytes(2)
    return bytes(80) + struct.pack("<I", announced) + 2 * facet


def glb(gltf: dict, binary: bytes = TRIANGLE) -> bytes:
    text = json.dumps(gltf).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def one_triangle(positions=None, view=None, **changes) -> dict:
    """The JSON of a GLB of one triangle, some of whose parts are replaced."""
    accessor = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
    accessor |= positions or {}
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


NAN = CORNERS.copy()
NAN.view("<u4")[2, 1] = 0x7F81_0000  # a signalling one
FACE = off(GOOD, "3 0 1 2")
OFFS = {
    "no faces": off(GOOD, ""),
    "index too high": off(GOOD, "3 0 1 3"),
    "NaN": off("0 0 nan\n1 0 0\n0 1 0", "3 0 1 2"),
    "no extent": off("5 5 5\n5 5 5\n5 5 5", "3 0 1 2"),
    "cut in its faces": off(GOOD, "3 0 1 2", announced="3 6 0"),
    "huge counts": "OFF\n1 999999999999 0\n1 2 3\n",
    "too many faces": off(GOOD, "3 0 1 2\n" * 101),
    "binary": b"OFF BINARY\n" + bytes(60),
    "decimal commas": FACE.replace("0 0 0\n", "0,5 0,0 0,0\n"),
    "packed": gzip.compress(FACE.encode()),
}
for what, content in OFFS.items():
    row("OFF", what, file("a.off", content))
VERTICES = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
OBJS = {
    "index too high": VERTICES + "f 1 2 4\n",
    "cut in a face": VERTICES + "f 1 2 3\nf 1 2",
    "a web page": "\n<!DOCTYPE html>\n<html></html>",
}
for what, content in OBJS.items():
    row("OBJ", what, file("a.obj", content))
ONE = (*XYZ, "element face 1", LIST)
PLYS = {
    "index too high": ply(*ONE, rows="3 0 1 3"),
    "points": ply(*XYZ),
    "splats": ply(*XYZ, "property float f_dc_0").replace(GOOD, SPLATS),
    "a list longer than the file": ply(*ONE, rows=f"{BIG} 0 1 2"),
    "a word": ply(*ONE, rows="3 0 one 2"),
    "more rows than lines": ply(*XYZ, f"element face {BIG}", LIST, rows="3 0 1 2"),
    "no format": "ply\nelement vertex 1\nend_header\n0\n",
    "binary saved as text": codecs.BOM_UTF16_LE
    + ply(*ONE, kind="binary_little_endian").encode("utf-16-le"),
    "binary and cut": ply(*ONE, kind="binary_little_endian").encode()[:-4],
    "a pointer": "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 9\n",
}
for what, content in PLYS.items():
    row("PLY", what, file("a.ply", content))
STLS = {
    "too few announced": binary_stl(1),
    "a signalling NaN": binary_stl(2, NAN),
    "no end of the solid": stl().replace("endsolid", ""),
    "two numbers": stl(facet="vertex 0 0\nvertex 1 0 0\nvertex 0 1 1\n"),
}
for what, content in STLS.items():
    row("STL", what, file("a.stl", content))
MANY_TIMES = {"scenes": [{"nodes": list(range(101))}], "nodes": 101 * [{"mesh": 0}]}
GLBS = {
    "more positions than bytes": one_triangle({"count": BIG}),
    "a view beyond the buffer": one_triangle(view={"byteOffset": 1 << 40}),
    "elsewhere": one_triangle(buffers=[{"uri": "x.bin"}]),
    "a node in itself": one_triangle(nodes=[{"children": [0]}]),
    "a mesh too often": one_triangle(**MANY_TIMES),
}
for what, gltf in GLBS.items():
    row("GLB", what, file("a.glb", glb(gltf)))
for suffix in FORMATS:
    kind = suffix[1:].upper()
    row(kind, "empty", file(f"a{suffix}", b" \r\n\n"))
    row(kind, "prose", file(f"a{suffix}", "To whom it may concern\n" * 20))
    row(kind, "noise", file(f"a{suffix}", np.random.default_rng(0).bytes(500)))


def pipe(folder: Path) -> Path:
    os.mkfifo(folder / "pipe.off")
    return folder / "pipe.off"


def endless(folder: Path) -> Path:
    (folder / "endless.off").symlink_to("/dev/zero")
    return folder / "endless.off"


row("OFF", "a pipe", pipe)
row("OFF", "endless", endless)
row("OFF", "not there", lambda folder: folder / "none.off")
row("mesh", "unknown suffix", file("a.xyz", "0 0 0\n"))


# Captures: folders


POSES = ("poses", "camera_poses.npy")


def edited(write: Callable, name: str, change: Callable[[Path], object]) -> Maker:
    """A capture of one view in a layout, in which a file is changed; of two without poses."""

    def make(folder: Path) -> Path:
        path = write(folder, VIEWS[: 1 + (name in POSES)])
        change(path / name)
        return path

    return make


def text(content: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(content)


def cut(part: float) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(
        path.read_bytes()[: int(part * path.stat().st_size)]
    )


def fields(which: str | None = None, **changed) -> Callable[[Path], object]:
    """Change fields of a JSON file, of all its records or of one."""

    def change(path: Path) -> None:
        values = json.loads(path.read_text())
        (values if which is None else values[which]).update(changed)
        path.write_text(json.dumps(values))

    return change


def away(path: Path) -> None:
    """What was there lies elsewhere now, and is linked to."""
    path.symlink_to(path.rename(path.parents[1] / "elsewhere"))


CAMERAS, TRAJECTORY, SEVEN = "scene_camera.json", "groundtruth.txt", "frame-000000"
LAYOUT_ROWS = {
    "no image": (write_bop, "depth/000000.png", Path.unlink),
    "no JSON": (write_bop, CAMERAS, text("{")),
    "a scaled rotation": (write_bop, CAMERAS, fields("0", cam_R_w2c=[2, 0, 0] * 3)),
    "an empty trajectory": (write_tum, TRAJECTORY, text("# t\n")),
    "an image elsewhere": (write_tum, "depth.txt", text("10 /etc/passwd\n")),
    "no intrinsics": (write_tum, "camera-intrinsics.txt", Path.unlink),
    "a cut image": (write_seven, f"{SEVEN}.depth.png", cut(0.5)),
    "a link to an image elsewhere": (write_seven, f"{SEVEN}.depth.png", away),
    "a lost camera": (write_seven, f"{SEVEN}.pose.txt", text(4 * "nan nan nan nan\n")),
    "another size": (write_folder, "intrinsics.json", fields(width=1280)),
    "no depth scale": (write_folder, "intrinsics.json", text(json.dumps(CAMERA))),
    "no pose": (write_folder, "poses", lambda path: path.rename(path.parent / "other")),
    "a pose too many": (
        partial(write_folder, poses="json"),
        "poses.json",
        lambda path: path.write_text(json.dumps(2 * json.loads(path.read_text()))),
    ),
}
for what, (write, name, change) in LAYOUT_ROWS.items():
    row("capture", what, edited(write, name, change))
row("capture", "a part of one", lambda f: write_folder(f, VIEWS) / "depth")
row(
    "capture",
    "no 16-bit PNG files",
    edited(
        write_folder,
        "depth/0000.png",
        lambda p: [
            each.rename(each.with_suffix(".jpeg")) for each in p.parent.iterdir()
        ],
    ),
)


# Clouds


def cloud(**changed) -> Maker:
    return lambda folder: write_pcd(folder / "a.pcd", points_of(VIEWS[0][0]), **changed)


def cut_cloud(kind: str, part: float) -> Maker:
    def make(folder: Path) -> Path:
        path = cloud(kind=kind)(folder)
        cut(part)(path)
        return path

    return make


def packed_cloud(size: int, data: bytes) -> Maker:
    def make(folder: Path) -> Path:
        path = cloud(kind="binary_compressed")(folder)
        start = path.read_bytes().index(b"compressed\n") + len(b"compressed\n")
        head = path.read_bytes()[:start]
        path.write_bytes(head + struct.pack("<II", len(data), size) + data)
        return path

    return make


PCDS = {
    "more than any camera": {"WIDTH": 10**9, "HEIGHT": 10**9, "POINTS": 10**18},
    "no z": {"FIELDS": "x y w _ rgb _"},
    "a huge count": {"COUNT": "1 1 1 4 1 999999999"},
    "a quaternion of zeros": {"VIEWPOINT": "0 0 0 0 0 0 0"},
    "twice as many rows": {"HEIGHT": 240, "POINTS": 38400},
}
for what, changed in PCDS.items():
    row("PCD", what, cloud(**changed))
for kind in ("ascii", "binary", "binary_compressed"):
    row("PCD", f"{kind}, cut in the header", cut_cloud(kind, 0.0005))
    row("PCD", f"{kind}, cut in the points", cut_cloud(kind, 0.5))
row("PCD", "an LZF bomb", packed_cloud(307200, b"\x00a" + 10_000 * b"\xe0\xff\x00"))
row("PCD", "a lie about what is packed", packed_cloud(2**32 - 1, b"\x00a"))
row(
    "PCD",
    "unorganised",
    lambda folder: write_pcd(
        folder / "a.pcd", points_of(VIEWS[0][0]).reshape(1, -1, 3)
    ),
)
row(
    "PCD",
    "in the frame of a robot",
    lambda folder: write_pcd(
        folder / "a.pcd", points_of(VIEWS[0][0])[..., [2, 0, 1]] * [1, -1, -1]
    ),
)


# Files of MATLAB and NumPy


def meta(**changed) -> Maker:
    return lambda folder: write_ycb_video(folder, VIEWS, **changed)


def mat(spoil: Callable[[bytes], bytes]) -> Maker:
    return edited(
        write_ycb_video,
        "000001-meta.mat",
        lambda path: path.write_bytes(spoil(path.read_bytes())),
    )


BOMB = zlib.compress(bytes(100 * MEGABYTE), 9)
MATS = {
    "a matrix of another shape": meta(intrinsic_matrix=np.zeros((4, 4))),
    "a pose that is not rigid": meta(rotation_translation_matrix=np.zeros((3, 4))),
    "cut": mat(lambda data: data[: len(data) // 2]),
    "HDF5": mat(lambda data: b"\x89HDF\r\n\x1a\n" + bytes(500)),
    "a zlib bomb": mat(
        lambda data: data[:128] + struct.pack("<II", 15, len(BOMB)) + BOMB
    ),
}
for what, make in MATS.items():
    row("MATLAB", what, make)


def absurd_npy(path: Path) -> None:
    """An array that claims to be large, and is not."""
    said = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000, 4, 4), }"
    top = b"\x93NUMPY\x01\x00" + struct.pack("<H", 118)
    path.write_bytes(top + (said.ljust(117) + "\n").encode())


ARRAYS = {
    "absurdly large": absurd_npy,
    "an object": lambda path: np.save(path, np.array({"a": 1})),
    "NaN": lambda path: np.save(path, np.full((2, 4, 4), np.nan)),
    "not there": Path.unlink,
}
for what, change in ARRAYS.items():
    row("NumPy", what, edited(write_graspnet, "camera_poses.npy", change))


# Bags


def bag(change: Callable[[list], list], **options) -> Maker:
    return lambda folder: write_bag(folder / "bag", change(said_at(VIEWS)), **options)


def of_topic(said: list, *topics: str) -> list:
    return [each for each in said if each[0] in topics]


def tf(child: str, parent: str, time: float = START) -> tuple:
    return "/tf", time, tf_message(transform_message(np.eye(4), child, time, parent))


def changed_at(topic: str, change: Callable) -> Maker:
    return bag(
        lambda said: [
            (name, time, change(each) if name == topic else each)
            for name, time, each in said
        ]
    )


def chain(said: list) -> list:
    links = [
        transform_message(np.eye(4), f"frame{n}", 0.0, f"frame{n + 1}")
        for n in range(300)
    ]
    links[0].child_frame_id = "optical"
    rest = of_topic(said, DEPTH, CAMERA_INFO)
    return [("/tf_static", START, tf_message(*links)), *rest]


def of_one_file(change: Callable[[bytearray], bytes], mcap: bool = True) -> Maker:
    def make(folder: Path) -> Path:
        path = write_recording(folder, VIEWS, mcap=mcap)
        (one,) = path.glob("*.mcap" if mcap else "*.db3")
        one.write_bytes(change(bytearray(one.read_bytes())))
        return path

    return make


def overwritten(content: bytearray) -> bytes:
    noise = np.random.default_rng(0).bytes(3 * len(content) // 4)
    content[len(content) // 8 : len(content) // 8 + len(noise)] = noise
    return bytes(content)


def repeating(name: str, levels: int = 6) -> str:
    """A few hundred bytes of YAML that mean 9 ** levels values."""
    lines = ["a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    for before, this in zip("abcdefgh"[: levels - 1], "bcdefgh", strict=False):
        lines.append(f"{this}: &{this} [{', '.join([f'*{before}'] * 9)}]")
    return "\n".join([*lines, f"{name}: *{'abcdefgh'[levels - 1]}", ""])


def mcap_record(kind: int, content: bytes, length: int | None = None) -> bytes:
    return (
        struct.pack("<BQ", kind, len(content) if length is None else length) + content
    )


def mcap_text(said: str) -> bytes:
    return struct.pack("<I", len(said)) + said.encode()


def mcap_of(*records: bytes) -> bytes:
    magic = b"\x89MCAP0\r\n"
    begin = mcap_record(1, mcap_text("ros2") + mcap_text("test"))
    end = mcap_record(2, struct.pack("<QQI", 0, 0, 0))
    return magic + begin + b"".join(records) + end + magic


NOTHING = message("std_msgs/msg/String", data="nothing to see")
BAGS = {
    "no tf": bag(lambda said: of_topic(said, DEPTH, CAMERA_INFO)),
    "names that a terminal obeys": bag(
        lambda said: [
            tf("cam\x1b]0;gone\x07\nera", "world"),
            *of_topic(said, DEPTH, CAMERA_INFO),
        ]
    ),
    "another clock": bag(
        lambda said: [
            *of_topic(said, DEPTH, CAMERA_INFO),
            tf("optical", "base_link", 0.0),
            tf("optical", "base_link", 9.0),
        ]
    ),
    "two parents": bag(lambda said: [*said, tf("optical", "table")]),
    "a chain": bag(chain),
    "colour": changed_at(DEPTH, lambda each: replace(each, encoding="rgb8")),
    "no images": bag(lambda said: [("/chatter", START, NOTHING)]),
    "two topics": bag(
        lambda said: [*said, ("/other", START, of_topic(said, DEPTH)[0][2])]
    ),
    "no camera_info": bag(lambda said: of_topic(said, "/tf", DEPTH)),
    "not calibrated": changed_at(
        CAMERA_INFO,
        lambda each: info_message(np.zeros((3, 3)), SHAPE, header=each.header),
    ),
    "metadata is cut": edited(
        write_recording, "metadata.yaml", text("rosbag2_bagfile_inf: [")
    ),
    "metadata that repeats itself": edited(
        write_recording,
        "metadata.yaml",
        lambda path: path.write_text(
            path.read_text() + repeating("compression_format")
        ),
    ),
    "a record of 2 ** 50 bytes": file(
        "a.mcap", mcap_of(mcap_record(3, b"\0" * 100, 2**50))
    ),
    "of ROS 1": file("old.bag", b"#ROSBAG V2.0\n"),
}
for what, make in BAGS.items():
    row("bag", what, make)
for mcap, kind in ((True, "MCAP"), (False, "SQLite")):
    row("bag", f"{kind}, empty", of_one_file(lambda content: b"", mcap))
    row("bag", f"{kind}, overwritten", of_one_file(overwritten, mcap))
    row(
        "bag",
        f"{kind}, cut",
        of_one_file(lambda content: bytes(content[: len(content) // 2]), mcap),
    )


# Intrinsics


YAML = "fx: 600\nfy: 600\ncx: 320\ncy: 240\n"
CAMERA_FILES = {
    "no JSON": ("camera.json", "{"),
    "no intrinsics": ("camera.json", '{"width": 640}'),
    "a negative scale": ("camera.json", json.dumps(CAMERA | {"depth_scale": -1})),
    "distortion": ("camera.json", json.dumps(CAMERA | {"coeffs": [0.1, 0]})),
    "many digits": ("camera.json", json.dumps(CAMERA).replace("150", "1" * 5000)),
    "aliases": ("camera.yaml", YAML + repeating("k")),
    "deep": ("camera.yaml", "k: " + "[" * 5000 + "]" * 5000),
    "a Python object": ("camera.yaml", "k: !!python/object/apply:os.getcwd []\n"),
    "control characters": ("camera.yaml", "\x1b[31m: 1\n"),
    "binned": ("camera.yaml", YAML + "binning_x: 2\n"),
}
for what, (name, content) in CAMERA_FILES.items():
    row("camera", what, file(name, content))


# All of them


def read_all(path: Path) -> None:
    for captured in read_capture(path).frames:
        captured.read()


MESHES = (*(suffix[1:].upper() for suffix in FORMATS), "mesh")
READERS = {
    **dict.fromkeys(MESHES, (lambda path: load_mesh(path, max_faces=100), MeshError)),
    "camera": (read_camera_file, DatasetError),
}


def sentence_of(name: str, folder: Path) -> str:
    reader, make = ROWS[name]
    read, error = READERS.get(reader, (read_all, DatasetError))
    path = make(folder).relative_to(folder)
    os.chdir(folder)  # a library's sentence is cut: it is the same in all folders
    tracemalloc.start()
    try:
        with pytest.raises(error) as refusal:
            read(path)
        assert tracemalloc.get_traced_memory()[1] < 40 * MEGABYTE
    finally:
        tracemalloc.stop()
    said = str(refusal.value)
    assert said.isprintable()
    assert path.name in said
    return said.replace(f"{folder}/", "").replace(str(folder), ".")


@pytest.fixture(scope="module")
def sentences():
    """Those of the file; with NEXTVIEW_UPDATE the file is written from what is said now."""
    known = dict(line.split(" => ", 1) for line in SENTENCES.read_text().splitlines())
    said = {}
    yield known, said
    if os.environ.get("NEXTVIEW_UPDATE") and said.keys() == ROWS.keys():
        SENTENCES.write_text("".join(f"{name} => {said[name]}\n" for name in ROWS))


@pytest.mark.parametrize("name", ROWS)
def test_a_broken_file_is_refused_in_one_sentence(
    name, tmp_path, sentences, capfd, monkeypatch
):
    known, said = sentences
    (tmp_path / "in").mkdir()
    monkeypatch.chdir(tmp_path)  # and back at the end
    said[name] = sentence_of(name, tmp_path / "in")
    assert capfd.readouterr() == ("", "")
    if not os.environ.get("NEXTVIEW_UPDATE"):
        assert said[name] == known[name]


def test_no_sentence_is_kept_of_a_row_that_is_gone():
    kept = [line.split(" => ")[0] for line in SENTENCES.read_text().splitlines()]
    assert kept == list(ROWS)


# Files whose memory Python does not count


READ_IN_A_PROCESS = """
import resource, sys
import rosbags.rosbag2, rosbags.typesys
from PIL import Image
from nextview.captured.folders import read_capture
from nextview.errors import NextviewError
Image.init()
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
before = peak()
try:
    for frame in read_capture(sys.argv[1], (600, 600, 320, 240), depth_scale=0.001).frames:
        frame.read()
except NextviewError:
    print("refused", round(peak() - before))
"""


def png_of_zeros(width: int, height: int) -> bytes:
    """A grey PNG of 16 bits that is black; hundreds of megabytes are some hundred kilobytes."""
    packer = zlib.compressobj(9)
    row = bytes(1 + 2 * width)
    data = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()

    def chunk(kind: bytes, content: bytes) -> bytes:
        checked = kind + content
        length = struct.pack(">I", len(content))
        return length + checked + struct.pack(">I", zlib.crc32(checked))

    size = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    chunks = chunk(b"IHDR", size) + chunk(b"IDAT", data) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


def chunk_of_zeros(claimed: int) -> bytes:
    """A bag of one chunk of 300 MB that claims to hold so many bytes."""
    from rosbags.rosbag2.storage_mcap import zstd

    packer = zstd.ZstdCompressor()
    data = b"".join(packer.compress(bytes(MEGABYTE)) for _ in range(300))
    data += packer.flush()
    content = struct.pack("<QQQI", 0, 1, claimed, 0) + mcap_text("zstd")
    return mcap_of(mcap_record(6, content + struct.pack("<Q", len(data)) + data))


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.png", lambda: png_of_zeros(8_000, 8_000)),
        ("a.mcap", lambda: chunk_of_zeros(10)),
        ("a.mcap", lambda: chunk_of_zeros(300 * MEGABYTE)),
    ],
)
def test_a_bomb_is_refused_before_memory_is_spent_on_it(name, content, tmp_path):
    path = file(name, content())(tmp_path)
    assert path.stat().st_size < MEGABYTE
    done = run_python(
        f"import sys; sys.argv = ['-', {str(path)!r}]\n{READ_IN_A_PROCESS}"
    )
    refused, growth = done.stdout.split()
    assert refused == "refused"
    assert int(growth) < 90  # megabytes


@pytest.mark.parametrize("size", [(6000, 6000), (160, 120)])
def test_a_damaged_image_of_a_bag_costs_only_itself(size, tmp_path):
    """One of another size is known by its header: its pixels cannot be decoded."""
    said = of_topic(said_at(VIEWS), "/tf", CAMERA_INFO)
    for number, (depth, _) in enumerate(VIEWS):
        packed = compressed_message(depth, "16UC1", START + number)
        if number == 1:
            content = png_of_zeros(*size)
            half = bytes(packed.data[:12]) + content[: len(content) // 2]
            packed.data = np.frombuffer(half, np.uint8)
        said.append((f"{DEPTH}/compressedDepth", START + number, packed))
    capture = read_capture(write_bag(tmp_path / "bag", said))
    read = {}
    for frame in capture.frames:
        with suppress(NextviewError):
            read[frame.name] = frame.read().depth.shape
    assert read == {"0.050": SHAPE, "2.050": SHAPE}
