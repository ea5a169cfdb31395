"""A robot for the tests of the ROS 2 node: cameras that publish what they see from where they are.

Needs rclpy and nextview_msgs, in the environment of ``make test-ros``.
"""

import os
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("ROS_DOMAIN_ID", str(os.getpid() % 100 + 1))
rclpy = pytest.importorskip("rclpy")
pytest.importorskip("nextview_msgs")
PACKAGE = Path(__file__).parents[1] / "ros2" / "nextview_ros"
sys.path.insert(0, str(PACKAGE))

from factories import pose_at
from geometry_msgs.msg import PoseArray, PoseStamped, TransformStamped
from moveit_msgs.msg import PlanningScene
from nextview_msgs.action import LookUntilSettled, Recognise
from nextview_msgs.srv import Learn
from nextview_ros.conversion import fill_transform
from nextview_ros.node import LATCHED, NextviewNode
from rclpy.action import ActionClient
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from vision_msgs.msg import Detection3DArray

from nextview.captured.messages import pose_of

SECONDS = 120.0
"""After which something that is waited for will not come; the machine may be busy."""
MOUNTED = pose_at(-20, 30, 0.05, (0.02, 0.01, 0.1))
"""The optical frame on the arm's last link."""
HEARD = {
    "detections": Detection3DArray,
    "next_pose": PoseStamped,
    "next_poses": PoseArray,
    "planning_scene": PlanningScene,
}
"""Latched topics of the node, with their types."""


class Robot(Node):
    """Cameras that are wherever they are sent, and publish all the time what they see.

    Args:
        see: what a camera sees from a pose: depth, (H, W) uint16, millimetres.
        k: pinhole matrix of the cameras, first pixel's centre at 0.
        start: poses of the cameras in base_link, (4, 4), by namespace.
        **options: of rclpy's node.

    Attributes:
        poses: of the cameras.
        change: what is done to an image, its camera_info and its transform before they are sent.
        heard: the last message of each topic of the node.
        objects: transforms of objects that were heard, by name.
        looks_new: number that changes where the cameras see something else from the same poses.
    """

    def __init__(
        self, see: Callable, k: np.ndarray, start: dict[str, np.ndarray], **options
    ):
        super().__init__("robot", **options)
        self.see, self.k, self.start = see, k, start
        self.depth_of = {}
        self.looks_new = 0
        self.heard = {}
        self.objects = {}
        self.reset()
        quality = qos_profile_sensor_data
        self.images = {
            name: self.create_publisher(Image, f"{name}/image", quality)
            for name in start
        }
        self.infos = {
            name: self.create_publisher(CameraInfo, f"{name}/camera_info", quality)
            for name in start
        }
        self.moving = self.create_publisher(TFMessage, "/tf", 10)
        self.fixed = self.create_publisher(TFMessage, "/tf_static", LATCHED)
        mounted = [
            self.transform(MOUNTED, self.frame(name, "tool"), self.frame(name))
            for name in start
        ]
        self.fixed.publish(TFMessage(transforms=mounted))
        for topic, kind in HEARD.items():
            self.create_subscription(
                kind,
                topic,
                lambda given, topic=topic: self.heard.update({topic: given}),
                LATCHED,
            )
        self.create_subscription(
            Detection3DArray,
            "tracked",
            lambda given: self.heard.update(tracked=given),
            10,
        )
        self.create_subscription(TFMessage, "/tf", self.hear_transforms, 100)
        self.look_client = self.create_client(Trigger, "look")
        self.failed_client = self.create_client(Trigger, "failed")
        self.learn_client = self.create_client(Learn, "learn")
        self.actions = {
            Recognise: ActionClient(self, Recognise, "recognise"),
            LookUntilSettled: ActionClient(
                self, LookUntilSettled, "look_until_settled"
            ),
        }
        self.create_timer(0.1, self.publish)

    @property
    def is_served(self):
        """Whether any service or action of the node is there."""
        return self.look_client.service_is_ready() or any(
            client.server_is_ready() for client in self.actions.values()
        )

    @property
    def pose(self):
        """The pose of the first camera."""
        return next(iter(self.poses.values()))

    @pose.setter
    def pose(self, pose):
        self.poses[next(iter(self.poses))] = pose

    def frame(self, name, of="optical"):
        """The tf frame of a camera, or of the link that it is on."""
        return f"{self.get_namespace()}/{name}_{of}".strip("/")

    def reset(self):
        self.poses = dict(self.start)
        self.change = lambda image, info, transform: (image, info, transform)
        self.heard.clear()
        self.objects.clear()

    def show(self, pose, depth):
        """Let a camera see this depth from a pose from now on."""
        self.depth_of[pose.tobytes(), self.looks_new + 1] = depth
        self.looks_new += 1

    def hear_transforms(self, message):
        for each in message.transforms:
            if "tool" not in each.child_frame_id:
                self.objects[each.child_frame_id] = pose_of(each)

    def transform(self, pose, parent, child):
        made = TransformStamped(child_frame_id=child)
        made.header.frame_id = parent
        made.header.stamp = self.get_clock().now().to_msg()
        fill_transform(made.transform, pose)
        return made

    def publish(self):
        for name, pose in self.poses.items():
            self.publish_camera(name, pose)

    def publish_camera(self, name, pose):
        key = pose.tobytes(), self.looks_new
        if key not in self.depth_of:
            self.depth_of[key] = self.see(pose)
        depth = self.depth_of[key]
        height, width = depth.shape
        image = Image(height=height, width=width, encoding="16UC1", step=2 * width)
        image.data = depth.tobytes()
        image.header.frame_id = self.frame(name)
        image.header.stamp = self.get_clock().now().to_msg()
        info = CameraInfo(header=image.header, height=height, width=width)
        info.k = self.k.ravel()
        info.p = np.hstack([self.k, np.zeros((3, 1))]).ravel()
        link = self.frame(name, "tool")
        tool = self.transform(pose @ np.linalg.inv(MOUNTED), "base_link", link)
        tool.header.stamp = image.header.stamp

        image, info, tool = self.change(image, info, tool)
        if tool is not None:
            self.moving.publish(TFMessage(transforms=[tool]))
        # The order in which messages arrive is not that in which they are sent.
        if info is not None:
            self.infos[name].publish(info)
        if image is not None:
            self.images[name].publish(image)

    # What a robot's program does; each waits for the answer

    def goal(self, kind=Recognise, **asked):
        """Send a goal; its handle, and its result when it comes."""
        client = self.actions[kind]
        assert client.wait_for_server(SECONDS)
        self.feedback = []
        sent = client.send_goal_async(
            kind.Goal(**asked), lambda said: self.feedback.append(said.feedback)
        )
        handle = wait(sent)
        return handle, handle.get_result_async() if handle.accepted else None

    def look(self):
        assert self.look_client.wait_for_service(SECONDS)
        return wait(self.look_client.call_async(Trigger.Request()))

    def look_when_all_is_there(self):
        """The answer to the first look for which all messages have come to a node that began."""
        answers = []

        def looks():
            answers.append(self.look())
            return answers[-1].success

        until(looks, "a look")
        return answers[-1]

    def failed(self):
        return wait(self.failed_client.call_async(Trigger.Request()))

    def learn(self, **asked):
        assert self.learn_client.wait_for_service(SECONDS)
        return wait(self.learn_client.call_async(Learn.Request(**asked)))

    def hears(self, topic, after=None):
        """A message of a topic that is another than the one that was heard before."""
        until(
            lambda: (
                self.heard.get(topic) is not None and self.heard[topic] is not after
            ),
            topic,
        )
        return self.heard[topic]

    def target(self, after=None):
        """The pose that the node asks for, (4, 4)."""
        return matrix_of(self.hears("next_pose", after).pose)


