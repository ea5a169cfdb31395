"""Read depth images from a ROS 2 bag, with camera poses from its tf messages.

A bag is a folder with ``metadata.yaml``, or a single file of it (.mcap, .db3). Images are read one
by one; a long bag is sampled.
"""

import io
import os
import weakref
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from nextview.captured.frames import CapturedFrame, LayoutViews
from nextview.captured.messages import (
    ENCODING_STEPS,
    ENCODINGS,
    compressed_encoding,
    compressed_size,
    depth_of,
    depth_of_compressed,
    intrinsics_of,
    parts_of,
    seconds,
)
from nextview.captured.transforms import NoTransformError, TransformError, TransformTree
from nextview.captured.yaml_fields import read_yaml
from nextview.checks import extras, number, one_line
from nextview.errors import (
    DAMAGED,
    DatasetError,
    NextviewError,
    ObservationError,
    UsageError,
    option,
)
from nextview.files import regular_file
from nextview.types import Float, Float32

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Reader

ENDINGS = (".mcap", ".db3")
OLD_ENDING = ".bag"  # of ROS 1
METADATA = "metadata.yaml"
STANDING_CAMERA = (
    "tf does not move the camera (one image: --at first, --at last, --at SECONDS)"
)
MOST_FRAMES = 120  # largest number of frames used, evenly spread in time
RAW = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TF = "tf2_msgs/msg/TFMessage"
# suffix of the topic of static transforms
STATIC_TRANSFORMS = "tf_static"
NANOSECONDS = 1e-9
# replaces the encoding of a topic whose announced messages are missing
NOT_THERE = "announced, and none is there"
LARGEST_METADATA = 2**24  # bytes of metadata.yaml
# bytes, largest decompressed size of a chunk or a message. Recorders write chunks of a few
# megabytes, and the largest images and point clouds are below a hundred
LARGEST_BAG_CHUNK = 2**28
# times its size to which a compressed file of a bag may expand. Depth images shrink to a fifth or a
# tenth, an empty scene to a fiftieth
MOST_EXPANSION = 100
# nanoseconds, first interval in which the last image is searched; doubled until one is found
FIRST_REACH = 1_000_000_000
# image of a static camera: first, last, or seconds after the bag's first message; None for all
At = Literal["first", "last"] | float | None


def is_bag(path: Path) -> bool:
    """Return True if a path is a bag or a file of one.

    ROS 1 bags are included; ``read_bag`` rejects them.
    """
    if path.is_dir():
        return (path / METADATA).exists() or bool(_storage_files(path))
    return path.suffix.lower() in (*ENDINGS, OLD_ENDING) and path.is_file()


