"""The ROS 2 node at work: a robot publishes what a simulated camera sees, and asks it to recognise.

Runs where rclpy and the action of nextview_msgs are, in the environment of ``make test-ros``.
"""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("ROS_DOMAIN_ID", str(os.getpid() % 100 + 1))
rclpy = pytest.importorskip("rclpy")
pytest.importorskip("nextview_msgs")
sys.path.insert(0, str(Path(__file__).parents[1] / "ros2" / "nextview_ros"))

import trimesh
from geometry_msgs.msg import Point, PoseArray, PoseStamped, TransformStamped
from nextview_msgs.action import Recognise
from nextview_ros.conversion import fill_pose
from nextview_ros.node import RecogniseNode
from pipeline import box, cast, pose_at
from rclpy.action import ActionClient
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import Trigger

from nextview.captured.messages import pose_of
from nextview.data.samples import sample_mesh

try:
    from tf2_msgs.msg import TFMessage
except ModuleNotFoundError:
    TFMessage = None
try:
    from vision_msgs.msg import Detection3DArray
except ModuleNotFoundError:
    Detection3DArray = None

K = np.array([[280.0, 0, 159.5], [0, 280.0, 119.5], [0, 0, 1]])
SHAPE = 240, 320
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SECONDS = 60.0
"""After which something that is waited for will not come; the machine may be busy."""
MOUNTED = pose_at(-20, 30, 0.05, (0.02, 0.01, 0.1))
"""The optical frame on the arm's last link."""


def chair():
    """The sample chair, 0.35 m high, on the table."""
    mesh = sample_mesh("chair")
    thing = trimesh.Trimesh(0.2 * mesh.vertices, mesh.faces, process=False)
    thing.apply_translation([0.5, 0.1, -thing.bounds[0, 2]])
    return thing


class Robot(Node):
    """A camera that is wherever it is sent, and publishes all the time what it sees.

    Attributes:
        pose: of the camera, base_link, (4, 4).
        change: what is done to an image, its camera_info and its transform before they are sent.
        heard: the last message of each topic of the node.
    """

    def __init__(self, poses, **options):
        super().__init__("robot", **options)
        self.things = [box((3, 3, 0.02), (0, 0, -0.01)), chair()]
        self.start = pose_at(40, 20, 0.7, self.things[1].bounds.mean(0))
        self.poses = poses
        self.depth_of = {}
        self.heard = {}
        self.reset()
        self.images = self.create_publisher(Image, "depth", qos_profile_sensor_data)
        self.infos = self.create_publisher(
            CameraInfo,
            "camera_info",
            qos_profile_sensor_data,
        )
        self.stamped = self.create_publisher(PoseStamped, "camera_pose", 10)
        if TFMessage is not None:
            self.moving = self.create_publisher(TFMessage, "/tf", 10)
            self.fixed = self.create_publisher(TFMessage, "/tf_static", LATCHED)
            self.fixed.publish(
                TFMessage(transforms=[self.transform(MOUNTED, "tool", "optical")])
            )
        kinds = {"next_pose": PoseStamped, "next_poses": PoseArray}
        if Detection3DArray is not None:
            kinds["detections"] = Detection3DArray
        for topic, kind in kinds.items():
            self.create_subscription(
                kind,
                topic,
                lambda given, topic=topic: self.heard.update({topic: given}),
                LATCHED,
            )
        self.look_client = self.create_client(Trigger, "look")
        self.failed_client = self.create_client(Trigger, "failed")
        self.action = ActionClient(self, Recognise, "recognise")
        self.create_timer(0.1, self.publish)

    def reset(self):
        self.pose = self.start
        self.change = lambda image, info, transform: (image, info, transform)
        self.heard.clear()

    def transform(self, pose, parent, child):
        made = TransformStamped(child_frame_id=child)
        made.header.frame_id = parent
        made.header.stamp = self.get_clock().now().to_msg()
        placed = fill_pose(PoseStamped().pose, pose)
        made.transform.rotation = placed.orientation
        for axis in "xyz":
            setattr(made.transform.translation, axis, getattr(placed.position, axis))
        return made

    def publish(self):
        pose = self.pose
        key = pose.tobytes()
        if key not in self.depth_of:
            half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
            depth, _ = cast(self.things, pose, K + half, SHAPE)
            self.depth_of[key] = np.rint(1000 * depth).astype(np.uint16)
        depth = self.depth_of[key]
        image = Image(
            height=SHAPE[0],
            width=SHAPE[1],
            encoding="16UC1",
            step=2 * SHAPE[1],
        )
        image.data = depth.tobytes()
        image.header.frame_id = "optical"
        image.header.stamp = self.get_clock().now().to_msg()
        info = CameraInfo(header=image.header, height=SHAPE[0], width=SHAPE[1])
        info.k = K.ravel()
        info.p = np.hstack([K, np.zeros((3, 1))]).ravel()
        tool = self.transform(pose @ np.linalg.inv(MOUNTED), "base_link", "tool")
        tool.header.stamp = image.header.stamp

        image, info, tool = self.change(image, info, tool)
        if tool is not None and self.poses == "tf":
            self.moving.publish(TFMessage(transforms=[tool]))
        if tool is not None and self.poses == "topic":
            there = PoseStamped(header=tool.header)
            fill_pose(there.pose, pose)
            self.stamped.publish(there)
        # The order in which messages arrive is not that in which they are sent.
        if info is not None:
            self.infos.publish(info)
        if image is not None:
            self.images.publish(image)

    # What a robot's program does; each waits for the answer

    def goal(self, **asked):
        """Send a goal; its handle, and its result when it comes."""
        assert self.action.wait_for_server(SECONDS)
        self.feedback = []
        sent = self.action.send_goal_async(
            Recognise.Goal(**asked), lambda said: self.feedback.append(said.feedback)
        )
        handle = wait(sent)
        return handle, handle.get_result_async() if handle.accepted else None

    def look(self):
        assert self.look_client.wait_for_service(SECONDS)
        return wait(self.look_client.call_async(Trigger.Request()))

    def failed(self):
        return wait(self.failed_client.call_async(Trigger.Request()))

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
        given = self.hears("next_pose", after)
        made = TransformStamped()
        made.transform.rotation = given.pose.orientation
        for axis in "xyz":
            setattr(
                made.transform.translation,
                axis,
                getattr(given.pose.position, axis),
            )
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
    """Node and robot, spinning in threads of their own."""

    def __init__(self, poses, **parameters):
        all_parameters = {
            "life_size": False,
            "patience": 3.0,
            "poses": poses,
        } | parameters
        rclpy.init()
        given = [Parameter(name, value=value) for name, value in all_parameters.items()]
        self.node = RecogniseNode(parameter_overrides=given)
        self.robot = Robot(poses)
        self.robots = [self.robot]
        self.executor = MultiThreadedExecutor(8)
        self.executor.add_node(self.node)
        self.executor.add_node(self.robot)
        self.thread = threading.Thread(target=self.executor.spin, daemon=True)
        self.thread.start()

    def another_robot(self, **options):
        """One more, for another node; it is destroyed at the end, as the executor uses it."""
        robot = Robot("topic", **options)
        self.robots.append(robot)
        self.executor.add_node(robot)
        return robot

    def close(self):
        self.executor.shutdown(5.0)
        self.thread.join(10.0)
        self.node.server.destroy()
        self.node.destroy_node()
        for robot in self.robots:
            robot.action.destroy()
            robot.destroy_node()
        rclpy.try_shutdown()


