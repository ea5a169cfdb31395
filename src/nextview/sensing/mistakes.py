"""The usual mistakes in what a depth camera gives, each a transformation that undoes it.

A mistake is named where frames that disagree agree without it. All kinds are in one list, and one
score decides: how many points of frames are contradicted by other frames (``agreement``). A new
kind is one entry of ``usual_mistakes``, or of ``fitted_mistakes`` if it has a size.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from nextview.sensing.agreement import (
    ROUGH,
    Agreement,
    SurfaceView,
    compare,
    quick_view,
)
from nextview.sensing.frame import CAMERA_AXES, Frame
from nextview.types import Float, Index, Mask

# A mistake explains contradictions if so much of their share is left without it ...
FEWER_CONTRADICTIONS = 0.5
LEAST_EXPLAINED = 100  # ... if it explains so many ...
LEAST_CONCERNED = 0.01  # ... and such a share of the points that it concerns ...
LEAST_OVERLAP = 0.5  # ... of which this part can still be judged without it
# Right poses of a real camera leave half of this share contradicted: of less no mistake is made.
LEAST_CONTRADICTED = 0.05
# Frames look past each other if less than this part of what they see without a mistake is judged as
# read, and so much of all that can be judged is judged without it.
NO_OVERLAP = 0.25
# Share of the judgements that has to confirm without a mistake. The errors of a usual calibration
# leave .88; of real frames whose poses are in any order, no mistake makes more than .2 confirm.
WELL_EXPLAINED = 0.75
# of two frames: share that confirms if most of what they show stands still
HALF_AGREES = 0.5
# Cameras stand in one place within this part of the depth: less of a move does not show.
ONE_PLACE = ROUGH.depth_tolerance
SAME_POSE = 1e-3  # metres, and parts of a rotation, up to which two poses are the same

UNIT_NAMES = {
    1.0: "metres",
    0.01: "centimetres",
    0.001: "millimetres",
    0.0254: "inches",
    0.3048: "feet",
}
DEPTH_SCALES = (1000, 100, 10, 8, 5, 4, 2.5, 2, 0.5, 0.4, 0.25, 0.2, 0.1, 0.01, 0.001)
"""By which the depth may be too large: the steps of cameras are 1, 0.5, 0.25, 0.2, 0.125 and 0.1
mm.
"""
# that are tried together with another mistake
COMMON_SCALES = (1000, 0.001, 10, 0.1, 5, 0.2, 4, 0.25)
# times by which a depth scale is hardly ever wrong, and a unit of length often
NEVER_A_DEPTH = 25
# metres that a capture of an object may have as its median depth
PLAUSIBLE_DEPTH = (0.05, 15.0)

MOST_FITTED = 20  # frames by which two mistakes, or one with a size, are searched for
MOST_TRIALS = 120  # sizes that are tried
# logarithms of the focal length that are tried first, from a half to twice
FOCAL_STEPS = 0.05 * np.arange(-14, 15)
LEAST_FOCAL_CHANGE = 0.05  # part of the focal length; less is a matter of calibration
LEAST_OFFSET = 0.02  # metres; less is a matter of calibration
FEWEST_STANDING = 10  # points of a frame whose middle tells where its object is
# part of the largest singular value below which an offset has no effect in that direction
NOT_OBSERVED = 1e-2


@dataclass(frozen=True)
class Stored:
    """How frames and their poses are stored, so that a sentence can say what was expected.

    Attributes:
        to_world: whether the poses are camera-to-world; otherwise they are world-to-camera.
        unit: of the translations, metres.
        step: of the depth images, metres.
        step_told_by: what tells that step.
    """

    to_world: bool = True
    unit: float = 1.0
    step: float = 0.001
    step_told_by: str = "as uint16 is taken"


@dataclass(frozen=True)
class PosedViews:
    """Frames and poses as they are taken to be: what a mistake transforms.

    Attributes:
        views: N frames.
        poses: of their cameras, camera-to-world, (N, 4, 4), metres.
        stored: how both were stored.
    """

    views: Sequence[SurfaceView]
    poses: Float
    stored: Stored = Stored()

    @property
    def median_depth(self) -> float:
        """Metres; 0 without any point."""
        depths = [
            np.median(view.points[:, 2]) for view in self.views if len(view.points)
        ]
        return float(np.median(depths)) if depths else 0.0

    def some(self, which: Index | Mask) -> "PosedViews":
        """Some of the frames.

        Args:
            which: their indices, or (N,) bool.
        """
        chosen = [self.views[i] for i in np.arange(len(self.views))[which]]
        return replace(self, views=chosen, poses=self.poses[which])

    def with_poses(self, poses: Float) -> "PosedViews":
        """The frames with other poses, (N, 4, 4)."""
        return replace(self, poses=poses)


@dataclass(frozen=True)
class Mistake:
    """A kind of mistake, with the transformation of the input that undoes it.

    Attributes:
        name: short.
        kind: what it is a mistake in; two of one kind are not made at once.
        sentence: what it looks like, the end of a sentence.
        undone: makes the right input of the wrong one.
        alone: whether it is not tried together with another mistake.
        scale: by which the depth is too large, or the translations are too small.
    """

    name: str
    kind: str
    sentence: str
    undone: Callable[[PosedViews], PosedViews]
    alone: bool = False
    scale: float = 1.0

    def right_pose(self, pose: Float) -> Float:
        """The right pose if this mistake was made in one, camera-to-world, (4, 4)."""
        return self.undone(PosedViews((), pose[None])).poses[0]


@dataclass(frozen=True)
class FittedMistake:
    """A kind of mistake that has a size.

    Attributes:
        starts: where the search for the size begins, (K,) each; the best of them.
        step: of the search.
        least: length of the size from which it is a mistake.
        of_size: the mistake of some size, (K,).
    """

    starts: Callable[[PosedViews], Sequence[Float]]
    step: float
    least: float
    of_size: Callable[[Float], Mistake]


def find_mistake(posed: PosedViews) -> Mistake | None:
    """Return the mistake without which frames agree much better.

    First each mistake is tried alone, then two at once.

    Args:
        posed: frames and poses as they are.

    Returns:
        The mistake; None if the frames agree, or none explains why they do not.
    """
    as_read = compare(posed.views, posed.poses)
    overlap = as_read.judged / max(_judgeable(posed.views), 1)
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
    part: Mask | None = None,
) -> Mistake | None:
    """Return the mistake without which most points are confirmed, if it explains much.

    Args:
        posed: frames and poses as they are.
        mistakes: that may have been made.
        as_read: agreement of the frames as they are.
        part: in which frames they may have been made, (N,) bool; in all by default.
    """
    best = None
    most_confirmed = 0.0
    for mistake in mistakes:
        right = mistake.undone(posed)
        if part is not None:
            right = right.with_poses(
                np.where(part[:, None, None], right.poses, posed.poses)
            )
        if _in_one_place(right):
            continue

        changed = relative_change(posed.poses, right.poses)
        before = as_read.among(changed)
        after = compare(right.views, right.poses).among(changed)

        confirmed = float(after.confirmed.sum())
        if confirmed > most_confirmed and _explains_all(before, after, posed, changed):
            best = mistake
            most_confirmed = confirmed
    return best


def mistake_between(
    frame: Frame, last: Frame, scales: Sequence[float]
) -> Mistake | None:
    """Return the mistake without which a frame agrees with the one before.

    It may be in the depth of both frames, or in the pose of the latter. Frames that agree by half
    have none: what stands in view may move.

    Args:
        frame: a frame with a pose.
        last: the one before.
        scales: by which the depth may be too large.

    Returns:
        The mistake; None if the frames agree, or none explains why they do not.
    """
    views = [quick_view(one) for one in (last, frame)]
    poses = np.stack([last.camera_to_world, frame.camera_to_world])
    posed = PosedViews(views, poses)
    as_read = compare(views, poses)
    if as_read.judged >= LEAST_EXPLAINED and as_read.share > HALF_AGREES:
        return None

    in_depth = _scales(posed, scales)
    in_pose = [
        *mistakes_in_poses(),
        *_mistakes_in_quaternions(),
        *_mirrored_pictures(),
    ]
    of_last = np.array([False, True])
    return likeliest(posed, in_depth, as_read) or likeliest(
        posed, in_pose, as_read, of_last
    )


def explains(before: Agreement, after: Agreement) -> bool:
    """Whether frames contradict each other much less without a mistake than with it.

    Args:
        before: agreement as read, of the pairs of frames that the mistake concerns.
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
    """Whether a mistake explains why frames disagree, or why they look past each other."""
    if after.judged < LEAST_EXPLAINED or after.share < WELL_EXPLAINED:
        return False
    count = len(posed.views)
    possible = _judgeable(posed.views) * changed.sum() / max(count * (count - 1), 1)
    looks_past = (
        before.judged < NO_OVERLAP * after.judged
        and after.judged > NO_OVERLAP * possible
    )
    return looks_past or explains(before, after)


