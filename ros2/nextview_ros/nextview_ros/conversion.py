"""From ROS messages to frames of nextview, and back to poses. Nothing here needs ROS: only the
messages' fields count.

Depth images are as REP 118 has them (16UC1 millimetres, 32FC1 metres), optical frames as REP 103 (z
forward, x right, y down), which are nextview's own axes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nextview.errors import ObservationError
from nextview.sensing.frame import AXES, Frame

Float = NDArray[np.float64]

ENCODINGS = {
    "16UC1": np.dtype(np.uint16),
    "mono16": np.dtype(np.uint16),
    "32FC1": np.dtype(np.float32),
}
"""How a pixel is stored, by the encoding of a depth image."""
SIMULTANEOUS = 0.02
"""Seconds that image, camera_info and transform may be apart: a camera at 30 Hz never mixes
neighbours.
"""


def depth_of(image: Any) -> NDArray[Any]:
    """The pixels of a ``sensor_msgs/Image``: (height, width), uint16 millimetres or float32 metres,
    native byte order.

    Raises:
        ObservationError: it is no depth image, or shorter than it says.
    """
    if image.encoding not in ENCODINGS:
        raise ObservationError(
            f"a depth image is {', '.join(ENCODINGS)}, not {image.encoding!r}: a colour topic?"
        )
    kind = ENCODINGS[image.encoding].newbyteorder(">" if image.is_bigendian else "<")
    height, width, step = int(image.height), int(image.width), int(image.step)
    data = np.frombuffer(bytes(image.data), np.uint8)
    if step < width * kind.itemsize or len(data) < step * height:
        raise ObservationError(
            f"an image of {width} x {height} in {image.encoding} has rows of"
            f" {width * kind.itemsize} bytes or more; this one has {len(data)} bytes in rows of"
            f" {step}"
        )
    rows = data[: step * height].reshape(height, step)[:, : width * kind.itemsize]
    return np.ascontiguousarray(rows).view(kind).astype(kind.newbyteorder("="))


def intrinsics_of(info: Any, rectified: bool = False) -> Float:
    """The pinhole matrix of a ``sensor_msgs/CameraInfo``, (3, 3), pixels; the first pixel's centre
    is at 0.

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
    """A ``geometry_msgs/TransformStamped`` as a matrix, (4, 4): from its child's frame into that of
    its header.

    Raises:
        ObservationError: the quaternion is none of a rotation.
    """
    t, q = transform.transform.translation, transform.transform.rotation
    quaternion = np.array([q.x, q.y, q.z, q.w])
    if not abs(np.linalg.norm(quaternion) - 1) < 1e-3:
        raise ObservationError(f"a rotation is a quaternion of length 1, not {quaternion.tolist()}")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    pose[:3, 3] = t.x, t.y, t.z
    return pose


def frame_of(
    image: Any, info: Any, transform: Any, rectified: bool = False, axes: str = "opencv"
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
    if (image.width, image.height) != (info.width, info.height):
        raise ObservationError(
            f"the image has {image.width} x {image.height} pixels, its camera_info {info.width} x"
            f" {info.height}"
        )
    if (
        image.header.frame_id != info.header.frame_id
        or image.header.frame_id != transform.child_frame_id
    ):
        raise ObservationError(
            f"frames differ: {image.header.frame_id!r} of the image, {info.header.frame_id!r} of"
            f" camera_info, {transform.child_frame_id!r} of the transform"
        )
    times = [seconds(message.header.stamp) for message in (image, info, transform)]
    if times[2] == 0:  # of a transform that never changes
        times.pop()
    if max(times) - min(times) > SIMULTANEOUS:
        raise ObservationError(
            f"image, camera_info and transform are {max(times) - min(times):.3f} s apart"
        )
    return Frame(depth_of(image), intrinsics_of(info, rectified), pose_of(transform), axes=axes)


def seconds(stamp: Any) -> float:
    """A ``builtin_interfaces/Time`` in seconds."""
    return stamp.sec + 1e-9 * stamp.nanosec


def fill_pose(message: Any, pose: Float, axes: str = "opencv") -> Any:
    """Write a camera-to-world pose, (4, 4), OpenCV axes, into a ``geometry_msgs/Pose``, for a
    frame of some axes.
    """
    quaternion = Rotation.from_matrix(pose[:3, :3] @ AXES[axes].T).as_quat()
    message.position.x, message.position.y, message.position.z = map(float, pose[:3, 3])
    (
        message.orientation.x,
        message.orientation.y,
        message.orientation.z,
        message.orientation.w,
    ) = map(float, quaternion)
    return message