@pytest.fixture(scope="module", params=["topic", "tf"])
def running(request):
    if request.param == "tf" and TFMessage is None:
        pytest.skip("tf2_msgs is not installed")
    made = Running(request.param, threshold=1.0, max_views=3)
    yield made
    made.close()


@pytest.fixture
def robot(running):
    running.robot.reset()
    yield running.robot
    # A goal that a test has left behind ends here.
    node = running.node
    until(lambda: node.goal is not None or not node.taken, "the goal's begin")
    node.ended.set()
    until(lambda: not node.taken, "the goal's end")


def test_an_episode_ends_with_the_name_of_the_thing(robot):
    handle, result = robot.goal(distance=0.7)
    assert handle.accepted
    heard = None
    for number in range(3):
        answer = robot.look()
        assert answer.success, answer.message
        if number < 2:
            robot.pose = robot.target(heard)
            heard = robot.heard["next_pose"]
            ranked = robot.heard["next_poses"]
            assert ranked.header.frame_id == "base_link"
            assert len(ranked.poses) > 5
    found = wait(result)
    assert found.status == 4  # succeeded
    assert found.result.answer == "chair"
    assert found.result.views == 3
    assert "chair" in found.result.message
    assert len(found.result.belief) == len(found.result.classes) == 10
    until(lambda: len(robot.feedback) >= 3, "feedback")
    assert [said.views for said in robot.feedback[:3]] == [1, 2, 3]

    if Detection3DArray is not None:
        (detection,) = robot.hears("detections").detections
        assert detection.id == "chair"
        assert detection.results[0].hypothesis.class_id == "chair"
        centre = detection.bbox.center.position
        true = robot.things[1].bounds.mean(0)
        assert np.linalg.norm(np.array([centre.x, centre.y, centre.z]) - true) < 0.05


def test_the_poses_asked_for_look_at_the_thing_from_the_distance(robot):
    robot.goal(distance=0.7)
    assert robot.look().success
    target = robot.target()
    middle = robot.things[1].bounds.mean(0)
    assert np.linalg.norm(target[:3, 3] - middle) == pytest.approx(0.7, abs=0.06)
    towards = (middle - target[:3, 3]) / np.linalg.norm(middle - target[:3, 3])
    assert towards @ target[:3, 2] > 0.99


