"""Detect usual mistakes in depth and poses, each with the transformation that undoes it.

A mistake is reported if contradictory frames agree once it is undone. All kinds of mistakes are in
one list and compared by one score, the share of points that other frames contradict
(``agreement``). To add a kind, add an entry to ``usual_mistakes``, or to ``fitted_mistakes`` if it
has a magnitude.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from nextview.sensing.agreement import (
    Agreement,
    SurfaceView,
    compare,
)
from nextview.sensing.frame import CAMERA_AXES, SAME_POSE, Frame
from nextview.types import Float, Index, Mask

# A mistake explains contradictions if undoing it leaves at most this share of them, ...
FEWER_CONTRADICTIONS = 0.5
LEAST_EXPLAINED = 100  # ... resolves at least so many ...
LEAST_CONCERNED = 0.01  # ... and at least this share of the affected points, ...
LEAST_OVERLAP = 0.5  # ... and if at least this share of them can still be judged.
# Correct poses of a real camera leave half of this share contradicted.
LEAST_CONTRADICTED = 0.05
# A mistake explains a missing overlap if the frames as read have less than this share of the
# judgements without the mistake, and these exceed this share of all possible judgements.
NO_OVERLAP = 0.25
# Least confirmed share once a mistake is undone. Usual calibration errors leave .88; for real
# frames with shuffled poses, no mistake gives more than .2.
WELL_EXPLAINED = 0.75
# Cameras closer than this, relative to the depth, count as being in one place.
ONE_PLACE = 0.02

UNIT_NAMES = {
    1.0: "metres",
    0.01: "centimetres",
    0.001: "millimetres",
    0.0254: "inches",
    0.3048: "feet",
}
DEPTH_SCALES = (1000, 100, 10, 8, 5, 4, 2.5, 2, 0.5, 0.4, 0.25, 0.2, 0.1, 0.01, 0.001)
"""Factors by which the depth may be too large. The depth units of cameras are 1, 0.5, 0.25, 0.2,
0.125 and 0.1 mm.
"""
TIMES_TOO_LARGE = (2.0, 4.0, 5.0, 8.0, 10.0)
"""Factors by which depth is too large if 16-bit units of 0.5, 0.25, 0.2, 0.125 and 0.1 mm are read
as millimetres.
"""
# Of frames in 16 bits, one in twenty is not in millimetres: each of the five factors.
STEPS_PRIOR = 0.01
UNUSUAL_MISTAKE = (
    1e-4  # prior of centimetres, and of a pose of which one half is inverse
)
# factors that are tried together with another mistake
COMMON_SCALES = (1000, 0.001, 10, 0.1, 5, 0.2, 4, 0.25)
# a factor above this is rarely an error of the depth unit, and often one of the unit of length
NEVER_A_DEPTH = 25
# metres, range of the median depth of a capture of an object
PLAUSIBLE_DEPTH = (0.05, 15.0)

MOST_FITTED = (
    20  # frames used in the search for two mistakes, or for one with a magnitude
)
MOST_TRIALS = 120  # tried magnitudes
# first tried logarithms of the focal length, from a half to twice
FOCAL_STEPS = 0.05 * np.arange(-14, 15)
LEVEL_ERROR = np.radians(3.0)  # tilt of a level plane by errors of pose and depth
LEAST_FOCAL_CHANGE = 0.05  # relative; smaller changes are calibration errors
LEAST_OFFSET = 0.02  # metres; smaller offsets are calibration errors
FEWEST_STANDING = 10  # least number of points whose mean locates the object
# singular values below this share of the largest one mark unobservable directions
NOT_OBSERVED = 1e-2


@dataclass(frozen=True)
class Stored:
    """Storage conventions of frames and poses, so that messages can name the expected ones.

    Attributes:
        to_world: whether the poses are camera-to-world; otherwise world-to-camera.
        unit: of the translations, metres.
        step: unit of the depth images, metres.
        step_told_by: source of that unit.
    """

    to_world: bool = True
    unit: float = 1.0
    step: float = 0.001
    step_told_by: str = "as uint16 is taken"


@dataclass(frozen=True)
class PosedViews:
    """Frames and poses as they were read, to which mistakes are applied.

    Attributes:
        views: N frames.
        poses: of their cameras, camera-to-world, (N, 4, 4), metres.
        stored: storage conventions of both.
    """

    views: Sequence[SurfaceView]
    poses: Float
    stored: Stored = Stored()

    @property
    def median_depth(self) -> float:
        """Median depth, metres; 0 without points."""
        depths = [
            np.median(view.points[:, 2]) for view in self.views if len(view.points)
        ]
        return float(np.median(depths)) if depths else 0.0

    def some(self, which: Index | Mask) -> "PosedViews":
        """Return a subset of the frames.

        Args:
            which: their indices, or (N,) bool.
        """
        chosen = [self.views[i] for i in np.arange(len(self.views))[which]]
        return replace(self, views=chosen, poses=self.poses[which])

    def with_poses(self, poses: Float) -> "PosedViews":
        """Return the frames with other poses, (N, 4, 4)."""
        return replace(self, poses=poses)


@dataclass(frozen=True)
class Mistake:
    """A kind of mistake, with the transformation that undoes it.

    Attributes:
        name: short.
        kind: the affected quantity; two mistakes of one kind are not combined.
        sentence: description, the end of a sentence.
        undone: function that corrects the input.
        alone: whether it is never combined with another mistake.
        scale: factor by which the depth is too large, or the translations are too small.
        prior: probability that a frame has it.
    """

    name: str
    kind: str
    sentence: str
    undone: Callable[[PosedViews], PosedViews]
    alone: bool = False
    scale: float = 1.0
    prior: float = 1e-3

    def right_pose(self, pose: Float) -> Float:
        """Return the corrected pose, camera-to-world, (4, 4)."""
        return self.undone(PosedViews((), pose[None])).poses[0]


@dataclass(frozen=True)
class FittedMistake:
    """A kind of mistake with a magnitude.

    Attributes:
        starts: start values of the search for the magnitude, (K,) each.
        step: of the search.
        least: least norm of the magnitude that is a mistake.
        of_size: creates the mistake with a magnitude, (K,).
    """

    starts: Callable[[PosedViews], Sequence[Float]]
    step: float
    least: float
    of_size: Callable[[Float], Mistake]


def find_mistake(posed: PosedViews) -> Mistake | None:
    """Return the mistake without which frames agree much better.

    Single mistakes are tried first, then pairs.

    Args:
        posed: frames and poses as read.

    Returns:
        The mistake; None if the frames agree, or no mistake explains the contradictions.
    """
    as_read = compare(posed.views, posed.poses)
    overlap = as_read.judged / max(judgeable(posed.views), 1)
    if overlap > NO_OVERLAP and 1 - as_read.share < LEAST_CONTRADICTED:
        return None
    single = usual_mistakes(posed)
    found = likeliest(posed, single, as_read)
    if found is not None:
        return found

    few = posed.some(_spread(len(posed.views)))
    found = likeliest(few, list(_pairs(single)), compare(few.views, few.poses))
    return None if found is None else likeliest(posed, [found], as_read)


def likeliest(
    posed: PosedViews,
    mistakes: Sequence[Mistake],
    as_read: Agreement,
) -> Mistake | None:
    """Return the mistake whose correction confirms most points, if it explains enough.

    Args:
        posed: frames and poses as read.
        mistakes: candidates.
        as_read: agreement of the frames as read.
    """
    best = None
    most_confirmed = 0.0
    for mistake in mistakes:
        right = mistake.undone(posed)
        if in_one_place(right):
            continue

        changed = relative_change(posed.poses, right.poses)
        before = as_read.among(changed)
        after = compare(right.views, right.poses).among(changed)

        confirmed = float(after.confirmed.sum())
        if confirmed > most_confirmed and _explains_all(before, after, posed, changed):
            best = mistake
            most_confirmed = confirmed
    return best


def explains(before: Agreement, after: Agreement) -> bool:
    """Return True if frames contradict each other much less once a mistake is undone.

    Args:
        before: agreement as read, of the pairs of frames that the mistake affects.
        after: the same without the mistake.
    """
    explained = before.contradicted.sum() - after.contradicted.sum()
    return bool(
        explained >= max(LEAST_EXPLAINED, LEAST_CONCERNED * before.judged)
        and after.judged >= LEAST_OVERLAP * before.judged
        and 1 - after.share <= FEWER_CONTRADICTIONS * (1 - before.share)
    )


def _explains_all(
    before: Agreement,
    after: Agreement,
    posed: PosedViews,
    changed: Mask,
) -> bool:
    """Return True if a mistake explains contradictions, or a missing overlap, between frames."""
    if after.judged < LEAST_EXPLAINED or after.share < WELL_EXPLAINED:
        return False
    count = len(posed.views)
    possible = judgeable(posed.views) * changed.sum() / max(count * (count - 1), 1)
    looks_past = (
        before.judged < NO_OVERLAP * after.judged
        and after.judged > NO_OVERLAP * possible
    )
    return looks_past or explains(before, after)


def find_fitted(posed: PosedViews, kind: FittedMistake) -> Mistake | None:
    """Return the mistake with the magnitude without which frames agree best, if it explains enough.

    Args:
        posed: frames and poses as read.
        kind: of the mistake.

    Returns:
        The mistake; None if the frames agree, or it does not explain the contradictions.
    """
    as_read = compare(posed.views, posed.poses)
    if 1 - as_read.share < LEAST_CONTRADICTED:
        return None
    few = posed.some(_spread(len(posed.views)))

    def contradicted(size: Float) -> float:
        right = kind.of_size(size).undone(few)
        return 1 - compare(right.views, right.poses).share

    start = min(kind.starts(few), key=contradicted)
    simplex = start + kind.step * np.vstack([np.zeros(len(start)), np.eye(len(start))])
    found = minimize(
        contradicted,
        start,
        method="Nelder-Mead",
        options={"maxfev": MOST_TRIALS, "initial_simplex": simplex, "xatol": 1e-3},
    )
    size = np.asarray(found.x, np.float64)
    if np.linalg.norm(size) < kind.least:
        return None
    mistake = kind.of_size(size)
    right = mistake.undone(posed)
    return mistake if explains(as_read, compare(right.views, right.poses)) else None


def _spread(count: int) -> Index:
    """Return evenly spaced indices of the frames used in a search."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_FITTED)).astype(int))


