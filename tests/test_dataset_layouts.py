"""Organised PCD clouds, YCB-Video and GraspNet: written here as their tools write them, read back
with the poses and intrinsics of the camera, and what is damaged, hostile or of another kind.
"""

import struct
import tracemalloc
import zlib

import numpy as np
import pytest
from factories import box, cast, pose_at, refused
from PIL import Image
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from nextview.captured.check import check_capture
from nextview.captured.folders import is_capture, read_capture
from nextview.captured.pcd import decompress_lzf, fitted_intrinsics
from nextview.errors import DatasetError

SHAPE = 120, 160
K = np.array([[150.0, 0, 81.5], [0, 152, 58.2], [0, 0, 1]])
HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
KINDS = ("ascii", "binary", "binary_compressed")
MEGABYTE = 2**20
NAMES = ("0000", "0001", "0002")


@pytest.fixture(scope="module")
def views():
    """Depth, whole millimetres as uint16, and poses, of a camera around a box on the ground."""
    ground, thing = (
        box((3, 3, 0.02), (0, 0, -0.01)),
        box((0.2, 0.3, 0.25), (0, 0, 0.125)),
    )
    found = []
    for azimuth in (10, 40, 75):
        pose = pose_at(40, azimuth, 1.0, (0.02, 0, 0.1))
        depth, _ = cast((ground, thing), pose, K + HALF, SHAPE)
        depth[50:53, 20:40] = 0  # holes
        found.append((np.rint(1000 * depth).astype(np.uint16), pose))
    return found


def points_of(depth, k=K):
    """Points of a depth image, (H, W, 3) float32, metres, NaN for holes."""
    rows, columns = np.indices(depth.shape)
    z = np.where(depth > 0, depth / 1000, np.nan)
    x = (columns - k[0, 2]) / k[0, 0] * z
    y = (rows - k[1, 2]) / k[1, 1] * z
    return np.stack([x, y, z], -1).astype(np.float32)


def packed_by_lzf(content):
    """Literal runs, and a reference to the eight bytes before wherever they are repeated."""
    out = bytearray()
    at = 0
    while at < len(content):
        begin = content[at - 8 : at] if at >= 8 else b""
        run = 0
        while begin and run < 200 and content[at + run : at + run + 8] == begin:
            run += 8
        if run >= 16:
            out += bytes([7 << 5, run - 2 - 7, 7])
            at += run
            continue
        literal = content[at : at + 8]
        out += bytes([len(literal) - 1]) + literal
        at += len(literal)
    return bytes(out)


def write_pcd(path, points, kind, pose=None, version="0.7", **changed):
    """A cloud of PointXYZRGB, as PCL's writers lay it out: with padding only if binary."""
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = points.shape[:2]
    said = np.array([0, 0, 0, 1, 0, 0, 0.0])
    if pose is not None:
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        said = np.array([*pose[:3, 3], w, x, y, z])
    padded = kind == "binary"
    header = {
        "VERSION": version,
        "FIELDS": "x y z _ rgb _" if padded else "x y z rgb",
        "SIZE": "4 4 4 1 4 1" if padded else "4 4 4 4",
        "TYPE": "F F F U F U" if padded else "F F F F",
        "COUNT": "1 1 1 4 1 12" if padded else "1 1 1 1",
        "WIDTH": width,
        "HEIGHT": height,
        "VIEWPOINT": " ".join(f"{value:.9g}" for value in said),
        "POINTS": width * height,
        "DATA": kind,
    } | changed
    text = "# .PCD v0.7 - Point Cloud Data file format\n"
    text += "".join(
        f"{name} {value}\n" for name, value in header.items() if value is not None
    )
    flat = points.reshape(-1, 3)
    colour = np.full((len(flat), 1), 4.2108e06, np.float32)
    every = np.hstack([flat, colour]).astype(np.float32)
    if kind == "ascii":
        content = "".join(
            " ".join("nan" if np.isnan(v) else f"{v:.9g}" for v in row) + "\n"
            for row in every
        ).encode()
    elif kind == "binary":
        padding = np.zeros((len(flat), 1), np.float32)
        content = np.hstack([flat, padding, colour, *[padding] * 3]).tobytes()
    else:
        plain = every.T.tobytes()
        packed = packed_by_lzf(plain)
        content = struct.pack("<II", len(packed), len(plain)) + packed
    path.write_bytes(text.encode() + content)
    return path


