"""Warn of implausible views and observations, and name the likely mistake."""

from collections.abc import Sequence

import numpy as np

from nextview.geometry.observation import Observation
from nextview.geometry.pinhole import PinholeCamera
from nextview.sensing.displacement import Displacement
from nextview.sensing.frame import Frame, one_stand
from nextview.sensing.lean import Lean
from nextview.sensing.mistakes import focal_that_levels, mistakes_in_poses
from nextview.sensing.view_warning import ViewWarning
from nextview.types import Float, Index

PIXELS_SAMPLED = 500  # sampled pixels
FEWEST_DEPTHS = 20  # least number of pixels with valid depth
# object radii, largest plausible distance of a surface from the origin
OUTERMOST = 1.15
INNERMOST = 0.4  # object radii, least plausible distance of the outermost points
# views contradict each other if one misses this share of the surface seen in the other
CONTRADICTION = 0.2
COMPARED_VIEWS = 3  # earlier views with which the last one is compared
# largest offset of the principal point from the centre of an uncropped image, in half sides
OFF_CENTRE = 0.25
# object radii, largest horizontal distance of the selecting point from the object
FARTHEST_POINT_ASIDE = 3.0
# metres: few depth cameras measure nearer than the first, and hardly any nearer than the second
NEAR_RANGE = 0.25
NEAREST_RANGE = 0.1
# degrees by which few poses and tables lean
FAR_FROM_LEVEL = 6.0
CHANGED = 0.04
CHANGED_SHARE = 0.03
"""Relative change of a changed pixel's depth, and share of changed pixels in a changed image."""
# factor above which a ratio of radii is closer to ten than to one
ORDER_OF_SIZE = np.sqrt(10)


def check_frame(frame: Frame) -> list[ViewWarning]:
    """Return likely problems of a frame that is not rejected; usually empty."""
    found = []
    k = frame.intrinsics
    height, width = frame.shape
    off = max(abs(2 * k[0, 2] / width - 1), abs(2 * k[1, 2] / height - 1))
    if off > OFF_CENTRE:
        message = (
            f"the principal point ({k[0, 2]:.0f}, {k[1, 2]:.0f}) is far from the middle of an image"
            f" of {width} x "
        )
        message += (
            f"{height}: intrinsics of another resolution, unless the image is a part of a"
            " larger one"
        )
        found.append(ViewWarning("intrinsics", message))
    middle = _median(frame)
    if middle < NEAREST_RANGE:
        message = (
            f"the depth has a median of {100 * middle:.1f} cm, and hardly any depth camera measures"
            " so near: is it ten times too small, as by a wrong depth scale?"
        )
        found.append(ViewWarning("unit", message, holds=False))
    return found


def check_level(frame: Frame, normal: Float, upwards: Float) -> list[ViewWarning]:
    """Warn if the support plane would be level with another focal length.

    Args:
        frame: with a pose.
        normal: of the plane, (3,), world.
        upwards: direction against gravity, (3,), world.
    """
    leans = np.degrees(np.arccos(np.clip(normal @ upwards, -1, 1)))
    mistake = focal_that_levels(frame, normal, upwards)
    if mistake is None or leans < FAR_FROM_LEVEL:
        return []
    return [
        ViewWarning(
            "intrinsics",
            f"the support plane leans by {leans:.0f} degrees, and if it is level,"
            f" {mistake.sentence}",
            holds=False,
        )
    ]


def check_sizes(
    frame: Frame, sizes: Sequence[Float], smallest: float
) -> list[ViewWarning]:
    """Warn if all that is seen is both too near and too small for what is known.

    Either alone may be right: a camera for short distances, or a table of small strangers.

    Args:
        frame: that shows the objects.
        sizes: extents of each object, (3,), metres; none for no warning.
        smallest: diameter of the smallest known thing, metres.
    """
    middle = _median(frame)
    largest = max((float(np.linalg.norm(size)) for size in sizes), default=np.inf)
    # a thing may be seen from its small end
    if not NEAREST_RANGE <= middle < NEAR_RANGE or largest > smallest / 2:
        return []
    message = (
        f"the depth has a median of {100 * middle:.0f} cm, and the largest object in sight measures"
        f" {100 * largest:.1f} cm, the smallest known one {100 * smallest:.1f} cm: is the depth"
        " several times too small, as by a wrong depth scale?"
    )
    return [ViewWarning("unit", message, holds=False)]


