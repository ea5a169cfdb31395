"""The known world before a new frame, and what is checked of the frame itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nextview.checks import one_line
from nextview.errors import ObservationError
from nextview.geometry.axes import upright_axes
from nextview.geometry.observation import Observation
from nextview.geometry.viewsphere import VISITED_ANGLE, angle_between, direction_of
from nextview.sensing.camera_offsets import camera_offsets
from nextview.sensing.frame import Frame, stands_still
from nextview.sensing.lean import lean_of
from nextview.sensing.planes import POSE_SHIFT, Plane
from nextview.sensing.plausibility import (
    check_frame,
    check_lean,
    check_level,
    check_pose_moved,
    check_views,
)
from nextview.sensing.view_warning import ViewWarning
from nextview.types import Float

# tolerance for the third rows of two poses that differ only by a rotation about the vertical
SAME_THIRD_ROW = 1e-4
REPEATED = ViewWarning(
    "repeated",
    "this picture was handed in before, to the last bit, and counts once: does the camera hang?",
)


@dataclass(frozen=True)
class KnownFrames:
    """Known world before a new frame.

    Attributes:
        frames: used frames, in order, with their original poses.
        planes: the support plane in each of them; None if it is not visible.
        up: direction against gravity in the world, (3,); None for the normal of the support plane.
        target: expected position of an object, (3,), world, metres; None if not known.
        radius: of that object, metres.
    """

    frames: tuple[Frame, ...] = ()
    planes: tuple[Plane | None, ...] = ()
    up: Float | None = None
    target: Float | None = None
    radius: float = 0.0

    @property
    def last(self) -> Frame | None:
        """The last frame; None for a first one."""
        return self.frames[-1] if self.frames else None

    @property
    def upwards(self) -> Float | None:
        """Direction against gravity, (3,); the normal of the first visible plane without ``up``."""
        shown = [plane for plane in self.planes if plane is not None]
        return shown[0].normal if self.up is None and shown else self.up

    def refuse(self, frame: Frame) -> None:
        """Reject input that cannot be another frame of the same world, whatever it shows.

        Args:
            frame: new frame.

        Raises:
            ObservationError: the type is wrong, or the pose is missing.
        """
        if not isinstance(frame, Frame):
            raise ObservationError(
                f"what a depth camera gave is a Frame, not {one_line(repr(frame))}"
            )
        if self.frames and (frame.pose is None or self.frames[0].pose is None):
            raise ObservationError(
                "a second frame needs a pose, and the first one too: how else do they fit together?"
            )

    def check(self, frame: Frame, plane: Plane | None) -> list[ViewWarning]:
        """Return likely problems of a frame that was not rejected; usually empty.

        Args:
            frame: new frame.
            plane: the support plane in this frame; None if it is not visible.
        """
        warnings = check_frame(frame)
        own = [one for one in self.frames if one.camera == frame.camera]
        if own and not self.stands(frame):
            warnings += check_pose_moved(frame, own[-1])
        if frame.pose is None:
            return warnings
        if plane is not None and self.up is not None:
            warnings += check_level(frame, plane.normal, self.up)
        warnings += self._check_cameras(frame)
        return warnings + self._check_lean(frame, plane)

    def stands(self, frame: Frame) -> bool:
        """Return True if the camera of a frame has a name and has never moved.

        Args:
            frame: new frame.
        """
        own = [one for one in self.frames if one.camera == frame.camera]
        return bool(own) and stands_still(frame, own)

    def _check_cameras(self, frame: Frame) -> list[ViewWarning]:
        """Warn if the pose of a camera has an error relative to the first camera with a name."""
        named = [one for one in self.frames if one.camera]
        if not frame.camera or not named or named[0].camera == frame.camera:
            return []
        reference = [one for one in named if one.camera == named[0].camera]
        return [
            ViewWarning("camera", str(offset), holds=False)
            for offset in camera_offsets([[reference[-1], frame]])
            if offset.noticed
        ]

    def _check_lean(self, frame: Frame, plane: Plane | None) -> list[ViewWarning]:
        """Warn if the planes of all frames are tilted; a single one may have depth errors."""
        frames = (*self.frames, frame)
        planes = (*self.planes, plane)
        shown = [
            (own, one.camera_to_world)
            for own, one in zip(planes, frames, strict=True)
            if own is not None
        ]
        shown = self._of_one_surface(shown)
        if self.up is None or len(shown) < 2:
            return []
        own, poses = zip(*shown, strict=True)
        return check_lean(lean_of(own, poses, upright_axes(self.up)))

    def _of_one_surface(
        self, shown: list[tuple[Plane, Float]]
    ) -> list[tuple[Plane, Float]]:
        """Return the planes, with poses, of the lowest surface below the object.

        With a box, one frame may yield the seat of a chair as its plane, and another the floor.
        """
        if self.target is None or not shown:
            return shown
        below = [float(plane.height(self.target)) for plane, _ in shown]
        return [
            one
            for one, height in zip(shown, below, strict=True)
            if height > max(below) - POSE_SHIFT
        ]


def repeated(
    frame: Frame, earlier: Sequence[Frame], any_mask: bool = False
) -> int | None:
    """Return which earlier frame a frame repeats, as from a camera that hangs.

    No two images of a depth camera are bitwise identical, so such a frame was not captured at its
    stated pose.

    Args:
        frame: new frame.
        earlier: used frames, in order.
        any_mask: whether it repeats one with another mask, too, as all frames show one object.

    Returns:
        Its position in ``earlier``; None if the frame is new.
    """
    for number, one in enumerate(earlier):
        if np.array_equal(one.depth, frame.depth) and (
            any_mask or _same_mask(one, frame)
        ):
            return number
    return None


def _same_mask(one: Frame, other: Frame) -> bool:
    """Return True if two frames of the same shape have the same mask."""
    if one.mask is None or other.mask is None:
        return one.mask is other.mask
    return np.array_equal(one.mask, other.mask)


def repeated_observation(seen: Observation, earlier: Sequence[Observation]) -> bool:
    """Return True if an observation repeats the image of an earlier one.

    Args:
        seen: the observation.
        earlier: the earlier observations.
    """
    return any(
        np.array_equal(one.depth, seen.depth) and _is_one_picture(one, seen)
        for one in earlier
    )


def _is_one_picture(first: Observation, second: Observation) -> bool:
    """Return True if two observations with the same depth are the same image.

    Two renders of a symmetric object may also be identical, but only after a rotation about the
    vertical.
    """
    if not first.seen:
        return False
    near = (
        angle_between(direction_of(first.pose), direction_of(second.pose))
        <= VISITED_ANGLE
    )
    return bool(
        near
        or not np.allclose(first.pose[2], second.pose[2], atol=SAME_THIRD_ROW)
        or check_views(first, second)
    )