def find_fitted(posed: PosedViews, kind: FittedMistake) -> Mistake | None:
    """Return a mistake of the size without which frames agree best, if it explains much.

    Args:
        posed: frames and poses as they are.
        kind: of the mistake.

    Returns:
        The mistake; None if the frames agree, or it does not explain why they do not.
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
    """Frames of so many by which mistakes are searched for, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_FITTED)).astype(int))


def relative_change(poses: Float, others: Float) -> Mask:
    """Of which two cameras the pose relative to each other differs, (N, N).

    Args:
        poses: camera-to-world, (N, 4, 4).
        others: the same cameras with other poses, (N, 4, 4).
    """
    relative = np.linalg.inv(poses)[:, None] @ poses[None]
    other_relative = np.linalg.inv(others)[:, None] @ others[None]
    return np.abs(relative - other_relative).max((2, 3)) > SAME_POSE


def _judgeable(views: Sequence[SurfaceView]) -> float:
    """How often points would be judged if all frames showed all of them, closely and roughly."""
    return 2.0 * sum(len(view.points) for view in views) * (len(views) - 1)


def _in_one_place(posed: PosedViews) -> bool:
    """Return whether all cameras stand in one place, where rotations cannot be told."""
    places = posed.poses[:, :3, 3]
    apart = np.linalg.norm(places - np.median(places, 0), axis=1)
    return bool(np.quantile(apart, 0.9) < ONE_PLACE * posed.median_depth)


