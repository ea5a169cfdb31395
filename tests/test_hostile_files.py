"""Files that claim other sizes than they have, repeat themselves, or hold what no tool writes: each
is refused in one sentence, and before memory is spent on it.
"""

import json
import struct
import sys
import zlib

import numpy as np
import pytest
import yaml
from factories import run_python
from ros_messages import (
    CAMERA_INFO,
    DEPTH,
    compressed_message,
    header,
    image_message,
    info_message,
    tf_message,
    transform_message,
    write_bag,
)

from nextview.captured.camera_file import read_camera_file
from nextview.captured.folders import read_capture
from nextview.errors import DatasetError, NextviewError, PolicyError, UsageError

MEGABYTE = 2**20
MOST_GROWTH = 200  # megabytes by which reading a file may let the process grow
START = 1_700_000_000.0

READ_IN_A_PROCESS = """
import resource, sys
from pathlib import Path
import rosbags.rosbag2, rosbags.typesys
from PIL import Image
from nextview.captured.folders import read_capture
from nextview.errors import NextviewError
Image.init()
per_megabyte = 2**10 if sys.platform == "linux" else 2**20
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / per_megabyte
before = peak()
try:
    for frame in read_capture(sys.argv[1], (600, 600, 320, 240), depth_scale=0.001).frames:
        frame.read()
except NextviewError as error:
    print(error)
print(round(peak() - before))
"""


def read_in_a_process(path):
    """What is said of a capture, and by how many megabytes a process grows that reads it."""
    code = f"import sys; sys.argv = ['-', {str(path)!r}]\n{READ_IN_A_PROCESS}"
    done = run_python(code)
    assert not done.stderr
    *said, growth = done.stdout.splitlines()
    return " ".join(said), int(growth)


# Images


def png_of_zeros(width, height):
    """A grey PNG of 16 bits that is black; hundreds of megabytes are some hundred kilobytes."""
    packer = zlib.compressobj(9)
    row = bytes(1 + 2 * width)
    data = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()

    def chunk(kind, content):
        checked = kind + content
        length = struct.pack(">I", len(content))
        return length + checked + struct.pack(">I", zlib.crc32(checked))

    size = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    chunks = chunk(b"IHDR", size) + chunk(b"IDAT", data) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


@pytest.mark.skipif(sys.platform == "win32", reason="resource limits are of Unix")
def test_an_image_is_refused_by_its_size_before_it_is_decoded(tmp_path):
    content = png_of_zeros(11_000, 11_000)
    assert len(content) < MEGABYTE
    (tmp_path / "large.png").write_bytes(content)
    said, growth = read_in_a_process(tmp_path / "large.png")
    assert "large.png: has 11000 x 11000 pixels, more than any depth camera" in said
    assert growth < MOST_GROWTH


def tf():
    stand = transform_message(np.eye(4), "optical", 0.0, "world")
    return ("/tf_static", START, tf_message(stand))


def moving_tf(times):
    said = []
    for time in times:
        pose = np.eye(4)
        pose[0, 3] = 0.1 * time
        link = transform_message(pose, "optical", START + time, "world")
        said.append(("/tf", START + time, tf_message(link)))
    return said


def info(time):
    stamped = info_message(header=header("optical", START + time))
    return (CAMERA_INFO, START + time, stamped)


def packed_at(time, data=None):
    depth = np.full((120, 160), 900, np.uint16)
    packed = compressed_message(depth, "16UC1", START + time)
    if data is not None:
        packed.data = np.frombuffer(bytes(packed.data[:12]) + data, np.uint8)
    return (f"{DEPTH}/compressedDepth", START + time, packed)


