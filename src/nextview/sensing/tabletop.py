"""The ground of one frame, and the segmented objects on it and on other surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nextview.errors import ObservationError
from nextview.sensing.frame import Frame, within
from nextview.sensing.masks import above_plane
from nextview.sensing.noise import Noise
from nextview.sensing.planes import Plane
from nextview.sensing.segmented_frame import SegmentedFrame
from nextview.sensing.view_warning import ViewWarning
from nextview.types import Float, Float32, Mask

NO_SUPPORT = (
    "no support plane is seen below the camera: give a mask or a box, or check the pose (inverse?"
    " OpenGL axes?) and which way is up"
)
# metres, least height of an object above the plane, to exclude stains
LOWEST_TOP = 0.008


@dataclass(frozen=True, eq=False)
class TableTop:
    """The ground of one frame, and the objects on it and on other surfaces.

    Attributes:
        seen: the frame with its instances and surfaces.
        plane: the level that carries most objects, in this frame or in an earlier one.
        up: direction against gravity, (3,), world.
        above: pixels of objects above their support, (H, W) bool.
        height: of each pixel above its supporting plane, (H, W) float32, metres.
        shows_ground: whether the plane is visible.
        warnings: about the frame.
    """

    seen: SegmentedFrame
    plane: Plane
    up: Float
    above: Mask
    height: Float32
    shows_ground: bool = True
    warnings: tuple[ViewWarning, ...] = ()

    @classmethod
    def of(
        cls,
        seen: SegmentedFrame,
        up: Float | None,
        earlier: Plane | None = None,
        among: Mask | None = None,
        widest: float | None = None,
        warnings: tuple[ViewWarning, ...] = (),
    ) -> TableTop:
        """Find the ground of a frame, and the objects above it.

        Args:
            seen: the frame with its instances and surfaces.
            up: direction against gravity, (3,), world; None for the normal of the plane.
            earlier: ground of an earlier frame, which is found again.
            among: search area, (H, W) bool; None for the whole frame.
            widest: diameter of the largest candidate object, metres; None for any.
            warnings: about the frame.

        Raises:
            ObservationError: no surface is visible.
        """
        frame = seen.frame
        if earlier is None:
            inside = np.ones(frame.shape, bool) if among is None else among
            level = seen.ground(inside, widest)
        else:
            level = seen.again(earlier)
        if level is not None:
            plane = level.plane
        elif earlier is not None:
            plane = earlier
        else:
            told = next((one for one in warnings if not one.holds), None)
            raise ObservationError(NO_SUPPORT if told is None else told.message)

        height, above = _heights(seen, plane)
        upright = plane.normal if up is None or frame.pose is None else up
        return cls(seen, plane, upright, above, height, level is not None, warnings)

    @property
    def frame(self) -> Frame:
        """The frame."""
        return self.seen.frame

    @property
    def noise(self) -> Noise:
        """Noise of the depth of the frame."""
        return self.frame.noise

    @property
    def other_surfaces(self) -> Mask:
        """Pixels of surfaces other than the plane, (H, W) bool."""
        found = np.zeros(self.frame.shape, bool)
        for level in self.seen.levels:
            if level.plane is not self.plane:
                found |= level.pixels
        return found


def _heights(seen: SegmentedFrame, plane: Plane) -> tuple[Float32, Mask]:
    """Return the height of each pixel above its support, metres, and the pixels of objects."""
    frame = seen.frame
    height = frame.along(plane.normal, plane.offset)
    for level in seen.levels:
        on = level.pixels
        height[on] = level.height[on]

    above = np.zeros(frame.shape, bool)
    for mask, carrier in zip(seen.masks, seen.carriers, strict=True):
        if carrier is None or not mask.any():
            continue
        part = within(mask)
        own = mask[part]
        under = carrier.plane
        raised = frame.along(under.normal, under.offset, part)
        height[part][own] = raised[own]
        above[part] |= own & above_plane(frame, under, frame.noise, part)
    return height, above
