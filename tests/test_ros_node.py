"""The ROS 2 node at work: a robot publishes what a simulated camera sees, and asks it to recognise.

Runs where rclpy and nextview_msgs are, in the environment of ``make test-ros``.
"""

import os
import re
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

pytest.importorskip("rclpy")
import trimesh
from factories import box, cast, pose_at
from geometry_msgs.msg import Point
from nextview_msgs.msg import Box
from ros_robot import PACKAGE, SECONDS, Robot, Running, until, wait
from sensor_msgs.msg import Image

from nextview.data.samples import sample_mesh

K = np.array([[520.0, 0, 319.5], [0, 520.0, 239.5], [0, 0, 1]])
SHAPE = 480, 640


def chair():
    """The sample chair, 0.35 m high, on the table."""
    mesh = sample_mesh("chair")
    thing = trimesh.Trimesh(0.2 * mesh.vertices, mesh.faces, process=False)
    thing.apply_translation([0.5, 0.1, -thing.bounds[0, 2]])
    return thing


THINGS = [box((3, 3, 0.02), (0, 0, -0.01)), chair()]
MIDDLE = THINGS[1].bounds.mean(0)


def see(pose):
    """What a camera sees of the chair."""
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    depth, _ = cast(THINGS, pose, K + half, SHAPE)
    return np.rint(1000 * depth).astype(np.uint16)


def a_robot(**options):
    return Robot(see, K, {"depth": pose_at(40, 20, 0.7, MIDDLE)}, **options)


@pytest.fixture(scope="module")
def running():
    made = Running(a_robot, models=["modelnet10"], threshold=1.0, max_views=3)
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

    (detection,) = robot.hears("detections").detections
    assert detection.results[0].hypothesis.class_id == "chair"
    centre = detection.bbox.center.position
    assert np.linalg.norm(np.array([centre.x, centre.y, centre.z]) - MIDDLE) < 0.05


def test_a_pose_that_cannot_be_reached_is_not_asked_for_again(robot):
    robot.goal(distance=0.7)
    assert "call look" in robot.failed().message
    assert robot.look().success
    first = robot.target()
    heard = robot.heard["next_pose"]
    assert robot.failed().success
    assert np.linalg.norm(robot.target(heard)[:3, 3] - first[:3, 3]) > 0.1


def test_a_goal_is_cancelled_and_the_next_one_begins_anew(robot):
    handle, result = robot.goal(distance=0.7)
    assert robot.look().success
    wait(handle.cancel_goal_async())
    found = wait(result)
    assert found.status == 5  # cancelled
    assert "ended too early: 1 view" in found.result.message
    assert "no pose was asked for" in robot.failed().message

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


def corner(x, y, z):
    return Point(x=float(x), y=float(y), z=float(z))


def mask_of_chair(shape=SHAPE):
    """The pixels of the chair from the robot's first pose, as an image."""
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    _, thing = cast(THINGS, pose_at(40, 20, 0.7, MIDDLE), K + half, SHAPE)
    rows = np.where(thing == 1, 255, 0).astype(np.uint8)[: shape[0], : shape[1]]
    made = Image(height=shape[0], width=shape[1], encoding="mono8", step=shape[1])
    made.data = rows.tobytes()
    return made


def test_an_object_is_chosen_by_a_box(robot):
    margin = np.array([[0.02, 0.02, -0.002], [-0.02, -0.02, -0.02]])
    low, high = THINGS[1].bounds - margin
    robot.goal(distance=0.7, region=[Box(low=corner(*low), high=corner(*high))])
    assert robot.look().message == "view 1 is taken in"
    distance = np.linalg.norm(robot.target()[:3, 3] - MIDDLE)
    assert distance == pytest.approx(0.7, abs=0.06)


def test_an_object_is_chosen_by_a_mask_of_the_next_image(robot):
    handle, result = robot.goal(distance=0.7, mask=[mask_of_chair((100, 640))])
    answer = robot.look()
    assert not answer.success
    assert "a mask is (H, W) bool as the depth" in answer.message

    wait(handle.cancel_goal_async())
    wait(result)
    robot.goal(distance=0.7, mask=[mask_of_chair()])
    assert robot.look().message == "view 1 is taken in"
    # the camera moves, and the mask was of the first image alone
    robot.pose = robot.target()
    assert robot.look().message == "view 2 is taken in"


def stale(image, info, transform):
    image.header.stamp.sec -= 30
    return image, info, transform


def other_size(image, info, transform):
    info.width = 320
    return image, info, transform


WRONG = {
    "no image": (
        lambda image, info, transform: (None, info, transform),
        "no depth image with",
    ),
    "stale": (stale, "the images are older than the look"),
    "of another size": (other_size, "its camera_info 320 x 480"),
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
    given = ["--ros-args", "-r", "__ns:=/second", "-p", "cameras:=[depth]"]
    given += ["-p", "image:=image", "-p", "models:=[modelnet10]"]
    given += ["-p", "threshold:=1.0", *options]
    path = os.pathsep.join([str(PACKAGE), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-c", code, *given], env=os.environ | {"PYTHONPATH": path}
    )


def test_parameters_that_make_no_sense_end_the_node_with_a_sentence():
    process = started("-p", "policy:=nowhere")
    assert process.wait(SECONDS) == 2
