"""Reject implausible frames, and name the likely mistake behind an observation."""

from collections.abc import Sequence

import numpy as np

from nextview.errors import ObservationError
from nextview.geometry.observation import Observation
from nextview.geometry.pinhole import PinholeCamera
from nextview.sensing.displacement import Displacement
from nextview.sensing.frame import Frame, one_stand
from nextview.sensing.lean import Lean
from nextview.sensing.mistakes import mistake_between, mistakes_in_poses
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
# metres, median depth beyond the range of most depth cameras
FAR_DEPTH = 10.0
# object radii, largest horizontal distance of the selecting point from the object
FARTHEST_POINT_ASIDE = 3.0
# largest distance of an object as a multiple of the farthest depth in the frame
TOO_FAR = 2.5
CHANGED = 0.04
CHANGED_SHARE = 0.03
"""Relative change of a changed pixel's depth, and share of changed pixels in a changed image."""
TIMES_TOO_LARGE = (2.0, 4.0, 5.0, 8.0, 10.0)
"""Factors by which depth is too large if 16-bit units of 0.5, 0.25, 0.2, 0.125 and 0.1 mm are read
as millimetres.
"""
NOTHING_NEARER = 1.2
MUCH_FARTHER = 1.7
"""Multiples of the target distance. If depth is too large, nothing is nearer than the first, and
the surface at the target's pixels is at least as far as the second.
"""
# metres from the world origin: workspace of robots; larger positions may be in millimetres
FAR_ORIGIN = 30.0
# largest distance of a robot's camera from the world origin, millimetres
FARTHEST_MILLIMETRES = 20_000.0
SAME_HEIGHT = 0.1  # relative tolerance of equal heights
SAME_STEPS = 0.03  # the same for heights that identify the depth unit
# factor above which a ratio of radii is closer to ten than to one
ORDER_OF_SIZE = np.sqrt(10)


def refuse_far(
    frame: Frame,
    last: Frame | None,
    target: Float | None,
    radius: float,
) -> None:
    """Reject a camera that is much farther away than anything it measures.

    Args:
        frame: the frame.
        last: the previous frame; None for a first one.
        target: expected position of the object, world, (3,); None if not known.
        radius: of the object, metres.

    Raises:
        ObservationError: the camera is too far from its last position, or from its target.
    """
    camera = frame.camera_to_world[:3, 3]
    farthest = float(frame.depth.max())
    if last is not None:
        moved = np.linalg.norm(camera - last.camera_to_world[:3, 3])
        reach = farthest + float(last.depth.max())
        if moved > TOO_FAR * reach:
            what = (
                f"the camera is {moved:.0f} m from where it was, and what it sees is within"
                f" {reach:.1f} m"
            )
            raise ObservationError(f"{what}: is the pose in millimetres?")
    distance = (
        0.0
        if target is None or frame.mask is not None
        else np.linalg.norm(target - camera)
    )
    if distance - radius > TOO_FAR * farthest:
        what = (
            f"the target is {distance:.0f} m away, and nothing in the frame is farther than"
            f" {farthest:.1f} m"
        )
        raise ObservationError(
            f"{what}: is the pose in millimetres, or are target and pose of different worlds?"
        )

    refuse_mistake(frame, last, target, radius)


def refuse_millimetres(pose: Float, height: float, up: Float) -> None:
    """Reject a first pose in millimetres: its height is a thousand times that above the support.

    Args:
        pose: camera-to-world, (4, 4).
        height: of the camera above the support plane according to the depth, metres.
        up: against gravity, world, (3,).
    """
    place = pose[:3, 3]
    origin = float(np.linalg.norm(place))
    in_metres = float(place @ up) / 1000
    near = abs(in_metres - height) < SAME_HEIGHT * height
    if FAR_ORIGIN < origin < FARTHEST_MILLIMETRES and near:
        raise ObservationError(
            f"the camera is {origin:.0f} m from the world's origin and {height:.2g} m above the"
            f" support, which is {in_metres:.2g} m in millimetres: the pose is in millimetres"
        )


