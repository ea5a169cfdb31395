"""The node: topics of what a scene holds, two actions, and services for whoever moves the camera.

What is computed is in ``nextview.Scene`` and ``nextview.Session``. Messages are read in ``inputs``
and ``conversion``, and written in ``outputs``.
"""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import rclpy
from geometry_msgs.msg import PoseArray, PoseStamped
from nextview_msgs.action import LookUntilSettled, Recognise
from nextview_msgs.srv import Learn
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

import nextview
from nextview.captured.messages import seconds
from nextview.checks import number_of
from nextview.data.progress import silently
from nextview.errors import (
    DatasetError,
    NextviewError,
    ObservationError,
    SessionError,
    UsageError,
)
from nextview.recognition.belief import Stopping
from nextview.recognition.protocol import JudgesTogether
from nextview.sensing import ObservedObject
from nextview.sensing.frame import Frame
from nextview_ros.conversion import box_of, frame_at
from nextview_ros.inputs import DepthCamera, Transforms
from nextview_ros.outputs import (
    Detection3DArray,
    PlanningScene,
    detection_of,
    object_message,
    planning_scene,
    pose_array,
    pose_stamped,
    ranked_poses,
    scene_detections,
    transforms_of,
)
from nextview_ros.parameters import declare

# A goal and a look each wait in one, while messages are taken in: rclpy's default, one for each
# core, is too few on two cores.
THREADS = 8
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class NextviewNode(Node):
    """Names and locates the things in front of depth cameras.

    A look goes to the session of the goal ``recognise`` if one is active, otherwise to the scene.

    Args:
        **options: of rclpy's ``Node``, such as ``parameter_overrides``.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("nextview", **options)
        declare(self)
        self.system = self.load()
        self.scene = nextview.Scene(self.system)
        self.session: nextview.Session | None = None
        self.mask = None  # of the object in the next image of the first camera
        self.goal = None
        self.seen_at = self.get_clock().now().to_msg()
        self.in_planning_scene: set[str] = set()
        self.taken = False  # by a goal
        self.busy = threading.Lock()
        self.ended = threading.Event()
        self.begun = threading.Event()  # set while no accepted goal waits for its begin
        self.begun.set()

        group = ReentrantCallbackGroup()
        self.transforms = Transforms(self, group)
        self.cameras = [
            DepthCamera(self, namespace, self.value("image"), group)
            for namespace in self.value("cameras")
        ]
        self.publish()
        self.serve(group)

    def publish(self) -> None:
        """Create the publishers."""
        self.next_pose = self.create_publisher(PoseStamped, "next_pose", LATCHED)
        self.next_poses = self.create_publisher(PoseArray, "next_poses", LATCHED)
        self.tf = self.create_publisher(TFMessage, "/tf", 100)
        self.detections = self.planning_scene = None
        if Detection3DArray is None:
            self.get_logger().info("vision_msgs is not installed: no topic detections")
        else:
            self.detections = self.create_publisher(
                Detection3DArray,
                "detections",
                LATCHED,
            )
        if PlanningScene is None:
            self.get_logger().info(
                "moveit_msgs is not installed: no topic planning_scene"
            )
        else:
            self.planning_scene = self.create_publisher(
                PlanningScene,
                "planning_scene",
                LATCHED,
            )

    def serve(self, group: Any) -> None:
        """Create the services, the actions and the timers."""
        self.create_service(Trigger, "look", self.look, callback_group=group)
        self.create_service(Trigger, "failed", self.failed, callback_group=group)
        self.create_service(Learn, "learn", self.learn, callback_group=group)
        self.servers = [
            ActionServer(
                self,
                kind,
                name,
                partial(self.execute, kind=kind, begin=begin, result=result),
                callback_group=group,
                goal_callback=self.accept,
                cancel_callback=lambda goal: CancelResponse.ACCEPT,
            )
            for kind, name, begin, result in (
                (
                    LookUntilSettled,
                    "look_until_settled",
                    self.begin_scene,
                    self.scene_result,
                ),
                (Recognise, "recognise", self.begin_session, self.session_result),
            )
        ]
        for period, repeat in (
            (self.value("period"), self.look_by_itself),
            (1 / self.value("tf_rate") if self.value("tf_rate") else 0, self.tell_tf),
        ):
            if period:
                alone = MutuallyExclusiveCallbackGroup()
                self.create_timer(period, repeat, callback_group=alone)

    def value(self, name: str) -> Any:
        """A parameter."""
        return self.get_parameter(name).value

    def limit(self, name: str) -> float | None:
        """A limit of the views that are asked for, metres; None for the usual one."""
        given = self.value(name)
        return None if math.isnan(given) else given

    def load(self) -> nextview.System:
        """Open the models."""
        return nextview.load(
            self.value("models"),
            self.value("policy") or None,
            self.value("threshold"),
            max_views=self.value("max_views"),
        )

    def header(self) -> Header:
        """That of a message in the world's frame, of now."""
        now = self.get_clock().now().to_msg()
        return Header(frame_id=self.value("world_frame"), stamp=now)

    # Frames

    def frames(self) -> list[Frame | NextviewError]:
        """A frame of each camera that was taken from now on, or why there is none.

        Earlier images may have been taken on the way.
        """
        now = seconds(self.get_clock().now().to_msg())
        mask = self.mask
        found: list[Frame | NextviewError] = []
        for camera in self.cameras:
            try:
                found.append(self.frame(camera, now, mask))
            except NextviewError as error:
                found.append(error)
            mask = None
        return found

    def frame(self, camera: DepthCamera, start: float, mask: Any) -> Frame:
        """A frame of a camera that was taken after a time, seconds."""
        patience = self.value("patience")
        image, info = camera.image_after(start, patience)
        self.seen_at = image.header.stamp
        pose = self.transforms.pose(
            image.header.frame_id,
            self.value("world_frame"),
            seconds(image.header.stamp),
            patience,
        )
        return frame_at(
            image,
            info,
            pose,
            self.value("rectified"),
            self.value("axes"),
            mask,
        )

    # Looks

    def look(
        self,
        request: Trigger.Request,
        response: Trigger.Response,
    ) -> Trigger.Response:
        """The cameras stand still, where they were asked to be or anywhere: take in what they
        see.
        """
        return self.answer(response, self.take_look)

    def failed(
        self,
        request: Trigger.Request,
        response: Trigger.Response,
    ) -> Trigger.Response:
        """The camera cannot be brought to the pose that was asked for."""
        return self.answer(response, self.give_up)

    def look_by_itself(self) -> None:
        """Look without being asked, until the scene or the session is done."""
        if (self.session or self.scene).done or not self.begun.is_set():
            return
        said = self.look(None, Trigger.Response())
        log = self.get_logger()
        if said.success:
            log.info(said.message)
        else:
            log.warning(said.message, throttle_duration_sec=10.0)

    def answer(
        self,
        response: Trigger.Response,
        act: Callable[[], str],
    ) -> Trigger.Response:
        """Do something with the session or the scene, tell what follows, and answer."""
        # Whoever sends a goal may call before it has begun.
        self.begun.wait(self.value("patience"))
        with self.busy:
            try:
                said = act()
                self.tell()
                response.success, response.message = True, said
            except NextviewError as error:
                response.success, response.message = False, str(error)
        return response

    def take_look(self) -> str:
        """Take in a frame of each camera; what was seen, in words.

        Raises:
            ObservationError: no frame can be used.
            SessionError: the goal has ended.
        """
        if self.session is not None and self.session.done:
            raise SessionError("the goal has ended")
        taken = 0
        said = []
        for frame in self.frames():
            try:
                if isinstance(frame, NextviewError):
                    raise frame
                if self.session is None:
                    look = self.scene.update(frame)
                    taken += look.taken
                    said += [warning.message for warning in look.warnings]
                elif not self.session.done:
                    self.session.update(frame)
                    taken += 1
            except NextviewError as error:
                said.append(str(error))
        if not taken:
            raise ObservationError("; ".join(said))
        self.mask = None
        return "; ".join([self.in_words(), *said])

    def in_words(self) -> str:
        """What is known now."""
        if self.session is not None:
            if self.session.done:
                return str(self.session.result)
            return f"view {len(self.session.views)} is taken in"
        things = self.scene.objects
        views = number_of(len(self.scene.frames), "view")
        sure = sum(thing.confident for thing in things)
        return (
            f"{views}: {number_of(len(things), 'object')}, {sure} with a confident name"
        )

    def give_up(self) -> str:
        """Ask for another pose.

        Raises:
            SessionError: no pose was asked for yet, or the goal has ended.
        """
        if self.session is None:
            self.scene.failed()
            return "another pose is asked for"
        if not self.session.views:
            raise SessionError(
                "no pose was asked for yet: bring the camera anywhere before the object, and call"
                " look"
            )
        self.session.failed()
        return self.in_words()

    # What is told

    def tell(self) -> None:
        """Publish what is known and where to look next, and end the goal if nothing is open."""
        poses = self.next_views()
        header, axes = self.header(), self.value("axes")
        self.next_poses.publish(pose_array(poses, header, axes))
        if poses:
            self.next_pose.publish(pose_stamped(poses[0], header, axes))
        if self.session is None:
            self.tell_scene()
        if self.goal is not None:
            self.goal.publish_feedback(self.feedback(poses))
            if not poses:
                self.ended.set()

    def next_views(self) -> list[Any]:
        """Camera poses to look from next, the best first; none at the end of an episode."""
        if self.session is None:
            return [] if self.scene.done else list(self.scene.targets)
        if self.session.done:
            return []
        target = self.session.target
        others = [pose for pose in ranked_poses(self.session) if (pose != target).any()]
        return [target, *others]

    def tell_scene(self) -> None:
        """Publish the objects of the scene."""
        objects = self.scene.objects
        header = self.header()
        if self.planning_scene is not None:
            changes = planning_scene(objects, self.in_planning_scene, header)
            self.in_planning_scene = {
                one.id
                for one in changes.world.collision_objects
                if one.operation == one.ADD
            }
            self.planning_scene.publish(changes)
        if self.detections is not None:
            header.stamp = self.seen_at
            self.detections.publish(scene_detections(objects, header))

    def tell_tf(self) -> None:
        """Publish the poses of the objects with a confident name."""
        told = transforms_of(self.scene.objects, self.header())
        if told.transforms:
            self.tf.publish(told)

    def feedback(self, poses: list[Any]) -> Any:
        """The feedback of the goal."""
        header, axes = self.header(), self.value("axes")
        next_pose = pose_stamped(poses[0] if poses else None, header, axes)
        if self.session is None:
            return LookUntilSettled.Feedback(
                objects=[object_message(one, header) for one in self.scene.objects],
                views=len(self.scene.frames),
                next_pose=next_pose,
                warnings=[remark.message for remark in self.scene.remarks],
            )
        views = self.session.views
        last = views[-1] if views else None
        return Recognise.Feedback(
            views=len(views),
            classes=list(self.session.models.classes),
            belief=[] if last is None else last.belief.tolist(),
            next_pose=next_pose,
            warnings=[] if last is None else [one.message for one in last.warnings],
        )

    # The actions

    def accept(self, request: Any) -> GoalResponse:
        """One goal at a time."""
        if self.taken:
            return GoalResponse.REJECT
        self.taken = True
        self.begun.clear()
        return GoalResponse.ACCEPT

    def execute(
        self,
        goal: Any,
        kind: Any,
        begin: Callable[[Any], None],
        result: Callable[[], Any],
    ) -> Any:
        """Begin an episode, and wait until looks have ended it.

        Args:
            goal: its handle.
            kind: of the action.
            begin: begins what its request asks for.
            result: returns what was found.
        """
        self.ended.clear()
        try:
            with self.busy:
                begin(goal.request)
                self.goal = goal
            self.begun.set()
            while (
                not self.ended.wait(0.1) and not goal.is_cancel_requested and rclpy.ok()
            ):
                pass
            with self.busy:
                found = result()
                if self.ended.is_set():
                    goal.succeed()
                    return found
            goal.canceled() if goal.is_cancel_requested else goal.abort()
            found.message = f"ended too early: {found.message}"
            return found
        except NextviewError as error:
            self.get_logger().error(str(error))
            goal.abort()
            return kind.Result(message=str(error))
        finally:
            with self.busy:
                self.session = self.goal = self.mask = None
                self.taken = False
            self.begun.set()

    def begin_scene(self, asked: LookUntilSettled.Goal) -> None:
        """Forget the scene, and begin one as a goal asks for."""
        self.scene = nextview.Scene(
            replace(self.system, stopping=self.stopping(0.0, asked.max_views)),
            region=box_of(asked.region[0]) if asked.region else None,
            distance=asked.distance or None,
        )

    def scene_result(self) -> LookUntilSettled.Result:
        """What the scene holds."""
        header = self.header()
        return LookUntilSettled.Result(
            objects=[object_message(one, header) for one in self.scene.objects],
            done=self.scene.done,
            views=len(self.scene.frames),
            message=self.in_words(),
        )

    def begin_session(self, asked: Recognise.Goal) -> None:
        """Begin a session as a goal asks for; what it leaves at zero is the node's."""
        near = [[point.x, point.y, point.z] for point in asked.near]
        # Things are as large as they were taught, and known by it.
        life_size = self.value("life_size") or isinstance(
            self.system.models.recogniser,
            JudgesTogether,
        )
        thing = ObservedObject(
            point=near[0] if near else None,
            box=box_of(asked.region[0]) if asked.region else None,
            support=not asked.in_air,
            life_size=life_size,
        )
        stopping = self.stopping(asked.threshold, asked.max_views)
        self.session = replace(self.system, stopping=stopping).session(
            object=thing,
            distance=asked.distance or None,
            min_height=self.limit("min_height"),
            max_height=self.limit("max_height"),
            clearance=self.limit("clearance"),
            any_orientation=asked.any_orientation,
        )
        self.mask = asked.mask[0] if asked.mask else None

    def session_result(self) -> Recognise.Result:
        """What the session has recognised."""
        if not self.session.done:
            views = number_of(len(self.session.views), "view")
            return Recognise.Result(message=f"{views}, and it was not sure")
        found = self.session.result
        if self.detections is not None:
            header = self.header()
            header.stamp = self.seen_at
            told = [detection_of(found, header)]
            self.detections.publish(Detection3DArray(header=header, detections=told))
        uncertainty = found.pose_uncertainty
        return Recognise.Result(
            answer=found.answer or "",
            confidence=found.confidence,
            confident=found.confident,
            stranded=found.stranded,
            classes=list(found.classes),
            belief=found.views[-1].belief.tolist(),
            views=len(found.views),
            pose=pose_stamped(found.pose, self.header()),
            pose_of=found.pose_of or "",
            pose_degrees=0.0 if uncertainty is None else uncertainty.degrees,
            pose_millimetres=0.0 if uncertainty is None else uncertainty.millimetres,
            message=str(found),
        )

    def stopping(self, threshold: float, max_views: int) -> Stopping:
        """When an episode stops; the node's rule where a number is 0."""
        return Stopping.of(
            self.system.models.recogniser.calibration,
            threshold or self.value("threshold"),
            max_views=max_views or self.value("max_views"),
        )

    # Teaching

    def learn(self, request: Learn.Request, response: Learn.Response) -> Learn.Response:
        """Teach a thing, add it to the memory, and look at the frames of the scene again."""
        with self.busy:
            try:
                if self.taken:
                    raise SessionError("a goal is active: learn before or after it")
                response.message = self.add_to_memory(request)
                self.system = self.load()
                frames = self.scene.frames
                self.scene = nextview.Scene(self.system)
                for frame in frames:
                    self.scene.update(frame)
                if frames:
                    self.tell_scene()
                response.success = True
            except NextviewError as error:
                response.success, response.message = False, str(error)
        return response

    def add_to_memory(self, request: Learn.Request) -> str:
        """Teach a thing; what is known then, in words.

        Raises:
            DatasetError: there is nothing to be taught.
            UsageError: the name cannot be one, or is taken.
        """
        path = Path(request.path).expanduser()
        memory = Path(self.value("models")[-1])
        if not path.exists():
            raise DatasetError(f"{path}: there is no such file")
        if not memory.is_dir():
            raise UsageError(
                f"{memory}: is not the folder of a memory, so nothing can be added; the last one of"
                " the parameter models is that of the memory"
            )
        name = request.name or path.stem
        if Path(name).name != name:
            raise UsageError(f"{name!r} cannot be the name of a thing")
        with TemporaryDirectory() as folder:
            Path(folder, f"{name}{path.suffix}").symlink_to(path.resolve())
            learned = nextview.learn(
                folder,
                memory,
                add=True,
                unit=request.unit or None,
                workers=0,
                track=silently,
            )
        return str(learned)


def main() -> None:
    """Run the node."""
    rclpy.init()
    try:
        node = NextviewNode()
    except NextviewError as error:
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
