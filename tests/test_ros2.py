"""The ROS 2 package: what it makes of messages that a bag has recorded.

ROS itself is not here; ``rosbags`` is.
"""

import ast
import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from factories import pose_at
from ros_messages import (
    SHAPE,
    STORE,
    header,
    image_message,
    info_message,
    message,
    roi,
    transform_message,
)
from rosbags.rosbag2 import Reader, Writer
from scipy.spatial.transform import Rotation

import nextview
from nextview.errors import ObservationError

ROS = Path(__file__).parents[1] / "ros2"
sys.path.insert(0, str(ROS / "nextview_ros"))
from nextview_ros import conversion

ROS_MODULES = """
geometry_msgs geometry_msgs.msg moveit_msgs moveit_msgs.msg nextview_msgs
nextview_msgs.action nextview_msgs.msg nextview_msgs.srv rcl_interfaces
rcl_interfaces.msg rclpy rclpy.action rclpy.callback_groups rclpy.executors
rclpy.node rclpy.qos sensor_msgs sensor_msgs.msg shape_msgs shape_msgs.msg
std_srvs std_srvs.srv std_msgs std_msgs.msg tf2_msgs tf2_msgs.msg vision_msgs
vision_msgs.msg
"""
"""What the node imports from ROS."""


def recorded(folder, views):
    """Messages by topic as they come out of a bag into which they were written: (image, info,
    transform) of each.
    """
    topics = {
        "depth": "sensor_msgs/msg/Image",
        "camera_info": "sensor_msgs/msg/CameraInfo",
        "tf": "tf2_msgs/msg/TFMessage",
    }
    with Writer(folder, version=9) as bag:
        connections = {
            topic: bag.add_connection(topic, kind, typestore=STORE)
            for topic, kind in topics.items()
        }
        for k, (image, info, transform) in enumerate(views):
            for topic, what in (
                ("depth", image),
                ("camera_info", info),
                ("tf", [transform]),
            ):
                what = (
                    message("tf2_msgs/msg/TFMessage", transforms=what)
                    if topic == "tf"
                    else what
                )
                bag.write(
                    connections[topic], k, STORE.serialize_cdr(what, topics[topic])
                )
    found = {topic: [] for topic in topics}
    with Reader(folder) as bag:
        for connection, _, data in bag.messages():
            found[connection.topic].append(
                STORE.deserialize_cdr(data, connection.msgtype)
            )
    return list(
        zip(
            found["depth"],
            found["camera_info"],
            [tf.transforms[0] for tf in found["tf"]],
            strict=True,
        )
    )


@pytest.fixture(scope="module")
def depth():
    rng = np.random.default_rng(0)
    return np.where(rng.random(SHAPE) < 0.1, 0, rng.uniform(0.4, 2.0, SHAPE)).astype(
        np.float32
    )


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("padding", [0, 12])
@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_a_recorded_image_equals_the_camera_image(
    tmp_path, depth, encoding, padding, big
):
    pose = pose_at(40, 70, 0.7, (0.4, 0.1, 0.0), turn=(3, -2, 5))
    given = (
        np.rint(1000 * depth).astype(np.uint16)
        if encoding == "16UC1"
        else np.where(depth > 0, depth, np.nan)
    )
    written = (
        image_message(given, encoding, big, padding),
        info_message(),
        transform_message(pose),
    )
    ((image, info, transform),) = recorded(tmp_path / "bag", [written])
    frame = conversion.frame_of(image, info, transform)
    np.testing.assert_allclose(
        frame.depth, depth, atol=6e-4 if encoding == "16UC1" else 0
    )
    np.testing.assert_allclose(frame.pose, pose, atol=1e-9)
    # the first pixel's centre is at 0.5 here
    np.testing.assert_allclose(frame.intrinsics[:2, 2], [80, 60])


def test_rectified_images_have_the_intrinsics_of_p():
    p = np.array([[250.0, 0, 81, -12.0], [0, 250, 61, 0], [0, 0, 1, 0]])
    info = info_message(d=(0.1, -0.2, 0, 0, 0), p=p)
    np.testing.assert_array_equal(
        conversion.intrinsics_of(info, rectified=True), p[:, :3]
    )
    with pytest.raises(
        ObservationError, match=r"distorts \(plumb_bob\): use rectified images"
    ):
        conversion.intrinsics_of(info)


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"image": {"encoding": "rgb8"}}, "not 'rgb8': a colour topic"),
        ({"info": {"width": 320}}, "its camera_info 320 x 120"),
        ({"info": {"roi": roi(8)}}, "binned or cropped"),
        ({"info": {"k": np.zeros(9)}}, "not calibrated: k of camera_info is zero"),
        (
            {"info": {"header": header("depth_link")}},
            "frames differ: 'optical' of the image, 'depth_link'",
        ),
        ({"info": {"header": header("optical", 12.6)}}, "0.100 s apart"),
        (
            {"transform": {"child_frame_id": "base_link"}},
            "'base_link' of the transform",
        ),
        ({"transform": {"header": header("world", 11.5)}}, "1.000 s apart"),
    ],
)
def test_messages_that_cannot_be_used_are_refused(depth, wrong, match):
    made = {
        "image": image_message(depth, "32FC1"),
        "info": info_message(),
        "transform": transform_message(np.eye(4)),
    }
    made |= {name: replace(made[name], **fields) for name, fields in wrong.items()}
    with pytest.raises(ObservationError, match=match):
        conversion.frame_of(**made)