def same_frames(capture, views, tolerance=1e-6):
    assert len(capture.frames) == len(views)
    for captured, (depth, pose) in zip(capture.frames, views, strict=True):
        np.testing.assert_allclose(captured.pose, pose, atol=1e-6)
        np.testing.assert_allclose(captured.intrinsics, K, atol=0.01)
        assert captured.size == (160, 120)
        np.testing.assert_allclose(captured.read().depth, depth / 1000, atol=tolerance)
    check_capture(capture)


# Clouds


@pytest.mark.parametrize("kind", KINDS)
def test_organised_clouds_are_depth_images_of_the_camera_that_made_them(
    kind, views, tmp_path
):
    for name, (depth, pose) in zip(NAMES, views, strict=True):
        write_pcd(tmp_path / f"clouds/{name}.pcd", points_of(depth), kind, pose)
    assert is_capture(tmp_path / "clouds")
    capture = read_capture(tmp_path / "clouds")
    assert capture.layout == "PCD"
    assert capture.up is None
    assert "intrinsics fitted to 0000.pcd: 150.0 152.0 81.5 58.2" in capture.notes
    same_frames(capture, views)


def test_a_single_cloud_needs_no_pose_and_may_be_of_any_precision(views, tmp_path):
    depth, _ = views[0]
    path = write_pcd(tmp_path / "one.PCD", points_of(depth), "ascii")
    for file in (path, write_pcd(tmp_path / "folder/a.pcd", points_of(depth), "ascii")):
        capture = read_capture(file if file == path else file.parent)
        np.testing.assert_array_equal(capture.frames[0].pose, np.eye(4))
        np.testing.assert_allclose(capture.frames[0].intrinsics, K, atol=0.01)

    double = points_of(depth).astype(np.float64)
    header = (
        "FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nWIDTH 160\nHEIGHT 120\nPOINTS 19200\n"
    )
    (tmp_path / "old.pcd").write_bytes(
        header.encode() + b"DATA binary\n" + double.tobytes()
    )
    (captured,) = read_capture(tmp_path / "old.pcd").frames
    np.testing.assert_allclose(captured.read().depth, depth / 1000, atol=1e-6)


def test_a_sequence_of_ocid_is_read_cloud_by_cloud(views, tmp_path):
    """It has depth images, too, without intrinsics, and things are added between the images."""
    for name, (depth, _) in zip(NAMES, views, strict=True):
        write_pcd(tmp_path / f"seq/pcd/{name}.pcd", points_of(depth), "binary")
        for folder in ("depth", "label", "rgb"):
            (tmp_path / "seq" / folder).mkdir(exist_ok=True)
            Image.fromarray(depth).save(tmp_path / f"seq/{folder}/{name}.png")
    assert is_capture(tmp_path / "seq")
    with pytest.raises(DatasetError, match=r"has 3 clouds.*name one.*0002\.pcd"):
        read_capture(tmp_path / "seq")
    (captured,) = read_capture(tmp_path / "seq/pcd/0002.pcd").frames
    np.testing.assert_allclose(captured.read().depth, views[2][0] / 1000, atol=1e-6)


def test_given_intrinsics_and_scale_replace_those_of_clouds(views, tmp_path):
    millimetres = 1000 * points_of(views[0][0])
    path = write_pcd(tmp_path / "mm.pcd", millimetres, "binary")
    (captured,) = read_capture(path, depth_scale=0.001).frames
    np.testing.assert_allclose(captured.read().depth, views[0][0] / 1000, atol=1e-6)
    (captured,) = read_capture(path, (1.0, 2.0, 3.0, 4.0), depth_scale=0.001).frames
    np.testing.assert_array_equal(captured.intrinsics[:2, 2], [3, 4])


def test_clouds_in_another_frame_and_of_another_camera_are_named(views, tmp_path):
    depth, pose = views[0]
    in_body = points_of(depth)[..., [2, 0, 1]] * [1, -1, -1]
    path = write_pcd(tmp_path / "body.pcd", in_body, "binary")
    with pytest.raises(
        DatasetError, match=r"not those that a pinhole camera sees.*opt"
    ):
        read_capture(path)
    flat = points_of(depth).reshape(1, -1, 3)
    path = write_pcd(tmp_path / "flat/flat.pcd", flat, "binary")
    for given in (path, path.parent):
        with pytest.raises(DatasetError, match="unorganised cloud"):
            read_capture(given)
    assert not is_capture(path.parent)

    write_pcd(tmp_path / "two/a.pcd", points_of(depth), "binary", pose)
    other = points_of(depth, K + np.diag([20, 20, 0]))
    write_pcd(tmp_path / "two/b.pcd", other, "binary", views[1][1])
    first, second = read_capture(tmp_path / "two").frames
    first.read()
    with pytest.raises(DatasetError, match="is it of another camera"):
        second.read()