def relative_change(poses: Float, others: Float) -> Mask:
    """Return the pairs of cameras whose relative pose differs between two sets of poses, (N, N).

    Args:
        poses: camera-to-world, (N, 4, 4).
        others: the same cameras with other poses, (N, 4, 4).
    """
    relative = np.linalg.inv(poses)[:, None] @ poses[None]
    other_relative = np.linalg.inv(others)[:, None] @ others[None]
    return np.abs(relative - other_relative).max((2, 3)) > SAME_POSE


def judgeable(views: Sequence[SurfaceView]) -> float:
    """Return the number of judgements if all frames saw all points, with both tolerances."""
    return 2.0 * sum(len(view.points) for view in views) * (len(views) - 1)


def in_one_place(posed: PosedViews) -> bool:
    """Return True if all cameras are in one place, where rotations cannot be verified."""
    places = posed.poses[:, :3, 3]
    apart = np.linalg.norm(places - np.median(places, 0), axis=1)
    return bool(np.quantile(apart, 0.9) < ONE_PLACE * posed.median_depth)


def _pairs(single: Sequence[Mistake]) -> Iterator[Mistake]:
    """Combine mistakes of different kinds in pairs; the first one in the list is undone first."""
    single = [mistake for mistake in single if not mistake.alone]
    for i, first in enumerate(single):
        for second in single[i + 1 :]:
            if first.kind == second.kind:
                continue
            yield Mistake(
                f"{first.name}, {second.name}",
                f"{first.kind}, {second.kind}",
                f"{first.sentence} and {second.sentence}",
                _one_after_the_other(first, second),
            )


