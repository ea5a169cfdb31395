"""Convert ROS messages of a depth camera to arrays.

This module does not need ROS: only the fields of the messages are used. Depth images follow REP 118
(16UC1 millimetres, 32FC1 metres), and optical frames REP 103 (z forward, x right, y down), which is
also nextview's convention.
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
"""Data type of a pixel, by encoding of a depth image."""
ENCODING_STEPS = {"16UC1": MILLIMETRES, "mono16": MILLIMETRES, "32FC1": 1.0}
"""Metres per unit, by encoding."""
PNG = b"\x89PNG\r\n\x1a\n"
# header of compressed_depth_image_transport before the PNG: format and two parameters
DEPTH_HEADER = struct.Struct("<iff")


def depth_of(image: Any) -> NDArray[Any]:
    """Return the pixels of a ``sensor_msgs/Image``, (height, width), native byte order.

    They are uint16 millimetres or float32 metres.

    Raises:
        ObservationError: it is not a depth image, or shorter than declared.
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
    """Reject an image without depth; an ObservationError names its encoding."""
    if encoding not in ENCODINGS:
        raise ObservationError(
            f"a depth image is {', '.join(ENCODINGS)}, not {encoding!r}: a colour topic?"
        )


def compressed_encoding(message: Any) -> str:
    """Return the encoding of a ``sensor_msgs/CompressedImage``; "" if it is not given.

    Its format is "16UC1; compressedDepth png", or "16UC1; png compressed".
    """
    first, _, rest = str(message.format).partition(";")
    return first.strip() if rest else ""


def depth_of_compressed(message: Any) -> NDArray[Any]:
    """Return the pixels of a compressed depth image, like ``depth_of``.

    Args:
        message: ``sensor_msgs/CompressedImage`` of ``compressed_depth_image_transport``, in PNG.
            Floats are stored as 16-bit inverse depth.

    Raises:
        ObservationError: it is not a depth image, has another compression, or is damaged.
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
    """Return width and height of a compressed depth image, pixels, from the header of its PNG.

    Args:
        message: see ``depth_of_compressed``.

    Raises:
        ObservationError: it is not a depth image, has another compression, or is damaged.
    """
    check_encoding(compressed_encoding(message))
    return png_size(_png_in(message)[1])


def _png_in(message: Any) -> tuple[int, io.BytesIO]:
    """Return the offset of the PNG in a compressed depth image, bytes, and the PNG."""
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
        rectified: whether the images are rectified: then ``p`` is used, and the distortion ``d`` is
            already removed.

    Raises:
        ObservationError: the camera is not calibrated, has distortion, or its images are binned or
            cropped.
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

    It maps the child frame to the frame of the header.

    Raises:
        ObservationError: the quaternion is not a unit quaternion.
    """
    return matrix_of(*parts_of(transform.transform))


def parts_of(transform: Any) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return position and quaternion (x, y, z, w) of a ``geometry_msgs/Transform`` or ``Pose``."""
    is_pose = hasattr(transform, "position")
    t = transform.position if is_pose else transform.translation
    q = transform.orientation if is_pose else transform.rotation
    return (t.x, t.y, t.z), (q.x, q.y, q.z, q.w)


def matrix_of(position: tuple[float, ...], quaternion: tuple[float, ...]) -> Float:
    """Convert a position and a quaternion to a pose, (4, 4).

    Args:
        position: (3,), metres.
        quaternion: (4,), x, y, z, w.

    Raises:
        ObservationError: the quaternion is not a unit quaternion.
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
    """Convert a ``builtin_interfaces/Time`` to seconds."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)