def test_the_fit_to_points_is_exact_and_tells_noise():
    rng = np.random.default_rng(0)
    depth = rng.uniform(500, 2000, SHAPE)
    intrinsics, misfit = fitted_intrinsics(points_of(depth).astype(float))
    np.testing.assert_allclose(intrinsics, K, atol=1e-3)
    assert misfit < 1e-3
    assert fitted_intrinsics(rng.normal(size=(*SHAPE, 3)))[1] > 10
    assert fitted_intrinsics(np.full((*SHAPE, 3), np.nan))[1] == np.inf
    assert fitted_intrinsics(np.ones((*SHAPE, 3)))[1] == np.inf


def test_lzf_is_unpacked_as_liblzf_packs_it():
    assert decompress_lzf(b"\x00a\xe0\x0a\x00", 20) == 20 * b"a"
    assert decompress_lzf(b"\x04hello\x60\x04", 10) == b"hellohello"
    content = np.repeat(np.arange(50, dtype=np.float64), 7).tobytes()
    packed = packed_by_lzf(content)
    assert len(packed) < len(content)
    assert decompress_lzf(packed, len(content)) == content
    for damaged, size in (
        (b"\x00a\x20\x05", 4),
        (b"\x00a\xe0\x0a\x00", 19),
        (b"a", 1),
        (b"\x00a\xe0", 9),
    ):
        with pytest.raises(ValueError, match=r"bytes where|damaged LZF"):
            decompress_lzf(damaged, size)


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        (
            {"WIDTH": 10**9, "HEIGHT": 10**9, "POINTS": 10**18},
            "more than any depth cam",
        ),
        ({"WIDTH": -160}, "are not POINTS"),
        ({"POINTS": 7}, "160 x HEIGHT 120 are not POINTS 7"),
        ({"WIDTH": "many"}, "header is damaged"),
        ({"WIDTH": None}, "there is no line WIDTH"),
        ({"FIELDS": "x y w _ rgb _"}, "its points have no z"),
        ({"SIZE": "4 4 4"}, "header is damaged"),
        ({"SIZE": "4 4 3 1 4 1"}, "field z of 1 times 3 bytes"),
        ({"TYPE": "F F Q U F U"}, "header is damaged"),
        ({"COUNT": "1 1 1 4 1 999999999"}, "field _ of 999999999 times"),
        ({"COUNT": "1 1 1 4 1 4000"}, "bytes where 77184000 are expected"),
        (
            {"WIDTH": 4000, "HEIGHT": 4000, "POINTS": 16 * 10**6},
            "its points take 488 MB, at most 256 MB are read",
        ),
        ({"VIEWPOINT": "0 0 0 0 0 0 0"}, "VIEWPOINT is no pose"),
        ({"VIEWPOINT": "nan 0 0 1 0 0 0"}, "VIEWPOINT is no pose"),
        ({"VIEWPOINT": "0 0 0 1"}, "header is damaged"),
        ({"DATA": "binary_zipped"}, "DATA is one of ascii, binary, binary_compressed"),
        (
            {"DATA": "binary_compressed"},
            "bytes where 307200 are expected|cannot be read",
        ),
        ({"HEIGHT": 240, "POINTS": 38400}, "bytes where 1228800 are expected"),
    ],
)
def test_headers_that_claim_what_is_not_there_are_refused(
    changed, sentence, views, tmp_path
):
    path = write_pcd(tmp_path / "a.pcd", points_of(views[0][0]), "binary", **changed)
    refused_cheaply(path, sentence)