def _one_after_the_other(
    first: Mistake,
    second: Mistake,
) -> Callable[[PosedViews], PosedViews]:
    return lambda posed: second.undone(first.undone(posed))


# List of mistakes


def usual_mistakes(posed: PosedViews) -> list[Mistake]:
    """Return all mistakes without a magnitude that are possible with the storage conventions.

    Late poses depend on the order of the frames, see ``captured.late_poses``.

    Args:
        posed: frames and poses as read.
    """
    return [
        *mistakes_in_poses(posed.stored.to_world),
        *_mistakes_in_quaternions(),
        *_mirrored_pictures(),
        *_scales(posed.stored, posed.median_depth, _all_scales(posed.stored)),
    ]


@cache
def mistakes_of_frame(stored: Stored, has_pose: bool) -> tuple[Mistake, ...]:
    """Return all mistakes that a single frame may have.

    Args:
        stored: storage conventions of the frame.
        has_pose: whether it has a pose.
    """
    along_rays = (
        "the depth is measured along the rays, a range: give it along the optical axis"
    )
    of_one_frame = partial(_scales, stored, 1.0)
    steps = STEPS_PRIOR if stored.step else Mistake.prior
    found = (
        Mistake("range", "range", along_rays, lambda posed: posed),
        *(replace(one, prior=steps) for one in of_one_frame(TIMES_TOO_LARGE)),
        *of_one_frame((1 / 0.3048, 1 / 0.0254)),
    )
    if not has_pose:
        return found
    return (
        *found,
        *of_one_frame((0.001,)),
        *(replace(one, prior=UNUSUAL_MISTAKE) for one in of_one_frame((0.01,))),
        *mistakes_in_poses(),
        *_mistakes_in_quaternions(),
        *_mirrored_pictures(),
    )


