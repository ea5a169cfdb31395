"""What the node hears: depth images with their camera_info, and where the camera was."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from nextview.captured.messages import parts_of, seconds
from nextview.captured.transforms import NoTransformError, TransformError, TransformTree
from nextview.errors import UsageError
from nextview.types import Float

UNPAIRED = 10  # images, or camera_infos, that wait for the other of the same stamp
TRANSFORMS = 2000  # of each frame that are remembered
CAMERA = "camera_pose"  # the frame of poses that come on the topic of this name
POSE_SOURCES = ("tf", "topic")


class Pairs:
    """Depth images, each with the camera_info of its stamp, whichever comes first.

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
        """What is lacking where no pair comes, in words."""
        if self.waiting["image"] and not self.waiting["info"]:
            return "depth images come, but no camera_info"
        if self.waiting["info"] and not self.waiting["image"]:
            return "camera_info comes, but no depth image"
        if self.waiting["image"]:
            return "depth images and camera_info come with different stamps"
        return "no depth image came"


class CameraPoses:
    """Where the camera was, and when.

    Args:
        node: whose subscriptions are made.
        source: "tf", or "topic" for ``geometry_msgs/PoseStamped`` of the images' frame on
            ``camera_pose``.
        world: name of the world's frame.
        group: callback group of the subscriptions.

    Raises:
        UsageError: there is no such source, or tf2_msgs is not installed.
    """

    def __init__(self, node: Node, source: str, world: str, group: Any) -> None:
        if source not in POSE_SOURCES:
            raise UsageError(
                f"poses come from {' or '.join(POSE_SOURCES)}, not {source!r}"
            )
        self.node = node
        self.source = source
        self.world = world
        self.tree = TransformTree(kept=TRANSFORMS)
        self.arrived = threading.Condition()
        if source == "topic":
            node.create_subscription(
                PoseStamped,
                CAMERA,
                self.take_pose,
                100,
                callback_group=group,
            )
            return
        try:
            from tf2_msgs.msg import TFMessage
        except ModuleNotFoundError:
            raise UsageError(
                "tf2_msgs is not installed: set the parameter poses to 'topic', and publish the"
                " camera's pose on camera_pose"
            ) from None
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for topic, quality, fixed in (
            ("/tf", 100, False),
            ("/tf_static", latched, True),
        ):
            take = partial(self.take_transforms, fixed)
            node.create_subscription(
                TFMessage,
                topic,
                take,
                quality,
                callback_group=group,
            )

    def take_transforms(self, fixed: bool, message: Any) -> None:
        """Take in what tf says."""
        for each in message.transforms:
            self._add(each.child_frame_id, each.header, each.transform, fixed)

    def take_pose(self, message: Any) -> None:
        """Take in a pose of the camera."""
        self._add(CAMERA, message.header, message.pose)

    def _add(
        self,
        child: str,
        header: Any,
        transform: Any,
        fixed: bool = False,
    ) -> None:
        position, quaternion = parts_of(transform)
        with self.arrived:
            try:
                self.tree.add(
                    child,
                    header.frame_id,
                    seconds(header.stamp),
                    position,
                    quaternion,
                    fixed,
                )
            except TransformError as error:
                self.node.get_logger().warning(str(error))
            self.arrived.notify_all()

    def at(self, frame: str, stamp: float, patience: float) -> Float:
        """Where a frame was in the world, (4, 4), metres.

        Args:
            frame: that of the images.
            stamp: seconds.
            patience: seconds to wait for it.

        Raises:
            NoTransformError: nothing says it.
        """
        child = frame if self.source == "tf" else CAMERA
        end = time.monotonic() + patience
        with self.arrived:
            while True:
                try:
                    self.tree.sort()
                    return self.tree.pose(child, self.world, stamp)
                except NoTransformError:
                    if time.monotonic() >= end:
                        raise
                self.arrived.wait(min(0.05, patience))
