"""What the node tells, as messages: what the objects are and where, and where to look next."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, Pose, PoseArray, PoseStamped, TransformStamped
from nextview_msgs.msg import SceneObject as ObjectMessage
from shape_msgs.msg import Mesh, MeshTriangle
from tf2_msgs.msg import TFMessage

import nextview
from nextview.recognition.poses import PoseCandidate
from nextview.scene.body import Tracked
from nextview.scene.objects import SceneObject
from nextview.types import Float
from nextview.viewers.scene_shapes import placed_shape
from nextview_ros.conversion import fill_pose, fill_transform

try:
    from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesisWithPose
except ModuleNotFoundError:  # then there is no such topic
    Detection3DArray = None
try:
    from moveit_msgs.msg import CollisionObject, PlanningScene
except ModuleNotFoundError:  # then there is no such topic
    PlanningScene = None

ANY_TURN = np.pi**2 / 3  # variance of an angle of which nothing is known
LEAST_SCORE = 0.01  # hypotheses that are less likely are not told


# Where to look next


def ranked_poses(session: nextview.Session) -> list[Float]:
    """Camera poses that a session would look from next, the best first, camera-to-world, (4, 4).

    Where things of known geometry may be what is seen, by what a view would tell of them; else by
    what the policy values them at.
    """
    if session.done or not session.views:
        return []
    if session.outlook is not None:
        return [view.pose for view in session.ranked()]

    values = session.views[-1].values
    if values is None:
        return [session.target]
    taken = {view.index for view in session.views}
    left = [
        k
        for k in np.argsort(-values)
        if not (np.isnan(values[k]) or session.left_out[k] or k in taken)
    ]
    return [session.poses[k] for k in left]


def pose_array(poses: Sequence[Float], header: Any, axes: str) -> PoseArray:
    """Camera poses as a message."""
    return PoseArray(
        header=header,
        poses=[fill_pose(Pose(), pose, axes) for pose in poses],
    )


def pose_stamped(pose: Float | None, header: Any, axes: str = "opencv") -> PoseStamped:
    """A pose as a message; an empty one, without a frame, if it is None."""
    if pose is None:
        return PoseStamped()
    return PoseStamped(header=header, pose=fill_pose(Pose(), pose, axes))


# The objects of a scene


def called(thing: SceneObject | Tracked) -> str:
    """The name of an object as a tf frame and in a planning scene, such as mug_3."""
    return f"{thing.name}_{thing.number}"


def object_message(thing: SceneObject, header: Any) -> ObjectMessage:
    """An object as a message.

    Args:
        thing: of a scene.
        header: of the world's frame.
    """
    message = ObjectMessage(
        number=thing.number,
        name=thing.name,
        confidence=thing.confidence,
        confident=thing.confident,
        settled=thing.settled,
        pose=pose_stamped(thing.pose, header),
        place=_point(thing.place),
        doubt=thing.doubt,
    )
    if thing.pose_uncertainty is not None:
        message.pose_degrees = thing.pose_uncertainty.degrees
        message.pose_millimetres = thing.pose_uncertainty.millimetres
    message.size.x, message.size.y, message.size.z = map(float, thing.size)
    return message


def transforms_of(
    things: Sequence[SceneObject | Tracked],
    header: Any,
) -> TFMessage:
    """The poses of things, which have one, as transforms from the world."""
    return TFMessage(transforms=[_transform(thing, header) for thing in things])


def _transform(thing: SceneObject | Tracked, header: Any) -> TransformStamped:
    message = TransformStamped(header=header, child_frame_id=called(thing))
    fill_transform(message.transform, thing.pose)
    return message


def planning_scene(
    objects: Sequence[SceneObject],
    before: Collection[str],
    header: Any,
) -> Any:
    """A ``moveit_msgs/PlanningScene`` with the changes: objects to add, and those to remove.

    The shape of a named thing is its scan, that of an unknown object the hull of the visible
    points. An object whose visible points have no volume is left out.

    Args:
        objects: of the scene.
        before: names of the objects that are in the planning scene.
        header: of the world's frame.
    """
    message = PlanningScene(is_diff=True)
    message.robot_state.is_diff = True
    added = [
        _collision_object(thing, header)
        for thing in objects
        if placed_shape(thing) is not None
    ]
    left = set(before) - {one.id for one in added}
    removed = [
        CollisionObject(header=header, id=name, operation=CollisionObject.REMOVE)
        for name in sorted(left)
    ]
    message.world.collision_objects = added + removed
    return message


def _collision_object(thing: SceneObject, header: Any) -> Any:
    """An object with its shape as a mesh, in the frame of its scan."""
    message = CollisionObject(
        header=header,
        id=called(thing),
        operation=CollisionObject.ADD,
    )
    vertices, faces = placed_shape(thing)
    if thing.pose is not None:
        fill_pose(message.pose, thing.pose)
        vertices = (vertices - thing.pose[:3, 3]) @ thing.pose[:3, :3]
    mesh = Mesh(
        triangles=[
            MeshTriangle(vertex_indices=face.astype(np.uint32)) for face in faces
        ],
        vertices=[_point(vertex) for vertex in vertices],
    )
    message.meshes, message.mesh_poses = [mesh], [Pose()]
    return message


def _point(place: Float) -> Point:
    return Point(**dict(zip("xyz", map(float, place), strict=True)))


# What was recognised, as detections


def scene_detections(objects: Sequence[SceneObject], header: Any) -> Any:
    """The objects of a scene as a ``vision_msgs/Detection3DArray``.

    Args:
        objects: of the scene; the id of a detection is the number of its object.
        header: of the world's frame, with the time of the last image.
    """
    detections = []
    for thing in objects:
        detection = Detection3D(header=header, id=str(thing.number))
        _fill_poses(detection, thing.candidates)
        if thing.pose is None:
            low, high = thing.seen_points.min(0), thing.seen_points.max(0)
            _fill_box(detection.bbox, np.eye(4), low, high)
        detections.append(detection)
    return Detection3DArray(header=header, detections=detections)


def tracked_detections(
    things: Sequence[Tracked],
    objects: Sequence[SceneObject],
    header: Any,
) -> Any:
    """Things that are followed as a ``vision_msgs/Detection3DArray``, each with one hypothesis.

    Args:
        things: that are not lost; the id of a detection is the number of its object.
        objects: of the scene, with the scans.
        header: of the world's frame, with the time of the image.
    """
    scans = {
        (one.number, posed.thing): posed.vertices
        for one in objects
        for posed in one.candidates
    }
    detections = []
    for thing in things:
        detection = Detection3D(header=header, id=str(thing.number))
        detection.results = [
            _hypothesis(
                thing.name,
                thing.probability,
                thing.pose,
                thing.uncertainty.degrees,
                thing.uncertainty.millimetres,
            )
        ]
        vertices = scans.get((thing.number, thing.name))
        if vertices is not None:
            low, high = vertices.min(0), vertices.max(0)
            _fill_box(detection.bbox, thing.pose, low, high)
        detections.append(detection)
    return Detection3DArray(header=header, detections=detections)


def detection_of(result: nextview.Recognition, header: Any, number: str = "") -> Any:
    """What was recognised, as a ``vision_msgs/Detection3D``.

    Each hypothesis is a thing in a pose, of the frame of its scan; or a class, at the object's
    centre, where no geometry is known: its orientation has then the variance of any turn. An
    unknown object has no hypothesis. The box is that of the scan in its likeliest pose, or the
    sphere around the object.

    Args:
        result: of an object in frames.
        header: of the world's frame, with the time of the last image.
        number: id of the detection.
    """
    detection = Detection3D(header=header, id=number)
    if result.answer is None:
        pass  # nothing that is known explains it
    elif result.pose_candidates:
        _fill_poses(detection, result.pose_candidates)
    else:
        scores = sorted(result.beliefs.items(), key=lambda pair: -pair[1])
        detection.results = [
            _hypothesis_of_class(name, score, result)
            for name, score in scores
            if score >= LEAST_SCORE
        ]

    if result.pose is None or result.pose_candidates[0].vertices is None:
        radius = np.full(3, result.radius or 0.0)
        _fill_box(detection.bbox, result.poses_in.from_object, -radius, radius)
    return detection


def _fill_poses(detection: Any, every: Sequence[PoseCandidate]) -> None:
    """Fill in the hypotheses of an object, and the box of the scan in its likeliest pose."""
    detection.results = [
        _hypothesis(
            one.thing,
            one.probability,
            one.pose,
            one.degrees,
            one.millimetres,
        )
        for one in every
        if one.probability >= LEAST_SCORE
    ]
    if every and every[0].vertices is not None:
        low, high = every[0].vertices.min(0), every[0].vertices.max(0)
        _fill_box(detection.bbox, every[0].pose, low, high)


def _hypothesis(
    name: str,
    score: float,
    pose: Float,
    degrees: float,
    millimetres: float,
) -> Any:
    """A hypothesis; the deviations are of all axes together."""
    one = ObjectHypothesisWithPose()
    one.hypothesis.class_id = name
    one.hypothesis.score = float(score)
    fill_pose(one.pose.pose, pose)
    place = (0.001 * millimetres) ** 2 / 3
    turn = np.radians(degrees) ** 2 / 3
    one.pose.covariance = np.diag([place] * 3 + [turn] * 3).ravel()
    return one


def _hypothesis_of_class(
    name: str,
    score: float,
    result: nextview.Recognition,
) -> Any:
    """A hypothesis without geometry: at the object's centre, in any orientation."""
    pose = np.eye(4)
    pose[:3, 3] = result.poses_in.from_object[:3, 3]
    one = _hypothesis(name, score, pose, 0.0, 1000 * (result.radius or 0.0))
    for turn in (21, 28, 35):  # on the diagonal of the matrix
        one.pose.covariance[turn] = ANY_TURN
    return one


def _fill_box(box: Any, pose: Float, low: Float, high: Float) -> None:
    """Write a box between two corners, (3,), of a frame in the world into a message."""
    centre = np.array(pose, np.float64)
    centre[:3, 3] += pose[:3, :3] @ ((low + high) / 2)
    fill_pose(box.center, centre)
    box.size.x, box.size.y, box.size.z = map(float, high - low)
