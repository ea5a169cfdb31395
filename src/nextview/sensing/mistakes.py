"""The mistakes with which depth and poses are read, each with the change that undoes it.

Frames have several readings: as they were handed in, or with one of these mistakes undone. The
reading that agrees best with all that is known tells which mistake was made: of a new frame of a
session or a scene (``known_frames``), and of the frames of a folder (``captured.check``). To add a
mistake, add an entry to ``mistakes``.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from nextview.sensing.agreement import SurfaceView
from nextview.sensing.frame import CAMERA_AXES
from nextview.types import Float

UNITS = {
    1.0: "metres",
    0.01: "centimetres",
    0.001: "millimetres",
    0.0254: "inches",
    0.3048: "feet",
}
UNUSUAL = 1e-4  # prior of centimetres, and of a pose of which one half is inverse
QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Stored:
    """Storage conventions of frames and poses, so that messages can name the expected ones.

    Attributes:
        focal_length: of the frames, pixels.
        median_depth: of the frames, metres.
        to_world: whether the poses are camera-to-world; otherwise world-to-camera.
        unit: of the translations, metres.
        step: unit of the depth images, metres; 0 for float metres.
        step_told_by: source of that unit.
    """

    focal_length: float
    median_depth: float = 1.0
    to_world: bool = True
    unit: float = 1.0
    step: float = 0.0
    step_told_by: str = "as uint16 is taken; hand it in as float metres"


@dataclass(frozen=True)
class PosedViews:
    """Frames, and the poses of their cameras, camera-to-world, (N, 4, 4), metres."""

    views: Sequence[SurfaceView]
    poses: Float


@dataclass(frozen=True)
class Mistake:
    """A mistake, with the change that undoes it.

    Attributes:
        name: of the affected quantity; two whose names share a word are not combined.
        sentence: description, the end of a sentence.
        right_poses: function that corrects poses, camera-to-world, (N, 4, 4).
        prior: probability that a single frame has it; 0 if only many frames tell.
        combines: whether it is also tried together with another one.
        scale: factor by which the depth is too large, or the translations are too small.
        focal: factor by which the focal length is too small.
    """

    name: str
    sentence: str
    right_poses: Callable[[Float], Float] = lambda poses: poses
    prior: float = 1e-3
    combines: bool = False
    scale: float = 1.0
    focal: float = 1.0

    def undone(self, posed: PosedViews) -> PosedViews:
        """Return the frames without the mistake."""
        views = posed.views
        if self.focal != 1:
            views = [view.with_focal_length(self.focal) for view in views]
        return PosedViews(views, self.right_poses(posed.poses))

    def with_another(self, other: "Mistake") -> "Mistake":
        """Return both mistakes, of which this one is undone first."""
        return Mistake(
            f"{self.name}, {other.name}",
            f"{self.sentence} and {other.sentence}",
            lambda poses: other.right_poses(self.right_poses(poses)),
        )

    def of_single_pose(self, row: int, frame: str) -> "Mistake":
        """Return the mistake in the pose of one frame alone.

        Args:
            row: of the pose.
            frame: name of the frame.
        """
        return replace(
            self,
            sentence=f"in frame {frame} alone, {self.sentence}",
            right_poses=lambda poses: np.where(
                np.arange(len(poses))[:, None, None] == row,
                self.right_poses(poses),
                poses,
            ),
        )


def mistakes(stored: Stored) -> list[Mistake]:
    """Return all mistakes that frames, or a single one, may have.

    Late poses depend on the order of the frames, see ``captured.late_poses``.

    Args:
        stored: storage conventions of the frames.
    """
    steps = 1e-2 if stored.step else 1e-3  # of frames in 16 bits, one in twenty
    priors = {0.001: 1e-3, 0.01: UNUSUAL, 1 / 0.3048: 1e-3, 1 / 0.0254: 1e-3}
    # The depth units of cameras are 1, 0.5, 0.25, 0.2, 0.125 and 0.1 mm.
    priors |= dict.fromkeys((2, 4, 5, 8, 10), steps)
    units = {round(unit / stored.unit, 6) for unit in UNITS if unit != stored.unit}
    others = (1000, 100, 2.5, 0.5, 0.4, 0.25, 0.2, 0.1, 0.01, 0.001)
    return [
        Mistake(
            "range",
            "the depth is measured along the rays, a range: give it along the optical axis",
        ),
        *in_poses(stored.to_world),
        *(_of_scale(scale, stored, prior) for scale, prior in priors.items()),
        *(_of_scale(scale, stored, 0) for scale in {*others, *units} - {*priors}),
        *(_of_focal_length(k / 20, stored) for k in range(-14, 15) if k),
    ]


def in_poses(to_world: bool = True) -> list[Mistake]:
    """Return the mistakes of single poses: axes, inverse poses, rotated and mirrored images.

    Args:
        to_world: whether camera-to-world poses were expected.
    """
    expected, other = "camera-to-world", "world-to-camera"
    if not to_world:
        expected, other = other, expected

    wrong = f"{expected} ones are expected, and"
    opencv = "and OpenCV's are expected (x right, y down, z forward)"
    by_a_quarter = "the picture is turned to the {} by a quarter turn"
    return [
        Mistake(
            "inverse pose",
            f"the poses are inverse: {wrong} these are {other}",
            _inverted,
            combines=True,
        ),
        Mistake(
            "inverse rotation",
            f"the rotations are inverse: {wrong} only the translations are",
            _in_stored(_rotation_inverted, to_world),
            UNUSUAL,
            combines=True,
        ),
        Mistake(
            "inverse translation",
            f"the translations are those of inverse poses: {wrong} only the rotations are",
            _in_stored(lambda poses: _inverted(_rotation_inverted(poses)), to_world),
            UNUSUAL,
            combines=True,
        ),
        *(
            Mistake(name, sentence, partial(_turned, by=by), combines="axes" in name)
            for name, sentence, by in (
                (
                    "opengl axes",
                    "the camera's axes are those of OpenGL (x right, y up, z backward),"
                    f" {opencv}",
                    CAMERA_AXES["opengl"],
                ),
                (
                    "ros axes",
                    "the camera's axes are those of a ROS body (x forward, y left, z up),"
                    f" {opencv}",
                    CAMERA_AXES["ros"],
                ),
                ("turned", by_a_quarter.format("left"), QUARTER_TURN),
                ("turned", by_a_quarter.format("right"), QUARTER_TURN.T),
                (
                    "turned",
                    "the picture stands on its head, turned by half a turn",
                    np.diag([-1.0, -1, 1]),
                ),
                (
                    "mirrored",
                    "the picture is flipped left to right",
                    np.diag([-1.0, 1, 1]),
                ),
                (
                    "mirrored",
                    "the picture is flipped top to bottom",
                    np.diag([1.0, -1, 1]),
                ),
            )
        ),
        *(
            Mistake(
                "quaternions",
                f"the quaternions are in the order {order}, and were taken for {taken}",
                _in_stored(partial(_quaternions_rolled, steps=steps), of_world),
                combines=True,
            )
            for steps, order, taken in (
                (1, "w, x, y, z", "x, y, z, w"),
                (-1, "x, y, z, w", "w, x, y, z"),
            )
            for of_world in (True, False)
        ),
    ]


def _of_scale(scale: float, stored: Stored, prior: float) -> Mistake:
    """Return the mistake in the unit of translations or of depth, which are equivalent up to scale.

    Translations are multiplied by the scale, or depths divided by it.
    """
    unit = stored.unit * scale
    other = min(UNITS, key=lambda each: abs(np.log(each / unit)))
    translations = ""
    if abs(np.log(other / unit)) < 0.01:
        translations = (
            f"the translations are in {UNITS[other]}, where {UNITS[stored.unit]} are"
            " expected"
        )
    times = max(scale, 1 / scale)
    if stored.step:
        why = (
            f"its steps are of {1000 * stored.step / scale:.3g} mm, not of"
            f" {1000 * stored.step:.3g} mm ({stored.step_told_by})"
        )
    else:
        own = min(UNITS, key=lambda each: abs(np.log(each * scale)))
        named = abs(np.log(own * scale)) < 0.01
        why = f"is it in {UNITS[own] if named else 'another unit'}"
    size = "large" if scale > 1 else "small"
    sentence = f"the depth is {times:g} times too {size}: {why}"
    # a capture of an object has a median depth of 5 cm to 15 m
    if translations and 0.05 <= stored.median_depth <= 15:
        # a large factor is rarely an error of the depth unit
        sentence = translations if times >= 25 else f"{sentence}; or {translations}"
    return Mistake(
        "scale",
        sentence,
        partial(_scaled, scale=scale),
        prior,
        combines=scale in (1000, 0.001, 10, 0.1, 5, 0.2, 4, 0.25),
        scale=scale,
    )


def _of_focal_length(log_times: float, stored: Stored) -> Mistake:
    """Return the mistake of a focal length that must be multiplied by exp(log_times)."""
    times = float(np.exp(log_times))
    wrong = 1 / times - 1
    given = stored.focal_length
    sentence = (
        f"the focal length is some {100 * abs(wrong):.0f} % too"
        f" {'long' if wrong > 0 else 'short'} ({given:.0f} pixels, about {times * given:.0f} fit):"
        " are these the intrinsics of another camera or picture size?"
    )
    return Mistake("focal length", sentence, prior=3e-3, focal=times)


# Changes of camera-to-world poses, (N, 4, 4)


def _in_stored(
    change: Callable[[Float], Float], to_world: bool
) -> Callable[[Float], Float]:
    """Apply a change of the stored poses to camera-to-world poses."""
    if to_world:
        return change
    return lambda poses: _inverted(change(_inverted(poses)))


def _changed(poses: Float, rotations: Float, places: Float) -> Float:
    """Return poses with other rotations, (N, 3, 3), and places, (N, 3)."""
    found = poses.copy()
    found[:, :3, :3] = rotations
    found[:, :3, 3] = places
    return found


def _turned(poses: Float, by: Float) -> Float:
    return _changed(poses, poses[:, :3, :3] @ by, poses[:, :3, 3])


def _scaled(poses: Float, scale: float) -> Float:
    return _changed(poses, poses[:, :3, :3], scale * poses[:, :3, 3])


def _inverted(poses: Float) -> Float:
    return np.asarray(np.linalg.inv(poses), np.float64)


def _rotation_inverted(poses: Float) -> Float:
    return _changed(poses, poses[:, :3, :3].transpose(0, 2, 1), poses[:, :3, 3])


def _quaternions_rolled(poses: Float, steps: int) -> Float:
    """Return the rotations for another order of the quaternion components x, y, z, w."""
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    # e.g. (x, y, z, w) as read are w, x, y, z: roll to the left by one
    right = Rotation.from_quat(np.roll(quaternions, -steps, axis=1)).as_matrix()
    return _changed(poses, right, poses[:, :3, 3])