def fitted_mistakes(focal_length: float) -> dict[str, FittedMistake]:
    """Return the kinds of mistakes that have a magnitude, by name.

    Args:
        focal_length: of the frames, pixels, for the message.
    """
    return {
        "focal length": FittedMistake(
            starts=lambda posed: list(FOCAL_STEPS[:, None]),
            step=0.0125,
            least=LEAST_FOCAL_CHANGE,
            of_size=lambda size: _wrong_focal_length(float(size[0]), focal_length),
        ),
        "offset": FittedMistake(
            starts=lambda posed: [np.zeros(3), _offset_of_middles(posed)],
            step=0.03,
            least=LEAST_OFFSET,
            of_size=_offset_camera,
        ),
    }


def mistakes_in_poses(to_world: bool = True) -> list[Mistake]:
    """Return the mistakes of single poses: axes, inverse poses, and rotated images.

    Args:
        to_world: whether camera-to-world poses were expected.
    """
    expected = "camera-to-world" if to_world else "world-to-camera"
    other = "world-to-camera" if to_world else "camera-to-world"
    wrong = f"{expected} ones are expected, and"
    opencv = "and OpenCV's are expected (x right, y down, z forward)"
    opengl = "the camera's axes are those of OpenGL (x right, y up, z backward)"
    ros = "the camera's axes are those of a ROS body (x forward, y left, z up)"

    return [
        Mistake(
            "inverse pose",
            "inverse",
            f"the poses are inverse: {wrong} these are {other}",
            _posed(_inverted),
        ),
        Mistake(
            "inverse rotation",
            "inverse",
            f"the rotations are inverse: {wrong} only the translations are",
            _posed(_in_stored(_rotation_inverted, to_world)),
            prior=UNUSUAL_MISTAKE,
        ),
        Mistake(
            "inverse translation",
            "inverse",
            f"the translations are those of inverse poses: {wrong} only the rotations are",
            _posed(_in_stored(_translation_inverted, to_world)),
            prior=UNUSUAL_MISTAKE,
        ),
        Mistake(
            "opengl axes",
            "axes",
            f"{opengl}, {opencv}",
            _turned_by(CAMERA_AXES["opengl"]),
        ),
        Mistake("ros axes", "axes", f"{ros}, {opencv}", _turned_by(CAMERA_AXES["ros"])),
        *_turned_pictures(),
    ]


def _turned_pictures() -> list[Mistake]:
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    by_a_quarter = "the picture is turned to the {} by a quarter turn"

    return [
        Mistake(
            "turned left",
            "picture",
            by_a_quarter.format("left"),
            _turned_by(quarter),
            True,
        ),
        Mistake(
            "turned right",
            "picture",
            by_a_quarter.format("right"),
            _turned_by(quarter.T),
            True,
        ),
        Mistake(
            "turned over",
            "picture",
            "the picture stands on its head, turned by half a turn",
            _turned_by(quarter @ quarter),
            True,
        ),
    ]


