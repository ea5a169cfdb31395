"""A stand-in for a robot with a depth camera: it shows a recording, or a simulated table.

    ros2 run nextview_ros nextview_player [RECORDING] [--ros-args -p camera:=/camera/camera/depth]

It publishes depth images, camera_info and tf, and goes wherever the node wants to look next: with a
recording, to the frame whose camera is nearest. RECORDING is a folder or a bag of depth frames with
poses; without one, a simulated camera looks at four bundled things on a table.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, TransformStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import CameraInfo, Image
from tf2_msgs.msg import TFMessage

from nextview.captured.folders import read_capture
from nextview.captured.messages import pose_of
from nextview.errors import MissingExtraError, NextviewError, ObservationError
from nextview.sensing.frame import Frame
from nextview.simulation.sensor import SENSORS
from nextview.things.memory import taught_meshes
from nextview.types import Float
from nextview_ros.conversion import fill_transform

OPTICAL_FRAME = "camera_depth_optical_frame"
ON_TABLE = ("cracker_box", "mug", "banana", "tomato_soup_can")  # of the bundled memory
HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


class Source(Protocol):
    """Where the frames of the stand-in come from."""

    def first(self) -> Frame:
        """Return the frame at the start."""

    def towards(self, pose: Float) -> Frame:
        """Return a frame from a pose, camera-to-world, (4, 4), or from near it.

        Raises:
            ObservationError: there is none.
        """


class RecordedFrames:
    """Frames of a recording, each returned once.

    Args:
        recording: a folder or a bag, see ``nextview.captured.folders.read_capture``.
    """

    def __init__(self, recording: Path) -> None:
        self.left = list(read_capture(recording).frames)

    def first(self) -> Frame:
        """Return the first frame."""
        return self.left.pop(0).read(masked=False)

    def towards(self, pose: Float) -> Frame:
        """Return the frame whose camera is nearest to a pose."""
        if not self.left:
            raise ObservationError("all frames of the recording were shown")
        away = [np.linalg.norm(one.pose[:3, 3] - pose[:3, 3]) for one in self.left]
        return self.left.pop(int(np.argmin(away))).read(masked=False)


class TableFrames:
    """Frames of a simulated camera over a table, which nextview-lab draws.

    Raises:
        MissingExtraError: nextview-lab is not installed.
    """

    def __init__(self) -> None:
        try:
            from nextview_lab.worlds.tables import (
                SimulatedTable,
                TableCamera,
                poses_around,
            )
        except ModuleNotFoundError as error:
            raise MissingExtraError(
                "the simulated table needs nextview-lab: pip install ./lab; or name a"
                " recording"
            ) from error

        rng = np.random.default_rng(5)
        table = SimulatedTable.draw(taught_meshes("ycb", ON_TABLE), rng, gap=0.08)
        self.camera = TableCamera(table, SENSORS["stereo"], rng)
        place = np.array([0.0, 0.0, 0.03])
        self._above = poses_around(np.zeros(1), np.radians(50), 0.65, place)[0]

    def first(self) -> Frame:
        """Return a frame from 0.65 m, 50 degrees above the table."""
        return self.camera.frame(self._above)

    def towards(self, pose: Float) -> Frame:
        """Return a frame from a pose."""
        return self.camera.frame(pose)


class PlayerNode(Node):
    """Publishes frames of a source, and follows the topic next_pose.

    Args:
        source: of the frames.
        **options: of rclpy's ``Node``, such as ``parameter_overrides``.
    """

    def __init__(self, source: Source, **options: Any) -> None:
        super().__init__("nextview_player", **options)
        self.declare_parameter("camera", "/camera/camera/depth")
        self.declare_parameter("image", "image_rect_raw")
        self.declare_parameter("world_frame", "base_link")
        self.declare_parameter("rate", 5.0)  # hertz, of the images
        self.source = source
        self.frame = source.first()
        camera = self.value("camera")
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
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(PoseStamped, "next_pose", self.go, latched)
        self.create_timer(1 / self.value("rate"), self.show)

    def value(self, name: str) -> Any:
        """A parameter."""
        return self.get_parameter(name).value

    def go(self, message: PoseStamped) -> None:
        """Go to a pose."""
        there = TransformStamped()
        there.transform.rotation = message.pose.orientation
        for axis in "xyz":
            setattr(
                there.transform.translation,
                axis,
                getattr(message.pose.position, axis),
            )
        try:
            self.frame = self.source.towards(pose_of(there))
        except ObservationError as error:
            self.get_logger().info(str(error))

    def show(self) -> None:
        """Publish the current frame."""
        now = self.get_clock().now().to_msg()
        there = TransformStamped(child_frame_id=OPTICAL_FRAME)
        there.header.frame_id = self.value("world_frame")
        there.header.stamp = now
        fill_transform(there.transform, self.frame.camera_to_world)
        image, info = messages_of(self.frame)
        image.header.frame_id = info.header.frame_id = OPTICAL_FRAME
        image.header.stamp = info.header.stamp = now
        self.tf.publish(TFMessage(transforms=[there]))
        self.infos.publish(info)
        self.images.publish(image)


def messages_of(frame: Frame) -> tuple[Image, CameraInfo]:
    """A frame as a depth image, 32FC1, and its camera_info, without headers."""
    height, width = frame.shape
    image = Image(height=height, width=width, encoding="32FC1", step=4 * width)
    image.data = frame.depth.astype("<f4").tobytes()
    info = CameraInfo(height=height, width=width)
    intrinsics = frame.intrinsics - HALF_PIXEL
    info.k = intrinsics.ravel()
    info.p = np.hstack([intrinsics, np.zeros((3, 1))]).ravel()
    return image, info


def main() -> None:
    """Stand in for a robot."""
    rclpy.init()
    given = remove_ros_args(sys.argv)[1:]
    try:
        source = RecordedFrames(Path(given[0])) if given else TableFrames()
        node = PlayerNode(source)
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
