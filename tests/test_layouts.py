"""Captures of every layout are read as they were written: depth, poses, intrinsics; and intrinsics
as tools write them.
"""

import json
from functools import partial

import numpy as np
import pytest
from recordings import (
    CAMERA,
    HALF,
    LAYOUTS,
    SHAPE,
    K,
    points_of,
    views_around,
    write_clouds,
    write_folder,
    write_graspnet,
    write_recording,
    write_ycb_video,
)

from nextview.captured.camera_file import read_camera_file
from nextview.captured.check import check_capture
from nextview.captured.folders import is_capture, read_capture
from nextview.errors import DatasetError, UsageError
from nextview.teaching.thing_sources import find_things

FORMS = {name: (name, write) for name, write in LAYOUTS.items()}
FORMS |= {
    f"PCD, {kind}": ("PCD", partial(write_clouds, kind=kind))
    for kind in ("ascii", "binary_compressed")
}
FORMS |= {
    f"depth folder, poses as {poses}": (
        "depth folder",
        partial(write_folder, poses=poses),
    )
    for poses in ("json", "names", "log")
}
FORMS["ROS 2 bag of SQLite"] = ("ROS 2 bag", partial(write_recording, mcap=False))
UPRIGHT = ("BOP", "TUM RGB-D", "GraspNet", "ROS 2 bag")
"""Whose world has z up."""


@pytest.fixture(scope="module")
def views():
    return views_around()


@pytest.mark.parametrize("form", FORMS)
def test_a_capture_is_read_as_it_was_written(form, views, tmp_path):
    layout, write = FORMS[form]
    path = write(tmp_path, views)
    assert is_capture(path)
    capture = read_capture(path)
    assert capture.layout == layout
    assert capture.up == ((0, 0, 1) if layout in UPRIGHT else None)
    for captured, (depth, pose) in zip(capture.frames, views, strict=True):
        np.testing.assert_allclose(captured.pose, pose, atol=1e-6)
        assert captured.size == SHAPE[::-1]
        frame = captured.read()
        np.testing.assert_allclose(frame.depth, depth / 1000, atol=1e-6)
        np.testing.assert_allclose(frame.intrinsics, K + HALF, atol=0.01)
    usable, left_out = check_capture(capture)
    assert (len(usable.frames), left_out) == (3, {})


def test_a_single_cloud_needs_no_pose_and_may_be_of_any_precision(views, tmp_path):
    depth, _ = views[0]
    double = points_of(depth).astype(np.float64)
    header = (
        "FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nWIDTH 160\nHEIGHT 120\nPOINTS 19200\n"
    )
    path = tmp_path / "old.PCD"
    path.write_bytes(header.encode() + b"DATA binary\n" + double.tobytes())
    (captured,) = read_capture(path).frames
    np.testing.assert_array_equal(captured.pose, np.eye(4))
    np.testing.assert_allclose(captured.read().depth, depth / 1000, atol=1e-6)


def test_captures_without_poses_are_read_one_by_one(views, tmp_path):
    for name in ("one", "several", "free"):
        (tmp_path / name).mkdir()
    lacks = {"rotation_translation_matrix": None}
    with pytest.raises(DatasetError):
        read_capture(write_ycb_video(tmp_path / "several", views, **lacks))
    capture = read_capture(write_ycb_video(tmp_path / "one", views[:1], **lacks))
    np.testing.assert_array_equal(capture.frames[0].pose, np.eye(4))
    capture = read_capture(write_graspnet(tmp_path / "free", views, table=False))
    assert capture.up is None
    np.testing.assert_allclose(capture.frames[0].pose, np.eye(4), atol=1e-9)


@pytest.mark.parametrize("form", ["PCD", "YCB-Video", "depth folder", "ROS 2 bag"])
def test_given_intrinsics_and_scale_count_before_those_of_the_capture(
    form, views, tmp_path
):
    """Numbers, and a file, whose images have to have the size of these."""
    path = LAYOUTS[form](tmp_path, views)
    frame = read_capture(path, (1.0, 2.0, 3.0, 4.0), depth_scale=0.002).frames[0]
    np.testing.assert_array_equal(frame.intrinsics[:2, 2], [3, 4])
    if form != "PCD":
        assert frame.scale == 0.002
    (tmp_path / "mine.json").write_text(json.dumps(CAMERA | {"fx": 99}))
    assert read_capture(path, tmp_path / "mine.json").frames[0].intrinsics[0, 0] == 99
    (tmp_path / "wide.json").write_text(json.dumps(CAMERA | {"width": 640}))
    with pytest.raises(DatasetError):
        read_capture(path, tmp_path / "wide.json")


def test_one_image_with_intrinsics_is_a_capture(views, tmp_path):
    image = write_folder(tmp_path, views[:1]) / "depth/0000.png"
    (captured,) = read_capture(image, tmp_path / "intrinsics.json").frames
    np.testing.assert_allclose(captured.read().depth, views[0][0] / 1000, atol=1e-6)
    with pytest.raises(UsageError):
        read_capture(image, depth_topic="/depth")


