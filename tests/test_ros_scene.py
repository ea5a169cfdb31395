"""The ROS 2 node before a whole table: what it tells of the things on it.

Runs where rclpy and nextview_msgs are, in the environment of ``make test-ros``.
"""

import os
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")
from factories import camera_over, view, without, write_scan
from nextview_msgs.action import LookUntilSettled
from nextview_ros.player import PlayerNode, RecordedFrames
from rclpy.parameter import Parameter
from ros_messages import (
    CAMERA_INFO,
    DEPTH,
    at,
    image_message,
    info_message,
    tf_message,
    transform_message,
    write_bag,
)
from ros_robot import Robot, Running, matrix_of, node_with, until, wait
from scipy.spatial import cKDTree
from sensor_msgs.msg import Image
from test_scene_changes import shifted

import nextview
from nextview.sensing import Frame
from nextview.teaching.learn import learn

TAUGHT = ("cracker_box", "tomato_soup_can")
STRANGER = "mug"
HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


@pytest.fixture(scope="module")
def mine(ycb_meshes, tmp_path_factory):
    """A memory of two things."""
    scans = tmp_path_factory.mktemp("scans")
    for name in TAUGHT:
        write_scan(ycb_meshes[name], scans)
    memory = tmp_path_factory.mktemp("memory") / "mine"
    learn(scans, memory, unit="m", workers=0)
    return memory


@pytest.fixture(scope="module")
def camera(ycb_meshes):
    """A camera over them and a stranger."""
    return camera_over([ycb_meshes[name] for name in (*TAUGHT, STRANGER)])


@pytest.fixture(scope="module")
def see(camera):
    """What the camera sees from a pose, millimetres."""
    lock = threading.Lock()

    def see(pose):
        with lock:  # the camera draws its errors
            depth = camera.frame(pose).depth
        return np.rint(1000 * depth).astype(np.uint16)

    return see


@pytest.fixture(scope="module")
def intrinsics(camera):
    """Pinhole matrix, first pixel's centre at 0."""
    return camera.sensor.intrinsics - HALF_PIXEL


@pytest.fixture(scope="module")
def running(mine, see, intrinsics):
    def robot():
        return Robot(see, intrinsics, {"depth": view(20)})

    made = Running(robot, models=[str(mine)], max_views=4)
    yield made
    made.close()


@pytest.fixture
def robot(running):
    running.robot.reset()
    yield running.robot
    node = running.node
    node.ended.set()
    until(lambda: not node.taken, "the goal's end")


def is_in_place(camera, name, pose, least=0.01):
    """Whether a scan in a pose is where the thing is: ADD-S below 10 % of the diameter."""
    thing = next(one for one in camera.table.things if one.name == name)
    true = thing.placed @ camera.lean[:3, :3].T + camera.lean[:3, 3]
    placed = thing.vertices @ pose[:3, :3].T + pose[:3, 3]
    add_s = cKDTree(placed).query(true)[0].mean()
    return add_s < 0.1 * np.linalg.norm(np.ptp(true, axis=0))


def wait_for_target(robot, result, heard):
    """Whether another pose is asked for, before the result comes."""
    until(
        lambda: result.done() or robot.heard.get("next_pose") is not heard,
        "a pose or the result",
    )
    return robot.heard.get("next_pose") is not heard


