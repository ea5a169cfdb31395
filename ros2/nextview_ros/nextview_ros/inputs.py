"""What the node hears: depth images with their camera_info, and tf."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from tf2_msgs.msg import TFMessage

from nextview.captured.messages import parts_of, seconds
from nextview.captured.transforms import NoTransformError, TransformError, TransformTree
from nextview.errors import ObservationError
from nextview.types import Float

UNPAIRED = 10  # images, or camera_infos, that wait for the other of the same stamp
TRANSFORMS = 2000  # of each frame that are remembered


class Pairs:
    """Pair depth images with the camera_info of the same stamp, whichever comes first.

    Args:
        paired: called with an image and its camera_info.
    """

    def __init__(self, paired: Callable[[Any, Any], None]) -> None:
        self.paired = paired
        self.waiting: dict[str, dict[int, Any]] = {"image": {}, "info": {}}
        self.lock = threading.Lock()

    def take(self, kind: str, message: Any) -> None:
        """Take in a message; ``kind`` is "image" or "info"."""
        other = "info" if kind == "image" else "image"
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        with self.lock:
            partner = self.waiting[other].pop(stamp, None)
            if partner is None:
                waiting = self.waiting[kind]
                waiting[stamp] = message
                while len(waiting) > UNPAIRED:
                    del waiting[next(iter(waiting))]
                return
        self.paired(*((message, partner) if kind == "image" else (partner, message)))

    def missing(self) -> str:
        """Return what is lacking if no pair comes, in words."""
        if self.waiting["image"] and not self.waiting["info"]:
            return "depth images come, but no camera_info"
        if self.waiting["info"] and not self.waiting["image"]:
            return "camera_info comes, but no depth image"
        if self.waiting["image"]:
            return "depth images and camera_info come with different stamps"
        return "no depth image came"


class DepthCamera:
    """The latest depth image of a camera, with its camera_info.

    Args:
        node: that subscribes.
        namespace: of the camera's topics.
        image: topic of the depth images below it; that of their intrinsics is camera_info.
        group: callback group of the subscriptions.
    """

    def __init__(self, node: Node, namespace: str, image: str, group: Any) -> None:
        self.namespace = namespace
        self.latest: tuple[Image, CameraInfo] | None = None
        self.arrived = threading.Condition()
        self.pairs = Pairs(self.keep)
        for kind, topic, name in (
            (Image, image, "image"),
            (CameraInfo, "camera_info", "info"),
        ):
            node.create_subscription(
                kind,
                f"{namespace}/{topic}",
                partial(self.pairs.take, name),
                qos_profile_sensor_data,
                callback_group=group,
            )

    def keep(self, image: Image, info: CameraInfo) -> None:
        """Keep the latest image and its camera_info."""
        with self.arrived:
            self.latest = image, info
            self.arrived.notify_all()

    def image_after(self, start: float, patience: float) -> tuple[Image, CameraInfo]:
        """Return the first image that was taken after a time, with its camera_info.

        Args:
            start: seconds, in the clock of the stamps.
            patience: seconds to wait for it.

        Raises:
            ObservationError: none came.
        """

        def is_fresh() -> bool:
            return (
                self.latest is not None
                and seconds(self.latest[0].header.stamp) >= start
            )

        with self.arrived:
            if self.arrived.wait_for(is_fresh, patience):
                return self.latest
            stale = self.latest is not None
        why = "the images are older than the look" if stale else self.pairs.missing()
        raise ObservationError(
            f"no depth image with its camera_info came on {self.namespace} within {patience} s:"
            f" {why}"
        )


class Transforms:
    """The transforms of tf.

    Args:
        node: that subscribes.
        group: callback group of the subscriptions.
    """

    def __init__(self, node: Node, group: Any) -> None:
        self.log = node.get_logger()
        self.tree = TransformTree(kept=TRANSFORMS)
        self.arrived = threading.Condition()
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for topic, quality, fixed in (
            ("/tf", 100, False),
            ("/tf_static", latched, True),
        ):
            node.create_subscription(
                TFMessage,
                topic,
                partial(self.take, fixed),
                quality,
                callback_group=group,
            )

    def take(self, fixed: bool, message: Any) -> None:
        """Take in a message; ``fixed`` if it is of /tf_static."""
        with self.arrived:
            for each in message.transforms:
                position, quaternion = parts_of(each.transform)
                parent = each.header.frame_id
                stamp = seconds(each.header.stamp)
                try:
                    self.tree.add(
                        each.child_frame_id,
                        parent,
                        stamp,
                        position,
                        quaternion,
                        fixed,
                    )
                except TransformError as error:
                    self.log.warning(str(error))
            self.arrived.notify_all()

    def pose(self, frame: str, world: str, stamp: float, patience: float) -> Float:
        """Return the pose of a frame in the world, (4, 4), metres.

        Args:
            frame: that of the images.
            world: that of the world.
            stamp: seconds.
            patience: seconds to wait for it.

        Raises:
            NoTransformError: tf does not say it.
        """
        end = time.monotonic() + patience
        with self.arrived:
            while True:
                try:
                    self.tree.sort()
                    return self.tree.pose(frame, world, stamp)
                except NoTransformError:
                    if time.monotonic() >= end:
                        raise
                self.arrived.wait(min(0.05, patience))
