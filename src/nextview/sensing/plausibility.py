"""Warn of implausible observations, and name the likely mistake."""

from collections.abc import Sequence

import numpy as np

from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.viewsphere import VISITED_ANGLE, angle_between, direction_of
from nextview.sensing.mistakes import in_poses
from nextview.sensing.observation import Observation
from nextview.sensing.view_warning import ViewWarning
from nextview.types import Float, Index

# object radii, within which the outermost points are from the origin
PLAUSIBLE_REACH = 0.4, 1.15


def check_observation(observation: Observation) -> list[ViewWarning]:
    """Return likely problems of an observation; usually empty.

    The object should fill most of the unit sphere around the origin and not exceed it. Otherwise
    the usual mistake that explains the difference is named.
    """
    seen = np.flatnonzero(observation.depth)
    pose = np.asarray(observation.pose, np.float64)
    if len(seen) < 20:
        message = (
            f"only {len(seen)} pixels have a depth: is the object in the picture, and the depth in"
            " object radii?"
        )
        return [ViewWarning("nothing seen", message)]
    points = _surface(observation, seen)
    if _plausible(points, pose):
        return []

    reach = _reach(points, pose)
    if reach < PLAUSIBLE_REACH[0]:
        message = (
            f"all that is seen lies within {reach:.2g} object radii of the object's centre: lengths"
            " in metres? Divide depth and camera position by the object radius"
        )
        return [ViewWarning("scale", message)]
    for mistake in in_poses():
        if mistake.name not in ("opengl axes", "ros axes", "inverse pose"):
            continue
        if _plausible(points, mistake.right_poses(pose[None])[0]):
            message = f"the view looks away from the object: {mistake.sentence}"
            return [ViewWarning(mistake.name, message)]
    distance = float(np.linalg.norm(pose[:3, 3]))
    for scale in (
        distance
        / np.median(np.linalg.norm(points, axis=1))
        * np.array([1, 0.9, 0.8, 1.1, 1.2])
    ):
        scaled = pose.copy()
        scaled[:3, 3] /= scale
        if _plausible(points * scale, pose) or _plausible(points, scaled):
            message = (
                f"depth and the camera's distance of {distance:.2g} do not fit, by a factor of"
                f" {scale:.2g}: is one in metres? Both are expected in object radii"
            )
            return [ViewWarning("scale", message)]
    message = (
        f"the surface that is seen reaches {reach:.2g} object radii from the object's centre, more"
        " than 1: a wrong pose, centre or radius, or more in the picture than the object?"
    )
    return [ViewWarning("outside", message)]


def _surface(observation: Observation, seen: Index) -> Float:
    """Sample the surface at pixels, given by index, (N, 3), camera frame."""
    few = seen[:: max(1, len(seen) // 500)]
    rows, columns = np.divmod(few, observation.depth.shape[1])
    camera = PinholeCamera.of(observation.intrinsics, observation.depth.shape)
    z = observation.depth[rows, columns].astype(np.float64)
    return camera.rays_through(rows, columns) * z[:, None]


def _reach(points: Float, pose: Float) -> float:
    """Return the distance of the outermost points from the origin, without flying pixels."""
    squares = ((points @ pose[:3, :3].T + pose[:3, 3]) ** 2).sum(1)
    rank = int(0.98 * (len(squares) - 1))
    return float(np.sqrt(np.partition(squares, rank)[rank]))


def _plausible(points: Float, pose: Float) -> bool:
    least, most = PLAUSIBLE_REACH
    return least < _reach(points, pose) < most


def check_views(first: Observation, second: Observation) -> list[ViewWarning]:
    """Warn if one of two views of an object sees through a surface observed in the other.

    Args:
        first: one view.
        second: the other view.

    Returns:
        The warning, if any.
    """
    share = max(_seen_through(first, second), _seen_through(second, first))
    if share < 0.2:
        return []
    message = (
        f"two views contradict each other: {share:.0%} of the surface that one saw is missing in"
        " the other: a wrong pose, or the object has moved"
    )
    return [ViewWarning("contradiction", message)]


def check_last_view(observations: Sequence[Observation]) -> list[ViewWarning]:
    """Warn if the last view of an object contradicts one of the three views just before it.

    Args:
        observations: of the object, in order, at least one.

    Returns:
        The first such warning, if any.
    """
    *earlier, last = observations
    return next(filter(None, (check_views(one, last) for one in earlier[-3:])), [])


def _seen_through(first: Observation, second: Observation) -> float:
    """Return the share of the first view's surface that the second view sees through.

    If the second view contains the whole scene, it must have measured something behind the surface:
    a hole in the depth is no contradiction.
    """
    seen = np.flatnonzero(first.depth)
    if len(seen) == 0 or not second.depth.any():
        return 0.0

    depth, pose, intrinsics = second.whole_frame
    if second.sighting is not None:
        depth = np.where(depth > 0, depth, -np.inf)
    points = _surface(first, seen) @ first.pose[:3, :3].T + first.pose[:3, 3]
    points = (points - pose[:3, 3]) @ pose[:3, :3]
    points = points[points[:, 2] > 0.1]
    if len(points) == 0:
        return 1.0

    height, width = depth.shape
    at = PinholeCamera.of(intrinsics, depth.shape).project(points)
    # pixels, allowance for errors of the object frame
    margin = max(2, width // 50) if second.sighting is None else 2
    inside = ((at >= margin) & (at < np.array([width, height]) - margin)).all(1)
    if not inside.any():
        return 0.0
    column, row = np.floor(at[inside]).astype(np.int64).T
    missing = np.ones(len(row), bool)
    for dy in (-margin, 0, margin):
        for dx in (-margin, 0, margin):
            there = depth[row + dy, column + dx]
            missing &= (there == 0) | (there > points[inside, 2] + 0.1)
    return float(missing.mean())


def repeated_observation(seen: Observation, earlier: Sequence[Observation]) -> bool:
    """Return True if an observation repeats the image of an earlier one.

    Two renders of a symmetric object may also be identical, but only after a rotation about the
    vertical.

    Args:
        seen: the observation.
        earlier: the earlier observations.
    """
    towards = direction_of(seen.pose)
    return any(
        one.seen
        and np.array_equal(one.depth, seen.depth)
        and (
            angle_between(direction_of(one.pose), towards) <= VISITED_ANGLE
            or not np.allclose(one.pose[2], seen.pose[2], atol=1e-4)
            or bool(check_views(one, seen))
        )
        for one in earlier
    )
