"""A frame with its segmented instances, its level surfaces, and what these carry.

A segmentation labels the surface pixels, of floors, tables and shelf boards. Planes are fitted to
them, and the plane that carries each instance is found. A plane carries objects only where it is
visible or hidden by them: a person behind a table is above the plane of its top, but does not stand
on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress
from operator import lt

import numpy as np
from scipy import ndimage

from nextview.segmentation.instances import Instances
from nextview.sensing.frame import Frame
from nextview.sensing.planes import (
    LEAST_SUPPORT,
    POSE_SHIFT,
    POSE_TURN,
    TILT,
    TOLERANCES_ASIDE,
    Plane,
    Samples,
    axes_along,
    find_plane,
    sample,
    sides_of,
    steep,
)
from nextview.sensing.sighting import FEWEST_OBJECT_PIXELS
from nextview.types import Float, Float32, Mask

# least share of an instance's points above its carrier
MOST_INSIDE = 0.5
# largest share of an instance's points below its bottom, due to noise
BOTTOM_SHARE = 0.04
# largest height of an instance's bottom above its carrier, relative to the distance
BOTTOM_MARGIN = 0.02
RING_WIDTH = 3  # pixels around the bottom of an instance that show the surface below it


@dataclass(frozen=True, eq=False)
class SurfaceLevel:
    """A plane support surface.

    Attributes:
        plane: the plane, with its normal on the side of the camera.
        axes: two directions along it, (2, 3).
        sides: of the convex hull of its visible part, (K, 3): a point (x, y) along the axes,
            metres, is inside if no element of ``sides @ (x, y, 1)`` is above 0.
        tolerance: largest distance of its samples from the plane, metres.
        pixels: of the frame on the surface, (H, W) bool.
        points: some of them, (N, 3), world, metres.
        height: of each pixel of the frame above the plane, (H, W) float32, metres.
    """

    plane: Plane
    axes: Float
    sides: Float
    tolerance: float
    pixels: Mask
    points: Float
    height: Float32

    def holds(self, points: Float) -> Mask:
        """Return which points are over the visible part of the surface, or close to it, (N,) bool.

        Args:
            points: (N, 3), world, metres.
        """
        along = points @ self.axes.T
        outside = along @ self.sides[:, :2].T + self.sides[:, 2]
        # 5 cm around its visible part may be hidden
        return np.asarray((outside <= 0.05).all(1))


@dataclass(frozen=True, eq=False)
class SegmentedFrame:
    """A frame with its segmented instances and the surfaces that carry them.

    Attributes:
        frame: the frame.
        masks: of each instance, (H, W) bool each.
        surface: pixels of all surfaces, (H, W) bool.
        background: pixels that are clearly neither an instance nor a surface, (H, W) bool.
        levels: planes of the surfaces, by decreasing number of carried pixels.
        carriers: the level that carries each instance, a surface or the top of another instance;
            None if there is no visible one.
    """

    frame: Frame
    masks: tuple[Mask, ...]
    surface: Mask
    background: Mask
    levels: tuple[SurfaceLevel, ...]
    carriers: tuple[SurfaceLevel | None, ...]

    @property
    def surface_samples(self) -> Samples:
        """Samples of all surfaces."""
        return sample(
            self.frame, self.surface & (self.frame.depth > 0), self.frame.noise
        )

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
            size = np.linalg.norm(np.ptp(self.frame.points(pixels), axis=0))
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
        points = self.frame.points(mask)
        level = _carrier_of(mask, points, self.frame, self.levels, stands)
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
            apart, reach = _apart_from(plane, level, self.frame)
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
    masks = instances.masks
    levels, carriers = _levels_of(frame, masks, instances.surface, up, earlier)
    return SegmentedFrame(
        frame,
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
    return SegmentedFrame(frame, tuple(masks), none, none, (), carriers)


def _levels_of(
    frame: Frame,
    masks: Sequence[Mask],
    surface: Mask,
    up: Float | None,
    earlier: Sequence[SurfaceLevel] = (),
) -> tuple[list[SurfaceLevel], list[SurfaceLevel | None]]:
    """Find the levels of a frame, by decreasing number of instance pixels that they carry.

    Args:
        frame: of a depth camera.
        masks: of each instance, (H, W) bool each.
        surface: pixels of all surfaces, (H, W) bool.
        up: direction against gravity, (3,), world; None for the normal of the plane that carries
            most instance pixels.
        earlier: levels of earlier frames; used if they are not visible in this one.

    Returns:
        The levels, and what carries each instance: a level, or the top of another instance.
    """
    sizes = [int(mask.sum()) for mask in masks]

    def load(level: SurfaceLevel, carriers: Sequence[SurfaceLevel | None]) -> int:
        """Return the number of instance pixels that a level carries."""
        pairs = zip(sizes, carriers, strict=True)
        return sum(size for size, carrier in pairs if carrier is level)

    levels = _found(frame, surface & (frame.depth > 0), up)
    none = np.zeros(frame.shape, bool)
    heights = [frame.along(one.plane.normal, one.plane.offset) for one in earlier]
    hidden = [
        replace(one, pixels=none, height=height)
        for one, height in zip(earlier, heights, strict=True)
    ]
    seen = [(mask, frame.points(mask)) for mask in masks]
    if up is None and levels:
        alone = [[_carrier_of(*each, frame, [one]) for each in seen] for one in levels]
        worth = [
            (load(one, carriers), one.pixels.sum())
            for one, carriers in zip(levels, alone, strict=True)
        ]
        first = levels[worth.index(max(worth))]
        along = [one.plane.normal @ first.plane.normal > TILT for one in levels]
        levels = list(compress(levels, along))
    apart = [
        one
        for one in hidden
        if not any(lt(*_apart_from(one.plane, other, frame)) for other in levels)
    ]
    every = [*levels, *apart]
    carriers = [_carrier_of(*each, frame, every) for each in seen]
    every.sort(key=lambda one: -load(one, carriers))
    if every and None in carriers:
        upright = every[0].plane.normal if up is None else up
        carriers = _on_others(carriers, seen, frame, upright)
    return every, carriers


def _carrier_of(
    mask: Mask,
    points: Float,
    frame: Frame,
    levels: Sequence[SurfaceLevel],
    stands: bool = False,
) -> SurfaceLevel | None:
    """Return the level below an object: in contact with it, or the next one below and hidden by it.

    Args:
        mask: of the object, (H, W) bool.
        points: of the object, (N, 3), world, metres.
        frame: of the mask.
        levels: of the frame.
        stands: whether the object is known not to hang in the air.

    Returns:
        The level; None if the visible bottom touches none, or the surface below is not visible.
    """
    if not levels or not len(points):
        return None
    camera = frame.camera_to_world[:3, 3]
    away = float(np.median(np.linalg.norm(points - camera, axis=1)))

    best = None
    least = np.inf
    touches = False
    for level in levels:
        height = level.plane.height(points)
        bottom = float(np.quantile(height, BOTTOM_SHARE))
        margin = BOTTOM_MARGIN * away + level.tolerance
        low = points[height < bottom + margin]
        if bottom < -margin or abs(bottom) >= least:
            continue
        if min(level.holds(low).mean(), level.holds(points).mean()) < MOST_INSIDE:
            continue
        best = level
        least = abs(bottom)
        touches = bottom < margin
    if best is None or touches or stands:
        return best
    if not _hangs(mask, frame, best, away):
        return best
    return None


def _hangs(mask: Mask, frame: Frame, level: SurfaceLevel, away: float) -> bool:
    """Return True if the bottom of an object is visible and the surface below is far behind it.

    Args:
        mask: of the object, (H, W) bool.
        frame: of the mask.
        level: below the object.
        away: distance of the object, metres.
    """
    depth = frame.depth
    own = mask & (depth > 0)
    bottom = float(np.quantile(level.height[own], BOTTOM_SHARE))
    low = own & (level.height < bottom + BOTTOM_MARGIN * away)
    ring = ndimage.binary_dilation(low, iterations=RING_WIDTH) & ~mask
    if not ring.any() or low[[0, -1]].any() or low[:, [0, -1]].any():
        return False
    # one surface has no such step between neighbouring pixels
    behind = depth[ring] > 1.04 * float(np.median(depth[low]))
    return bool(behind.mean() > 0.8)


def _found(
    frame: Frame,
    surface: Mask,
    up: Float | None,
) -> list[SurfaceLevel]:
    """Find the planes of a frame's surfaces one by one with RANSAC.

    The remaining pixels are resampled after each plane, so that a small table is found beside a
    large floor.

    Args:
        frame: of a depth camera.
        surface: pixels of surfaces, (H, W) bool; all with valid depth.
        up: direction against gravity, (3,), world; None for planes of any direction.
    """
    rng = np.random.default_rng(0)
    apart = frame.depth * (3 * frame.noise.at(frame.depth) * frame.depth + 0.003)
    left = surface
    found: list[SurfaceLevel] = []
    for _ in range(6):  # levels at most
        samples = sample(frame, left, frame.noise)
        if up is not None:
            samples = samples.some(~steep(samples, up))
        plane = find_plane(samples, rng, up)
        if plane is None:
            break

        own = samples.some(plane.holds(samples))
        axes = axes_along(plane)
        sides = sides_of(own.points @ axes.T)
        height = frame.along(plane.normal, plane.offset)
        off = np.abs(height)
        on = left & (off < apart)
        wide = np.count_nonzero(on) >= FEWEST_OBJECT_PIXELS
        if wide and sides is not None and not _beside(own, found):
            tolerance = float(np.median(own.tolerance))
            points = frame.points(on)
            found.append(
                SurfaceLevel(plane, axes, sides, tolerance, on, points, height)
            )

        left = left & (off > 2 * apart)
        # too little is left for another level
        if np.count_nonzero(left) < 0.003 * np.count_nonzero(surface):
            break
    return found


def _beside(own: Samples, levels: Sequence[SurfaceLevel]) -> bool:
    """Return True if samples are noise of a known level, close to it everywhere."""
    for level in levels:
        near = np.abs(level.plane.height(own.points)) < TOLERANCES_ASIDE * own.tolerance
        if np.mean(near & level.holds(own.points)) > MOST_INSIDE:
            return True
    return False


def _on_others(
    carriers: Sequence[SurfaceLevel | None],
    seen: Sequence[tuple[Mask, Float]],
    frame: Frame,
    up: Float,
) -> list[SurfaceLevel | None]:
    """Find carriers among the other instances for instances that no surface carries.

    Args:
        carriers: of each instance.
        seen: mask of each instance, (H, W) bool, and points of it, (N, 3), world, metres.
        frame: of the masks.
        up: direction against gravity, (3,), world.
    """
    things = np.zeros(frame.shape, bool)
    for mask, _ in seen:
        things |= mask
    tops = _found(frame, things & (frame.depth > 0), up)
    found = list(carriers)
    for row, (mask, points) in enumerate(seen):
        if found[row] is None:
            others = [top for top in tops if not (top.pixels & mask).any()]
            found[row] = _carrier_of(mask, points, frame, others)
    return found


def _apart_from(plane: Plane, level: SurfaceLevel, frame: Frame) -> tuple[float, float]:
    """Return the distance between an earlier plane and a level, and its largest pose error.

    Args:
        plane: of the earlier frame.
        level: of this frame.
        frame: of a depth camera.

    Returns:
        Both in metres.
    """
    camera = frame.camera_to_world[:3, 3]
    away = float(np.median(np.linalg.norm(level.points - camera, axis=1)))
    apart = abs(float(np.median(plane.height(level.points))))
    return apart, float(POSE_SHIFT + np.sin(POSE_TURN) * away)
