"""A frame with its segmented instances and the surfaces that carry them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nextview.segmentation.instances import Instances
from nextview.sensing.facets import Noise, noise_of
from nextview.sensing.frame import Frame
from nextview.sensing.levels import (
    SurfaceLevel,
    apart_from,
    carrier_of,
    levels_of,
    points_of,
)
from nextview.sensing.planes import LEAST_SUPPORT, TILT, Plane, Samples, sample
from nextview.sensing.sighting import FEWEST_OBJECT_PIXELS
from nextview.types import Float, Mask


@dataclass(frozen=True, eq=False)
class SegmentedFrame:
    """A frame with its segmented instances and the surfaces that carry them.

    Attributes:
        frame: the frame.
        noise: of its depth.
        masks: of each instance, (H, W) bool each.
        surface: pixels of all surfaces, (H, W) bool.
        background: pixels that are clearly neither an instance nor a surface, (H, W) bool.
        levels: planes of the surfaces, by decreasing number of carried pixels.
        carriers: the level that carries each instance, a surface or the top of another instance;
            None if there is no visible one.
    """

    frame: Frame
    noise: Noise
    masks: tuple[Mask, ...]
    surface: Mask
    background: Mask
    levels: tuple[SurfaceLevel, ...]
    carriers: tuple[SurfaceLevel | None, ...]

    @property
    def surface_samples(self) -> Samples:
        """Samples of all surfaces."""
        return sample(self.frame, self.surface & (self.frame.depth > 0), self.noise)

    @property
    def carried_by_none(self) -> tuple[Mask, ...]:
        """Masks of the objects without a supporting surface, (H, W) bool each."""
        pairs = zip(self.masks, self.carriers, strict=True)
        return tuple(
            mask
            for mask, carrier in pairs
            if carrier is None and np.count_nonzero(mask) >= FEWEST_OBJECT_PIXELS
        )

    def with_carried(self) -> SegmentedFrame:
        """Return the frame without the instances that have no supporting surface."""
        pairs = zip(self.masks, self.carriers, strict=True)
        kept = [(mask, carrier) for mask, carrier in pairs if carrier is not None]
        masks, carriers = zip(*kept, strict=True) if kept else ((), ())
        return replace(self, masks=masks, carriers=carriers)

    def ground(self, among: Mask, widest: float | None) -> SurfaceLevel | None:
        """Return the level that carries most pixels of candidate objects.

        Args:
            among: search area in the frame, (H, W) bool.
            widest: diameter of the largest candidate object, metres; None for any.

        Returns:
            The level; if none carries such an object, the level at which the camera is aimed. None
            if no level is visible.
        """
        if not self.levels:
            return None
        load = np.zeros(len(self.levels))
        for mask, level in zip(self.masks, self.carriers, strict=True):
            pixels = mask & among & (self.frame.depth > 0)
            if level not in self.levels or not pixels.any():
                continue
            size = np.linalg.norm(np.ptp(points_of(pixels, self.frame), axis=0))
            if widest is None or size <= widest:
                load[self.levels.index(level)] += np.count_nonzero(pixels)
        if load.any():
            return self.levels[int(load.argmax())]
        return min(self.levels, key=self._off_the_axis)

    def under(self, mask: Mask, stands: bool = False) -> SurfaceLevel | None:
        """Return the level that carries an object; None if there is no visible one.

        Args:
            mask: of the object, (H, W) bool.
            stands: whether the object is known not to hang in the air.
        """
        level = carrier_of(mask, self.frame, self.levels, stands)
        if level is not None or not self.masks:
            return level
        shared = [np.count_nonzero(mask & own) for own in self.masks]
        row = int(np.argmax(shared))
        return self.carriers[row] if shared[row] else None

    def again(self, plane: Plane) -> SurfaceLevel | None:
        """Return the level that corresponds to a plane of an earlier frame.

        Args:
            plane: in the earlier frame; both poses may have errors.

        Returns:
            The level; None if it is not visible.
        """
        found = None
        least = np.inf
        enough = LEAST_SUPPORT * np.count_nonzero(self.surface)
        for level in self.levels:
            if not np.count_nonzero(level.pixels) > enough:
                continue
            if level.plane.normal @ plane.normal < TILT:
                continue
            apart, reach = apart_from(plane, level, self.frame)
            if apart < min(reach, least):
                found = level
                least = apart
        return found

    def _off_the_axis(self, level: SurfaceLevel) -> float:
        """Return the distance from the image centre to the nearest pixel of a level, pixels."""
        rows, columns = np.nonzero(level.pixels)
        if not len(rows):
            return np.inf
        column, row = self.frame.intrinsics[:2, 2]
        return float(np.hypot(rows - row, columns - column).min())


def segmented_frame(
    frame: Frame,
    instances: Instances,
    up: Float | None,
    earlier: Sequence[SurfaceLevel] = (),
) -> SegmentedFrame:
    """Find the surfaces of a frame, and the one that carries each instance.

    Args:
        frame: of a depth camera.
        instances: of its segmentation.
        up: direction against gravity, (3,), world; None for the normal of the plane that carries
            most instance pixels.
        earlier: levels of earlier frames; used if they are not visible in this one.
    """
    noise = noise_of(frame)
    masks = instances.masks
    levels, carriers = levels_of(frame, masks, instances.surface, noise, up, earlier)
    return SegmentedFrame(
        frame,
        noise,
        masks,
        instances.surface,
        instances.background,
        tuple(levels),
        tuple(carriers),
    )


def without_surfaces(frame: Frame, masks: Sequence[Mask] = ()) -> SegmentedFrame:
    """Return a frame whose instances stand on nothing, as things that are held.

    Args:
        frame: of a depth camera.
        masks: of each instance, (H, W) bool each.
    """
    none = np.zeros(frame.shape, bool)
    carriers = (None,) * len(masks)
    return SegmentedFrame(
        frame, noise_of(frame), tuple(masks), none, none, (), carriers
    )
