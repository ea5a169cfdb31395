"""Play a recording as a depth camera: its images, camera_info and tf, one frame after the other.

    ros2 run nextview_ros nextview_player RECORDING [--ros-args -p hold:=2.0]

A bag with tf can also be played by ``ros2 bag play``.
"""

from __future__ import annotations

import sys
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import TransformStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import CameraInfo, Image
from tf2_msgs.msg import TFMessage

from nextview.captured.folders import read_capture
from nextview.captured.frames import CapturedFrame
from nextview.errors import NextviewError, UsageError
from nextview_ros.conversion import fill_transform

OPTICAL_FRAME = "camera_depth_optical_frame"


class PlayerNode(Node):
    """Publishes the frames of a recording, each for some seconds, again and again.

    Args:
        recording: a folder or a bag, see ``nextview.captured.folders.read_capture``.
        **options: of rclpy's ``Node``, such as ``parameter_overrides``.
    """

    def __init__(self, recording: Path, **options: Any) -> None:
        super().__init__("nextview_player", **options)
        self.declare_parameter("camera", "/camera/camera/depth")
        self.declare_parameter("image", "image_rect_raw")
        self.declare_parameter("world_frame", "base_link")
        self.declare_parameter("rate", 5.0)  # hertz, of the images
        self.declare_parameter("hold", 2.0)  # seconds for which a frame is published
        camera, rate = self.value("camera"), self.value("rate")
        self.images = self.create_publisher(
            Image,
            f"{camera}/{self.value('image')}",
            qos_profile_sensor_data,
        )
        self.infos = self.create_publisher(
            CameraInfo,
            f"{camera}/camera_info",
            qos_profile_sensor_data,
        )
        self.tf = self.create_publisher(TFMessage, "/tf", 100)
        self.repeats = max(1, round(rate * self.value("hold")))
        self.frames = cycle(read_capture(recording).frames)
        self.left = 0
        self.create_timer(1 / rate, self.play)

    def value(self, name: str) -> Any:
        """A parameter."""
        return self.get_parameter(name).value

    def play(self) -> None:
        """Publish the current frame, or the next one."""
        if self.left == 0:
            self.frame = next(self.frames)
            self.depth = self.frame.read(masked=False).depth
            self.left = self.repeats
        self.left -= 1
        now = self.get_clock().now().to_msg()
        there = TransformStamped(child_frame_id=OPTICAL_FRAME)
        there.header.frame_id = self.value("world_frame")
        there.header.stamp = now
        fill_transform(there.transform, self.frame.pose)
        image, info = messages_of(self.frame, self.depth)
        image.header.frame_id = info.header.frame_id = OPTICAL_FRAME
        image.header.stamp = info.header.stamp = now
        self.tf.publish(TFMessage(transforms=[there]))
        self.infos.publish(info)
        self.images.publish(image)


def messages_of(frame: CapturedFrame, depth: Any) -> tuple[Image, CameraInfo]:
    """A captured frame as messages, without headers.

    Args:
        frame: with its intrinsics.
        depth: its depth, (H, W) float32, metres, 0 = invalid.
    """
    height, width = depth.shape
    image = Image(height=height, width=width, encoding="32FC1", step=4 * width)
    image.data = depth.astype("<f4").tobytes()
    info = CameraInfo(height=height, width=width)
    info.k = np.asarray(frame.intrinsics, np.float64).ravel()
    info.p = np.hstack([frame.intrinsics, np.zeros((3, 1))]).ravel()
    return image, info


def main() -> None:
    """Play a recording."""
    rclpy.init()
    try:
        given = remove_ros_args(sys.argv)[1:]
        if len(given) != 1:
            raise UsageError("ros2 run nextview_ros nextview_player RECORDING")
        node = PlayerNode(Path(given[0]))
    except NextviewError as error:
        print(f"nextview: {error}", file=sys.stderr)
        rclpy.try_shutdown()
        raise SystemExit(2) from None
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
