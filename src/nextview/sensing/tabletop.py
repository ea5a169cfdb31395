"""Segmented objects on the support surfaces of one frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from nextview.errors import ObservationError
from nextview.geometry.axes import upright_axes
from nextview.segmentation.instances import Instances
from nextview.sensing.facets import Noise, noise_of
from nextview.sensing.frame import Frame, within
from nextview.sensing.levels import Supports
from nextview.sensing.masks import (
    TOUCHING_GAP,
    TOUCHING_STEP,
    above_plane,
    inside_box,
    inside_mask,
    touching,
)
from nextview.sensing.object_frame import Box
from nextview.sensing.planes import Plane, sample
from nextview.sensing.sighting import FEWEST_OBJECT_PIXELS, Sighting, sighting_of
from nextview.sensing.surface_checks import refuse_mistakes
from nextview.sensing.view_warning import ViewWarning
from nextview.types import Float, Float32, Index, Mask

NO_SUPPORT = (
    "no support plane is seen below the camera: give a mask or a box, or check the pose (inverse?"
    " OpenGL axes?) and which way is up"
)
# metres, least height of an object above the plane, to exclude stains
LOWEST_TOP = 0.008
# the same relative to the distance, for noisy depth
LOWEST_SHARE = 0.012
# quantile of an object's pixel heights that defines its top, to exclude flying pixels
TOP_SHARE = 0.9
# square metres, least visible area of an object, slightly less than that of a die
SMALLEST_AREA = 1.5e-4
THINNEST = (
    0.006  # metres, least width of an object at its thickest part, to exclude edges
)
# metres, height above the plane within which pixels are likely to belong to it
NEAR_TABLE = 0.015


@dataclass(frozen=True, eq=False)
class TableTop:
    """Support surfaces of one frame, and the objects on them.

    Attributes:
        frame: the frame.
        noise: of its depth.
        plane: the level that carries most objects, in this frame or in an earlier one.
        up: direction against gravity, (3,), world.
        above: pixels of objects above their support, (H, W) bool.
        background: pixels that are clearly neither an object nor a surface, (H, W) bool.
        height: of each pixel above its supporting plane, (H, W) float32, metres.
        supports: the surfaces, and the instances on each.
        pieces: of the segmentation, into which instances may be split, (H, W) int, 0 for none; None
            if there are none.
        shows_ground: whether the plane is visible.
        warnings: about the frame.
    """

    frame: Frame
    noise: Noise
    plane: Plane
    up: Float
    above: Mask
    background: Mask
    height: Float32
    supports: Supports
    pieces: Index | None = None
    shows_ground: bool = True
    warnings: tuple[ViewWarning, ...] = ()

    @classmethod
    def of(
        cls,
        frame: Frame,
        instances: Instances,
        up: Float | None,
        earlier: TableTop | None = None,
        region: Box | None = None,
        widest: float | None = None,
    ) -> TableTop:
        """Find the support surfaces of a frame, and the objects on them.

        Args:
            frame: of a depth camera; its mask, if any, limits the search.
            instances: segmented objects of the frame.
            up: direction against gravity, (3,), world; None for the normal of the plane.
            earlier: surfaces of an earlier frame, whose plane and levels are found again.
            region: upright box that limits the search.
            widest: diameter of the largest candidate object, metres; None for any.

        Raises:
            ObservationError: no surface is visible.
        """
        noise = noise_of(frame)
        inside = frame.depth > 0 if frame.mask is None else frame.mask
        if region is not None:
            inside = inside & inside_box(frame, region)
        upright = None if up is None or frame.pose is None else upright_axes(up)[2]
        supports = Supports.of(
            frame,
            tuple(mask & inside for mask in instances.masks),
            instances.surface,
            noise,
            earlier.plane.normal if upright is None and earlier else upright,
            () if earlier is None else earlier.supports.levels,
        )

        if earlier is None:
            level = supports.ground(inside, widest)
        else:
            level = supports.again(earlier.plane)
        shown = sample(frame, supports.surface & (frame.depth > 0), noise)
        refuse_mistakes(frame, shown, None if level is None else level.plane, upright)
        if level is not None:
            plane = level.plane
        elif earlier is not None:
            plane = earlier.plane
        else:
            raise ObservationError(NO_SUPPORT)

        height, above = _heights(supports, plane, noise)
        return cls(
            frame,
            noise,
            plane,
            plane.normal if upright is None else upright,
            above,
            instances.background,
            height,
            supports,
            instances.pieces,
            shows_ground=level is not None,
        )

    @property
    def carried_by_none(self) -> tuple[Mask, ...]:
        """Masks of the objects without a supporting surface, (H, W) bool each."""
        pairs = zip(self.supports.masks, self.supports.carriers, strict=True)
        return tuple(
            mask
            for mask, carrier in pairs
            if carrier is None and np.count_nonzero(mask) >= FEWEST_OBJECT_PIXELS
        )

    @property
    def other_surfaces(self) -> Mask:
        """Pixels of surfaces other than the plane, (H, W) bool."""
        found = np.zeros(self.frame.shape, bool)
        for level in self.supports.levels:
            if level.plane is not self.plane:
                found |= level.pixels
        return found

    def under(self, mask: Mask) -> Plane:
        """Return the plane that supports an object.

        Args:
            mask: of the object, (H, W) bool.
        """
        level = self.supports.under(mask)
        return self.plane if level is None else level.plane

    def sighting(self, mask: Mask) -> Sighting:
        """Return the sighting of an object in the frame.

        Args:
            mask: of the object, (H, W) bool.

        Raises:
            ObservationError: too little of it is visible.
        """
        seen = sighting_of(self.frame, mask, self.under(mask), self.noise)
        return replace(seen, warnings=self.warnings)

    def segments(self) -> list[Mask]:
        """Return the masks of all supported objects, (H, W) bool, the largest first.

        Background at their edges and pixels of their support are removed.
        """
        found = []
        for mask, carrier in zip(
            self.supports.masks, self.supports.carriers, strict=True
        ):
            if carrier is None or np.count_nonzero(mask) < FEWEST_OBJECT_PIXELS:
                continue
            own = inside_mask(self.frame, mask, carrier.plane, self.noise)
            if np.count_nonzero(own) >= FEWEST_OBJECT_PIXELS:
                found.append(own)
        return sorted(found, key=lambda mask: -np.count_nonzero(mask))

    def pieces_of(self, pixels: Mask) -> list[Mask]:
        """Return the pieces into which a mask may be split, the largest first.

        Args:
            pixels: of objects, (H, W) bool.

        Returns:
            The mask of each piece, (H, W) bool.
        """
        if self.pieces is None:
            return []
        inside = np.where(pixels & (self.frame.depth > 0), self.pieces, 0)
        sizes = np.bincount(inside.ravel())
        sizes[0] = 0
        numbers = np.flatnonzero(sizes >= FEWEST_OBJECT_PIXELS)
        return [inside == number for number in numbers[np.argsort(-sizes[numbers])]]

    def is_thing(self, mask: Mask) -> bool:
        """Return True if a mask, (H, W) bool, is large and high enough to be an object."""
        part = within(mask)
        own = mask[part] & (self.frame.depth[part] > 0)
        count = np.count_nonzero(own)
        if count < FEWEST_OBJECT_PIXELS:
            return False

        away = float(np.median(self.frame.depth[part][own]))
        top = float(np.quantile(self.height[part][own], TOP_SHARE))
        focal = self.frame.intrinsics[0, 0] * self.frame.intrinsics[1, 1]
        area = count * away**2 / focal
        if top < max(LOWEST_TOP, LOWEST_SHARE * away) or area < SMALLEST_AREA:
            return False
        half = round(float(np.sqrt(focal)) * THINNEST / 2 / away)
        filled = ndimage.binary_closing(np.pad(mask[part], 1))
        return bool(
            ndimage.binary_erosion(filled, np.ones((3, 3), bool), max(half, 1)).any()
        )

    def neighbours(
        self,
        masks: Sequence[Mask | None],
        gap: float = TOUCHING_GAP,
    ) -> list[tuple[int, int]]:
        """Return the pairs of objects that are close enough in the image to touch.

        Args:
            masks: of the objects, (H, W) bool; None if not visible in the frame.
            gap: largest gap between touching objects, metres.

        Returns:
            Their positions in ``masks``, the smaller one first.
        """
        shown = [row for row, mask in enumerate(masks) if mask is not None]
        parts = np.array(
            [
                [(side.start, side.stop) for side in within(mask)]
                for mask in masks
                if mask is not None
            ]
        ).reshape(-1, 2, 2)
        nearest = self.frame.depth[self.frame.depth > 0].min(initial=np.inf)
        focal = float(self.frame.intrinsics[[0, 1], [0, 1]].max())
        reach = max(2.0, gap * focal / nearest) + 1
        low, high = parts[..., 0], parts[..., 1]
        apart = np.maximum(low[:, None] - high, low - high[:, None]).max(-1)
        pairs = np.argwhere(np.triu(apart <= reach, 1))
        return [(shown[one], shown[other]) for one, other in pairs]

    def touching(
        self,
        one: Mask,
        other: Mask,
        gap: float = TOUCHING_GAP,
        step: float = TOUCHING_STEP,
    ) -> bool:
        """Return True if two objects touch in the image and in depth, see ``masks.touching``."""
        return touching(self.frame, one, other, gap, step)


def _heights(
    supports: Supports,
    plane: Plane,
    noise: Noise,
) -> tuple[Float32, Mask]:
    """Return the height of each pixel above its support, metres, and the pixels of objects."""
    frame = supports.frame
    height = frame.along(plane.normal, plane.offset)
    for level in supports.levels:
        on = level.pixels
        height[on] = frame.along(level.plane.normal, level.plane.offset)[on]

    above = np.zeros(frame.shape, bool)
    for mask, carrier in zip(supports.masks, supports.carriers, strict=True):
        if carrier is None or not mask.any():
            continue
        part = within(mask)
        own = mask[part]
        under = carrier.plane
        raised = frame.along(under.normal, under.offset, part)
        height[part][own] = raised[own]
        above[part] |= own & above_plane(frame, under, noise, part)
    return height, above