def _pairs(single: Sequence[Mistake]) -> Iterator[Mistake]:
    """Two mistakes at once, of two kinds; the one that comes first in the list is undone first."""
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


# The list


def usual_mistakes(posed: PosedViews) -> list[Mistake]:
    """All kinds of mistakes without a size, as they are made where poses are stored in some way.

    Late poses are a matter of the order of frames, see ``captured.late_poses``.

    Args:
        posed: frames and poses as they are.
    """
    return [
        *mistakes_in_poses(posed.stored.to_world),
        *_mistakes_in_quaternions(),
        *_mirrored_pictures(),
        *_scales(posed, _all_scales(posed.stored)),
    ]


def fitted_mistakes(focal_length: float) -> dict[str, FittedMistake]:
    """The kinds of mistakes that have a size, by name.

    Args:
        focal_length: of the frames, pixels, for the sentence.
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
    """Those that a single pose can have: axes, inverse ones, and pictures that are turned.

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
        ),
        Mistake(
            "inverse translation",
            "inverse",
            f"the translations are those of inverse poses: {wrong} only the rotations are",
            _posed(_in_stored(_translation_inverted, to_world)),
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
    """Of poses that are stored either way: the files may hold the inverse ones."""
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
    """Ratios of the units of length and of the steps of depth images."""
    units = {round(unit / stored.unit, 6) for unit in UNIT_NAMES if unit != stored.unit}
    return sorted(units | set(DEPTH_SCALES))


def _scales(posed: PosedViews, scales: Sequence[float]) -> list[Mistake]:
    """Another unit of the translations, or another step of the depth: the same but for a scale."""
    return [
        Mistake(
            f"scale {scale:g}",
            "scale",
            _scale_in_words(scale, posed),
            _posed(_scaled(scale)),
            alone=scale not in COMMON_SCALES,
            scale=scale,
        )
        for scale in scales
    ]


def _scale_in_words(scale: float, posed: PosedViews) -> str:
    """Translations have to be multiplied by a scale, or depths divided by it."""
    stored = posed.stored
    unit = stored.unit * scale
    other = min(UNIT_NAMES, key=lambda each: abs(np.log(each / unit)))
    translations = ""
    if abs(np.log(other / unit)) < 0.01:
        translations = (
            f"the translations are in {UNIT_NAMES[other]}, where"
            f" {UNIT_NAMES[stored.unit]} are expected"
        )

    times = max(scale, 1 / scale)
    size = "large" if scale > 1 else "small"
    depths = (
        f"the depth is {times:g} times too {size}: its steps are of"
        f" {1000 * stored.step / scale:.3g} mm, not of {1000 * stored.step:.3g} mm"
        f" ({stored.step_told_by})"
    )
    if not translations or not _is_plausible(posed.median_depth):
        return depths
    return translations if times >= NEVER_A_DEPTH else f"{depths}; or {translations}"


def _is_plausible(depth: float) -> bool:
    """Whether a median depth, metres, may be that of a frame that shows an object."""
    return PLAUSIBLE_DEPTH[0] <= depth <= PLAUSIBLE_DEPTH[1]


def _wrong_focal_length(log_times: float, given: float) -> Mistake:
    """A focal length, pixels, that has to be multiplied by the exponential of a number."""
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


def _offset_camera(offset: Float) -> Mistake:
    """Poses beside which the cameras stand, by an offset along their own axes, (3,), metres."""
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
    """Return the offset, (3,), metres, that brings the object's middles closest together.

    Least squares in the place w of the object and the offset d, with w - R d = R c + t for the
    middle c that a camera of the pose (R, t) sees. Cameras see the near side of the object: that is
    an error along their axes.
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


# Transformations of poses, camera-to-world, (N, 4, 4)


def _posed(change: Callable[[Float], Float]) -> Callable[[PosedViews], PosedViews]:
    return lambda posed: posed.with_poses(change(posed.poses))


def _in_stored(
    change: Callable[[Float], Float],
    to_world: bool,
) -> Callable[[Float], Float]:
    """A change of camera-to-world poses by one of the poses as they are stored."""
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
    """The rotations if the quaternions x, y, z, w that give them are in another order."""

    def rolled(poses: Float) -> Float:
        poses = poses.copy()
        quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        # (x, y, z, w) as read are w, x, y, z in truth: they move to the left by one.
        right = np.roll(quaternions, -steps, axis=1)
        poses[:, :3, :3] = Rotation.from_quat(right).as_matrix()
        return poses

    return rolled