def test_a_goal_looks_until_the_table_is_settled(robot, camera):
    handle, result = robot.goal(LookUntilSettled, distance=0.65)
    assert handle.accepted
    while True:
        heard = robot.heard.get("next_pose")
        answer = robot.look()
        assert answer.success, answer.message
        if not wait_for_target(robot, result, heard):
            break
        assert len(robot.hears("next_poses").poses) > 5
        robot.pose = robot.target(heard)
    found = wait(result)
    assert found.status == 4  # succeeded
    assert found.result.done
    assert 2 <= found.result.views <= 4
    objects = {thing.name: thing for thing in found.result.objects}
    assert set(objects) == {*TAUGHT, "unknown"}
    for name in TAUGHT:
        thing = objects[name]
        assert thing.confident
        assert thing.pose.header.frame_id == "base_link"
        assert is_in_place(camera, name, matrix_of(thing.pose.pose))
        assert 0 < thing.pose_millimetres < 20
    assert objects["unknown"].pose.header.frame_id == ""
    until(lambda: len(robot.feedback) >= found.result.views, "feedback")
    assert [said.views for said in robot.feedback] == list(
        range(1, found.result.views + 1)
    )

    # the same objects in all other topics
    detections = robot.hears("detections").detections
    assert [int(one.id) for one in detections] == [
        thing.number for thing in found.result.objects
    ]
    named = {
        one.results[0].hypothesis.class_id: one for one in detections if one.results
    }
    assert set(named) == set(TAUGHT)
    told = {
        one.id: one for one in robot.hears("planning_scene").world.collision_objects
    }
    names = {thing.name: f"{thing.name}_{thing.number}" for thing in objects.values()}
    assert {name for name, one in told.items() if one.operation == one.ADD} == set(
        names.values()
    )
    for name in TAUGHT:
        pose = matrix_of(objects[name].pose.pose)
        likeliest = named[name].results[0]
        assert likeliest.hypothesis.score > 0.5
        np.testing.assert_allclose(matrix_of(likeliest.pose.pose), pose, atol=1e-6)
        one = told[names[name]]
        np.testing.assert_allclose(matrix_of(one.pose), pose, atol=1e-6)
        thing = next(each for each in camera.table.things if each.name == name)
        corners = np.array([[v.x, v.y, v.z] for v in one.meshes[0].vertices])
        for extreme in (np.min, np.max):  # the shape in the frame of the scan's file
            np.testing.assert_allclose(
                extreme(corners, axis=0), extreme(thing.vertices, axis=0), atol=0.004
            )
        until(lambda name=name: names[name] in robot.objects, "the transform")
        # it is followed in the images that come, which have noise
        there = robot.objects[names[name]]
        np.testing.assert_allclose(there[:3, 3], pose[:3, 3], atol=0.004)
        assert is_in_place(camera, name, there)
    assert names["unknown"] not in robot.objects


def label_image(labels, encoding="mono16"):
    """A message of labels, (H, W), in 8 or 16 bits a pixel."""
    rows = labels.astype("<u2" if encoding == "mono16" else "u1")
    height, width = rows.shape
    made = Image(height=height, width=width, encoding=encoding, step=rows.strides[0])
    made.data = rows.tobytes()
    return made


def test_labels_tell_apart_the_things_in_the_next_image(robot, camera, see):
    until(lambda: robot.depth_of, "an image")  # the camera is free afterwards
    robot.show(view(20), see(view(20)))  # each image has errors of the arm
    names = [thing.name for thing in camera.table.things]
    can = 300 * (camera.owner == names.index("tomato_soup_can"))
    labels = label_image(can[:100])
    handle, result = robot.goal(LookUntilSettled, labels=[labels], max_views=1)
    answer = robot.look()
    assert not answer.success
    assert "labels of 848 x 100 pixels do not belong" in answer.message
    wait(handle.cancel_goal_async())
    wait(result)

    both = can // 300 + 2 * (camera.owner == names.index("cracker_box"))
    for labels, shown in (
        (label_image(can), {"tomato_soup_can"}),
        (label_image(both, "mono8"), {"tomato_soup_can", "cracker_box"}),
    ):
        _, result = robot.goal(LookUntilSettled, labels=[labels], max_views=1)
        assert robot.look().success
        places = [(one.place.x, one.place.y) for one in wait(result).result.objects]
        assert len(places) == len(shown)
        assert {nearest(camera, place) for place in places} == shown

    coloured = label_image(both, "mono8")
    coloured.encoding = "rgb8"
    _, result = robot.goal(LookUntilSettled, labels=[coloured])
    found = wait(result)
    assert found.status == 6  # aborted
    assert "a label image is encoded as mono8" in found.result.message


def nearest(camera, place):
    """Name of the thing whose middle is nearest to (x, y), metres."""
    middles = {
        thing.name: (thing.placed.min(0) + thing.placed.max(0))[:2] / 2
        for thing in camera.table.things
    }
    return min(middles, key=lambda name: np.linalg.norm(middles[name] - place))


def off(pose, camera, name):
    """Distance of a scan's middle from where it is, metres."""
    thing = next(one for one in camera.table.things if one.name == name)
    middle = (thing.vertices.min(0) + thing.vertices.max(0)) / 2
    difference = pose - camera.truth[name]
    return np.linalg.norm(difference[:3, :3] @ middle + difference[:3, 3])