def _mirrored_pictures() -> list[Mistake]:
    return [
        Mistake(
            f"mirrored {way}",
            "picture",
            f"the picture is flipped {way}",
            _turned_by(np.diag(signs)),
            True,
        )
        for way, signs in (
            ("left to right", (-1.0, 1.0, 1.0)),
            ("top to bottom", (1.0, -1.0, 1.0)),
        )
    ]


def _mistakes_in_quaternions() -> list[Mistake]:
    """Return mistakes in the order of quaternions, for files of poses or of inverse poses."""
    return [
        Mistake(
            "quaternions",
            "quaternions",
            f"the quaternions are in the order {wrong}, and were taken for {right}",
            _posed(_in_stored(_quaternion_rolled(steps), to_world)),
        )
        for steps, wrong, right in (
            (1, "w, x, y, z", "x, y, z, w"),
            (-1, "x, y, z, w", "w, x, y, z"),
        )
        for to_world in (True, False)
    ]


def _all_scales(stored: Stored) -> list[float]:
    """Return ratios of units of length and of depth units."""
    units = {round(unit / stored.unit, 6) for unit in UNIT_NAMES if unit != stored.unit}
    return sorted(units | set(DEPTH_SCALES))


def _scales(
    stored: Stored, median_depth: float, scales: Sequence[float]
) -> list[Mistake]:
    """Return mistakes in the unit of translations or of depth, which are equivalent up to scale."""
    return [
        Mistake(
            f"scale {scale:g}",
            "scale",
            _scale_in_words(scale, stored, median_depth),
            _posed(_scaled(scale)),
            alone=scale not in COMMON_SCALES,
            scale=scale,
        )
        for scale in scales
    ]


def _scale_in_words(scale: float, stored: Stored, median_depth: float) -> str:
    """Describe the correction: multiply translations by a scale, or divide depths by it."""
    unit = stored.unit * scale
    other = _nearest_unit(unit)
    translations = ""
    if abs(np.log(other / unit)) < 0.01:
        translations = (
            f"the translations are in {UNIT_NAMES[other]}, where"
            f" {UNIT_NAMES[stored.unit]} are expected"
        )

    times = max(scale, 1 / scale)
    size = "large" if scale > 1 else "small"
    if stored.step:
        why = (
            f"its steps are of {1000 * stored.step / scale:.3g} mm, not of"
            f" {1000 * stored.step:.3g} mm ({stored.step_told_by})"
        )
    else:
        own = _nearest_unit(1 / scale)
        named = abs(np.log(own * scale)) < 0.01
        why = f"is it in {UNIT_NAMES[own] if named else 'another unit'}"
    depths = f"the depth is {times:g} times too {size}: {why}"
    if not translations or not _is_plausible(median_depth):
        return depths
    return translations if times >= NEVER_A_DEPTH else f"{depths}; or {translations}"


def _nearest_unit(unit: float) -> float:
    return min(UNIT_NAMES, key=lambda each: abs(np.log(each / unit)))


def _is_plausible(depth: float) -> bool:
    """Return True if a median depth, metres, is plausible for a frame of an object."""
    return PLAUSIBLE_DEPTH[0] <= depth <= PLAUSIBLE_DEPTH[1]


def _wrong_focal_length(log_times: float, given: float) -> Mistake:
    """Return the mistake of a focal length, pixels, that must be multiplied by exp(log_times)."""
    times = float(np.exp(log_times))
    wrong = 1 / times - 1
    size = "long" if wrong > 0 else "short"
    sentence = (
        f"the focal length is some {100 * abs(wrong):.0f} % too {size} ({given:.0f} pixels, about"
        f" {times * given:.0f} fit): are these the intrinsics of another camera or picture size?"
    )

    def undone(posed: PosedViews) -> PosedViews:
        views = [view.with_focal_length(times) for view in posed.views]
        return replace(posed, views=views)

    return Mistake("focal length", "intrinsics", sentence, undone)