def read_bag(
    path: Path,
    intrinsics: Float | None = None,
    depth_topic: str | None = None,
    world_frame: str | None = None,
    at: At = None,
) -> LayoutViews:
    """Find the depth images of a bag, the camera intrinsics and the camera poses.

    Args:
        path: of a bag, see ``is_bag``.
        intrinsics: pinhole matrix, (3, 3), pixels; by default from camera_info.
        depth_topic: topic of the depth images, if there are several.
        world_frame: tf frame of the world, z up; by default the root of the camera's tf tree.
        at: image to use if the camera is static: the first, the last, or the first one after a
            number of seconds since the bag's first message. By default all of them, as for a camera
            that moves; the scene may then change, and the frames have the name of the camera.

    Raises:
        DatasetError: the bag is damaged, or lacks depth images, camera_info or transforms.
        UsageError: ``at`` is given, but the camera moves.
        MissingExtraError: rosbags is not installed.
    """
    bag = Bag(path)
    topic = _depth_topic(bag, depth_topic)
    images = _sample(bag, topic)
    first = next((each for each in images if not each.damage), images[0])
    tree = _transforms(bag)
    camera = first.frame
    if camera not in tree.frames:
        what = (
            "there is no tf in it"
            if not tree.frames
            else f"tf knows {_listed(tree.frames)}"
        )
        raise DatasetError(
            f"{path}: nothing says where the camera was: tf has no frame {camera!r}, which the"
            f" images are in ({what}); record /tf and /tf_static too"
        )
    world = tree.root(camera) if world_frame is None else world_frame.lstrip("/")
    if world not in tree.frames:
        raise DatasetError(
            f"{path}: tf has no frame {world!r}; there are {_listed(tree.frames)}"
        )

    notes = [f"depth of {topic.topic}", f"poses of {camera} in {world} by tf"]
    stands = not tree.moves(camera, world)
    if topic.msgcount > len(images) and at is None:
        notes.append(f"{len(images)} of {topic.msgcount} images, evenly spread")
    if stands and at is not None:
        images = [_image_at(bag, topic, images, at)]
        notes.append(f"its image at {images[0].name} s is used")
    elif stands:
        notes.append(STANDING_CAMERA)
    elif at is not None:
        raise UsageError(
            f"{path}: tf moves its camera, so all images are used; {option('at')} is for one that"
            " stands still"
        )
    if intrinsics is None:
        intrinsics, source = _intrinsics(bag, topic.topic, first)
        notes.append(f"intrinsics of {source}")

    # a root frame fixed to the camera has no known vertical
    views = LayoutViews(
        [],
        notes,
        z_is_up=world_frame is not None or not stands,
    )
    lost = _add_frames(views, images, tree, world, intrinsics, first.size)
    if stands:
        views.frames = [replace(frame, camera=camera) for frame in views.frames]
    if lost:
        notes.append(f"{lost} images have no pose in tf and are left out")
    if not views.frames and not views.unreadable:
        raise DatasetError(
            f"{path}: tf gives none of the images a pose of {camera!r} in {world!r} at its stamp"
            f" ({first.stamp:.3f} s the first): are the stamps of one clock?"
        )
    return views


