"""The node: one action, two services, and topics of what is found and of where to look next.

What is computed is in nextview's session; messages are read in ``inputs`` and ``conversion``, and
written in ``outputs``.
"""

from __future__ import annotations

import math
import sys
import threading
from dataclasses import replace
from functools import partial

import rclpy
from geometry_msgs.msg import PoseArray, PoseStamped
from nextview_msgs.action import Recognise
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header
from std_srvs.srv import Trigger

import nextview
from nextview.captured.messages import seconds
from nextview.recognition.belief import Stopping
from nextview.recognition.protocol import JudgesTogether
from nextview.sensing import ObservedObject
from nextview_ros.conversion import fill_pose, frame_at
from nextview_ros.inputs import CameraPoses, Pairs
from nextview_ros.outputs import Detection3DArray, detections, pose_array, ranked_poses

PARAMETERS = {
    "models": "modelnet10",
    "policy": "",
    "threshold": 0.97,
    "max_views": 5,
    "world_frame": "base_link",
    "poses": "tf",  # where the camera's poses come from; see ``inputs.CameraPoses``
    "rectified": True,
    "axes": "opencv",
    "life_size": False,
    "min_height": math.nan,  # metres; where it is NaN the limit is that of nextview's sessions
    "max_height": math.nan,
    "clearance": math.nan,
    "patience": 2.0,  # seconds to wait for an image that was taken after a look was asked for
}

# The action and a look each wait in one, while messages are taken in: rclpy's default, one for each
# core, is too few on two cores.
THREADS = 8