def _median(frame: Frame) -> float:
    """Median depth of a frame, metres; infinity without any."""
    few = frame.depth[::4, ::4]
    few = few[few > 0]
    return float(np.median(few)) if len(few) else np.inf


def check_point(aside: Float, radius: float) -> list[ViewWarning]:
    """Warn if the object is far from the point that selected it.

    Args:
        aside: offset from the point, metres, (2,).
        radius: of the object, metres.

    Returns:
        The warning, if any.
    """
    distance = float(np.linalg.norm(aside))
    if distance <= FARTHEST_POINT_ASIDE * radius:
        return []
    message = (
        f"the thing nearest to the point is {distance:.2g} m "
        f"away from it, of {radius:.2g} m radius"
    )
    return [
        ViewWarning(
            "point",
            f"{message}: is the point of another world, or what stands there out of view?",
        )
    ]


def check_size(radius: float, before: float) -> list[ViewWarning]:
    """Warn if a frame changes the size of the object by an order of magnitude.

    Args:
        radius: of the object with this frame, metres.
        before: of the object in earlier frames, metres.
    """
    if radius <= ORDER_OF_SIZE * before:
        return []
    return [
        ViewWarning(
            "size",
            f"the radius of the object grows from {before:.2g} to {radius:.2g} m by this frame: is"
            " its pose wrong, so that the support or a neighbour is taken for a part of it?",
        )
    ]


def check_place(displaced: Displacement | None) -> list[ViewWarning]:
    """Warn if the object is displaced relative to earlier frames.

    Args:
        displaced: the displacement; None if not known.
    """
    if displaced is None or not displaced.noticed:
        return []
    return [
        ViewWarning(
            "displaced",
            f"this frame shows the object {1000 * displaced.length:.0f} mm beside where earlier"
            " ones do, which is allowed for: was it nudged, or does the camera's pose err"
            " (hand-eye calibration, a late time stamp)?",
            holds=False,
        )
    ]


def check_lean(lean: Lean) -> list[ViewWarning]:
    """Warn if the support plane is tilted by more than camera errors explain."""
    if not lean.noticed:
        return []
    return [
        ViewWarning(
            "lean",
            f"the support plane leans by {lean.degrees:.1f} degrees against up: a tilted table,"
            " is it another surface than the support, or is up another direction?",
            holds=False,
        )
    ]


def check_pose_moved(frame: Frame, last: Frame) -> list[ViewWarning]:
    """Warn if the image has changed since the previous frame, but the pose has not.

    Args:
        frame: the frame.
        last: the previous frame.

    Returns:
        The warning, if any.
    """
    if frame.shape != last.shape or not one_stand(frame, last):
        return []

    now, then = (f.depth[::4, ::4] for f in (frame, last))
    both = (now > 0) & (then > 0)

    if (
        not both.any()
        or np.mean(np.abs(now - then)[both] > CHANGED * now[both]) <= CHANGED_SHARE
    ):
        return []

    return [
        ViewWarning(
            "stale pose",
            "the picture changed, the pose did not: an old pose, or a moved object?",
        )
    ]


def check_observation(observation: Observation) -> list[ViewWarning]:
    """Return likely problems of an observation; usually empty.

    The object should fill most of the unit sphere around the origin and not exceed it. Otherwise
    the usual mistake that explains the difference is named.
    """
    seen = np.flatnonzero(observation.depth)
    pose = np.asarray(observation.pose, np.float64)
    if len(seen) < FEWEST_DEPTHS:
        message = (
            f"only {len(seen)} pixels have a depth: is the object in the picture, and the depth in"
            " object radii?"
        )
        return [ViewWarning("nothing seen", message)]
    points = _surface(observation, seen)
    return [] if _plausible(points, pose) else [ViewWarning(*_diagnose(points, pose))]


