"""Convert ROS messages of a depth camera to arrays.

Nothing here needs ROS: only the fields of the messages count.

Depth images are as REP 118 has them (16UC1 millimetres, 32FC1 metres), optical frames as REP 103 (z
forward, x right, y down), which are nextview's own axes.
"""

import io
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nextview.captured.frames import MILLIMETRES, png_size, steps_of
from nextview.errors import ObservationError
from nextview.types import Float

ENCODINGS: dict[str, np.dtype[Any]] = {
    "16UC1": np.dtype(np.uint16),
    "mono16": np.dtype(np.uint16),
    "32FC1": np.dtype(np.float32),
}
"""How a pixel is stored, by the encoding of a depth image."""
ENCODING_STEPS = {"16UC1": MILLIMETRES, "mono16": MILLIMETRES, "32FC1": 1.0}
"""Metres that one step stands for, by the encoding."""
PNG = b"\x89PNG\r\n\x1a\n"
# of compressed_depth_image_transport, before the PNG: what is compressed, and two parameters of it
DEPTH_HEADER = struct.Struct("<iff")


def depth_of(image: Any) -> NDArray[Any]:
    """Return the pixels of a ``sensor_msgs/Image``, (height, width), native byte order.

    They are uint16 millimetres or float32 metres.

    Raises:
        ObservationError: it is no depth image, or shorter than it says.
    """
    check_encoding(image.encoding)
    kind = ENCODINGS[image.encoding].newbyteorder(">" if image.is_bigendian else "<")
    height, width = int(image.height), int(image.width)
    if min(height, width) < 1:
        raise ObservationError(f"an image of {width} x {height} pixels shows nothing")

    step = int(image.step)
    data = np.frombuffer(bytes(image.data), np.uint8)
    if step < width * kind.itemsize or len(data) < step * height:
        raise ObservationError(
            f"an image of {width} x {height} in {image.encoding} has rows of"
            f" {width * kind.itemsize} bytes or more; this one has {len(data)} bytes in rows of"
            f" {step}"
        )

    rows = data[: step * height].reshape(height, step)[:, : width * kind.itemsize]
    return np.ascontiguousarray(rows).view(kind).astype(kind.newbyteorder("="))


def check_encoding(encoding: str) -> None:
    """Refuse an image that holds no depth; an ObservationError names its encoding."""
    if encoding not in ENCODINGS:
        raise ObservationError(
            f"a depth image is {', '.join(ENCODINGS)}, not {encoding!r}: a colour topic?"
        )


def compressed_encoding(message: Any) -> str:
    """The encoding of the image in a ``sensor_msgs/CompressedImage``; "" if it is not told.

    Its format is "16UC1; compressedDepth png", or "16UC1; png compressed".
    """
    first, _, rest = str(message.format).partition(";")
    return first.strip() if rest else ""


def depth_of_compressed(message: Any) -> NDArray[Any]:
    """The pixels of a compressed depth image, as ``depth_of`` has them.

    Args:
        message: ``sensor_msgs/CompressedImage`` of ``compressed_depth_image_transport``, in PNG.
            Floats are kept there as 16 bits of inverse depth.

    Raises:
        ObservationError: it is no depth image, is compressed otherwise, or is damaged.
    """
    encoding = compressed_encoding(message)
    check_encoding(encoding)
    start, png = _png_in(message)
    steps = steps_of(png)
    if ENCODINGS[encoding] == np.uint16:
        return steps

    if start != DEPTH_HEADER.size:
        raise ObservationError(
            "a compressed image of floats has a header, this one has none"
        )
    _, scale, offset = DEPTH_HEADER.unpack_from(
        bytes(message.data[: DEPTH_HEADER.size])
    )
    inverse = steps.astype(np.float32) - np.float32(offset)
    near = (steps > 0) & (inverse > 0)
    return np.where(near, np.float32(scale) / np.where(near, inverse, 1), 0).astype(
        np.float32
    )


def compressed_size(message: Any) -> tuple[int, int]:
    """Width and height of a compressed depth image, pixels, from the header of its PNG alone.

    Args:
        message: see ``depth_of_compressed``.

    Raises:
        ObservationError: it is no depth image, is compressed otherwise, or is damaged.
    """
    check_encoding(compressed_encoding(message))
    return png_size(_png_in(message)[1])


def _png_in(message: Any) -> tuple[int, io.BytesIO]:
    """Where the PNG of a compressed depth image begins, bytes, and the PNG."""
    data = bytes(message.data)
    start = data.find(PNG, 0, DEPTH_HEADER.size + len(PNG))
    if start < 0:
        raise ObservationError(
            f"a compressed depth image is a PNG, not {message.format!r}: record the raw images"
        )
    return start, io.BytesIO(data[start:])


def intrinsics_of(info: Any, rectified: bool = False) -> Float:
    """Return the pinhole matrix of a ``sensor_msgs/CameraInfo``, (3, 3), pixels.

    The centre of the first pixel is at 0.

    Args:
        info: the message.
        rectified: whether the images are: then ``p`` counts, and the distortion ``d`` is undone
            already.

    Raises:
        ObservationError: the camera is not calibrated, distorts, or gives binned or cropped images.
    """
    binned = max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    if binned != (1, 1) or info.roi.x_offset or info.roi.y_offset:
        raise ObservationError(
            "camera_info is of binned or cropped images: use the topic of the whole image"
        )
    if rectified:
        k = np.asarray(info.p, float).reshape(3, 4)[:, :3].copy()
    else:
        k = np.asarray(info.k, float).reshape(3, 3).copy()
        if np.any(np.asarray(info.d, float)):
            raise ObservationError(
                f"the camera distorts ({info.distortion_model}): use rectified images (image_rect"
                " of image_proc), and say that they are"
            )
    if not k.any():
        raise ObservationError(
            f"the camera is not calibrated: {'p' if rectified else 'k'} of camera_info is zero"
        )

    return k


def pose_of(transform: Any) -> Float:
    """Return a ``geometry_msgs/TransformStamped`` as a matrix, (4, 4).

    It maps the frame of its child into the frame of its header.

    Raises:
        ObservationError: the quaternion is none of a rotation.
    """
    return matrix_of(*parts_of(transform.transform))


def parts_of(transform: Any) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Position, (3,), and quaternion (x, y, z, w) of a ``geometry_msgs/Transform`` or ``Pose``."""
    is_pose = hasattr(transform, "position")
    t = transform.position if is_pose else transform.translation
    q = transform.orientation if is_pose else transform.rotation
    return (t.x, t.y, t.z), (q.x, q.y, q.z, q.w)


def matrix_of(position: tuple[float, ...], quaternion: tuple[float, ...]) -> Float:
    """A position, (3,), and a quaternion (x, y, z, w) as a pose, (4, 4).

    Args:
        position: (3,), metres.
        quaternion: (4,), x, y, z, w.

    Raises:
        ObservationError: the quaternion is none of a rotation.
    """
    if not abs(np.linalg.norm(quaternion) - 1) < 1e-3:
        raise ObservationError(
            f"a rotation is a quaternion of length 1, not {[float(q) for q in quaternion]}"
        )
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    pose[:3, 3] = position
    return pose


def seconds(stamp: Any) -> float:
    """A ``builtin_interfaces/Time`` in seconds."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)
