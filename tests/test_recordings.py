"""ROS 2 bags and folders of depth images, written here and read back: poses by closed forms,
intrinsics as five tools write them, samples of long recordings, damage.
"""

import json
import shutil
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from factories import box, cast, meshed, pose_at, refused
from PIL import Image
from ros_messages import (
    CAMERA_INFO,
    DEPTH,
    SHAPE,
    K,
    at,
    compressed_message,
    header,
    image_message,
    info_message,
    message,
    tf_message,
    transform_message,
    write_bag,
)
from scipy.spatial.transform import Rotation

import nextview
from nextview.captured import bag as bag_reader
from nextview.captured.camera_file import read_camera_file
from nextview.captured.check import check_capture
from nextview.captured.folders import is_capture, read_capture
from nextview.captured.messages import parts_of
from nextview.captured.transforms import TransformTree
from nextview.data.samples import sample_mesh
from nextview.errors import DatasetError, UsageError
from nextview.teaching.learn import learn
from nextview.teaching.thing_sources import find_things
from nextview.teaching.thing_views import TeachingOptions, teach

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
    tmp_path,
    mcap,
    encoding,
):
    """The stamps lie between those of tf; the pose there is known in closed form."""
    times = [0.05, 1.02, 2.77]
    bag = write_bag(
        tmp_path / "bag",
        [*tf_of_an_arm(), *images_at(times, encoding)],
        mcap,
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


def test_messages_out_of_order_are_put_into_the_order_of_their_stamps(tmp_path):
    said = [*tf_of_an_arm(), *images_at([0.5, 1.5, 2.5])]
    order = np.random.default_rng(1).permutation(len(said))
    # recorded in another order than they were stamped in
    shuffled = [(said[i][0], START + 0.01 * n, said[i][2]) for n, i in enumerate(order)]
    capture = read_capture(write_bag(tmp_path / "bag", shuffled, mcap=False))
    found = np.array([frame.pose for frame in capture.frames])
    expected = np.array([tool_at(time) @ MOUNTED for time in (0.5, 1.5, 2.5)])
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize("mcap", [True, False])
def test_a_long_recording_is_sampled_without_loading_all_of_it(
    tmp_path,
    mcap,
    monkeypatch,
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
    with pytest.raises(
        DatasetError,
        match=r"2 topics; name one with depth_topic: /camera/depth",
    ):
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
    most,
    tmp_path,
    monkeypatch,
    capsys,
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
    with pytest.raises(DatasetError, match=r"no image from 9 s on; the last is at 7.2"):
        read_capture(bag, at=9)
    assert "is a number of at least 0, not -1" in refused(
        capsys,
        "recognise",
        str(bag),
        "--at",
        "-1",
    )
    moving = write_bag(tmp_path / "moving", [*tf_of_an_arm(), *images_at([1.0, 2.0])])
    assert "tf moves its camera" in refused(capsys, "look", str(moving), "--at", "last")


def test_images_before_and_after_tf_are_left_out(tmp_path):
    said = [*tf_of_an_arm(duration=1.0), *images_at([-0.3, 0.5, 1.01, 1.4])]
    capture = read_capture(write_bag(tmp_path / "bag", said))
    assert len(capture.frames) == 2
    assert "2 images have no pose in tf and are left out" in capture.notes


def test_no_pose_is_made_up_in_a_gap_of_tf():
    tree = TransformTree()
    for time in (0.0, 0.1, 2.0):
        link = transform_message(tool_at(time), "tool", time, "base_link")
        tree.add("tool", "base_link", time, *parts_of(link.transform))
    tree.sort()
    np.testing.assert_allclose(
        tree.pose("tool", "base_link", 0.05),
        tool_at(0.05),
        atol=1e-9,
    )
    with pytest.raises(DatasetError, match="tf has nothing of 'tool' in 'base_link'"):
        tree.pose("tool", "base_link", 1.0)
    # but where there is one
    np.testing.assert_allclose(
        tree.pose("tool", "base_link", 2.0),
        tool_at(2.0),
        atol=1e-9,
    )


def two_parents():
    said = transform_message(np.eye(4), "tool", START, "table")
    return [*tf_of_an_arm(), ("/tf", START, tf_message(said)), *images_at([1.0])]


def circle():
    said = transform_message(np.eye(4), "base_link", START, "tool")
    return [*tf_of_an_arm(), ("/tf", START, tf_message(said)), *images_at([1.0])]


def colour():
    image, info = images_at([1.0])
    return [*tf_of_an_arm(), (*image[:2], replace(image[2], encoding="rgb8")), info]


def text():
    return [("/chatter", START, message("std_msgs/msg/String", data="nothing to see"))]


UNUSABLE = {
    "no tf": (
        lambda: images_at([1.0]),
        r"tf has no frame 'optical'.*there is no tf in it",
    ),
    "tf of others": (
        lambda: [*tf_of_an_arm(static=False), *images_at([1.0])],
        "tf has no frame 'optical', .*tf knows base_link, tool",
    ),
    "another clock": (
        lambda: [*tf_of_an_arm(), *images_at([500.0])],
        "none of the images a pose .* are the stamps of one clock",
    ),
    "two parents": (two_parents, "'tool' has two parents, 'base_link' and 'table'"),
    "circle": (circle, "tf goes round in a circle"),
    "colour": (
        colour,
        r"holds no depth images .*its images are /camera/depth/image_rect_raw \(rgb8\)",
    ),
    "no images": (text, "holds no depth images .* and no others"),
    "no camera_info": (
        lambda: [*tf_of_an_arm(), images_at([1.0])[0]],
        "camera_info of .* is missing .*give intrinsics",
    ),
    "another size": (
        lambda: [
            *tf_of_an_arm(),
            images_at([1.0])[0],
            (CAMERA_INFO, START + 1, info_message(width=640, height=480)),
        ],
        "is of images of 640 x 480 pixels, and .* has 160 x 120",
    ),
    "not calibrated": (
        lambda: [
            *tf_of_an_arm(),
            images_at([1.0])[0],
            (CAMERA_INFO, START + 1, info_message(k=np.zeros((3, 3)))),
        ],
        "not calibrated",
    ),
}


@pytest.mark.parametrize("mcap", [True, False])
@pytest.mark.parametrize("what", UNUSABLE)
def test_missing_parts_of_a_bag_are_reported_in_one_sentence(
    what, mcap, tmp_path, capsys
):
    made, match = UNUSABLE[what]
    bag = write_bag(tmp_path / "bag", made(), mcap)
    with pytest.raises(DatasetError, match=match):
        read_capture(bag)
    assert "bag" in refused(capsys, "recognise", str(bag))


def cut(bag, part):
    """The file of a bag, cut off: as after a full disk, or a recording that was killed."""
    (file,) = [path for path in bag.iterdir() if path.suffix in (".mcap", ".db3")]
    content = file.read_bytes()
    file.write_bytes(content[: int(part * len(content))])
    return bag


def overwritten(bag):
    (file,) = [path for path in bag.iterdir() if path.suffix in (".mcap", ".db3")]
    content = bytearray(file.read_bytes())
    rng = np.random.default_rng(0)
    middle = slice(len(content) // 8, 7 * len(content) // 8)
    content[middle] = rng.integers(
        0,
        256,
        middle.stop - middle.start,
        np.uint8,
    ).tobytes()
    file.write_bytes(content)
    return bag


DAMAGE = {
    "empty": lambda bag: cut(bag, 0),
    "cut in the middle": lambda bag: cut(bag, 0.5),
    "cut near the end": lambda bag: cut(bag, 0.99),
    "overwritten": overwritten,
    "metadata is text": lambda bag: (
        (bag / "metadata.yaml").write_text("nothing") and bag
    ),
    "metadata is cut": lambda bag: (
        (bag / "metadata.yaml").write_text("rosbag2_bagfile_inf: [") and bag
    ),
}


@pytest.mark.parametrize("mcap", [True, False])
@pytest.mark.parametrize("what", DAMAGE)
def test_a_damaged_bag_is_named(what, mcap, tmp_path):
    bag = write_bag(
        tmp_path / "bag",
        [*tf_of_an_arm(), *images_at([0.5, 1.0, 2.0])],
        mcap,
    )
    DAMAGE[what](bag)
    with pytest.raises(
        DatasetError,
        match=r"bag.*the bag is damaged, or its recording was cut",
    ):
        for frame in read_capture(bag).frames:
            frame.read()


@pytest.mark.parametrize("mcap", [True, False])
def test_a_compressed_file_of_a_bag_expands_within_limits(mcap, tmp_path, monkeypatch):
    """Noise shrinks to no hundredth; images of one distance do, and fill no disk."""
    said = [*tf_of_an_arm(), *images_at([1.0, 2.0])]
    bag = write_bag(tmp_path / "bag", said, mcap, compressed="file")
    plain = write_bag(tmp_path / "plain", said, mcap)
    assert not [path for path in bag.iterdir() if path.suffix in (".mcap", ".db3")]
    for one, other in zip(
        read_capture(bag).frames, read_capture(plain).frames, strict=True
    ):
        np.testing.assert_array_equal(one.read().depth, other.read().depth)

    monkeypatch.setattr(bag_reader, "LARGEST_BAG_CHUNK", 2**16)
    assert len(read_capture(bag).frames) == 2
    flat = image_message(
        np.full((480, 640), 700), "16UC1", header=header("optical", 0.0)
    )
    times = START + 0.1 * np.arange(40)
    many = [(DEPTH, time, at(flat, time)) for time in times]
    bomb = write_bag(tmp_path / "bomb", [*said, *many], mcap, compressed="file")
    with pytest.raises(
        DatasetError, match=r"bomb: the bag is damaged.* holds more than"
    ):
        read_capture(bomb)


def test_a_bag_without_metadata_is_read_by_its_only_file(tmp_path):
    bag = write_bag(tmp_path / "bag", [*tf_of_an_arm(), *images_at([1.0])])
    (bag / "metadata.yaml").unlink()
    assert len(read_capture(bag).frames) == 1
    assert len(read_capture(next(bag.glob("*.mcap"))).frames) == 1
    shutil.copy(next(bag.glob("*.mcap")), bag / "second.mcap")
    with pytest.raises(DatasetError, match="ros2 bag reindex bag"):
        read_capture(bag)


def test_a_bag_of_ros_1_is_to_be_converted(tmp_path):
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(DatasetError, match=r"rosbags-convert --src old.bag --dst old"):
        read_capture(tmp_path / "old.bag")


# Things that were recorded


CAMERA = np.array([[300.0, 0, 159.5], [0, 300, 119.5], [0, 0, 1]])
"""First pixel's centre at 0."""
WIDE = 240, 320


def chair():
    """The sample chair, 0.6 m high, on the table."""
    mesh = sample_mesh("chair")
    thing = trimesh.Trimesh(0.35 * mesh.vertices, mesh.faces, process=False)
    thing.apply_translation([0.1, -0.1, -thing.bounds[0, 2]])
    return thing


def views_of(thing, count=8):
    """Depth images, whole millimetres as uint16, and poses of a camera around a thing."""
    k = CAMERA + HALF
    large = box((4, 4, 0.02), (0, 0, -0.01))
    found = []
    for number in range(count):
        azimuth = 360 * number / count
        pose = pose_at(35 + 10 * (number % 2), azimuth, 1.3, thing.bounds.mean(0))
        depth, _ = cast((large, thing), pose, k, WIDE)
        found.append((np.rint(1000 * depth).astype(np.uint16), pose))
    return found


def recorded(path, views, scale=1, **options):
    """A bag of an arm that stops at each view."""
    said = []
    for number, (depth, pose) in enumerate(views):
        time = START + number
        for moment in (time - 0.05, time + 0.05):
            link = transform_message(pose, "optical", moment, "base_link")
            said.append(("/tf", moment, tf_message(link)))
        image = image_message(scale * depth, "16UC1", header=header("optical", time))
        said.append((DEPTH, time, image))
        info = info_message(CAMERA, WIDE, header=header("optical", time))
        said.append((CAMERA_INFO, time, info))
    return write_bag(path, said, **options)


@pytest.fixture(scope="module")
def views():
    return views_of(chair())


def test_a_recording_is_recognised_from_a_bag_and_from_a_folder(
    views,
    tmp_path,
    capsys,
):
    system = nextview.load(threshold=1.0, max_views=3)
    of_bag = system.recognise(recorded(tmp_path / "bag", views), start=4)
    of_folder = system.recognise(written(tmp_path / "folder", views), start=4)
    assert of_bag.answer == of_folder.answer == "chair"
    np.testing.assert_allclose(
        of_bag.views[-1].belief,
        of_folder.views[-1].belief,
        atol=0.02,  # a bag rounds depth otherwise
    )


def things_folder(folder, views):
    """A bag of one file, and a scan."""
    folder.mkdir()
    bag = recorded(folder.with_name("seat"), views)
    next(bag.glob("*.mcap")).rename(folder / "seat.mcap")
    box((0.3, 0.2, 0.1), (0, 0, 0.05)).export(folder / "brick.ply")
    return folder


def test_a_bag_is_a_thing_to_be_taught_beside_scans(views, tmp_path):
    found = find_things(things_folder(tmp_path / "things", views))
    assert [thing.name for thing in found.things] == ["brick", "seat"]
    assert not found.left_out
    assert "1 mesh, 1 ROS 2 bag" in found.notes[0]
    arrays = teach(found.things[1].path, "seat", TeachingOptions())
    assert arrays["radii"][0] == pytest.approx(meshed(chair()).radius, rel=0.1)
    assert len(arrays["vertices"]) > 100


@pytest.mark.long
def test_things_taught_from_a_bag_are_recognised(views, tmp_path):
    folder = things_folder(tmp_path / "things", views)
    learned = learn(folder, tmp_path / "mine", unit="m", any_size=True, workers=0)
    assert not learned.left_out
    found = nextview.load(str(tmp_path / "mine")).recognise(
        recorded(tmp_path / "again", views)
    )
    assert found.answer == "seat"


# A folder


def written(folder, views, camera=None, poses="files"):
    (folder / "depth").mkdir(parents=True)
    for number, (depth, pose) in enumerate(views):
        Image.fromarray(depth).save(folder / f"depth/{number:04d}.png")
        if poses == "files":
            (folder / "poses").mkdir(exist_ok=True)
            np.savetxt(folder / f"poses/{number:04d}.txt", pose)
    if poses == "json":
        matrices = [pose.tolist() for _, pose in views]
        (folder / "poses.json").write_text(json.dumps(matrices))
    if poses == "names":
        named = {
            f"{number:04d}": pose.tolist() for number, (_, pose) in enumerate(views)
        }
        (folder / "poses.json").write_text(json.dumps(named))
    if poses == "log":
        lines = []
        for number, (_, pose) in enumerate(views):
            lines += [f"{number} {number} {number + 1}"]
            lines += [" ".join(map(str, row)) for row in pose.tolist()]
        (folder / "trajectory.log").write_text("\n".join(lines) + "\n")
    camera = (
        {"fx": 300, "fy": 300, "ppx": 159.5, "ppy": 119.5} if camera is None else camera
    )
    fields = {"width": 320, "height": 240, "depth_scale": 0.001} | camera
    (folder / "intrinsics.json").write_text(json.dumps(fields))
    return folder


@pytest.mark.parametrize("poses", ["files", "json", "names", "log"])
def test_a_folder_is_read_with_its_poses(views, poses, tmp_path):
    folder = written(tmp_path / "folder", views[:3], poses=poses)
    assert is_capture(folder)
    capture = read_capture(folder)
    assert capture.layout == "depth folder"
    for captured, (depth, pose) in zip(capture.frames, views[:3], strict=True):
        np.testing.assert_allclose(captured.pose, pose, atol=1e-9)
        np.testing.assert_allclose(captured.read().depth, depth / 1000, atol=1e-6)
        np.testing.assert_allclose(captured.intrinsics, CAMERA)


MATRIX = [615.5, 0.0, 319.25, 0.0, 616.5, 238.75, 0.0, 0.0, 1.0]
BY_COLUMNS = [615.5, 0.0, 0.0, 0.0, 616.5, 0.0, 319.25, 238.75, 1.0]
OF_TOOLS = {
    "librealsense.json": (
        '{"width": 640, "height": 480, "ppx": 319.25, "ppy": 238.75, "fx": 615.5, "fy": 616.5,'
        ' "model": "brown_conrady", "coeffs": [0, 0, 0, 0, 0], "depth_units": 0.00025}',
        0.00025,
    ),
    "open3d.json": (
        json.dumps(
            {
                "width": 640,
                "height": 480,
                "intrinsic_matrix": BY_COLUMNS,
                "depth_scale": 1000.0,
            }
        ),
        0.001,
    ),
    "bop.json": (
        '{"cx": 319.25, "cy": 238.75, "depth_scale": 0.1, "fx": 615.5, "fy": 616.5, "height": 480,'
        ' "width": 640}',
        0.0001,
    ),
    "two_cameras.json": (
        json.dumps(
            {
                "color": {"fx": 9.0},
                "depth": {"K": MATRIX, "width": 640, "height": 480},
                "depth_scale": 0.001,
            }
        ),
        0.001,
    ),
    "depth_in_colour.json": (
        json.dumps(
            {
                "fx": 910.0,
                "fy": 910.0,
                "ppx": 640.0,
                "ppy": 360.0,
                "width": 1280,
                "height": 720,
                "depth": {"K": MATRIX, "width": 640, "height": 480},
                "depth_scale": 0.001,
            }
        ),
        0.001,
    ),
    "colour_with_a_scale.json": (
        json.dumps(
            {
                "k": MATRIX,
                "width": 640,
                "height": 480,
                "depth": {"scale": 7},
                "depth_scale": 0.001,
            }
        ),
        0.001,
    ),
    "open3d_parameters.json": (
        json.dumps(
            {
                "class_name": "PinholeCameraParameters",
                "extrinsic": np.eye(4).ravel().tolist(),
                "intrinsic": {
                    "width": 640,
                    "height": 480,
                    "intrinsic_matrix": BY_COLUMNS,
                },
                "version_major": 1,
            }
        ),
        None,
    ),
    "part_of_the_sensor.json": (
        json.dumps(
            {
                "fx": 615.5,
                "fy": 616.5,
                "cx": 419.25,
                "cy": 288.75,
                "x_offset": 100,
                "y_offset": 50,
                "width": 640,
                "height": 480,
            }
        ),
        None,
    ),
    "roi.yaml": (
        "height: 600\nwidth: 800\nbinning_x: 0\nk: [615.5, 0, 419.25, 0, 616.5, 288.75, 0, 0, 1]\n"
        "roi: {x_offset: 100, y_offset: 50, height: 480, width: 640, do_rectify: false}\n",
        None,
    ),
    "whole_roi.yaml": (
        f"height: 480\nwidth: 640\nk: {MATRIX}\n"
        "roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}\n",
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
    (tmp_path / name).write_text(content)
    camera = read_camera_file(tmp_path / name)
    np.testing.assert_allclose(camera.intrinsics, np.reshape(MATRIX, (3, 3)))
    assert camera.size == (640, 480)
    assert camera.scale == (None if scale is None else pytest.approx(scale))


ZIVID = """__version__: 5
CameraIntrinsics:
  CameraMatrix:
    CX: 951.5
    CY: 594.25
    FX: 1780.5
    FY: 1781.5
  Distortion:
    K1: {k1}
    K2: 0
    K3: 0
    P1: 0
    P2: 0
"""


def test_intrinsics_of_zivid_are_read_and_its_distortion_is_noticed(tmp_path):
    (tmp_path / "camera.yml").write_text(ZIVID.format(k1=0))
    camera = read_camera_file(tmp_path / "camera.yml")
    np.testing.assert_array_equal(
        camera.intrinsics,
        [[1780.5, 0, 951.5], [0, 1781.5, 594.25], [0, 0, 1]],
    )
    assert camera.size is None
    assert camera.scale is None
    (tmp_path / "camera.yml").write_text(ZIVID.format(k1=-0.27))
    with pytest.raises(DatasetError, match=r"camera.yml: the camera distorts .*-0.27"):
        read_camera_file(tmp_path / "camera.yml")


@pytest.mark.parametrize(
    ("content", "match"),
    [
        ("{", "not the intrinsics of a camera"),
        ("[1, 2]", "holds no fields"),
        ('{"width": 640}', "holds no intrinsics; known are fx, fy"),
        ('{"k": [1, 2, 3]}', "not the intrinsics of a camera"),
        ('{"fx": "wide", "fy": 1, "cx": 1, "cy": 1}', "not the intrinsics of a camera"),
        (
            '{"fx": 1, "fy": 1, "cx": 1, "cy": 1, "depth_scale": -1}',
            "a depth scale of -1",
        ),
        ('{"fx": 1, "fy": 1, "cx": 1, "cy": 1, "coeffs": [0.1, 0]}', "distorts"),
    ],
)
def test_an_invalid_camera_file_is_reported(content, match, tmp_path):
    for name in ("camera.json", "camera.yaml"):
        (tmp_path / name).write_text(content)
        with pytest.raises(DatasetError, match=match):
            read_camera_file(tmp_path / name)


def test_the_depth_scale_is_asked_for_and_a_wrong_one_is_noticed(
    views,
    tmp_path,
    capsys,
):
    folder = written(
        tmp_path / "folder",
        views,
        {"fx": 300, "fy": 300, "cx": 159.5, "cy": 119.5},
    )
    fields = json.loads((folder / "intrinsics.json").read_text())
    del fields["depth_scale"]
    (folder / "intrinsics.json").write_text(json.dumps(fields))

    assert "give --depth-scale" in refused(capsys, "recognise", str(folder))
    assert "(1000 steps a metre are 0.001)" in refused(
        capsys,
        "recognise",
        str(folder),
        "--depth-scale",
        "1000",
    )
    said = refused(capsys, "recognise", str(folder), "--depth-scale", "0.0001")
    assert "its steps are of 1 mm, not of 0.1 mm (--depth-scale)" in said
    usable, left_out = check_capture(read_capture(folder, depth_scale=0.001))
    assert not left_out
    assert len(usable.frames) == len(views)


def test_a_wrong_depth_scale_of_a_bag_is_noticed(views, tmp_path):
    """Steps of 0.1 mm, where ROS has millimetres."""
    bag = recorded(tmp_path / "bag", views, scale=10)
    with pytest.raises(DatasetError, match=r"its steps are of 0\.1 mm, not of 1 mm"):
        check_capture(read_capture(bag))
    _, left_out = check_capture(read_capture(bag, depth_scale=0.0001))
    assert not left_out


@pytest.mark.parametrize(("quarters", "way"), [(1, "left"), (3, "right")])
def test_depth_images_turned_by_a_quarter_turn_are_named(
    quarters, way, views, tmp_path
):
    """With the intrinsics of the turned images, and with those of the camera as it is."""
    turned = [(np.rot90(depth, quarters).copy(), pose) for depth, pose in views]
    own = {"fx": 300, "fy": 300, "cx": 119.5, "cy": 159.5, "width": 240, "height": 320}
    folder = written(tmp_path / "own", turned, own)
    match = f"without this mistake.* turned to the {way} by a quarter turn"
    with pytest.raises(DatasetError, match=match):
        check_capture(read_capture(folder))
    first = read_capture(folder).frames[0].read()
    with pytest.raises(nextview.ObservationError, match=f"turned to the {way}"):
        nextview.sensing.ObservedObject().add(first)

    whole = own | {"cx": 159.5, "cy": 119.5}
    folder = written(tmp_path / "whole", turned[:1], whole)
    with pytest.raises(nextview.ObservationError, match="turned by a quarter turn"):
        read_capture(folder).frames[0].read()


def as_jpeg(folder):
    for image in (folder / "depth").iterdir():
        image.rename(image.with_suffix(".jpeg"))
    return folder


def emptied(folder):
    for image in (folder / "depth").iterdir():
        image.unlink()
    return folder / "depth"


def without_depth_folder(folder):
    (folder / "depth").rename(folder / "images")
    return folder


def images_alone(folder):
    (folder / "depth").rename(folder.parent / "images")
    return folder.parent / "images"


@pytest.mark.parametrize(
    ("what", "said"),
    [
        (
            as_jpeg,
            "shot: depth/ holds 3 .jpeg files; depth images are 16-bit PNG files",
        ),
        (emptied, "shot: depth/ is empty; depth images are 16-bit PNG files"),
        (
            lambda folder: folder / "depth",
            "depth: is only a part of a capture: give the",
        ),
        (lambda folder: folder / "poses", "give the folder above, {tmp}/shot"),
        (lambda folder: folder.parent, "in a folder inside it: give {tmp}/shot"),
        (images_alone, "images: holds 3 .png files and has no folder depth/; give one"),
        (
            without_depth_folder,
            "shot: no captured views are found; it holds 2 folders and",
        ),
    ],
)
@pytest.mark.parametrize("command", ["look", "check", "recognise"])
def test_a_folder_without_frames_says_what_is_there_and_what_is_expected(
    command, what, said, views, tmp_path, capsys
):
    camera = {"fx": 300, "fy": 300, "cx": 159.5, "cy": 119.5}
    folder = what(written(tmp_path / "shot", views[:3], camera))
    told = refused(capsys, command, folder)
    assert said.format(tmp=tmp_path) in told
    assert "7-Scenes" not in told


def test_a_capture_cannot_be_taught_as_a_folder_of_captures(views, tmp_path, capsys):
    folder = written(tmp_path / "mug", views[:3], None)
    told = refused(capsys, "learn", folder, tmp_path / "mine")
    assert f"{folder}: is the capture of one thing: give the folder above" in told


def of_another_size(folder):
    fields = json.loads((folder / "intrinsics.json").read_text()) | {"width": 1280}
    (folder / "intrinsics.json").write_text(json.dumps(fields))


def without_poses(folder):
    shutil.rmtree(folder / "poses")


def one_pose_less(folder):
    without_poses(folder)
    (folder / "poses.json").write_text(json.dumps([np.eye(4).tolist()] * 2))


INCOMPLETE = {
    "no intrinsics": (
        lambda f: (f / "intrinsics.json").unlink(),
        "intrinsics of the depth camera",
    ),
    "other size": (
        of_another_size,
        "of images of 1280 x 240 pixels, and .* has 320 x 240",
    ),
    "no poses": (without_poses, "has 3 depth images and no poses"),
    "too few poses": (one_pose_less, "holds 2 poses for 3 depth images"),
}


@pytest.mark.parametrize("what", INCOMPLETE)
def test_missing_files_of_a_folder_are_reported(what, views, tmp_path):
    folder = written(tmp_path / "folder", views[:3])
    spoil, match = INCOMPLETE[what]
    spoil(folder)
    with pytest.raises(DatasetError, match=match):
        read_capture(folder)


FULL = {"fx": 600, "fy": 600, "cx": 319, "cy": 239, "width": 640, "height": 480}


def test_intrinsics_from_a_file_are_of_images_of_that_size(views, tmp_path, capsys):
    """Through all doors: a folder, one image and a bag, and as an option of both commands."""
    (tmp_path / "wide.json").write_text(json.dumps(FULL | {"depth_scale": 0.001}))
    folder = written(tmp_path / "folder", views[:2])
    bag = recorded(tmp_path / "bag", views[:2])
    match = r"wide\.json: the intrinsics are of images of 640 x 480 .* has 320 x 240"
    for path in (folder, folder / "depth/0000.png", bag):
        with pytest.raises(DatasetError, match=match):
            read_capture(path, tmp_path / "wide.json")
        option = ("--intrinsics", str(tmp_path / "wide.json"))
        for command in ("recognise", "look"):
            said = refused(capsys, command, str(path), *option)
            assert "the intrinsics are of images of 640 x 480 pixels" in said
    half = FULL | {"fx": 300, "fy": 300, "cx": 159.5, "cy": 119.5}
    half |= {"width": 320, "height": 240}
    (tmp_path / "half.json").write_text(json.dumps(half))
    for path in (folder, bag):
        (frame, _) = read_capture(path, tmp_path / "half.json").frames
        np.testing.assert_allclose(frame.intrinsics, CAMERA)


def test_the_scale_of_a_given_file_counts_before_that_of_the_folder(views, tmp_path):
    given = {"fx": 300, "fy": 300, "cx": 159.5, "cy": 119.5, "depth_scale": 0.0005}
    (tmp_path / "mine.json").write_text(json.dumps(given))
    folder = written(tmp_path / "folder", views[:1])
    for path in (folder, folder / "depth/0000.png"):
        (frame,) = read_capture(path, tmp_path / "mine.json").frames
        assert frame.scale == 0.0005
        (frame,) = read_capture(path, tmp_path / "mine.json", depth_scale=0.002).frames
        assert frame.scale == 0.002


def test_one_image_with_intrinsics_is_a_capture(views, tmp_path, capsys):
    folder = written(tmp_path / "folder", views[:1])
    image = folder / "depth/0000.png"
    (captured,) = read_capture(image, folder / "intrinsics.json").frames
    np.testing.assert_allclose(captured.read().depth, views[0][0] / 1000, atol=1e-6)
    with pytest.raises(DatasetError, match="the intrinsics of its camera are missing"):
        read_capture(image)
    with pytest.raises(DatasetError, match="give depth_scale"):
        read_capture(image, (300, 300, 159.5, 119.5))
    with pytest.raises(
        UsageError, match="topics, tf frames and moments are of ROS 2 bags"
    ):
        read_capture(image, depth_topic="/depth")