def _surface(observation: Observation, seen: Index) -> Float:
    """Sample the surface at pixels, given by index, (N, 3), camera frame."""
    rows, columns = np.divmod(
        seen[:: max(1, len(seen) // PIXELS_SAMPLED)],
        observation.depth.shape[1],
    )
    camera = PinholeCamera.of(observation.intrinsics, observation.depth.shape)
    z = observation.depth[rows, columns].astype(np.float64)
    return camera.rays_through(rows, columns) * z[:, None]


def _reach(points: Float, pose: Float) -> float:
    """Return the distance of the outermost points from the origin, without flying pixels."""
    squares = ((points @ pose[:3, :3].T + pose[:3, 3]) ** 2).sum(1)
    rank = int(0.98 * (len(squares) - 1))
    return float(np.sqrt(np.partition(squares, rank)[rank]))


def _plausible(points: Float, pose: Float) -> bool:
    return INNERMOST < _reach(points, pose) < OUTERMOST


def _diagnose(points: Float, pose: Float) -> tuple[str, str]:
    """Return name and message of the mistake without which the points are in the unit sphere."""
    reach = _reach(points, pose)
    distance = float(np.linalg.norm(pose[:3, 3]))
    if reach < INNERMOST:
        what = f"all that is seen lies within {reach:.2g} object radii of the object's centre"
        return (
            "scale",
            f"{what}: lengths in metres? Divide depth and camera position by the object radius",
        )

    mistakes = {mistake.name: mistake for mistake in mistakes_in_poses()}
    for name in ("opengl axes", "ros axes", "inverse pose"):
        mistake = mistakes[name]
        if _plausible(points, mistake.right_pose(pose)):
            return name, f"the view looks away from the object: {mistake.sentence}"

    middle = float(np.median(np.linalg.norm(points, axis=1)))
    factor = distance / middle if middle > 0 else 1.0

    for scale in factor * np.array([1, 0.9, 0.8, 1.1, 1.2]):
        scaled = pose.copy()
        scaled[:3, 3] /= scale
        if _plausible(points * scale, pose) or _plausible(points, scaled):
            unfit = (
                f"depth and the camera's distance of {distance:.2g} do not fit, by a factor of"
                f" {scale:.2g}"
            )
            return (
                "scale",
                f"{unfit}: is one in metres? Both are expected in object radii",
            )
    what = (
        f"the surface that is seen reaches {reach:.2g} object radii from the object's centre, more"
        " than 1"
    )

    return (
        "outside",
        f"{what}: a wrong pose, centre or radius, or more in the picture than the object?",
    )


def check_views(first: Observation, second: Observation) -> list[ViewWarning]:
    """Warn if one of two views of an object sees through a surface observed in the other.

    Args:
        first: one view.
        second: the other view.

    Returns:
        The warning, if any.
    """
    share = max(_seen_through(first, second), _seen_through(second, first))
    if share < CONTRADICTION:
        return []
    message = (
        f"two views contradict each other: {share:.0%} of the surface that one saw is missing in"
        " the other: a "
    )
    return [
        ViewWarning("contradiction", message + "wrong pose, or the object has moved")
    ]


def check_last_view(observations: Sequence[Observation]) -> list[ViewWarning]:
    """Warn if the last view of an object contradicts one of the views just before it.

    Args:
        observations: of the object, in order, at least one.

    Returns:
        The first such warning, if any.
    """
    *earlier, last = observations
    for view in earlier[-COMPARED_VIEWS:]:
        warnings = check_views(view, last)
        if warnings:
            return warnings
    return []


def _seen_through(first: Observation, second: Observation) -> float:
    """Return the share of the first view's surface that the second view sees through.

    If the second view contains the whole scene, it must have measured something behind the surface:
    a hole in the depth is no contradiction.
    """
    seen = np.flatnonzero(first.depth)
    if len(seen) == 0 or not second.depth.any():
        return 0.0

    scene = second.scene
    depth = second.depth
    pose = second.pose
    k = second.intrinsics
    if scene is not None:
        depth = np.where(scene.depth > 0, scene.depth, -np.inf)
        pose = scene.pose
        k = scene.intrinsics
    points = _surface(first, seen) @ first.pose[:3, :3].T + first.pose[:3, 3]
    points = (points - pose[:3, 3]) @ pose[:3, :3]
    points = points[points[:, 2] > 0.1]
    if len(points) == 0:
        return 1.0

    height, width = depth.shape
    at = PinholeCamera.of(k, depth.shape).project(points)
    column, row = np.floor(at).astype(np.int64).T
    # pixels, allowance for errors of the object frame
    margin = max(2, width // 50) if scene is None else 2
    inside = (
        (column >= margin)
        & (column < width - margin)
        & (row >= margin)
        & (row < height - margin)
    )
    if not inside.any():
        return 0.0

    column = column[inside]
    row = row[inside]
    away = points[inside, 2]
    missing = np.ones(len(away), bool)

    for dy in (-margin, 0, margin):
        for dx in (-margin, 0, margin):
            there = depth[row + dy, column + dx]
            missing &= (there == 0) | (there > away + 0.1)

    return float(missing.mean())