def test_the_transform_of_a_thing_follows_it_and_ends_where_it_is_lost(
    running, robot, camera
):
    name = "tomato_soup_can"
    _, result = robot.goal(LookUntilSettled, max_views=1)
    assert robot.look().success
    (can,) = [one for one in wait(result).result.objects if one.name == name]
    assert can.confident
    before = matrix_of(can.pose.pose)
    called = f"{name}_{can.number}"
    full = camera.table
    try:
        for _ in range(6):
            camera.change(shifted(camera.table, name, [-0.006, 0.008]))
            robot.looks_new += 1
            until(
                lambda: (
                    called in robot.objects
                    and off(robot.objects[called], camera, name) < 0.006
                ),
                "the transform of the can",
            )
        assert np.linalg.norm((robot.objects[called] - before)[:2, 3]) > 0.05

        def told():
            """The can in the last message."""
            message = robot.heard.get("tracked")
            every = [] if message is None else message.detections
            return next((one for one in every if int(one.id) == can.number), None)

        until(
            lambda: (
                (one := told()) is not None
                and off(matrix_of(one.results[0].pose.pose), camera, name) < 0.006
            ),
            "what is tracked",
        )
        one = told()
        assert [each.hypothesis.class_id for each in one.results] == [name]
        assert abs(one.bbox.size.z - 0.1) < 0.01  # a can is 10 cm high
        # the scene has not been asked
        (known,) = [
            one for one in running.node.scene.objects if one.number == can.number
        ]
        np.testing.assert_allclose(known.pose, before, atol=1e-6)

        camera.change(without(camera.table, name))
        robot.looks_new += 1
        until(lambda: is_missing(robot, can.number), "the loss of the can")
        robot.objects.clear()
        heard = robot.hears("tracked", robot.heard["tracked"])
        robot.hears("tracked", heard)
        assert called not in robot.objects
        assert any("cracker_box" in each for each in robot.objects)

        # a look notices by itself where it is now
        camera.change(shifted(full, name, [0.0, 0.11]))
        robot.looks_new += 1
        robot.pose = view(110)
        until(lambda: "2 views" in robot.look().message, "a look from there")
        until(
            lambda: (
                called in robot.objects
                and off(robot.objects[called], camera, name) < 0.006
            ),
            "the can",
        )
    finally:
        camera.change(full)
        robot.looks_new += 1


def is_missing(robot, number):
    """Whether a thing is not tracked any more."""
    return str(number) not in [one.id for one in robot.heard["tracked"].detections]


def test_a_thing_that_is_learned_gets_its_name_in_the_frames_so_far(
    robot, mine, camera, ycb_meshes, tmp_path
):
    _, result = robot.goal(LookUntilSettled, max_views=1)
    assert "a goal is active" in robot.learn(path="any").message
    assert robot.look().success
    assert "unknown" in {one.name for one in wait(result).result.objects}
    heard = robot.hears("detections")

    scan = write_scan(ycb_meshes[STRANGER], tmp_path)
    answer = robot.learn(path=str(tmp_path / "none.ply"), unit="m")
    assert not answer.success
    assert "there is no such file" in answer.message
    answer = robot.learn(path=str(scan), name="cup", unit="m")
    assert answer.success, answer.message
    assert "3 things learned" in answer.message
    assert set(nextview.load(mine).classes) == {*TAUGHT, "cup"}

    results = {
        one.results[0].hypothesis.class_id: one.results[0].pose.pose
        for one in robot.hears("detections", heard).detections
        if one.results
    }
    assert set(results) == {*TAUGHT, "cup"}
    assert is_in_place(camera, STRANGER, matrix_of(results["cup"]))
    answer = robot.learn(path=str(scan), name="cup", unit="m")
    assert "is known already" in answer.message


