"""What the node tells, as standard messages: what the object is and where, and where to look."""

from __future__ import annotations

from typing import Any

import numpy as np
from geometry_msgs.msg import Pose, PoseArray

import nextview
from nextview.types import Float
from nextview_ros.conversion import fill_pose

try:
    from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesisWithPose
except ModuleNotFoundError:  # then there is no such topic
    Detection3DArray = None

UNKNOWN = "unknown"
ANY_TURN = np.pi**2 / 3  # variance of an angle of which nothing is known
LEAST_SCORE = 0.01  # hypotheses that are less likely are not told


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


def pose_array(poses: list[Float], header: Any, axes: str) -> PoseArray:
    """Camera poses as a message."""
    return PoseArray(
        header=header,
        poses=[fill_pose(Pose(), pose, axes) for pose in poses],
    )


def detections(result: nextview.Recognition, header: Any) -> Any:
    """What was recognised, as a ``vision_msgs/Detection3DArray`` of one detection.

    Its id is the answer, or "unknown", without a hypothesis. Each hypothesis is a thing in a pose,
    of the frame of its scan; or a class, at the object's centre, where no geometry is known: its
    orientation has then the variance of any turn. The box is the sphere around the object.

    Args:
        result: of a session with frames.
        header: of the world's frame.
    """
    detection = Detection3D(header=header, id=result.answer or UNKNOWN)
    if result.answer is None:
        pass  # nothing that is known explains it
    elif result.pose_candidates:
        of_thing = result.pose_candidates
        detection.results = [
            _hypothesis(
                one.thing,
                one.probability,
                one.pose,
                one.degrees,
                one.millimetres,
            )
            for one in of_thing
            if one.probability >= LEAST_SCORE
        ]
    else:
        place = np.eye(4)
        place[:3, 3] = result.poses_in.from_object[:3, 3]
        scores = sorted(result.beliefs.items(), key=lambda pair: -pair[1])
        for name, score in scores:
            if score >= LEAST_SCORE:
                one = _hypothesis(
                    name,
                    score,
                    place,
                    0.0,
                    1000 * (result.radius or 0.0),
                )
                one.pose.covariance[21] = one.pose.covariance[28] = one.pose.covariance[
                    35
                ] = ANY_TURN
                detection.results.append(one)

    centre = result.poses_in.from_object
    fill_pose(detection.bbox.center, centre)
    across = 2.0 * (result.radius or 0.0)
    detection.bbox.size.x = detection.bbox.size.y = detection.bbox.size.z = across
    return Detection3DArray(header=header, detections=[detection])


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
