"""The one check of a frame against what is known, whether one object is looked at or a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nextview.checks import one_line
from nextview.errors import ObservationError
from nextview.geometry.axes import upright_axes
from nextview.sensing.frame import Frame
from nextview.sensing.lean import lean_of
from nextview.sensing.planes import POSE_SHIFT, Plane
from nextview.sensing.plausibility import (
    check_frame,
    check_lean,
    check_pose_moved,
    check_steps,
    refuse_far,
    refuse_millimetres,
)
from nextview.sensing.view_warning import ViewWarning
from nextview.types import Float


@dataclass(frozen=True)
class KnownFrames:
    """What is known before a frame.

    Attributes:
        frames: that were taken in, in order, with the poses that they were handed in with.
        planes: the support plane as each of them shows it; None where it does not.
        up: direction against gravity in the world, (3,); None if the support plane tells it.
        target: where an object is expected, (3,), world, metres; None if no place is known.
        radius: of that object, metres.
    """

    frames: tuple[Frame, ...] = ()
    planes: tuple[Plane | None, ...] = ()
    up: Float | None = None
    target: Float | None = None
    radius: float = 0.0

    def refuse(self, frame: Frame) -> None:
        """Refuse what cannot be another frame of the same world, whatever it shows.

        Args:
            frame: that was handed in.

        Raises:
            ObservationError: it is no frame, it lacks a pose, it is too far from what is known, or
                its depth is several times too large.
        """
        if not isinstance(frame, Frame):
            raise ObservationError(
                f"what a depth camera gave is a Frame, not {one_line(repr(frame))}"
            )
        if self.frames and (frame.pose is None or self.frames[0].pose is None):
            raise ObservationError(
                "a second frame needs a pose, and the first one too: how else do they fit together?"
            )
        last = self.frames[-1] if self.frames else None
        refuse_far(frame, last, self.target, self.radius)

    def check(self, frame: Frame, plane: Plane | None) -> list[ViewWarning]:
        """What is likely to be wrong with a frame that was not refused; usually nothing.

        Args:
            frame: that was handed in.
            plane: the support plane as it shows it; None where it does not.

        Raises:
            ObservationError: its pose is in millimetres.
        """
        warnings = check_frame(frame)
        if self.frames:
            warnings += check_pose_moved(frame, self.frames[-1])
        if frame.pose is None:
            return warnings
        if plane is not None and not self.frames:
            up = plane.normal if self.up is None else self.up
            height = float(plane.height(frame.pose[:3, 3]))
            refuse_millimetres(frame.pose, height, up)
            warnings += check_steps(frame, height, up)
        return warnings + self._check_lean(frame, plane)

    def repeats(self, frame: Frame) -> bool:
        """Whether a frame shows, to the last bit, what an earlier one did.

        Args:
            frame: that was handed in.
        """
        return any(
            np.array_equal(one.depth, frame.depth) and _same_mask(one, frame)
            for one in self.frames
        )

    def _check_lean(self, frame: Frame, plane: Plane | None) -> list[ViewWarning]:
        """Whether the planes of all frames lean; of one alone that may be an error of depth."""
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
        """Planes, with poses, that are the lowest of them where the object is expected.

        By its box the seat of a chair may be found in one frame, and in another one the floor.
        """
        if self.target is None or not shown:
            return shown
        below = [float(plane.height(self.target)) for plane, _ in shown]
        return [
            one
            for one, height in zip(shown, below, strict=True)
            if height > max(below) - POSE_SHIFT
        ]


def _same_mask(one: Frame, other: Frame) -> bool:
    """Whether two frames of one shape are looked at in the same pixels."""
    if one.mask is None or other.mask is None:
        return one.mask is other.mask
    return np.array_equal(one.mask, other.mask)