def check_steps(frame: Frame, height: float, up: Float) -> list[ViewWarning]:
    """Warn if 16-bit depth in another unit than millimetres would fit the pose.

    If depth is several times too large, the support plane is too far below the camera. With the
    right unit it is level with the world origin, as a robot's base or table often is.

    Args:
        frame: the first frame, with a pose.
        height: of the camera above the support plane according to the depth, metres.
        up: against gravity, world, (3,).
    """
    stands = float(frame.camera_to_world[:3, 3] @ up)
    if not frame.counted or stands <= 0:
        return []
    for times in TIMES_TOO_LARGE:
        if abs(height / times - stands) < SAME_STEPS * stands:
            return [
                ViewWarning(
                    "unit",
                    f"the support lies {height - stands:.2g} m below the world's origin, and level"
                    f" with it if the depth is {times:g} times too large: are the steps of the"
                    f" uint16 depth {1 / times:.3g} mm?",
                )
            ]
    return []


def refuse_mistake(
    frame: Frame,
    last: Frame | None,
    target: Float | None,
    radius: float,
) -> None:
    """Reject depth that is several times too large, and poses with an identifiable mistake.

    16-bit depth in units smaller than a millimetre is read as too large. This is detected if
    everything visible is behind the target, at a multiple of its distance; or if the frame and the
    previous one contradict each other, but agree with smaller depth.

    Args:
        frame: the frame.
        last: the previous frame; None for a first one.
        target: expected position of the object, world, (3,); None if not known.
        radius: of the object, metres.

    Raises:
        ObservationError: the depth is too large, with the likely factor; or another mistake.
    """
    times = 0.0
    if target is not None and frame.mask is None:
        times = _times_behind(frame, target, radius)
    if not times and last is not None:
        mistake = mistake_between(frame, last, TIMES_TOO_LARGE)
        if mistake is None:
            return
        if mistake.kind != "scale":
            raise ObservationError(
                f"the frame does not agree with the last one, and without this mistake it would:"
                f" {mistake.sentence}"
            )
        times = mistake.scale
    if not times:
        return
    steps = (
        f"its steps look like {1 / times:.3g} mm"
        if frame.counted
        else "is it in another unit?"
    )

    hint = (
        ", and uint16 is taken for millimetres: hand it in as float metres"
        if frame.counted
        else ""
    )
    raise ObservationError(f"the depth is {times:g} times too large: {steps}{hint}")


def _times_behind(frame: Frame, target: Float, radius: float) -> float:
    """Return the factor by which depth is too large if everything is behind a target; else 0."""
    pose = frame.camera_to_world
    in_camera = pose[:3, :3].T @ (target - pose[:3, 3])
    z = in_camera[2]
    if z <= 0:
        return 0.0

    height, width = frame.shape
    column, row = frame.pinhole.project(in_camera[None])[0].astype(int).tolist()
    if not (0 <= column < width and 0 <= row < height):
        return 0.0

    few = frame.depth[::4, ::4]
    around = frame.depth[max(0, row - 4) : row + 5, max(0, column - 4) : column + 5]
    if not (around > 0).any():
        return 0.0

    there = float(np.median(around[around > 0]))
    nearest = float(np.quantile(few[few > 0], 0.02)) if (few > 0).any() else 0.0
    if nearest < NOTHING_NEARER * (z + radius) or there < MUCH_FARTHER * (z + radius):
        return 0.0

    return min(TIMES_TOO_LARGE, key=lambda times: abs(np.log(times * z / there)))


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
    seen = frame.depth[::4, ::4]
    middle = float(np.median(seen[seen > 0])) if seen.any() else 0.0
    if middle > FAR_DEPTH:
        found.append(
            ViewWarning(
                "unit",
                f"the depth has a median of {middle:.0f} m: is it in inches or feet?",
            )
        )
    origin = float(np.linalg.norm(frame.camera_to_world[:3, 3]))
    if origin > max(FAR_ORIGIN, 20 * middle):
        message = (
            f"the camera is {origin:.0f} m from the world's origin, and sees {middle:.2g} m far:"
            " is the"
        )
        found.append(ViewWarning("far origin", message + " pose in millimetres?"))

    return found


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
