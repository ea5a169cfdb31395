"""The usual mistakes in the poses of captured frames, and which of them makes the frames agree."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from nextview.captured.shifted_poses import (
    FEWER_CONTRADICTIONS,
    LEAST_OVERLAP,
    relative_change,
)
from nextview.sensing.agreement import Agreement, SurfaceView, compare
from nextview.sensing.frame import CAMERA_AXES
from nextview.sensing.planes import QUARTER
from nextview.types import Float, Index

# points that two frames or more have to share before anything is said
FEWEST_JUDGED = 100
CERTAIN_SHARE = 0.99  # share of confirmed points from which no mistake is searched for
# a mistake is named if FEWER_CONTRADICTIONS are left without it, of at least this share of the
# points that it concerns
LEAST_CONTRADICTED = 0.08
# as read, frames that see less than this part of what they could see in common look past each other
NO_OVERLAP = 0.25
WELL_EXPLAINED = 0.85  # share of the points that are confirmed without the mistake
ONE_PLACE = 0.1  # cameras within this part of the depth stand in one place: no capture of an object
UNIT_NAMES = {
    1.0: "metres",
    0.01: "centimetres",
    0.001: "millimetres",
    0.0254: "inches",
    0.3048: "feet",
}
DEPTH_SCALES = (1000, 100, 10, 5, 4, 2.5, 2, 0.5, 0.4, 0.25, 0.2, 0.1, 0.01, 0.001)
"""By which the depth may be too large: the steps of cameras are 1, 0.5, 0.25, 0.2, 0.125 and 0.1
mm.
"""
# of a picture that was turned so
QUARTER_TURNS = {"left": QUARTER, "right": QUARTER.T}
# that are tried together with another mistake
COMMON_SCALES = (1000, 0.001, 10, 0.1, 5, 0.2, 4, 0.25)


@dataclass(frozen=True)
class PoseMistake:
    """One mistake that captured poses may have.

    Attributes:
        kind: "inverse", "quaternion", "axes", "turned", "scale" or "mixed".
        sentence: what it looks like, the end of a sentence; empty for a scale, which may be that
            of the translations or of the depth.
        corrected: makes the right poses of the wrong ones, both camera-to-world, (N, 4, 4).
        scale: by which the translations are multiplied.
    """

    kind: str
    sentence: str
    corrected: Callable[[Float], Float]
    scale: float = 1.0


@dataclass(frozen=True)
class Posed:
    """Frames that are compared, among all those of a capture.

    Attributes:
        views: N frames.
        indices: which of all frames they are, (N,).
        poses: of all frames, in their order, as read, camera-to-world, (M, 4, 4).
        to_world: whether the layout stores camera-to-world poses.
        unit: of the translations that the layout stores, metres.
    """

    views: Sequence[SurfaceView]
    indices: Index
    poses: Float
    to_world: bool
    unit: float

    def as_read(self) -> Float:
        """The poses of the views, (N, 4, 4)."""
        return self.poses[self.indices]


def find_mistake(posed: Posed, as_read: Agreement) -> PoseMistake | None:
    """Return the mistake whose correction makes frames agree much better.

    First each mistake is tried alone, then two at once.

    Args:
        posed: the frames with their poses.
        as_read: agreement of the frames as they are.

    Returns:
        The mistake; None if there is none.
    """
    overlap = as_read.judged / max(_judgeable(posed.views), 1)
    if overlap > NO_OVERLAP and as_read.share > CERTAIN_SHARE:
        return None
    single = _single_mistakes(posed.to_world, posed.unit)
    return _best(posed, as_read, single) or _best(posed, as_read, _pairs(single))


def _best(
    posed: Posed,
    as_read: Agreement,
    mistakes: Sequence[PoseMistake],
) -> PoseMistake | None:
    """Return the mistake with the most confirmed points, if it explains much more."""
    best = None
    most_confirmed = 0.0
    for mistake in mistakes:
        confirmed = _explained(posed, as_read, mistake)
        if confirmed > most_confirmed:
            best = mistake
            most_confirmed = confirmed
    return best


def _explained(posed: Posed, as_read: Agreement, mistake: PoseMistake) -> float:
    """How many points are confirmed without a mistake; 0 if that is not much better than with it.

    Only the pairs of frames count whose poses relative to each other the mistake changes.
    """
    views = posed.views
    poses = mistake.corrected(posed.as_read())
    if _in_one_place(views, poses):
        return 0.0

    changed = relative_change(poses, posed.as_read())
    with_it = as_read.among(changed)
    without = compare(views, poses).among(changed)
    if without.judged < FEWEST_JUDGED or without.share < WELL_EXPLAINED:
        return 0.0

    possible = _judgeable(views) * changed.sum() / max(changed.size - len(changed), 1)
    looks_past = (
        with_it.judged < NO_OVERLAP * without.judged and without.judged > possible / 2
    )
    wrong = 1 - with_it.share
    contradicted = (
        with_it.judged >= FEWEST_JUDGED
        and wrong > LEAST_CONTRADICTED
        and 1 - without.share < FEWER_CONTRADICTIONS * wrong
        and without.judged > LEAST_OVERLAP * with_it.judged
    )
    return float(without.confirmed.sum()) if looks_past or contradicted else 0.0


def _judgeable(views: Sequence[SurfaceView]) -> float:
    """How many points could be judged if all frames showed all of them."""
    return float(sum(len(view.points) for view in views) * (len(views) - 1))


def _in_one_place(views: Sequence[SurfaceView], poses: Float) -> bool:
    """Return whether all cameras stand in one place, where rotations cannot be told."""
    depths = [np.median(view.points[:, 2]) for view in views if len(view.points)]
    places = poses[:, :3, 3]
    apart = np.linalg.norm(places - np.median(places, 0), axis=1)
    return not depths or bool(np.quantile(apart, 0.9) < ONE_PLACE * np.median(depths))


# The mistakes; poses that are late or early are found in ``shifted_poses``


def _single_mistakes(to_world: bool, unit: float) -> list[PoseMistake]:
    """Return all mistakes but shifts, of poses in some convention and unit."""
    stored = "camera-to-world"
    other = "world-to-camera"
    if not to_world:
        stored, other = other, stored

    found = [
        PoseMistake(
            "inverse",
            f"the poses are inverse: this layout has {stored} poses, and these are {other}",
            _inverted,
        ),
        PoseMistake(
            "mixed",
            f"the rotations are inverse: this layout has {stored} poses, and only the"
            " translations are",
            _in_stored(_rotation_inverted, to_world),
        ),
        PoseMistake(
            "mixed",
            f"the translations are those of inverse poses: this layout has {stored} poses, and only"
            " the rotations are",
            _in_stored(_translation_inverted, to_world),
        ),
    ]

    for name, axes in (
        ("OpenGL", CAMERA_AXES["opengl"]),
        ("a ROS body", CAMERA_AXES["ros"]),
    ):
        sentence = f"the camera's axes are those of {name}, and OpenCV's are expected (x right, "
        sentence += "y down, z forward)"
        found.append(PoseMistake("axes", sentence, _turned_by(axes)))

    for way, axes in QUARTER_TURNS.items():
        sentence = f"the depth images are turned to the {way} by a quarter turn"
        found.append(PoseMistake("turned", sentence, _turned_by(axes)))

    for steps, wrong, right in (
        (1, "w, x, y, z", "x, y, z, w"),
        (-1, "x, y, z, w", "w, x, y, z"),
    ):
        sentence = (
            f"the quaternions are in the order {wrong}, and were taken for {right}"
        )
        for in_world in (True, False):
            corrected = _in_stored(_quaternion_rolled(steps), in_world)
            found.append(PoseMistake("quaternion", sentence, corrected))

    units = {round(other / unit, 6) for other in UNIT_NAMES if other != unit}
    return found + [_scaled(scale) for scale in sorted(units | set(DEPTH_SCALES))]


def _pairs(single: Sequence[PoseMistake]) -> list[PoseMistake]:
    """Two mistakes at once, of two kinds; of the scales only the commonest."""
    single = [
        m
        for m in single
        if m.kind != "turned" and (m.scale == 1 or m.scale in COMMON_SCALES)
    ]
    found = []
    for i, first in enumerate(single):
        for second in single[i + 1 :]:
            if first.kind == second.kind or {first.kind, second.kind} == {
                "mixed",
                "inverse",
            }:
                continue

            found.append(
                PoseMistake(
                    f"{first.kind} and {second.kind}",
                    " and ".join(filter(None, (first.sentence, second.sentence))),
                    _one_after_the_other(first.corrected, second.corrected),
                    scale=first.scale * second.scale,
                )
            )
    return found


def _one_after_the_other(
    first: Callable[[Float], Float],
    second: Callable[[Float], Float],
) -> Callable[[Float], Float]:
    return lambda poses: second(first(poses))


def _scaled(scale: float) -> PoseMistake:
    def corrected(poses: Float) -> Float:
        poses = poses.copy()
        poses[:, :3, 3] *= scale
        return poses

    return PoseMistake("scale", "", corrected, scale=scale)


def _turned_by(axes: Float) -> Callable[[Float], Float]:
    def corrected(poses: Float) -> Float:
        poses = poses.copy()
        poses[:, :3, :3] = poses[:, :3, :3] @ axes
        return poses

    return corrected


def _in_stored(
    change: Callable[[Float], Float],
    to_world: bool,
) -> Callable[[Float], Float]:
    """A change of camera-to-world poses by one of the poses as they are stored."""
    if to_world:
        return change
    return lambda poses: _inverted(change(_inverted(poses)))


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

    def corrected(poses: Float) -> Float:
        poses = poses.copy()
        quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        # (x, y, z, w) as read are w, x, y, z in truth: they move to the left by one.
        rolled = np.roll(quaternions, -steps, axis=1)
        poses[:, :3, :3] = Rotation.from_quat(rolled).as_matrix()
        return poses

    return corrected