def test_a_compressed_image_of_another_size_is_told_by_its_header(tmp_path):
    """One whose pixels cannot be decoded shows that nothing but the header is read."""
    times = [0.0, 1.0, 2.0]
    other = png_of_zeros(6000, 6000)
    said = [*moving_tf(times), *map(info, times), packed_at(0.0), packed_at(2.0)]
    bag = write_bag(tmp_path / "bag", [*said, packed_at(1.0, other[: len(other) // 2])])
    capture = read_capture(bag)
    assert [frame.name for frame in capture.frames] == ["0.000", "2.000"]
    ((name, reason),) = capture.unreadable
    assert name == "1.000"
    assert "has 6000 x 6000 pixels, more than any depth camera" in reason


def test_an_image_of_the_right_size_that_is_damaged_costs_only_itself(tmp_path):
    times = [0.0, 1.0, 2.0]
    short = png_of_zeros(160, 120)[:60]
    said = [*moving_tf(times), *map(info, times), packed_at(0.0), packed_at(2.0)]
    bag = write_bag(tmp_path / "bag", [*said, packed_at(1.0, short)])
    first, damaged, last = read_capture(bag).frames
    assert first.read().shape == last.read().shape == (120, 160)
    with pytest.raises(NextviewError, match="the image is damaged"):
        damaged.read()


@pytest.mark.parametrize("size", [(0, 160), (120, 0), (0, 0)])
def test_an_image_without_pixels_is_refused(size, tmp_path):
    depth = np.full((120, 160), 900, np.uint16)
    empty = image_message(depth, "16UC1", header=header("optical", START))
    empty.height, empty.width = size
    bag = write_bag(tmp_path / "bag", [tf(), (DEPTH, START, empty)])
    with pytest.raises(NextviewError, match="shows nothing"):
        read_capture(bag, (260, 260, 80, 60)).frames[0].read()


# Bags


def mcap_record(kind, content):
    return struct.pack("<BQ", kind, len(content)) + content


def mcap_text(text):
    return struct.pack("<I", len(text)) + text.encode()


def mcap_of_a_chunk(path, claimed, megabytes):
    """A file without an index, with one chunk that claims to hold so many bytes."""
    from rosbags.rosbag2.storage_mcap import zstd

    packer = zstd.ZstdCompressor()
    zeros = bytes(MEGABYTE)
    data = b"".join(packer.compress(zeros) for _ in range(megabytes)) + packer.flush()
    chunk = struct.pack("<QQQI", 0, 1, claimed, 0) + mcap_text("zstd")
    chunk += struct.pack("<Q", len(data)) + data
    magic = b"\x89MCAP0\r\n"
    begin = mcap_record(1, mcap_text("ros2") + mcap_text("test"))
    end = mcap_record(2, struct.pack("<QQI", 0, 0, 0))
    path.write_bytes(magic + begin + mcap_record(6, chunk) + end + magic)
    assert path.stat().st_size < MEGABYTE
    return path


@pytest.mark.skipif(sys.platform == "win32", reason="resource limits are of Unix")
@pytest.mark.parametrize("claimed", [10, 1000 * MEGABYTE])
def test_a_chunk_is_refused_by_what_it_claims_or_where_it_goes_beyond(
    tmp_path, claimed
):
    bag = mcap_of_a_chunk(tmp_path / "a.mcap", claimed, megabytes=1000)
    said, growth = read_in_a_process(bag)
    assert "a.mcap: the bag is damaged" in said
    assert growth < MOST_GROWTH


def test_a_record_of_a_damaged_length_is_no_reason_to_take_all_memory(tmp_path):
    """A length of 2 ** 50 bytes is more than any machine has."""
    magic = b"\x89MCAP0\r\n"
    begin = mcap_record(1, mcap_text("ros2") + mcap_text("test"))
    schema = struct.pack("<BQ", 3, 2**50) + b"\0" * 100
    end = mcap_record(2, struct.pack("<QQI", 0, 0, 0))
    path = tmp_path / "a.mcap"
    path.write_bytes(magic + begin + schema + end + magic)
    with pytest.raises(DatasetError, match="the bag is damaged"):
        read_capture(path)


def announced(bag, topic):
    """A bag that says of a topic that it has three messages more than are there."""
    file = bag / "metadata.yaml"
    content = yaml.safe_load(file.read_text())
    counts = content["rosbag2_bagfile_information"]["topics_with_message_count"]
    (count,) = (each for each in counts if each["topic_metadata"]["name"] == topic)
    assert count["message_count"] == 0
    count["message_count"] = 3
    file.write_text(yaml.safe_dump(content))
    return bag


@pytest.mark.parametrize("mcap", [True, False])
@pytest.mark.parametrize("topic", [DEPTH, CAMERA_INFO, "/other/camera_info"])
def test_a_topic_may_be_announced_and_have_no_message(topic, mcap, tmp_path):
    """As after a recording whose file was repaired."""
    depth = np.full((120, 160), 900, np.uint16)
    image = image_message(depth, "16UC1", header=header("optical", START))
    said = [tf(), (DEPTH, START, image), info(0.0)]
    kept = [each for each in said if each[0] != topic]
    kinds = {each[0]: each[2].__msgtype__ for each in said}
    kind = kinds.get(topic, "sensor_msgs/msg/CameraInfo")
    bag = write_bag(tmp_path / "bag", kept, mcap, empty={topic: kind})
    announced(bag, topic)
    if topic == "/other/camera_info":
        assert len(read_capture(bag).frames) == 1
        return
    match = (
        "holds no depth images" if topic == DEPTH else "camera_info of .* is missing"
    )
    with pytest.raises(DatasetError, match=match):
        read_capture(bag)
    with pytest.raises(
        DatasetError, match=match if topic != DEPTH else "none is there"
    ):
        read_capture(bag, depth_topic=DEPTH)


def chain(length):
    links = [
        transform_message(np.eye(4), f"frame{n}", 0.0, f"frame{n + 1}")
        for n in range(length)
    ]
    links[0].child_frame_id = "optical"
    return ("/tf_static", START, tf_message(*links))


def test_a_chain_of_transforms_is_as_long_as_a_robot(tmp_path):
    depth = np.full((120, 160), 900, np.uint16)
    image = image_message(depth, "16UC1", header=header("optical", START))
    rest = [(DEPTH, START, image), info(0.0)]
    capture = read_capture(write_bag(tmp_path / "arm", [chain(60), *rest]))
    np.testing.assert_allclose(capture.frames[0].pose, np.eye(4), atol=1e-12)
    with pytest.raises(DatasetError, match="on a chain of more than 200 frames"):
        read_capture(write_bag(tmp_path / "chain", [chain(5000), *rest]))


def repeating(name, levels=6):
    """A few hundred bytes of YAML that mean 9 ** levels values."""
    lines = ["a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    for before, this in zip("abcdefgh"[: levels - 1], "bcdefgh", strict=False):
        lines.append(f"{this}: &{this} [{', '.join([f'*{before}'] * 9)}]")
    return "\n".join([*lines, f"{name}: *{'abcdefgh'[levels - 1]}", ""])


def test_what_describes_a_bag_does_not_repeat_itself_beyond_measure(tmp_path):
    depth = np.full((120, 160), 900, np.uint16)
    image = image_message(depth, "16UC1", header=header("optical", START))
    bag = write_bag(tmp_path / "bag", [tf(), (DEPTH, START, image), info(0.0)])
    file = bag / "metadata.yaml"
    file.write_text(file.read_text() + repeating("compression_format"))
    with pytest.raises(DatasetError, match=r"bag is damaged.* more than 100000 values"):
        read_capture(bag)


# Intrinsics

CAMERA = "fx: 600\nfy: 600\ncx: 320\ncy: 240\n"
HOSTILE_YAML = {
    "aliases": (CAMERA + repeating("k"), "holds more than 100000 values"),
    "itself": ("k: &k [*k]\n", r"\*k repeats what is not complete"),
    "no anchor": ("k: *k\n", r"\*k repeats what is not complete"),
    "deep": ("k: " + "[" * 5000 + "]" * 5000, "more than 50 lists inside each other"),
    "name": (CAMERA + "? [1, 2]\n: 3\n", "a name in it is no word"),
    "date": ("k: 2024-01-01\n", "not the intrinsics of a camera"),
    "dates": ("k: [2024-01-01, 2024-01-02]\n", "not the intrinsics of a camera"),
    "digits": (CAMERA.replace("320", "9" * 5000), "not all finite"),
    "size": (CAMERA + f"width: {'9' * 5000}\nheight: 5\n", "not the intrinsics"),
    "infinite": (CAMERA.replace("600", ".inf"), "not the intrinsics|not all finite"),
    "float": (CAMERA.replace("320", '!!float "x"'), "not the intrinsics of a camera"),
    "int": (CAMERA.replace("320", '!!int "x"'), "not the intrinsics of a camera"),
    "timestamp": (CAMERA.replace("320", '!!timestamp "x"'), "not the intrinsics"),
    "bool": (CAMERA.replace("320", '!!bool "x"'), "not the intrinsics of a camera"),
    "binary": (CAMERA.replace("320", '!!binary "x"'), "not the intrinsics of a camera"),
    "object": ("k: !!python/object/apply:os.getcwd []\n", "not the intrinsics"),
    "list": ("k: [" + "1, " * 5000 + "1]\n", "a list of 5001 numbers"),
    "offset": (CAMERA + "x_offset: .nan\n", "not the intrinsics of a camera"),
    "control": ("\x1b[31m: 1\n", "not the intrinsics of a camera"),
    "binned": (CAMERA + "binning_x: 2\n", "puts pixels together"),
}


@pytest.mark.parametrize("what", HOSTILE_YAML)
def test_what_no_tool_writes_into_a_camera_file_is_refused(what, tmp_path):
    content, match = HOSTILE_YAML[what]
    (tmp_path / "camera.yaml").write_text(content)
    with pytest.raises(DatasetError, match=f"camera.yaml: .*({match})") as raised:
        read_camera_file(tmp_path / "camera.yaml")
    assert str(raised.value).isprintable()


@pytest.mark.parametrize("digits", [400, 5000])
def test_numbers_of_many_digits_are_refused_in_json_too(digits, tmp_path):
    fields = json.dumps({"fx": 1, "fy": 600, "cx": 320, "cy": 240})
    (tmp_path / "camera.json").write_text(fields.replace("1", "1" * digits))
    with pytest.raises(DatasetError, match=r"camera.json: .*(intrinsics|finite)"):
        read_camera_file(tmp_path / "camera.json")


# Sentences


@pytest.mark.parametrize("kind", [UsageError, DatasetError, PolicyError])
def test_no_sentence_holds_what_a_terminal_obeys(kind):
    assert str(kind("a\x1b[31m\nb\r\x07\x9b")) == r"a\x1b[31m\nb\r\x07\x9b"
    assert str(kind("Größe 1 €")) == "Größe 1 €"


def test_names_in_a_bag_are_shown_and_not_obeyed(tmp_path):
    evil = "cam\x1b]0;gone\x07\nera"
    depth = np.full((120, 160), 900, np.uint16)
    image = image_message(depth, "16UC1", header=header("optical", START))
    other = tf_message(transform_message(np.eye(4), evil, 0.0, "world"))
    bag = write_bag(
        tmp_path / "bag",
        [("/tf_static", START, other), (DEPTH, START, image), info(0.0)],
    )
    with pytest.raises(DatasetError, match="tf has no frame 'optical'") as raised:
        read_capture(bag)
    assert r"cam\x1b]0;gone\x07\nera" in str(raised.value)
    assert str(raised.value).isprintable()