def test_two_cameras_look_at_one_scene(running, mine, camera, see, intrinsics):
    """The pose of one of them errs by 8 mm."""
    poses = {"left": view(20), "right": view(140)}
    pair = running.add(Robot(see, intrinsics, poses, namespace="/pair"))

    def erring(image, info, transform):
        if "right" in image.header.frame_id:
            transform.transform.translation.z += 0.008
        return image, info, transform

    pair.change = erring
    node = running.add(
        node_with("/pair", models=[str(mine)], cameras=["left", "right"], patience=10.0)
    )
    until(
        lambda: all(isinstance(one, Frame) for one in node.frames()),
        "a frame of each camera",
    )
    answer = pair.look()
    assert answer.success, answer.message
    assert answer.message.startswith("2 views")
    assert "camera right is " in answer.message
    assert "relative to camera left" in answer.message
    left, right = node.scene.frames
    assert (left.camera, right.camera) == ("left", "right")
    np.testing.assert_allclose(left.pose, view(20), atol=1e-6)
    np.testing.assert_allclose(right.pose[2, 3] - view(140)[2, 3], 0.008, atol=1e-6)
    until(lambda: "detections" in pair.heard, "detections")
    for thing in node.scene.objects:
        if thing.name in TAUGHT:
            assert set(thing.pixels) == {0, 1}
            assert is_in_place(camera, thing.name, thing.pose)

    # one of them is covered, the other one still counts
    pair.poses = {"left": view(80), "right": view(80)}
    pair.change = lambda image, info, transform: (
        (None if "right" in image.header.frame_id else image),
        info,
        transform,
    )
    time.sleep(0.5)
    answer = pair.look()
    assert answer.success, answer.message
    assert answer.message.startswith("3 views")
    assert "no depth image with its camera_info came on right" in answer.message


# Recordings


@pytest.fixture(scope="module")
def bag(see, intrinsics, tmp_path_factory):
    """A bag of two seconds, with two poses of the camera."""
    messages = []
    for k in range(20):
        pose = view(20 if k < 10 else 110)
        time = 100 + k / 10
        depth = see(pose)
        image = at(image_message(depth, "16UC1"), time)
        info = at(info_message(intrinsics, depth.shape), time)
        there = transform_message(pose, "optical", time, "base_link")
        messages += [
            ("/tf", time, tf_message(there)),
            (CAMERA_INFO, time, info),
            (DEPTH, time, image),
        ]
    return write_bag(tmp_path_factory.mktemp("bags") / "table", messages)


def is_done(node):
    """Whether a node has looked, and its scene is done."""
    return node.scene is not None and node.scene.done


def test_a_recording_is_played_as_a_camera(running, mine, bag):
    given = [Parameter("camera", value="/played/depth")]
    source = RecordedFrames(bag)
    running.add(PlayerNode(source, namespace="/played", parameter_overrides=given))
    node = running.add(
        node_with(
            "/played",
            models=[str(mine)],
            cameras=["depth"],
            image="image_rect_raw",
            period=0.5,
            max_views=2,
        )
    )
    until(lambda: is_done(node), "the end of the looks")
    assert {thing.name for thing in node.scene.objects} >= set(TAUGHT)
    seen = [frame.camera_to_world for frame in node.scene.frames]
    for pose in seen:
        true = min((view(20), view(110)), key=lambda one: np.abs(one - pose).max())
        np.testing.assert_allclose(pose, true, atol=1e-6)


# The page


def commands_of(page, heading):
    """The commands of the sh blocks below a heading."""
    section = page.read_text().split(f"## {heading}\n")[1].split("\n## ")[0]
    blocks = re.findall(r"```sh\n(.*?)```", section, re.DOTALL)
    return [shlex.split(line, comments=True) for line in "".join(blocks).splitlines()]


def test_the_first_steps_of_the_page_run_as_they_are_written(tmp_path):
    """Launch file, stand-in for the robot, goal, topics: each in a process of its own."""
    page = Path(__file__).parents[1] / "docs" / "ros2.md"
    commands = [words for words in commands_of(page, "A table in ten minutes") if words]
    prefix = Path(sys.prefix)
    env = os.environ | {
        "AMENT_PREFIX_PATH": str(prefix),
        "PATH": f"{prefix / 'bin'}{os.pathsep}{os.environ['PATH']}",
        "ROS_DOMAIN_ID": str(int(os.environ["ROS_DOMAIN_ID"]) + 100),
        "ROS_LOG_DIR": str(tmp_path),
    }
    said = []
    with ExitStack() as running:
        # the commands share a daemon, which would go on for two hours
        running.callback(subprocess.run, ["ros2", "daemon", "stop"], env=env)
        for words in commands:
            assert words[0] == "ros2"
            if words[1] in ("launch", "run"):
                process = subprocess.Popen(words, env=env, start_new_session=True)
                running.callback(process.wait)
                running.callback(os.killpg, process.pid, signal.SIGINT)
                continue
            done = subprocess.run(
                words, env=env, capture_output=True, text=True, timeout=300
            )
            assert done.returncode == 0, done.stderr
            said.append(done.stdout)
    goal, detections, *_ = said
    assert "Goal finished with status: SUCCEEDED" in goal
    assert "done: true" in goal
    assert "class_id: cracker_box" in detections