def matrix_of(given):
    """The matrix of a ``geometry_msgs/Pose``, (4, 4)."""
    made = TransformStamped()
    made.transform.rotation = given.orientation
    for axis in "xyz":
        setattr(made.transform.translation, axis, getattr(given.position, axis))
    return pose_of(made)


def until(true, what):
    end = time.monotonic() + SECONDS
    while not true():
        assert time.monotonic() < end, f"waited in vain for {what}"
        time.sleep(0.02)


def wait(future):
    """The result of a future of rclpy, which the executor's threads bring about."""
    done = Future()
    future.add_done_callback(lambda each: done.set_result(each.result()))
    return done.result(SECONDS)


class Running:
    """A node and a robot, spinning in threads of their own.

    Args:
        robot: makes the robot.
        parameters: of the node.
    """

    def __init__(self, robot: Callable[[], Robot], **parameters):
        rclpy.init()
        self.node = node_with(**parameters)
        self.robot = robot()
        self.others = []
        self.executor = MultiThreadedExecutor(8)
        self.executor.add_node(self.node)
        self.executor.add_node(self.robot)
        self.closed = threading.Event()
        self.thread = threading.Thread(target=self.spin, daemon=True)
        self.thread.start()

    def spin(self):
        """Until ``close``: nothing is begun any more when the executor shuts down."""
        while not self.closed.is_set():
            self.executor.spin_once(0.1)

    def add(self, other):
        """One more node or robot; it is destroyed at the end, as the executor uses it."""
        self.others.append(other)
        self.executor.add_node(other)
        return other

    def close(self):
        self.closed.set()
        self.thread.join(10.0)
        self.executor.shutdown(5.0)
        for each in (self.node, self.robot, *self.others):
            for made in (*getattr(each, "servers", ()),):
                made.destroy()
            for made in getattr(each, "actions", {}).values():
                made.destroy()
            each.destroy_node()
        rclpy.try_shutdown()


def node_with(namespace=None, **parameters):
    """A node of the tests' cameras with some parameters."""
    given = {"cameras": ["depth"], "image": "image", "patience": 3.0} | parameters
    overrides = [Parameter(name, value=value) for name, value in given.items()]
    return NextviewNode(parameter_overrides=overrides, namespace=namespace)