def test_a_pose_that_cannot_be_reached_is_not_asked_for_again(robot):
    assert robot.look().message == "no goal is active"
    robot.goal(distance=0.7)
    assert "call look" in robot.failed().message
    assert robot.look().success
    first = robot.target()
    heard = robot.heard["next_pose"]
    assert robot.failed().success
    assert np.linalg.norm(robot.target(heard)[:3, 3] - first[:3, 3]) > 0.1


def test_a_second_goal_is_refused_while_one_is_active(robot):
    robot.goal(distance=0.7)
    handle, _ = robot.goal(distance=0.7)
    assert not handle.accepted


def test_a_goal_is_cancelled_and_the_next_one_begins_anew(robot):
    handle, result = robot.goal(distance=0.7)
    assert robot.look().success
    wait(handle.cancel_goal_async())
    found = wait(result)
    assert found.status == 5  # cancelled
    assert "after 1 views" in found.result.message
    assert robot.look().message == "no goal is active"

    again, _ = robot.goal(distance=0.7)
    assert again.accepted
    assert robot.look().message == "view 1 is taken in"


def test_a_goal_that_makes_no_sense_is_aborted_with_the_reason(robot):
    _, result = robot.goal(distance=-1.0)
    found = wait(result)
    assert found.status == 6  # aborted
    assert "distance" in found.result.message


def test_a_point_where_nothing_is_is_said(robot):
    robot.goal(distance=0.7, near=[Point(x=5.0, y=5.0, z=0.0)])
    answer = robot.look()
    assert not answer.success
    assert answer.message


def colour(image, info, transform):
    image.encoding = "rgb8"
    return image, info, transform


def short(image, info, transform):
    image.data = image.data[:1000]
    return image, info, transform


def stale(image, info, transform):
    image.header.stamp.sec -= 30
    return image, info, transform


def other_stamp(image, info, transform):
    info = CameraInfo(
        header=image.header,
        height=info.height,
        width=info.width,
        k=info.k,
        p=info.p,
    )
    stamp = type(image.header.stamp)(sec=image.header.stamp.sec + 5, nanosec=7)
    info.header = type(image.header)(frame_id="optical", stamp=stamp)
    return image, info, transform


def other_size(image, info, transform):
    info.width = 640
    return image, info, transform


def no_rotation(image, info, transform):
    transform.transform.rotation.w = 5.0
    return image, info, transform


WRONG = {
    "no image": (
        lambda image, info, transform: (None, info, transform),
        "no depth image with",
    ),
    "no camera_info": (
        lambda image, info, transform: (image, None, transform),
        "no depth image",
    ),
    "of different stamps": (other_stamp, "no depth image with its camera_info came"),
    "stale": (stale, "the images are older than the look"),
    "colour": (colour, "not 'rgb8': a colour topic"),
    "cut off": (short, "this one has 1000 bytes"),
    "of another size": (other_size, "its camera_info 640 x 240"),
    "no pose": (
        lambda image, info, transform: (image, info, None),
        "tf (has nothing|does not)",
    ),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_is_wrong_with_the_messages_is_said_and_the_next_look_is_good(what, robot):
    robot.goal(distance=0.7)
    robot.change, match = WRONG[what]
    # what was sent before is on its way
    time.sleep(0.3)
    answer = robot.look()
    assert not answer.success
    assert re.search(match, answer.message), answer.message
    robot.change = lambda *messages: messages
    time.sleep(0.3)
    answer = robot.look()
    assert answer.success, answer.message
    assert answer.message == "view 1 is taken in"


def test_images_that_come_late_are_waited_for(robot):
    robot.goal(distance=0.7)
    robot.change = lambda image, info, transform: (None, None, transform)
    time.sleep(0.3)
    resume = threading.Timer(
        1.0, lambda: setattr(robot, "change", lambda *messages: messages)
    )
    resume.start()
    answer = robot.look()
    assert answer.success, answer.message


def started(*options):
    """A node in a process of its own, in the namespace /second."""
    code = "from nextview_ros.node import main; main()"
    given = ["--ros-args", "-r", "__ns:=/second", "-p", "poses:=topic"]
    given += ["-p", "threshold:=1.0", *options]
    folder = str(Path(__file__).parents[1] / "ros2" / "nextview_ros")
    path = os.pathsep.join([folder, os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-c", code, *given],
        env=os.environ | {"PYTHONPATH": path},
    )


def test_a_node_that_is_killed_and_started_again_takes_goals_again(running):
    second = running.another_robot(namespace="/second")
    process = started()
    try:
        second.goal(distance=0.7)
        assert second.look().success
        process.send_signal(signal.SIGKILL)
        process.wait()
        until(
            lambda: not second.look_client.service_is_ready(), "the end of the service"
        )
        process = started()
        handle, _ = second.goal(distance=0.7)
        assert handle.accepted
        assert second.look().message == "view 1 is taken in"
    finally:
        process.kill()
        process.wait()


def test_parameters_that_make_no_sense_end_the_node_with_a_sentence():
    process = started("-p", "poses:=gps")
    assert process.wait(SECONDS) == 2
