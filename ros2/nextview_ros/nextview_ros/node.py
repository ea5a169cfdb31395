"""The node: topics of what a scene holds, two actions, and services for whoever moves the camera.

What is computed is in ``nextview.Scene`` and ``nextview.Session``. Messages are read in ``inputs``
and ``conversion``, and written in ``outputs``.
"""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Callable, Sequence
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
from nextview_ros.conversion import box_of, frame_at, labels_of
from nextview_ros.following import Follower
from nextview_ros.inputs import DepthCamera, Transforms
from nextview_ros.labels import LabelledFrames
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
    tracked_detections,
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
        self.asked: LookUntilSettled.Goal | None = (
            None  # of the scene; None without a goal
        )
        self.segmentation = LabelledFrames()
        # begun by the first look or goal: models of classes alone have none
        self.scene: nextview.Scene | None = None
        self.session: nextview.Session | None = None
        # of the object, or the labels of all things, in the next image of the first camera
        self.mask = self.labels = None
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
        self.follower = Follower(self.cameras, partial(self.frame_of, patience=0.0))
        self.followed_at = -math.inf  # seconds, when an image was followed last
        self.publish()
        self.serve(group)

    def publish(self) -> None:
        """Create the publishers."""
        self.next_pose = self.create_publisher(PoseStamped, "next_pose", LATCHED)
        self.next_poses = self.create_publisher(PoseArray, "next_poses", LATCHED)
        self.tf = self.create_publisher(TFMessage, "/tf", 100)
        self.detections = self.tracked = self.planning_scene = None
        if Detection3DArray is None:
            self.get_logger().info(
                "vision_msgs is not installed: no topics detections and tracked"
            )
        else:
            self.detections = self.create_publisher(
                Detection3DArray,
                "detections",
                LATCHED,
            )
            self.tracked = self.create_publisher(Detection3DArray, "tracked", 10)
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
        period = self.value("period")
        for rate, repeat in (
            (1 / period if period else 0.0, self.look_by_itself),
            (self.value("tf_rate"), self.tell_tf),
            (self.value("track_rate"), self.track),
        ):
            if rate:
                alone = MutuallyExclusiveCallbackGroup()
                self.create_timer(1 / rate, repeat, callback_group=alone)

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

    def header(self, stamp: Any = None) -> Header:
        """That of a message in the world's frame, of a time; now by default."""
        stamp = stamp or self.get_clock().now().to_msg()
        return Header(frame_id=self.value("world_frame"), stamp=stamp)

    # Frames

    def frames(self) -> list[Frame | NextviewError]:
        """A frame of each camera that was taken from now on, or why there is none.

        Earlier images may have been taken on the way. All are the latest ones when all have come,
        so that they are of one time.

        Raises:
            ObservationError: a mask or labels are for a frame that the first camera has not given.
        """
        now = seconds(self.get_clock().now().to_msg())
        patience = self.value("patience")
        come: list[NextviewError | None] = []
        for camera in self.cameras:
            try:
                camera.image_after(now, patience)
                come.append(None)
            except NextviewError as error:
                come.append(error)
        if come[0] is not None and not (self.mask is None and self.labels is None):
            raise come[0]

        found: list[Frame | NextviewError] = []
        for number, (camera, error) in enumerate(zip(self.cameras, come, strict=True)):
            if error is not None:
                found.append(error)
                continue
            mask = self.mask if number == 0 else None
            image, info = camera.latest
            self.seen_at = image.header.stamp
            try:
                found.append(self.frame_of(camera, image, info, patience, mask))
            except NextviewError as error:
                if number == 0 and not (self.mask is None and self.labels is None):
                    raise
                found.append(error)
        return found

    def frame_of(
        self,
        camera: DepthCamera,
        image: Any,
        info: Any,
        patience: float,
        mask: Any = None,
    ) -> Frame:
        """The frame of an image of a camera.

        Args:
            camera: that took it.
            image: its depth image.
            info: its camera_info.
            patience: seconds to wait for its transform.
            mask: image of the object's pixels in it; None for none.
        """
        pose = self.transforms.pose(
            image.header.frame_id,
            self.value("world_frame"),
            seconds(image.header.stamp),
            patience,
        )
        named = len(self.cameras) > 1 or self.value("standing")
        return frame_at(
            image,
            info,
            pose,
            self.value("rectified"),
            self.value("axes"),
            mask,
            camera.namespace if named else "",
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
        begun = self.session or self.scene
        if (begun is not None and begun.done) or not self.begun.is_set():
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
            ModelError: a scene is looked at, and the models have no geometry.
            ObservationError: no frame can be used.
            SessionError: the goal has ended.
        """
        if self.session is not None and self.session.done:
            raise SessionError("the goal has ended")
        if self.session is None and self.scene is None:
            self.scene = self.new_scene(None)
            self.follower.begin(self.scene)
        found = self.frames()
        since = self.follower.things
        frames = [one for one in found if isinstance(one, Frame)]
        said = [str(one) for one in found if not isinstance(one, Frame)]
        if self.labels is not None:
            self.segmentation.add(frames[0], self.labels)
        taken, warned = self.take_in(frames)
        said += warned
        if not taken:
            raise ObservationError("; ".join(said))
        self.mask = self.labels = None
        if self.session is None:
            self.follower.look_taken(since)
        return "; ".join([self.in_words(), *said])

    def take_in(self, frames: Sequence[Frame]) -> tuple[int, list[str]]:
        """Take in frames of one time, together if all of them can be used.

        Returns:
            The number of frames that were used, and what is likely to be wrong, in words.
        """
        try:
            if self.session is not None:
                done = self.session.done or not frames
                return (0 if done else len(self.session.update(frames))), []
            looks = self.scene.update(frames)
        except NextviewError as error:
            if len(frames) == 1:
                return 0, [str(error)]
            alone = [self.take_in([frame]) for frame in frames]
            said = [sentence for _, sentences in alone for sentence in sentences]
            return sum(taken for taken, _ in alone), said
        warnings = [warning.message for look in looks for warning in look.warnings]
        return sum(look.taken for look in looks), list(dict.fromkeys(warnings))

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
        if self.session is None and self.scene is not None:
            self.scene.failed()
            return "another pose is asked for"
        if self.session is None or not self.session.views:
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
        """Publish the poses of the objects with a confident name, unless images tell them."""
        now = seconds(self.get_clock().now().to_msg())
        if 0 <= now - self.followed_at < self.value("patience"):
            return
        if self.value("track_rate") or self.scene is None:
            things = self.follower.found
        else:
            things = [
                thing
                for thing in self.scene.objects
                if thing.confident and thing.pose is not None
            ]
        if things:
            self.tf.publish(transforms_of(things, self.header()))

    def track(self) -> None:
        """Follow the objects with a confident name into the latest images, and publish them."""
        now = seconds(self.get_clock().now().to_msg())
        for step in self.follower.steps(now):
            if isinstance(step, NextviewError):
                said = f"an image is not followed: {step}"
                self.get_logger().warning(said, throttle_duration_sec=10.0)
                continue
            self.followed_at = now
            header = self.header(step)
            things = self.follower.found
            if things and self.value("tf_rate"):
                self.tf.publish(transforms_of(things, header))
            if self.tracked is not None:
                told = tracked_detections(things, self.scene.objects, header)
                self.tracked.publish(told)

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
                self.session = self.goal = self.mask = self.labels = None
                self.taken = False
            self.begun.set()

    def begin_scene(self, asked: LookUntilSettled.Goal) -> None:
        """Forget the scene, and begin one as a goal asks for."""
        labels = labels_of(asked.labels[0]) if asked.labels else None
        self.segmentation = LabelledFrames()
        self.scene = self.new_scene(asked)
        self.asked, self.labels = asked, labels
        self.follower.begin(self.scene)

    def new_scene(self, asked: LookUntilSettled.Goal | None) -> nextview.Scene:
        """A scene without frames as a goal asks for, or as without one."""
        if asked is None:
            return nextview.Scene(self.system)
        return nextview.Scene(
            replace(self.system, stopping=self.stopping(0.0, asked.max_views)),
            region=box_of(asked.region[0]) if asked.region else None,
            distance=asked.distance or None,
            segmentation=self.segmentation,
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
                frames = () if self.scene is None else self.scene.frames
                self.scene = self.new_scene(self.asked)
                for frame in frames:
                    self.scene.update(frame)
                self.follower.begin(self.scene)
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