class Bag:
    """An open bag; it is closed when it is no longer used.

    Args:
        path: of a bag, or a file of one.

    Attributes:
        path: the same.
        connections: recorded topics with their types, without empty ones.
        start: time of the first message, nanoseconds.
        end: time after the last message, nanoseconds.

    Raises:
        DatasetError: it cannot be read.
        MissingExtraError: rosbags is not installed.
    """

    def __init__(self, path: Path) -> None:
        with extras():
            from rosbags.rosbag2 import Reader
            from rosbags.typesys import Stores, get_typestore
        self.path = path
        self._types = get_typestore(Stores.ROS2_JAZZY)
        _bound_unpacking()
        with _damage_named(path):
            self._reader = Reader(_BoundedPath(_opened(path)))
            _check_metadata(path)
            self._reader.open()
            self.connections = _connections(self._reader)
            self.start = int(self._reader.start_time)
            self.end = int(self._reader.end_time)
            # decompressed here within limits; rosbags would decompress any size
            self._packed = self._reader.compression_mode == "message"
            storage: Any = self._reader.storage
            if self._packed:
                storage.metadata = storage.metadata._replace(compression_mode=None)
        # unfinished iterators, which must be closed before the file
        self._unread: set[Generator[Any, None, None]] = set()
        weakref.finalize(self, _close, self._reader, self._unread)

    def first(self, connection: "Connection") -> Any:
        """Return the first message of a topic; None if there is none, despite its index."""
        return next((message for _, _, message in self.messages([connection])), None)

    def of_type(self, *kinds: str) -> list["Connection"]:
        """Return the recorded connections of some message types, sorted by topic."""
        found = [each for each in self.connections if each.msgtype in kinds]
        return sorted(found, key=lambda each: each.topic)

    def messages(
        self,
        connections: Sequence["Connection"],
        start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[tuple["Connection", int, Any]]:
        """Read messages one by one.

        Args:
            connections: topics to read.
            start: of the interval, nanoseconds.
            stop: end of the interval, exclusive, nanoseconds.

        Yields:
            Topic, time of recording in nanoseconds, and the message.
        """
        found = self._reader.messages(connections, start, stop)
        self._unread.add(found)

        try:
            while True:
                with _damage_named(self.path):
                    given = next(found, None)
                    if given is None:
                        return
                    connection, time, data = given
                    if self._packed:
                        data = _bounded_zstd(data)
                    message = self._types.deserialize_cdr(data, connection.msgtype)
                yield connection, time, message
        finally:
            found.close()
            self._unread.discard(found)


@dataclass(frozen=True)
class RecordedImage:
    """A depth image in a bag.

    Attributes:
        bag: an open bag.
        connection: of the topic.
        time: of recording, nanoseconds.
        stamp: of its header, seconds.
        frame: tf frame of the image.
        encoding: one of ``messages.ENCODINGS``, if it contains depth.
        size: width and height, pixels; 0 if it is damaged.
        damage: description of the damage; "" if none is known.
    """

    bag: Bag
    connection: "Connection"
    time: int
    stamp: float
    frame: str
    encoding: str
    size: tuple[int, int]
    damage: str = ""

    def read(self) -> NDArray[np.uint16] | Float32:
        """Read the image, (H, W), uint16 or float32.

        Raises:
            DatasetError: the bag is damaged.
            ObservationError: it is not a depth image.
        """
        here = self.bag.messages([self.connection], self.time, self.time + 1)
        for _, _, message in here:
            if seconds(message.header.stamp) == self.stamp:
                return _pixels(message, self.connection.msgtype)
        raise DatasetError(f"{self}: the image is not there any more")

    @property
    def name(self) -> str:
        """Seconds since the bag's first message, as text."""
        return f"{(self.time - self.bag.start) * NANOSECONDS:.3f}"

    def __str__(self) -> str:
        return f"{self.bag.path}, {self.connection.topic} at {self.name} s"


class _BoundedFile(io.BufferedReader):
    """A file from which no more bytes are read than it has, whatever length a record claims."""

    def read(self, size: int | None = -1, /) -> bytes:
        """Read at most this many bytes."""
        if size is not None and size > io.DEFAULT_BUFFER_SIZE:
            left = os.fstat(self.fileno()).st_size - self.tell()
            size = max(0, min(size, left))
        return super().read(size)


class _BoundedPath(type(Path())):  # type: ignore[misc]
    """A path whose files are opened as ``_BoundedFile`` in binary mode."""

    def open(self, mode: str = "r", *how: Any, **named: Any) -> Any:
        """Open the file."""
        if mode == "rb":
            return _BoundedFile(io.FileIO(self))
        return super().open(mode, *how, **named)


def _check_metadata(path: Path) -> None:
    """Check that the aliases in metadata.yaml do not expand too far; rosbags reads it again."""
    file = path / METADATA
    if path.is_dir() and file.exists():
        regular_file(file, "what describes a bag", DatasetError, LARGEST_METADATA)
        read_yaml(
            file.read_text(),
            f"{path}: the bag is damaged, or its recording was cut off: {METADATA}",
        )


def _connections(reader: "Reader") -> list["Connection"]:
    """Return the topics of an open bag that have messages according to its index.

    Raises:
        TypeError: names or counts have the wrong type.
    """
    for each in reader.connections:
        if not isinstance(each.topic, str) or not isinstance(each.msgtype, str):
            raise TypeError(f"a topic is called {one_line(repr(each.topic))}")
    return [each for each in reader.connections if each.msgcount > 0]


@cache
def _bound_unpacking() -> None:
    """Patch rosbags to decompress no more of a chunk than its declared size, nor of a whole file.

    By default it decompresses everything before comparing the size, and ten bytes on the disk can
    expand to gigabytes.
    """
    with extras():
        from rosbags.rosbag2 import reader
        from rosbags.rosbag2.storage_mcap import DECOMPRESSORS
    DECOMPRESSORS["zstd"] = _bounded_zstd
    DECOMPRESSORS["lz4"] = _bounded_lz4
    whole: Any = reader
    # the only two uses of both: to unpack a compressed file, and to name what is unpacked
    whole.zstd = SimpleNamespace(open=partial(_bounded_file, whole.zstd.open))
    whole.Path = _BoundedPath


@contextmanager
def _bounded_file(
    opened: Callable[..., Any],
    packed: io.BufferedReader,
    mode: str,
) -> Iterator[SimpleNamespace]:
    """Open a compressed file whose content is read up to ``MOST_EXPANSION`` times its size.

    Raises:
        ValueError: when more is read.
    """
    size = os.fstat(packed.fileno()).st_size
    most = max(LARGEST_BAG_CHUNK, MOST_EXPANSION * size)
    with opened(packed, mode) as content:

        def read(length: int) -> bytes:
            found: bytes = content.read(length)
            if content.tell() > most:
                raise ValueError(
                    f"a compressed file of {size} bytes holds more than {most}"
                )
            return found

        yield SimpleNamespace(read=read)


def _bounded_zstd(data: bytes, size: int = LARGEST_BAG_CHUNK) -> bytes:
    """Decompress zstd data up to its declared size.

    Raises:
        ValueError: it is larger, or declares more than ``LARGEST_BAG_CHUNK``.
    """
    with extras():
        from rosbags.rosbag2.storage_mcap import zstd
    _check_chunk(size, size)
    found: bytes = zstd.ZstdDecompressor().decompress(data, size + 1)
    _check_chunk(len(found), size)
    return found


def _bounded_lz4(data: bytes, size: int) -> bytes:
    """Decompress lz4 data up to its declared size."""
    with extras():
        from lz4.frame import LZ4FrameDecompressor
    _check_chunk(size, size)
    found: bytes = LZ4FrameDecompressor().decompress(data, size + 1)
    _check_chunk(len(found), size)
    return found


def _check_chunk(length: int, claimed: int) -> None:
    """Check the size of a chunk; raises ValueError."""
    if claimed > LARGEST_BAG_CHUNK:
        raise ValueError(f"a chunk of {claimed} bytes, {LARGEST_BAG_CHUNK} are most")
    if length > claimed:
        raise ValueError(f"a chunk of {claimed} bytes holds more")


def _close(reader: "Reader", unread: set[Generator[Any, None, None]]) -> None:
    """Close a bag, even if reading was interrupted."""
    for rows in list(unread):
        rows.close()
    reader.close()


def _opened(path: Path) -> Path:
    """Return the path to open: the bag, or the only file of one without metadata."""
    if path.suffix.lower() == OLD_ENDING:
        raise DatasetError(
            f"{path}: is a bag of ROS 1; rosbags-convert --src {path.name} --dst {path.stem} makes"
            " one of ROS 2 of it"
        )
    if not path.is_dir() or (path / METADATA).exists():
        return path
    files = _storage_files(path)
    if len(files) > 1:
        raise DatasetError(
            f"{path}: has no {METADATA}, as after a recording that was killed; ros2 bag reindex"
            f" {path.name} writes it"
        )
    return files[0]


def _storage_files(folder: Path) -> list[Path]:
    """Return the data files of a bag folder."""
    return sorted(path for ending in ENDINGS for path in folder.glob(f"*{ending}"))


@cache
def _damage() -> tuple[type[Exception], ...]:
    """Return the exceptions that rosbags and its libraries raise for damaged files."""
    with extras():
        from rosbags.rosbag2 import ReaderError
        from rosbags.rosbag2.storage_mcap import zstd
        from rosbags.rosbag2.storage_sqlite3 import apsw
        from rosbags.serde import SerdeError
    return (
        *DAMAGED,
        AssertionError,
        ReaderError,
        SerdeError,
        zstd.ZstdError,
        apsw.Error,
    )


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    """Turn exceptions of rosbags for damaged files into a DatasetError."""
    try:
        yield
    except NextviewError:
        raise
    except _damage() as error:
        phrase = one_line(str(error) or type(error).__name__, 120).rstrip(".")
        raise DatasetError(
            f"{path}: the bag is damaged, or its recording was cut off ({phrase})"
        ) from None


def _depth_topic(bag: Bag, asked: str | None) -> "Connection":
    """Return the topic of the depth images: the requested one, or the only one."""
    topics = bag.of_type(RAW, COMPRESSED)
    encodings = {each.topic: _encoding(bag, each) for each in topics}
    if asked is not None:
        found = [each for each in topics if each.topic.strip("/") == asked.strip("/")]
        if not found:
            there = _listed(
                [f"{each.topic} ({encodings[each.topic]})" for each in topics]
            )
            raise DatasetError(
                f"{bag.path}: has no images on {asked}; there are {there}"
            )
        if encodings[found[0].topic] == NOT_THERE:
            raise DatasetError(f"{bag.path}: images on {asked} are {NOT_THERE}")
        if encodings[found[0].topic] not in ENCODINGS:
            raise DatasetError(
                f"{bag.path}: {asked} holds no depth but {encodings[found[0].topic]!r}; depth is"
                f" {', '.join(ENCODINGS)}"
            )
        return found[0]

    deep = [each for each in topics if encodings[each.topic] in ENCODINGS]
    raw = {each.topic for each in deep if each.msgtype == RAW}
    # leave out compressed copies of another topic
    deep = [
        each for each in deep if each.msgtype == RAW or _base(each.topic) not in raw
    ]
    if not deep:
        images = [f"{topic} ({encoding})" for topic, encoding in encodings.items()]
        others = f"; its images are {_listed(images)}" if images else " and no others"
        raise DatasetError(
            f"{bag.path}: holds no depth images ({', '.join(ENCODINGS)}){others}"
        )
    if len(deep) > 1:
        names = _listed([each.topic for each in deep])
        raise DatasetError(
            f"{bag.path}: holds depth images on {len(deep)} topics; name one with"
            f" {option('depth_topic')}: {names}"
        )
    return deep[0]


def _encoding(bag: Bag, connection: "Connection") -> str:
    """Return the encoding of the first image of a topic, or the reason why there is none."""
    message = bag.first(connection)
    if message is None:
        return NOT_THERE
    return (
        compressed_encoding(message)
        if connection.msgtype == COMPRESSED
        else message.encoding
    )


def _base(topic: str) -> str:
    """Return the topic of raw images to which a compressed topic belongs."""
    return topic.rpartition("/")[0]


def _sample(bag: Bag, topic: "Connection") -> list[RecordedImage]:
    """Return at most ``MOST_FRAMES`` images of a topic, evenly spread in time, ordered by stamp."""
    if topic.msgcount <= MOST_FRAMES:
        found = [
            _recorded(bag, topic, time, image)
            for _, time, image in bag.messages([topic])
        ]
    else:
        # the first image of each of MOST_FRAMES intervals
        found = []
        length = bag.end - bag.start
        edges = [
            bag.start + length * part // MOST_FRAMES for part in range(MOST_FRAMES + 1)
        ]
        for start, stop in pairwise(edges):
            first = next(bag.messages([topic], start, stop), None)
            if first is not None:
                found.append(_recorded(bag, topic, first[1], first[2]))
    if not found:
        raise DatasetError(
            f"{bag.path}: announces {topic.msgcount} images on {topic.topic}, and none is there"
        )
    return sorted(found, key=lambda image: image.stamp)


def _image_at(
    bag: Bag,
    topic: "Connection",
    images: list[RecordedImage],
    at: At,
) -> RecordedImage:
    """Return the image of a topic at a time, see ``read_bag``.

    Args:
        bag: an open bag.
        topic: of the images.
        images: sampled images, in order.
        at: the requested time.

    Raises:
        DatasetError: there is no image from that time on.
        UsageError: the time is invalid.
    """
    if at == "first":
        return images[0]
    if at == "last":
        return _last_image(bag, topic, images)
    moment = number(at, "the moment of an image, in seconds,", least=0)
    start = bag.start + round(moment / NANOSECONDS)
    found = next(bag.messages([topic], start), None) if start < bag.end else None
    if found is None:
        last = _last_image(bag, topic, images).name
        raise DatasetError(
            f"{bag.path}: there is no image from {moment:g} s on; the last is at {last} s"
        )
    return _recorded(bag, topic, found[1], found[2])


def _last_image(
    bag: Bag,
    topic: "Connection",
    images: list[RecordedImage],
) -> RecordedImage:
    """Return the last image of a topic from which some images were sampled."""
    if topic.msgcount <= MOST_FRAMES:
        return images[-1]
    reach = FIRST_REACH
    while True:
        start = max(bag.end - reach, bag.start)
        last = None
        for _, time, message in bag.messages([topic], start):
            last = time, message
        if last is not None:
            return _recorded(bag, topic, *last)
        if start == bag.start:
            return images[-1]
        reach *= 2


def _recorded(bag: Bag, topic: "Connection", time: int, message: Any) -> RecordedImage:
    """Return the metadata of an image, which is read later."""
    damage = ""
    size = 0, 0
    try:
        if topic.msgtype == COMPRESSED:
            encoding = compressed_encoding(message)
            size = compressed_size(message)
        else:
            encoding = message.encoding
            size = int(message.width), int(message.height)
    except ObservationError as error:
        damage = str(error)

    return RecordedImage(
        bag,
        topic,
        time,
        seconds(message.header.stamp),
        message.header.frame_id.lstrip("/"),
        encoding,
        size,
        damage,
    )


def _pixels(message: Any, kind: str) -> NDArray[Any]:
    return depth_of_compressed(message) if kind == COMPRESSED else depth_of(message)


def _transforms(bag: Bag) -> TransformTree:
    """Read all tf messages of a bag."""
    tree = TransformTree()
    topics = bag.of_type(TF)
    said = (
        (connection.topic.endswith(STATIC_TRANSFORMS), each)
        for connection, _, message in (bag.messages(topics) if topics else ())
        for each in message.transforms
    )

    try:
        for fixed, each in said:
            child = each.child_frame_id.lstrip("/")
            parent = each.header.frame_id.lstrip("/")
            position, quaternion = parts_of(each.transform)
            tree.add(
                child,
                parent,
                seconds(each.header.stamp),
                position,
                quaternion,
                fixed,
            )
        tree.sort()
    except TransformError as error:
        raise DatasetError(f"{bag.path}: {error}") from None

    return tree


def _intrinsics(bag: Bag, topic: str, image: RecordedImage) -> tuple[Float, str]:
    """Return the pinhole matrix of a bag's depth camera, and the topic of its camera_info."""
    infos = bag.of_type(CAMERA_INFO)
    places = {f"{_base(topic)}/camera_info", f"{_base(_base(topic))}/camera_info"}
    found = [each for each in infos if each.topic in places]
    if not found:
        found = [each for each in infos if _fits(bag.first(each), image)]
    info = bag.first(found[0]) if len(found) == 1 else None
    if info is None:
        there = _listed([each.topic for each in infos]) if infos else "none"
        raise DatasetError(
            f"{bag.path}: the camera_info of {topic} is missing (there is {there}): give"
            f" {option('intrinsics')} FX FY CX CY, or a file with them"
        )

    if (info.width, info.height) != image.size:
        raise DatasetError(
            f"{bag.path}: {found[0].topic} is of images of {info.width} x {info.height} pixels, and"
            f" {topic} has {image.size[0]} x {image.size[1]}"
        )

    distorts = bool(np.any(np.asarray(info.d)))
    try:
        return intrinsics_of(info, rectified=distorts and "rect" in topic), found[
            0
        ].topic
    except ObservationError as error:
        raise DatasetError(f"{bag.path}: {found[0].topic}: {error}") from None


def _fits(info: Any, image: RecordedImage) -> bool:
    """Return True if a camera_info has the frame and the size of an image."""
    if info is None:
        return False
    same = info.header.frame_id.lstrip("/") == image.frame
    return same and (info.width, info.height) == image.size


def _add_frames(
    views: LayoutViews,
    images: list[RecordedImage],
    tree: TransformTree,
    world: str,
    k: Float,
    size: tuple[int, int],
) -> int:
    """Add frames with the poses of images of one size; returns the number without a pose."""
    lost = 0
    for image in images:
        try:
            if image.encoding not in ENCODING_STEPS:
                raise ObservationError(f"{image}: its encoding is {image.encoding!r}")
            if image.damage:
                raise ObservationError(f"{image}: {image.damage}")
            if image.size != size:
                raise ObservationError(
                    f"{image}: has {image.size[0]} x {image.size[1]} pixels, and others"
                    f" {size[0]} x {size[1]}"
                )
            pose = tree.pose(image.frame, world, image.stamp)
        except NoTransformError:
            lost += 1
        except (DatasetError, ObservationError) as error:
            views.unreadable[image.name] = str(error)
        else:
            scale = ENCODING_STEPS[image.encoding]
            views.frames.append(CapturedFrame(image.name, image, scale, k, pose))

    return lost


def _listed(names: Sequence[str], most: int = 8) -> str:
    """Join names for a sentence."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return (", ".join(names[:most]) or "none") + more