def focal_that_levels(frame: Frame, normal: Float, upwards: Float) -> Mistake | None:
    """Find the focal length with which a plane that is not level would be.

    The points of an image are x = (u - c) z / f: another focal length stretches them across the
    optical axis, and what is flat stays flat.

    Args:
        frame: with a pose.
        normal: of the plane with the focal length as given, (3,), world.
        upwards: direction against gravity, (3,), world.

    Returns:
        The mistake; None if no plausible focal length makes the plane level.
    """
    to_camera = frame.camera_to_world[:3, :3].T
    normal, up = to_camera @ normal, to_camera @ upwards
    across, expected = np.hypot(*normal[:2]), np.hypot(*up[:2])
    if not (normal[2] * up[2] > 0 and across > 0 and expected > 0):
        return None
    times = float(expected / across * normal[2] / up[2])
    right = normal * [times, times, 1.0]
    right /= np.linalg.norm(right)
    log_times = float(np.log(times))
    if np.abs(log_times) > FOCAL_STEPS.max() or np.abs(log_times) < LEAST_FOCAL_CHANGE:
        return None
    if right @ up < np.cos(LEVEL_ERROR):
        return None
    return _wrong_focal_length(log_times, float(frame.intrinsics[0, 0]))


def _offset_camera(offset: Float) -> Mistake:
    """Return the mistake of poses with a constant offset in the camera frame, (3,), metres."""
    where = ", ".join(f"{value:+.2f}" for value in offset)
    sentence = (
        f"the camera stands some {100 * np.linalg.norm(offset):.0f} cm beside its poses, the same"
        f" way in all frames ({where} m along its axes x right, y down, z forward): is the hand-eye"
        " calibration missing or wrong?"
    )

    def moved(poses: Float) -> Float:
        poses = poses.copy()
        poses[:, :3, 3] += poses[:, :3, :3] @ offset
        return poses

    return Mistake("offset", "calibration", sentence, _posed(moved))


def _offset_of_middles(posed: PosedViews) -> Float:
    """Estimate the offset, (3,), metres, that aligns the object's centre in all frames.

    Least squares in the object position w and the offset d, with w - R d = R c + t for the centre c
    seen by a camera with pose (R, t). Cameras see only the near side of the object, which causes an
    error along their axes.
    """
    matrix = []
    middles = []
    for view, pose in zip(posed.views, posed.poses, strict=True):
        points = view.points[view.standing]
        if len(points) >= FEWEST_STANDING:
            rotation = pose[:3, :3]
            matrix.append(np.hstack([np.eye(3), -rotation]))
            middles.append(rotation @ np.median(points, axis=0) + pose[:3, 3])

    if len(matrix) < 2:
        return np.zeros(3)
    solution = np.linalg.lstsq(
        np.vstack(matrix),
        np.concatenate(middles),
        rcond=NOT_OBSERVED,
    )[0]
    return solution[3:]


# Transformations of camera-to-world poses, (N, 4, 4)


def _posed(change: Callable[[Float], Float]) -> Callable[[PosedViews], PosedViews]:
    return lambda posed: posed.with_poses(change(posed.poses))


def _in_stored(
    change: Callable[[Float], Float],
    to_world: bool,
) -> Callable[[Float], Float]:
    """Apply a change of the stored poses to camera-to-world poses."""
    if to_world:
        return change
    return lambda poses: _inverted(change(_inverted(poses)))


def _turned_by(axes: Float) -> Callable[[PosedViews], PosedViews]:
    def turned(poses: Float) -> Float:
        poses = poses.copy()
        poses[:, :3, :3] = poses[:, :3, :3] @ axes
        return poses

    return _posed(turned)


def _scaled(scale: float) -> Callable[[Float], Float]:
    def scaled(poses: Float) -> Float:
        poses = poses.copy()
        poses[:, :3, 3] *= scale
        return poses

    return scaled


def _inverted(poses: Float) -> Float:
    return np.asarray(np.linalg.inv(poses), np.float64)


def _rotation_inverted(poses: Float) -> Float:
    poses = poses.copy()
    poses[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    return poses


def _translation_inverted(poses: Float) -> Float:
    poses = poses.copy()
    poses[:, :3, 3] = -(poses[:, :3, :3] @ poses[:, :3, 3, None])[:, :, 0]
    return poses


def _quaternion_rolled(steps: int) -> Callable[[Float], Float]:
    """Return the rotations for another order of the quaternion components x, y, z, w."""

    def rolled(poses: Float) -> Float:
        poses = poses.copy()
        quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        # e.g. (x, y, z, w) as read are w, x, y, z: roll to the left by one
        right = np.roll(quaternions, -steps, axis=1)
        poses[:, :3, :3] = Rotation.from_quat(right).as_matrix()
        return poses

    return rolled
