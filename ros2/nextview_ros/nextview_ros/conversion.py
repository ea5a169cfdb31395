"""From ROS messages to frames of nextview, and back to poses. Nothing here needs ROS: only the
messages' fields count.

Depth images are as REP 118 has them (16UC1 millimetres, 32FC1 metres), optical frames as REP 103 (z
forward, x right, y down), which are nextview's own axes.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nextview.captured.messages import depth_of, intrinsics_of, pose_of, seconds
from nextview.errors import ObservationError
from nextview.sensing.frame import CAMERA_AXES, Frame
from nextview.sensing.object_frame import Box
from nextview.types import Index, Mask

Float = NDArray[np.float64]

MASK_ENCODINGS = ("mono8", "8UC1")
LABEL_ENCODINGS = {"mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2"}
"""Type of a label, by encoding of a label image."""
SIMULTANEOUS = 0.02
"""Seconds that image, camera_info and transform may be apart: a camera at 30 Hz never mixes
neighbours.
"""


def frame_of(
    image: Any,
    info: Any,
    transform: Any,
    rectified: bool = False,
    axes: str = "opencv",
) -> Frame:
    """What a session takes.

    Args:
        image: ``sensor_msgs/Image`` of depth.
        info: ``sensor_msgs/CameraInfo`` that came with it.
        transform: ``geometry_msgs/TransformStamped`` from the image's frame into the world: what
            tf2 gives for the image's stamp. tf2 has interpolated it, and has gone through base_link
            and whatever lies between.
        rectified: see ``intrinsics_of``.
        axes: "opencv" where the image's frame is an optical one, as it should be; "ros" where it is
            a body's.

    Raises:
        ObservationError: the messages do not belong together, or one of them cannot be used.
    """
    if image.header.frame_id != transform.child_frame_id:
        raise ObservationError(
            f"frames differ: {image.header.frame_id!r} of the image, {transform.child_frame_id!r}"
            " of the transform"
        )
    stamp = seconds(transform.header.stamp)
    late = abs(stamp - seconds(image.header.stamp))
    # one of zero is of a transform that never changes
    if stamp != 0 and late > SIMULTANEOUS:
        raise ObservationError(f"image and transform are {late:.3f} s apart")
    return frame_at(image, info, pose_of(transform), rectified, axes)


def frame_at(
    image: Any,
    info: Any,
    pose: Float,
    rectified: bool = False,
    axes: str = "opencv",
    mask: Any = None,
    camera: str = "",
) -> Frame:
    """The same, with the pose of the image's frame in the world as a matrix, (4, 4), metres.

    ``mask`` is a ``sensor_msgs/Image`` of the object's pixels, see ``mask_of``; None for none.
    ``camera`` is the name of the camera, see ``Frame``.
    """
    if (image.width, image.height) != (info.width, info.height):
        raise ObservationError(
            f"the image has {image.width} x {image.height} pixels, its camera_info {info.width} x"
            f" {info.height}"
        )
    if image.header.frame_id != info.header.frame_id:
        raise ObservationError(
            f"frames differ: {image.header.frame_id!r} of the image, {info.header.frame_id!r} of"
            " camera_info"
        )
    late = abs(seconds(image.header.stamp) - seconds(info.header.stamp))
    if late > SIMULTANEOUS:
        raise ObservationError(f"image and camera_info are {late:.3f} s apart")
    inside = None if mask is None else mask_of(mask)
    return Frame(
        depth_of(image),
        intrinsics_of(info, rectified),
        pose,
        inside,
        axes=axes,
        camera=camera,
    )


def mask_of(image: Any) -> Mask:
    """The pixels of an image of 8 bits a pixel that are not 0, (H, W) bool.

    Args:
        image: ``sensor_msgs/Image``, such as of the encodings mono8 and 8UC1.

    Raises:
        ObservationError: it has more than 8 bits a pixel, or data is missing.
    """
    return _pixels_of(image, "a mask", MASK_ENCODINGS) > 0


def labels_of(image: Any) -> Index:
    """The label of each pixel of an image of 8 or 16 bits a pixel, (H, W) int64, 0 for none.

    Args:
        image: ``sensor_msgs/Image`` of the encodings mono8, 8UC1, mono16 and 16UC1.

    Raises:
        ObservationError: it has another encoding, or data is missing.
    """
    return _pixels_of(image, "a label image", LABEL_ENCODINGS).astype(np.int64)


def _pixels_of(image: Any, what: str, encodings: Collection[str]) -> NDArray[Any]:
    """The values of an image with one of some encodings, (H, W), of unsigned integers."""
    if image.encoding not in encodings:
        raise ObservationError(
            f"{what} is encoded as {' or '.join(encodings)}, not {image.encoding!r}"
        )
    order = ">" if image.is_bigendian else "<"
    kind = np.dtype(LABEL_ENCODINGS[image.encoding]).newbyteorder(order)
    width = image.width * kind.itemsize
    if image.step < width or len(image.data) != image.step * image.height:
        raise ObservationError(
            f"{what} of {image.width} x {image.height} pixels has not {len(image.data)} bytes in"
            f" rows of {image.step}"
        )
    rows = np.frombuffer(bytes(image.data), np.uint8).reshape(image.height, image.step)
    return np.ascontiguousarray(rows[:, :width]).view(kind)


def box_of(box: Any) -> Box:
    """The box of a ``nextview_msgs/Box``.

    Raises:
        UsageError: it has no volume.
    """
    low, high = ([corner.x, corner.y, corner.z] for corner in (box.low, box.high))
    return Box(low, high)


def fill_pose(message: Any, pose: Float, axes: str = "opencv") -> Any:
    """Write a camera-to-world pose, (4, 4), OpenCV axes, into a ``geometry_msgs/Pose``, for a
    frame of some axes.
    """
    quaternion = Rotation.from_matrix(pose[:3, :3] @ CAMERA_AXES[axes].T).as_quat()
    message.position.x, message.position.y, message.position.z = map(float, pose[:3, 3])
    (
        message.orientation.x,
        message.orientation.y,
        message.orientation.z,
        message.orientation.w,
    ) = map(float, quaternion)
    return message


def fill_transform(message: Any, pose: Float) -> Any:
    """Write a pose, (4, 4), metres, into a ``geometry_msgs/Transform``."""
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
    for axis, value in zip("xyz", pose[:3, 3], strict=True):
        setattr(message.translation, axis, float(value))
    for axis, value in zip("xyzw", quaternion, strict=True):
        setattr(message.rotation, axis, float(value))
    return message