class RecogniseNode(Node):
    """Offers the action recognise, and the services look and failed for whoever moves the
    camera.

    Args:
        options: of rclpy's ``Node``, such as ``parameter_overrides``.
    """

    def __init__(self, **options) -> None:
        super().__init__("nextview", **options)
        for name, value in PARAMETERS.items():
            self.declare_parameter(name, value)
        self.system = nextview.load(
            self.value("models"),
            self.value("policy") or None,
            self.value("threshold"),
            max_views=self.value("max_views"),
        )
        self.session, self.goal, self.taken = None, None, False
        self.busy, self.ended, self.arrived = (
            threading.Lock(),
            threading.Event(),
            threading.Condition(),
        )
        # set while no accepted goal waits for its session
        self.begun = threading.Event()
        self.latest = None
        group = ReentrantCallbackGroup()
        self.poses = CameraPoses(
            self,
            self.value("poses"),
            self.value("world_frame"),
            group,
        )
        self.pairs = Pairs(self.keep)
        for kind, topic, name in (
            (Image, "depth", "image"),
            (CameraInfo, "camera_info", "info"),
        ):
            take = partial(self.pairs.take, name)
            self.create_subscription(
                kind,
                topic,
                take,
                qos_profile_sensor_data,
                callback_group=group,
            )

        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.next_pose = self.create_publisher(PoseStamped, "next_pose", latched)
        self.next_poses = self.create_publisher(PoseArray, "next_poses", latched)
        self.detections = None
        if Detection3DArray is not None:
            self.detections = self.create_publisher(
                Detection3DArray,
                "detections",
                latched,
            )

        self.create_service(Trigger, "look", self.look, callback_group=group)
        self.create_service(Trigger, "failed", self.failed, callback_group=group)
        self.server = ActionServer(
            self,
            Recognise,
            "recognise",
            self.execute,
            callback_group=group,
            goal_callback=self.accept,
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
        )

    def value(self, name: str):
        """A parameter."""
        return self.get_parameter(name).value

    def limit(self, name: str) -> float | None:
        """A limit of the views that are asked for, metres; None for the usual one."""
        given = self.value(name)
        return None if math.isnan(given) else given

    # Images

    def keep(self, image: Image, info: CameraInfo) -> None:
        """The latest image and its camera_info."""
        with self.arrived:
            self.latest = image, info
            self.arrived.notify_all()

    def frame(self):
        """A frame that was taken from now on. Earlier ones may have been taken on the way."""
        now = seconds(self.get_clock().now().to_msg())
        patience = self.value("patience")
        with self.arrived:
            fresh = self.arrived.wait_for(
                lambda: (
                    self.latest is not None
                    and seconds(self.latest[0].header.stamp) >= now
                ),
                patience,
            )
            latest = self.latest
        if not fresh:
            why = (
                self.pairs.missing()
                if latest is None
                else "the images are older than the look"
            )
            raise nextview.ObservationError(
                f"no depth image with its camera_info came within {patience} s: {why}"
            )
        image, info = latest
        header = image.header
        pose = self.poses.at(header.frame_id, seconds(header.stamp), patience)
        return frame_at(image, info, pose, self.value("rectified"), self.value("axes"))

    # The action

    def accept(self, request: Recognise.Goal) -> GoalResponse:
        """One object at a time."""
        if self.taken:
            return GoalResponse.REJECT
        self.taken = True
        self.begun.clear()
        return GoalResponse.ACCEPT

    def execute(self, goal) -> Recognise.Result:
        """Begin a session, and wait until looks have ended it."""
        self.ended.clear()
        try:
            session = self.begin(goal.request)
            with self.busy:
                self.session, self.goal = session, goal
            self.begun.set()
            while (
                not self.ended.wait(0.1) and not goal.is_cancel_requested and rclpy.ok()
            ):
                pass
        except nextview.NextviewError as error:
            self.get_logger().error(str(error))
            goal.abort()
            return without_answer(str(error))
        finally:
            with self.busy:
                self.session, self.goal, self.taken = None, None, False
            self.begun.set()
        if not session.done:
            goal.canceled() if goal.is_cancel_requested else goal.abort()
            return without_answer(
                f"ended after {len(session.views)} views, before it was sure"
            )
        goal.succeed()
        found = session.result
        if self.detections is not None:
            self.detections.publish(detections(found, self.header()))
        return Recognise.Result(
            answer=found.answer or "",
            confidence=found.confidence,
            confident=found.confident,
            stranded=found.stranded,
            classes=list(found.classes),
            belief=found.views[-1].belief.tolist(),
            views=len(found.views),
            pose=self.pose_of(found),
            pose_of=found.pose_of or "",
            pose_degrees=0.0
            if found.pose_uncertainty is None
            else found.pose_uncertainty.degrees,
            pose_millimetres=0.0
            if found.pose_uncertainty is None
            else found.pose_uncertainty.millimetres,
            message=str(found),
        )

    def header(self) -> Header:
        """That of a message in the world's frame, of now."""
        return Header(
            frame_id=self.value("world_frame"),
            stamp=self.get_clock().now().to_msg(),
        )

    def pose_of(self, found: nextview.Recognition) -> PoseStamped:
        """Where the thing is that was named; an empty message where that is not known."""
        message = PoseStamped()
        if found.pose is not None:
            message.header = self.header()
            fill_pose(message.pose, found.pose)
        return message

    def begin(self, asked: Recognise.Goal) -> nextview.Session:
        """A session for a goal; what it leaves at zero is the node's."""
        threshold, max_views = (
            asked.threshold or self.value("threshold"),
            asked.max_views or self.value("max_views"),
        )
        stopping = Stopping.of(
            self.system.models.recogniser.calibration,
            threshold,
            max_views=max_views,
        )
        near = [[point.x, point.y, point.z] for point in asked.near]
        # Things are as large as they were taught, and known by it.
        life_size = self.value("life_size") or isinstance(
            self.system.models.recogniser,
            JudgesTogether,
        )
        thing = ObservedObject(point=near[0] if near else None, life_size=life_size)
        limits = {
            name: self.limit(name) for name in ("min_height", "max_height", "clearance")
        }
        return replace(self.system, stopping=stopping).session(
            object=thing,
            distance=asked.distance or None,
            **limits,
        )

    # The services

    def look(
        self,
        request: Trigger.Request,
        response: Trigger.Response,
    ) -> Trigger.Response:
        """The camera stands where it was asked to be, or for the first view anywhere: take in
        what it sees.
        """
        return self.answer(response, lambda session: session.update(self.frame()))

    def failed(
        self,
        request: Trigger.Request,
        response: Trigger.Response,
    ) -> Trigger.Response:
        """The camera cannot be brought to the pose that was asked for."""
        return self.answer(response, give_up)

    def answer(self, response: Trigger.Response, act) -> Trigger.Response:
        """Do something with the session, and tell what follows."""
        # Whoever sends a goal may call before its session has begun.
        if self.taken:
            self.begun.wait(self.value("patience"))
        with self.busy:
            if self.session is None or self.session.done:
                response.success, response.message = False, "no goal is active"
                return response
            try:
                act(self.session)
                response.success, response.message = True, self.tell()
            except nextview.NextviewError as error:
                response.success, response.message = False, str(error)
        return response

    def tell(self) -> str:
        """Publish the next pose and the feedback; what was said in words."""
        session, feedback = self.session, Recognise.Feedback()
        feedback.views, feedback.classes = (
            len(session.views),
            list(session.models.classes),
        )
        if session.views:
            feedback.belief = session.views[-1].belief.tolist()
            feedback.warnings = [
                warning.message for warning in session.views[-1].warnings
            ]
        if not session.done:
            target = feedback.next_pose
            target.header = self.header()
            fill_pose(target.pose, session.target, self.value("axes"))
            self.next_pose.publish(target)
        ranked = pose_array(ranked_poses(session), self.header(), self.value("axes"))
        self.next_poses.publish(ranked)
        self.goal.publish_feedback(feedback)
        if session.done:
            self.ended.set()
            return str(session.result)
        return f"view {len(session.views)} is taken in"


def without_answer(why: str) -> Recognise.Result:
    """The result of a goal that was given up, and why."""
    result = Recognise.Result()
    result.message = why
    return result


def give_up(session: nextview.Session) -> None:
    """Tell a session that the pose that it asked for cannot be reached; before the first look it
    has asked for none.
    """
    if not session.views:
        raise nextview.SessionError(
            "no pose was asked for yet: bring the camera anywhere before the object, and call look"
        )
    session.failed()


def main() -> None:
    """Run the node."""
    rclpy.init()
    try:
        node = RecogniseNode()
    except nextview.NextviewError as error:
        print(f"nextview: {error}", file=sys.stderr)
        rclpy.try_shutdown()
        raise SystemExit(2) from None
    try:
        rclpy.spin(node, MultiThreadedExecutor(THREADS))
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