def test_captures_and_scans_are_found_beside_each_other(views, tmp_path):
    (tmp_path / "things/mug").mkdir(parents=True)
    write_folder(tmp_path / "things/mug", views)
    bag = write_recording(tmp_path, views)
    next(bag.glob("*.mcap")).rename(tmp_path / "things/seat.mcap")
    (tmp_path / "things/brick.off").write_text(
        "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    )
    found = find_things(tmp_path / "things")
    assert [thing.name for thing in found.things] == ["brick", "mug", "seat"]
    assert not found.left_out


def test_a_damaged_frame_costs_only_itself(views, tmp_path):
    write_clouds(tmp_path, views)
    (tmp_path / "000001.pcd").write_bytes(b"nothing")
    capture = read_capture(tmp_path)
    assert [frame.name for frame in capture.frames] == ["000000", "000002"]
    assert list(dict(capture.unreadable)) == ["000001"]


@pytest.mark.parametrize(("given", "true"), [(0.0001, 0.001), (0.001, 0.0001)])
def test_a_wrong_depth_scale_is_noticed(given, true, views, tmp_path):
    steps = [
        ((depth * (0.001 / true)).astype(np.uint16), pose) for depth, pose in views
    ]
    write_folder(tmp_path, steps, scale=given)
    with pytest.raises(DatasetError):
        check_capture(read_capture(tmp_path))
    assert not check_capture(read_capture(tmp_path, depth_scale=true))[1]


# Intrinsics of tools


MATRIX = [615.5, 0.0, 319.25, 0.0, 616.5, 238.75, 0.0, 0.0, 1.0]
BY_COLUMNS = [615.5, 0.0, 0.0, 0.0, 616.5, 0.0, 319.25, 238.75, 1.0]
SIZE = {"width": 640, "height": 480}
LIBREALSENSE = SIZE | {"ppx": 319.25, "ppy": 238.75, "fx": 615.5, "fy": 616.5}
FROM_CORNER = SIZE | {"fx": 615.5, "fy": 616.5, "cx": 419.25, "cy": 288.75}
OF_TOOLS = {
    "librealsense.json": (
        LIBREALSENSE
        | {"model": "brown_conrady", "coeffs": 5 * [0], "depth_units": 0.00025},
        0.00025,
    ),
    "open3d.json": (
        SIZE | {"intrinsic_matrix": BY_COLUMNS, "depth_scale": 1000.0},
        0.001,
    ),
    "bop.json": (
        SIZE
        | {"cx": 319.25, "cy": 238.75, "depth_scale": 0.1, "fx": 615.5, "fy": 616.5},
        0.0001,
    ),
    "two_cameras.json": (
        {"color": {"fx": 9.0}, "depth": {"K": MATRIX} | SIZE, "depth_scale": 0.001},
        0.001,
    ),
    "open3d_parameters.json": (
        {
            "class_name": "PinholeCameraParameters",
            "extrinsic": np.eye(4).ravel().tolist(),
            "intrinsic": SIZE | {"intrinsic_matrix": BY_COLUMNS},
        },
        None,
    ),
    "part_of_the_sensor.json": (FROM_CORNER | {"x_offset": 100, "y_offset": 50}, None),
    "roi.yaml": (
        "height: 600\nwidth: 800\nbinning_x: 0\nk: [615.5, 0, 419.25, 0, 616.5, 288.75, 0, 0, 1]\n"
        "roi: {x_offset: 100, y_offset: 50, height: 480, width: 640, do_rectify: false}\n",
        None,
    ),
    "opencv.yaml": (
        "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n"
        "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        "   data: [ 6.155e+02, 0., 3.1925e+02, 0., 6.165e+02,\n       2.3875e+02, 0., 0., 1. ]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n"
        "   data: [ 0., 0., 0., 0., 0. ]\n",
        None,
    ),
    "echo.yaml": (
        "header:\n  stamp: {sec: 1, nanosec: 5}\n  frame_id: optical\nheight: 480\nwidth: 640\n"
        "distortion_model: plumb_bob\nd:\n- 0.0\n- 0.0\nk:\n"
        + "".join(f"- {value}\n" for value in MATRIX)
        + "---\nheight: 1\n",
        None,
    ),
    "calibration.yaml": (
        "image_width: 640\nimage_height: 480\ncamera_name: depth\ncamera_matrix:\n  rows: 3\n"
        f"  cols: 3\n  data: {MATRIX}\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n"
        "  data: [0, 0, 0, 0, 0]\n",
        None,
    ),
}


@pytest.mark.parametrize("name", OF_TOOLS)
def test_intrinsics_are_read_as_tools_write_them(name, tmp_path):
    content, scale = OF_TOOLS[name]
    text = content if isinstance(content, str) else json.dumps(content)
    (tmp_path / name).write_text(text)
    camera = read_camera_file(tmp_path / name)
    np.testing.assert_allclose(camera.intrinsics, np.reshape(MATRIX, (3, 3)))
    assert camera.size == (640, 480)
    assert camera.scale == (None if scale is None else pytest.approx(scale))