@pytest.mark.parametrize("kind", KINDS)
def test_clouds_that_end_too_early_are_refused(kind, views, tmp_path):
    path = write_pcd(tmp_path / "a.pcd", points_of(views[0][0]), kind)
    content = path.read_bytes()
    for size in (0, 20, 200, len(content) // 2):
        path.write_bytes(content[:size])
        refused_cheaply(path, "header is damaged|points cannot be read|no line DATA")


def test_packed_clouds_that_lie_about_their_size_are_refused(views, tmp_path):
    path = write_pcd(tmp_path / "a.pcd", points_of(views[0][0]), "binary_compressed")
    content = bytearray(path.read_bytes())
    start = content.index(b"compressed\n") + len(b"compressed\n")
    content[start : start + 8] = struct.pack("<II", 2**32 - 1, 2**32 - 1)
    path.write_bytes(content)
    refused_cheaply(path, "4294967295 bytes where 307200 are expected")
    size = 160 * 120 * 16
    bomb = b"\x00a" + 10_000 * b"\xe0\xff\x00"
    path.write_bytes(content[:start] + struct.pack("<II", len(bomb), size) + bomb)
    refused_cheaply(path, "points cannot be read")


def test_a_damaged_cloud_costs_only_itself(views, tmp_path):
    for name, (depth, pose) in zip(NAMES, views, strict=True):
        write_pcd(tmp_path / f"{name}.pcd", points_of(depth), "binary", pose)
    (tmp_path / "0001.pcd").write_bytes(b"nothing")
    capture = read_capture(tmp_path)
    assert [frame.name for frame in capture.frames] == ["0000", "0002"]
    assert "there is no line DATA" in dict(capture.unreadable)["0001"]


def refused_cheaply(path, sentence):
    """Reading it ends with one sentence that names the file, in a few megabytes."""
    tracemalloc.start()
    try:
        with pytest.raises(DatasetError, match=sentence) as said:
            for captured in read_capture(path).frames:
                captured.read()
        assert tracemalloc.get_traced_memory()[1] < 40 * MEGABYTE
    finally:
        tracemalloc.stop()
    assert path.name in str(said.value)
    assert "\n" not in str(said.value)
    assert len(str(said.value)) < 500


# YCB-Video and GraspNet


def write_ycb_video(folder, views, **changed):
    """A sequence with depth in tenths of millimetres and poses from the world to the camera."""
    folder.mkdir()
    for number, (depth, pose) in enumerate(views, 1):
        Image.fromarray((10 * depth).astype(np.uint16)).save(
            folder / f"{number:06d}-depth.png"
        )
        Image.new("RGB", (160, 120)).save(folder / f"{number:06d}-color.jpg")
        meta = {
            "center": np.zeros((3, 2)),
            "cls_indexes": np.array([[2], [5]], np.uint8),
            "factor_depth": np.array([[10000]], np.uint16),
            "intrinsic_matrix": K,
            "poses": np.zeros((3, 4, 2)),
            "rotation_translation_matrix": np.linalg.inv(pose)[:3],
            "vertmap": np.zeros((120, 160, 3), np.float32),
        } | changed
        meta = {name: value for name, value in meta.items() if value is not None}
        savemat(
            folder / f"{number:06d}-meta.mat", meta, do_compression=bool(number % 2)
        )
    return folder


def test_a_sequence_of_ycb_video_is_read(views, tmp_path):
    capture = read_capture(write_ycb_video(tmp_path / "0048", views))
    assert capture.layout == "YCB-Video"
    assert capture.up is None
    assert all(frame.image is not None for frame in capture.frames)
    same_frames(capture, views)
    given = read_capture(capture.folder, (1.0, 2.0, 3.0, 4.0)).frames[0]
    np.testing.assert_array_equal(given.intrinsics[:2, 2], [3, 4])


def test_images_of_posecnn_without_camera_poses_are_read_one_by_one(views, tmp_path):
    lacks = {"rotation_translation_matrix": None}
    with pytest.raises(DatasetError, match="has no rotation_translation_matrix"):
        read_capture(write_ycb_video(tmp_path / "several", views, **lacks))
    capture = read_capture(write_ycb_video(tmp_path / "one", views[:1], **lacks))
    np.testing.assert_array_equal(capture.frames[0].pose, np.eye(4))


def write_graspnet(folder, views, table=True):
    """One camera of a scene: poses relative to the first image, which is seen from the table."""
    for name in ("depth", "meta", "rgb"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    first = views[0][1]
    for number, (depth, _) in enumerate(views):
        Image.fromarray(depth).save(folder / f"depth/{number:04d}.png")
        Image.new("RGB", (160, 120)).save(folder / f"rgb/{number:04d}.png")
        meta = {"intrinsic_matrix": K, "factor_depth": np.array([[1000]], np.uint16)}
        meta |= {"cls_indexes": np.ones((1, 2)), "poses": np.zeros((3, 4, 2))}
        savemat(folder / f"meta/{number:04d}.mat", meta)
    poses = np.stack([np.linalg.inv(first) @ pose for _, pose in views])
    np.save(folder / "camera_poses.npy", poses)
    if table:
        np.save(folder / "cam0_wrt_table.npy", first)
    return folder


def test_a_scene_of_graspnet_is_read_on_its_table(views, tmp_path):
    folder = write_graspnet(tmp_path / "scene_0000/kinect", views)
    capture = read_capture(folder)
    assert capture.layout == "GraspNet"
    assert capture.up == (0, 0, 1)
    same_frames(capture, views)

    capture = read_capture(write_graspnet(tmp_path / "other", views, table=False))
    assert capture.up is None
    np.testing.assert_allclose(capture.frames[0].pose, np.eye(4), atol=1e-9)


def test_graspnet_without_poses_is_refused(views, tmp_path):
    folder = write_graspnet(tmp_path / "scene", views)
    np.save(folder / "camera_poses.npy", np.tile(np.eye(4), (2, 1, 1)))
    assert "has no pose of image 0002" in dict(read_capture(folder).unreadable)["0002"]
    (folder / "camera_poses.npy").unlink()
    with pytest.raises(DatasetError, match=r"3 depth images and no camera_poses\.npy"):
        read_capture(folder)


def absurd_npy(path, shape):
    """An array that claims to be large, and is not."""
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}"
    header = header.ljust(117) + "\n"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + header.encode())


