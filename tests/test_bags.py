"""ROS 2 bags: poses between the stamps of tf by closed forms, compressed depth, standing cameras,
samples of long recordings.
"""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from factories import pose_at, refused
from ros_messages import (
    CAMERA_INFO,
    DEPTH,
    SHAPE,
    K,
    compressed_message,
    header,
    image_message,
    info_message,
    tf_message,
    transform_message,
    write_bag,
)
from scipy.spatial.transform import Rotation

from nextview.captured import bag as bag_reader
from nextview.captured.check import check_capture
from nextview.captured.folders import read_capture
from nextview.captured.messages import parts_of
from nextview.captured.transforms import TransformTree
from nextview.errors import DatasetError

MOUNTED = pose_at(-20, 30, 0.05, (0.02, 0.01, 0.1))
"""The camera's optical frame on the arm's last link."""
HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
"""From a first pixel's centre at 0 to one at 0.5."""
START = 1_700_000_000.0
"""Seconds, as of a real clock."""


def depth_image(seed=0):
    """Whole millimetres, and holes."""
    rng = np.random.default_rng(seed)
    metres = np.round(rng.uniform(0.4, 2.0, SHAPE), 3)
    return np.where(rng.random(SHAPE) < 0.1, 0, metres).astype(np.float32)


def tool_at(time):
    """A link that turns by 1 rad a second about the vertical, and moves evenly."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0, 0, time]).as_matrix()
    pose[:3, 3] = [0.4 + 0.1 * time, -0.2 * time, 0.5]
    return pose


def tf_of_an_arm(duration=3.0, step=0.1, static=True, **moving):
    """What tf says of a camera on an arm: topic, seconds, message of each."""
    said = []
    if static:
        fixed = transform_message(MOUNTED, "optical", 0.0, "tool")
        said.append(("/tf_static", START, tf_message(fixed)))
    for time in np.arange(0, duration + step / 2, step):
        link = {"child": "tool", "parent": "base_link", "time": START + time} | moving
        said.append(
            ("/tf", START + time, tf_message(transform_message(tool_at(time), **link)))
        )
    return said


def images_at(times, encoding="16UC1", **more):
    """Depth images and their camera_info: topic, seconds, message of each."""
    said = []
    for number, time in enumerate(times):
        depth = depth_image(number)
        stored = np.rint(1000 * depth) if encoding == "16UC1" else depth
        stamped = header("optical", START + time)
        image = image_message(stored, encoding, header=stamped)
        said.append((DEPTH, START + time, replace(image, **more)))
        said.append((CAMERA_INFO, START + time, info_message(header=stamped)))
    return said


# A bag


@pytest.mark.parametrize("mcap", [True, False])
@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_images_poses_and_intrinsics_are_those_that_were_recorded(
    tmp_path, mcap, encoding
):
    """The stamps lie between those of tf; the pose there is known in closed form."""
    times = [0.05, 1.02, 2.77]
    bag = write_bag(
        tmp_path / "bag", [*tf_of_an_arm(), *images_at(times, encoding)], mcap
    )
    capture = read_capture(bag)
    assert capture.layout == "ROS 2 bag"
    assert capture.up == (0, 0, 1)
    assert len(capture.frames) == 3
    for number, (time, captured) in enumerate(zip(times, capture.frames, strict=True)):
        frame = captured.read()
        np.testing.assert_allclose(frame.depth, depth_image(number), atol=1e-6)
        np.testing.assert_allclose(frame.pose, tool_at(time) @ MOUNTED, atol=1e-6)
        np.testing.assert_allclose(frame.intrinsics, K + HALF)
        assert captured.size == (160, 120)
        assert float(captured.name) == pytest.approx(time, abs=1e-3)


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_compressed_depth_is_read_where_there_is_no_raw_one(tmp_path, encoding):
    depth = depth_image()
    given = np.rint(1000 * depth) if encoding == "16UC1" else depth
    packed = compressed_message(given, encoding, START + 1, scale=2000.0)
    said = [(f"{DEPTH}/compressedDepth", START + 1, packed)]
    said.append(
        (CAMERA_INFO, START + 1, info_message(header=header("optical", START + 1)))
    )
    (captured,) = read_capture(
        write_bag(tmp_path / "bag", [*tf_of_an_arm(), *said])
    ).frames
    # Of floats one step of inverse depth is 2 m at 63 m, and 2 mm at 2 m.
    tolerance = 1e-6 if encoding == "16UC1" else 2e-3
    np.testing.assert_allclose(captured.read().depth, depth, atol=tolerance)

    raw = images_at([1.0], encoding)
    both = read_capture(
        write_bag(tmp_path / "both", [*tf_of_an_arm(), *said[:1], *raw])
    )
    assert f"depth of {DEPTH}" in both.notes


@pytest.mark.parametrize("mcap", [True, False])
def test_a_long_recording_is_sampled_without_loading_all_of_it(
    tmp_path, mcap, monkeypatch
):
    monkeypatch.setattr(bag_reader, "MOST_FRAMES", 20)
    pixels = np.random.default_rng(0).integers(400, 2000, (480, 640))
    size = pixels.size * 2
    said = tf_of_an_arm(duration=5.0)
    k = np.array([[600.0, 0, 319.5], [0, 600, 239.5], [0, 0, 1]])
    for time in np.arange(0, 5, 0.05):
        stamped = header("optical", START + time)
        said.append(
            (DEPTH, START + time, image_message(pixels, "16UC1", header=stamped))
        )
        said.append(
            (CAMERA_INFO, START + time, info_message(k, (480, 640), header=stamped))
        )
    bag = write_bag(tmp_path / "bag", said, mcap)
    assert sum(path.stat().st_size for path in bag.iterdir()) > 100 * size
    del said
    tracemalloc.start()
    capture = read_capture(bag)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 25 * size
    assert len(capture.frames) == 20
    assert "20 of 100 images, evenly spread" in capture.notes
    gaps = np.diff([float(frame.name) for frame in capture.frames])
    np.testing.assert_allclose(gaps, 0.25, atol=0.051)


def test_one_of_several_topics_is_named_and_the_world_too(tmp_path):
    other = [
        ("/other/depth/image", time, said) for _, time, said in images_at([1.0])[:1]
    ]
    bag = write_bag(tmp_path / "bag", [*tf_of_an_arm(), *images_at([1.0, 2.0]), *other])
    with pytest.raises(DatasetError):
        read_capture(bag)
    capture = read_capture(bag, depth_topic=DEPTH, world_frame="tool")
    # in the link's own frame the camera does not move
    assert capture.stands
    for frame in capture.frames:
        np.testing.assert_allclose(frame.pose, MOUNTED, atol=1e-6)


def standing(times):
    """A bag of a camera on a stand."""
    stand = transform_message(MOUNTED, "optical", 0.0, "camera_link")
    return [("/tf_static", START, tf_message(stand)), *images_at(times)]


def test_a_static_camera_gives_all_images_with_up_from_its_plane(tmp_path):
    bag = write_bag(tmp_path / "bag", standing([1.0, 1.1, 1.2]))
    capture = read_capture(bag)
    assert [frame.name for frame in capture.frames] == ["1.000", "1.100", "1.200"]
    assert {frame.camera for frame in capture.frames} == {"optical"}
    assert capture.stands
    assert capture.up is None
    assert any(
        note.startswith("tf does not move the camera (one image: --at first")
        for note in capture.notes
    )
    # the images differ everywhere, and no pose can be the reason
    usable, left_out = check_capture(capture)
    assert (len(usable.frames), left_out) == (3, {})
    # an object is recognised at one moment
    one = capture.at_one_moment
    assert [frame.name for frame in one.frames] == ["1.000"]
    assert "show an object at one moment: 1.000 is used" in one.notes[-1]
    # who names the frame says that its z axis is up
    assert read_capture(bag, world_frame="camera_link").up == (0, 0, 1)


@pytest.mark.parametrize("most", [120, 4])
def test_the_image_of_a_standing_camera_can_be_chosen(
    most, tmp_path, monkeypatch, capsys
):
    """Also of a recording that is too long for all of its images to be sampled."""
    monkeypatch.setattr(bag_reader, "MOST_FRAMES", most)
    times = [1.0, 2.5, 4.0, 5.5, 7.0, 7.2]
    bag = write_bag(tmp_path / "bag", standing(times))
    assert len(read_capture(bag).frames) == min(most, 6)
    chosen = {"first": 0, "last": 5, 0: 0, 2.5: 1, 2.6: 2, 7.1: 5}
    for when, number in chosen.items():
        capture = read_capture(bag, at=when)
        (captured,) = capture.frames
        depth = depth_image(number)
        np.testing.assert_allclose(captured.read().depth, depth, atol=1e-6)
        assert f"its image at {times[number]:.3f} s is used" in f"{capture!r}"
    with pytest.raises(DatasetError):
        read_capture(bag, at=9)
    assert "is a number of at least 0, not -1" in refused(
        capsys, "recognise", str(bag), "--at", "-1"
    )
    moving = write_bag(tmp_path / "moving", [*tf_of_an_arm(), *images_at([1.0, 2.0])])
    assert "tf moves its camera" in refused(capsys, "look", str(moving), "--at", "last")


def test_no_pose_is_made_up_in_a_gap_of_tf():
    tree = TransformTree()
    for time in (0.0, 0.1, 2.0):
        link = transform_message(tool_at(time), "tool", time, "base_link")
        tree.add("tool", "base_link", time, *parts_of(link.transform))
    tree.sort()
    np.testing.assert_allclose(
        tree.pose("tool", "base_link", 0.05), tool_at(0.05), atol=1e-9
    )
    with pytest.raises(DatasetError):
        tree.pose("tool", "base_link", 1.0)
    # but where there is one
    np.testing.assert_allclose(
        tree.pose("tool", "base_link", 2.0), tool_at(2.0), atol=1e-9
    )