# What the node tells of an object, with stand-ins for the messages


def pose_message(**fields):
    """An object with the fields of a ``geometry_msgs/Pose``."""
    place = SimpleNamespace(x=0.0, y=0.0, z=0.0)
    turn = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    return SimpleNamespace(position=place, orientation=turn, **fields)


def matrix_of(told):
    turn = told.orientation
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    pose[:3, 3] = told.position.x, told.position.y, told.position.z
    return pose


@pytest.fixture
def outputs(monkeypatch):
    """The module that makes the messages, with objects that have their fields."""

    def detection(header, id):
        sizes = SimpleNamespace(x=0.0, y=0.0, z=0.0)
        bbox = SimpleNamespace(center=pose_message(), size=sizes)
        return SimpleNamespace(header=header, id=id, results=[], bbox=bbox)

    def hypothesis():
        told = SimpleNamespace(pose=pose_message(), covariance=np.zeros(36))
        return SimpleNamespace(
            hypothesis=SimpleNamespace(class_id="", score=0.0), pose=told
        )

    for name in ROS_MODULES.split():
        monkeypatch.setitem(sys.modules, name, MagicMock())
    stand_ins = {
        "geometry_msgs": {
            "Point": SimpleNamespace,
            "Pose": pose_message,
            "PoseArray": SimpleNamespace,
        },
        "vision_msgs": {
            "Detection3D": detection,
            "Detection3DArray": SimpleNamespace,
            "ObjectHypothesisWithPose": hypothesis,
        },
    }
    for package, kinds in stand_ins.items():
        for kind, made in kinds.items():
            setattr(sys.modules[f"{package}.msg"], kind, made)
    monkeypatch.delitem(sys.modules, "nextview_ros.outputs", raising=False)
    yield importlib.import_module("nextview_ros.outputs")
    sys.modules.pop("nextview_ros.outputs", None)


def seen_at(centre, **fields):
    """What is known of an object of 5 cm around a place."""
    from_object = np.eye(4)
    from_object[:3, 3] = centre
    return SimpleNamespace(
        poses_in=SimpleNamespace(from_object=from_object),
        radius=0.05,
        beliefs={},
        **({"pose": None} | fields),
    )


def test_a_detection_holds_the_poses_of_scans_with_their_variances(outputs):
    poses = [np.eye(4), np.eye(4)]
    poses[0][:3, :3] = Rotation.from_euler(
        "xyz", [20, -35, 110], degrees=True
    ).as_matrix()
    poses[0][:3, 3] = 0.4, -0.1, 0.02  # the scan's origin, not its middle
    candidates = [
        SimpleNamespace(
            thing=name,
            probability=share,
            pose=pose,
            degrees=3.0,
            millimetres=6.0,
            vertices=np.array([[0.0, 0, 0], [0.1, 0.06, 0.2]]),
        )
        for name, share, pose in zip(("mug", "bowl"), (0.9, 0.1), poses, strict=True)
    ]
    unlikely = replace_in(candidates[1], thing="banana", probability=0.001)
    seen = seen_at(
        (0.41, -0.08, 0.07),
        answer="mug",
        pose=poses[0],
        pose_candidates=[*candidates, unlikely],
    )
    told = outputs.detection_of(seen, "world", "3")
    assert told.id == "3"
    assert [one.hypothesis.class_id for one in told.results] == ["mug", "bowl"]
    assert [one.hypothesis.score for one in told.results] == [0.9, 0.1]
    for one, pose in zip(told.results, poses, strict=True):
        np.testing.assert_allclose(matrix_of(one.pose.pose), pose, atol=1e-9)
        variances = np.diag(one.pose.covariance.reshape(6, 6))
        assert np.sqrt(variances[:3].sum()) == pytest.approx(0.006)
        assert np.degrees(np.sqrt(variances[3:].sum())) == pytest.approx(3.0)
    box = told.bbox
    np.testing.assert_allclose([box.size.x, box.size.y, box.size.z], [0.1, 0.06, 0.2])
    corner = matrix_of(box.center) @ [-0.05, -0.03, -0.1, 1]
    np.testing.assert_allclose(corner[:3], poses[0][:3, 3], atol=1e-9)


def replace_in(what, **fields):
    return SimpleNamespace(**(vars(what) | fields))


# What cannot be run here is at least well formed


@pytest.mark.parametrize("path", sorted(ROS.rglob("*.py")), ids=lambda path: path.name)
def test_the_node_compiles_and_its_imports_from_nextview_exist(path):
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
            "nextview."
        ):
            module = __import__(node.module, fromlist=["_"])
            assert all(hasattr(module, name.name) for name in node.names)
        if (
            isinstance(node, ast.Attribute)
            and isinstance(node.value, ast.Name)
            and node.value.id == "nextview"
        ):
            assert hasattr(nextview, node.attr)