def test_arrays_that_claim_what_is_not_there_are_refused(views, tmp_path):
    folder = write_graspnet(tmp_path / "scene", views)
    path = folder / "camera_poses.npy"
    absurd_npy(path, (10**9, 4, 4))
    refused_array(folder, "is no array of numpy, or is damaged")
    for values in (np.zeros((3, 3)), np.array([["a"]]), np.array({"a": 1})):
        np.save(path, values)
        refused_array(folder, "poses are 4 x 4 numbers|is no array of numpy")
    path.write_bytes(b"")
    refused_array(folder, "is no array of numpy")
    np.save(path, np.full((3, 4, 4), np.nan))
    with pytest.raises(DatasetError, match="pose 0000 of"):
        read_capture(folder)


def refused_array(folder, sentence):
    tracemalloc.start()
    try:
        with pytest.raises(DatasetError, match=rf"camera_poses\.npy: ({sentence})"):
            read_capture(folder)
        assert tracemalloc.get_traced_memory()[1] < 20 * MEGABYTE
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"intrinsic_matrix": np.zeros((4, 4))}, "intrinsic_matrix is 3 x 3 finite"),
        ({"intrinsic_matrix": None}, "has no intrinsic_matrix"),
        ({"intrinsic_matrix": np.zeros((3, 3, 3000))}, "has no intrinsic_matrix"),
        ({"intrinsic_matrix": "none"}, "has no intrinsic_matrix"),
        ({"factor_depth": np.array([[0.001]])}, "factor_depth is the number of steps"),
        ({"factor_depth": np.array([[np.nan]])}, "factor_depth is 1 x 1 finite"),
        ({"rotation_translation_matrix": np.zeros((3, 4))}, "not rigid"),
    ],
)
def test_meta_files_with_other_content_are_refused(changed, sentence, views, tmp_path):
    folder = write_ycb_video(tmp_path / "0000", views, **changed)
    with pytest.raises(DatasetError, match=rf"000001-meta\.mat: .*{sentence}"):
        read_capture(folder)


def test_damaged_meta_files_are_refused(views, tmp_path, capsys):
    folder = write_ycb_video(tmp_path / "0000", views[:1])
    path = folder / "000001-meta.mat"
    content = path.read_bytes()
    bomb = zlib.compress(bytes(300 * MEGABYTE), 9)
    for damaged in (
        b"",
        content[:100],
        content[: len(content) // 2],
        content[:128] + struct.pack("<II", 15, 2**32 - 1),
        content[:128] + struct.pack("<II", 15, 20) + bytes(20),
        b"\x89HDF\r\n\x1a\n" + bytes(500),
    ):
        path.write_bytes(damaged)
        refused_cheaply(path.parent, r"000001-meta\.mat: is no MATLAB file")
    path.write_bytes(content[:128] + struct.pack("<II", 15, len(bomb)) + bomb)
    refused_cheaply(path.parent, "has no intrinsic_matrix")
    said = refused(capsys, "look", folder)
    assert "has no" in said
