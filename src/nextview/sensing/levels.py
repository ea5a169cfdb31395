"""Level surfaces that a segmentation tells: floors, tables, boards, and what each of them carries.

A segmentation says which pixels are surfaces. The planes through these pixels are found here, and
for each instance the one that it stands on. A plane carries things only where it is seen or hidden
by them: a person behind a table stands above the plane of its top, but not on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from nextview.sensing.facets import Noise
from nextview.sensing.frame import Frame, within
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
    steep,
)
from nextview.sensing.sighting import FEWEST_OBJECT_PIXELS
from nextview.types import Float, Mask

MOST_LEVELS = 6
# share of all surface pixels below which no further level is looked for
LEAST_LEFT = 0.003
OUTLINE_MARGIN = 0.05  # metres around what is seen of a surface that may be hidden
INSTANCE_POINTS = 500  # points of an instance that are compared with levels
# share of an instance's points that lie over what carries it, at least
MOST_INSIDE = 0.5
# share of an instance's points that may lie lower than its bottom: noise
BOTTOM_SHARE = 0.04
# height over a plane of the bottom of what stands on it, as a part of the distance, at most
BOTTOM_MARGIN = 0.02
# neighbouring pixels of one surface differ by at most this part of their depth, and noise
SURFACE_STEP = 0.04
RING_WIDTH = 3  # pixels around the bottom of an instance that tell what is below it
HANGING_SHARE = 0.8  # share of these that lie behind an instance that hangs in the air


@dataclass(frozen=True, eq=False)
class SurfaceLevel:
    """A plane surface that carries things.

    Attributes:
        plane: through it, its normal on the side of the camera.
        axes: two directions along it, (2, 3).
        sides: of the convex outline of what is seen of it, (K, 3): a point (x, y) along the axes,
            metres, is inside where ``sides @ (x, y, 1)`` is nowhere above 0.
        tolerance: metres from the plane within which its samples lie.
        pixels: of the frame that show it, (H, W) bool.
    """

    plane: Plane
    axes: Float
    sides: Float
    tolerance: float
    pixels: Mask

    def holds(self, points: Float) -> Mask:
        """Which points lie over what is seen of it, or closely beside, (N,) bool.

        Args:
            points: (N, 3), world, metres.
        """
        along = points @ self.axes.T
        outside = along @ self.sides[:, :2].T + self.sides[:, 2]
        return np.asarray((outside <= OUTLINE_MARGIN).all(1))


@dataclass(frozen=True, eq=False)
class Supports:
    """What a frame shows of surfaces, and what stands on them.

    Attributes:
        frame: the frame.
        masks: pixels of each instance, (H, W) bool each.
        surface: pixels of all surfaces, (H, W) bool.
        levels: planes of the surfaces, those that carry most pixels of instances first.
        carriers: the level that carries each instance, a surface or the top of another instance;
            None where none that is seen does.
    """

    frame: Frame
    masks: tuple[Mask, ...]
    surface: Mask
    levels: tuple[SurfaceLevel, ...]
    carriers: tuple[SurfaceLevel | None, ...]

    @classmethod
    def of(
        cls,
        frame: Frame,
        masks: Sequence[Mask],
        surface: Mask,
        noise: Noise,
        up: Float | None,
        earlier: Sequence[SurfaceLevel] = (),
    ) -> Supports:
        """Find the levels of a frame, and what each instance stands on.

        Args:
            frame: of a depth camera.
            masks: pixels of each instance, (H, W) bool each.
            surface: pixels of all surfaces, (H, W) bool.
            noise: of the frame.
            up: direction against gravity, (3,), world; None: the normal of the plane that carries
                most pixels of instances.
            earlier: levels that earlier frames show; they carry where this one does not show them.
        """
        shown = surface & (frame.depth > 0)
        levels = _found(frame, shown, noise, up)
        if up is None:
            levels = _parallel(levels, frame, masks)

        none = np.zeros(frame.shape, bool)
        hidden = [
            replace(level, pixels=none)
            for level in earlier
            if not any(_same(level, other, frame) for other in levels)
        ]
        levels = _by_load([*levels, *hidden], frame, masks)
        carriers = [carrier_of(mask, frame, levels) for mask in masks]
        if levels and None in carriers:
            upright = levels[0].plane.normal if up is None else up
            carriers = _on_others(carriers, masks, frame, noise, upright)
        return cls(frame, tuple(masks), surface, tuple(levels), tuple(carriers))

    def ground(self, among: Mask, widest: float | None) -> SurfaceLevel | None:
        """The level that carries most pixels of things that are looked for.

        Args:
            among: pixels of the frame where things are looked for, (H, W) bool.
            widest: diameter of the largest thing that is looked for, metres; None: any.

        Returns:
            The level; where none carries such a thing, the one that the camera is aimed at. None
            where no level is seen.
        """
        if not self.levels:
            return None
        load = np.zeros(len(self.levels))
        for mask, level in zip(self.masks, self.carriers, strict=True):
            pixels = mask & among & (self.frame.depth > 0)
            if level is None or not pixels.any():
                continue
            size = np.linalg.norm(np.ptp(_points(pixels, self.frame), axis=0))
            if widest is None or size <= widest:
                load[self.levels.index(level)] += np.count_nonzero(pixels)
        if load.any():
            return self.levels[int(load.argmax())]
        return min(self.levels, key=self._off_the_axis)

    def under(self, mask: Mask, stands: bool = False) -> SurfaceLevel | None:
        """The level that carries something; None where none that is seen does.

        Args:
            mask: its pixels, (H, W) bool.
            stands: whether it is known to stand on something, so that it does not hang.
        """
        level = carrier_of(mask, self.frame, self.levels, stands)
        if level is not None or not self.masks:
            return level
        shared = [np.count_nonzero(mask & own) for own in self.masks]
        row = int(np.argmax(shared))
        return self.carriers[row] if shared[row] else None

    def again(self, plane: Plane) -> SurfaceLevel | None:
        """The level that a plane of an earlier frame is in this one; None where it is not seen.

        Args:
            plane: as the earlier frame shows it; the pose of either frame may err.
        """
        found = None
        least = np.inf
        enough = LEAST_SUPPORT * np.count_nonzero(self.surface)
        for level in self.levels:
            if not np.count_nonzero(level.pixels) > enough:
                continue
            if level.plane.normal @ plane.normal < TILT:
                continue
            apart, reach = _apart(plane, level, self.frame)
            if apart < min(reach, least):
                found = level
                least = apart
        return found

    def _off_the_axis(self, level: SurfaceLevel) -> float:
        """Pixels from the middle of the picture to the nearest one that shows a level."""
        rows, columns = np.nonzero(level.pixels)
        if not len(rows):
            return np.inf
        column, row = self.frame.intrinsics[:2, 2]
        return float(np.hypot(rows - row, columns - column).min())


def carrier_of(
    mask: Mask,
    frame: Frame,
    levels: Sequence[SurfaceLevel],
    stands: bool = False,
) -> SurfaceLevel | None:
    """The level that something stands on: it touches it, or is next above it and hides it.

    Args:
        mask: its pixels, (H, W) bool.
        frame: that shows it.
        levels: of the frame.
        stands: whether it is known to stand on something, so that it does not hang.

    Returns:
        The level; None where its bottom is seen to touch none, or what is below is not seen.
    """
    if not levels or not (mask & (frame.depth > 0)).any():
        return None
    points = _points(mask, frame)
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
    if not _hangs(mask, frame, best.plane, away):
        return best
    return None


def _hangs(mask: Mask, frame: Frame, plane: Plane, away: float) -> bool:
    """Whether the bottom of something is seen, and what is below it lies far behind.

    Args:
        mask: its pixels, (H, W) bool.
        frame: that shows it.
        plane: that it is above.
        away: its distance, metres.
    """
    part = within(mask, RING_WIDTH + 1)
    own = mask[part] & (frame.depth[part] > 0)
    height = frame.along(plane.normal, plane.offset, part)
    bottom = float(np.quantile(height[own], BOTTOM_SHARE))
    low = own & (height < bottom + BOTTOM_MARGIN * away)
    ring = ndimage.binary_dilation(low, iterations=RING_WIDTH) & ~mask[part]
    if not ring.any() or _cut_by_picture(low, part, frame.shape):
        return False
    depth = frame.depth[part]
    behind = depth[ring] > (1 + SURFACE_STEP) * float(np.median(depth[low]))
    return bool(behind.mean() > HANGING_SHARE)


def _cut_by_picture(
    low: Mask, part: tuple[slice, slice], shape: tuple[int, int]
) -> bool:
    """Whether pixels of a part of a picture touch the side of the picture."""
    rows, columns = np.nonzero(low)
    sides = ((rows, part[0].start, shape[0]), (columns, part[1].start, shape[1]))
    for index, start, size in sides:
        if index.min() + start == 0 or index.max() + start == size - 1:
            return True
    return False


def _found(
    frame: Frame,
    surface: Mask,
    noise: Noise,
    up: Float | None,
) -> list[SurfaceLevel]:
    """The planes of the surfaces of a frame, one after the other by RANSAC.

    What is left is sampled anew after each, so that a small table is found before a wide floor.

    Args:
        frame: of a depth camera.
        surface: pixels of surfaces, (H, W) bool; all have a depth.
        noise: of the frame.
        up: direction against gravity, (3,), world; None for planes of any direction.
    """
    rng = np.random.default_rng(0)
    apart = frame.depth * (3 * noise.at(frame.depth) * frame.depth + 0.003)
    left = surface
    found: list[SurfaceLevel] = []
    for _ in range(MOST_LEVELS):
        samples = sample(frame, left, noise)
        if up is not None:
            samples = samples.some(~steep(samples, up))
        plane = find_plane(samples, rng, up)
        if plane is None:
            break

        own = samples.some(plane.holds(samples))
        height = np.abs(frame.along(plane.normal, plane.offset))
        on = left & (height < apart)
        sides = _sides(own.points, plane)
        wide = np.count_nonzero(on) >= FEWEST_OBJECT_PIXELS
        if wide and sides is not None and not _beside(own, found):
            tolerance = float(np.median(own.tolerance))
            found.append(SurfaceLevel(plane, axes_along(plane), sides, tolerance, on))

        left = left & (height > 2 * apart)
        if np.count_nonzero(left) < LEAST_LEFT * np.count_nonzero(surface):
            break
    return found


def _beside(own: Samples, levels: Sequence[SurfaceLevel]) -> bool:
    """Whether samples are the noise of a level that was found: they lie closely along it."""
    for level in levels:
        near = np.abs(level.plane.height(own.points)) < TOLERANCES_ASIDE * own.tolerance
        if np.mean(near & level.holds(own.points)) > MOST_INSIDE:
            return True
    return False


def _sides(points: Float, plane: Plane) -> Float | None:
    """The sides of the convex outline of points on a plane.

    Args:
        points: (N, 3), metres.
        plane: that they lie on.

    Returns:
        The sides, (K, 3), see ``SurfaceLevel``; None where the points lie on a line.
    """
    try:
        return ConvexHull(points @ axes_along(plane).T).equations
    except (QhullError, ValueError):
        return None


def _on_others(
    carriers: Sequence[SurfaceLevel | None],
    masks: Sequence[Mask],
    frame: Frame,
    noise: Noise,
    up: Float,
) -> list[SurfaceLevel | None]:
    """Carriers, where instances that no surface carries may stand on other instances.

    Args:
        carriers: of each instance.
        masks: pixels of each, (H, W) bool.
        frame: that shows them.
        noise: of the frame.
        up: direction against gravity, (3,), world.
    """
    things = np.zeros(frame.shape, bool)
    for mask in masks:
        things |= mask
    tops = _found(frame, things & (frame.depth > 0), noise, up)
    found = list(carriers)
    for row, mask in enumerate(masks):
        if found[row] is None:
            others = [top for top in tops if not (top.pixels & mask).any()]
            found[row] = carrier_of(mask, frame, others)
    return found


def _points(mask: Mask, frame: Frame) -> Float:
    """Some of the positions that a mask, (H, W) bool, shows, (N, 3), world, metres."""
    rows, columns = np.nonzero(mask & (frame.depth > 0))
    few = slice(None, None, max(1, len(rows) // INSTANCE_POINTS))
    return frame.positions(rows[few], columns[few])


def _load(level: SurfaceLevel, frame: Frame, masks: Sequence[Mask]) -> int:
    """Pixels of the instances that one level would carry if there were no other."""
    return sum(
        int(np.count_nonzero(mask))
        for mask in masks
        if carrier_of(mask, frame, [level])
    )


def _by_load(
    levels: Sequence[SurfaceLevel],
    frame: Frame,
    masks: Sequence[Mask],
) -> list[SurfaceLevel]:
    """Levels, those that carry most pixels of instances first."""
    carriers = [carrier_of(mask, frame, levels) for mask in masks]
    load = {
        id(level): sum(
            int(np.count_nonzero(mask))
            for mask, carrier in zip(masks, carriers, strict=True)
            if carrier is level
        )
        for level in levels
    }
    return sorted(levels, key=lambda level: -load[id(level)])


def _parallel(
    levels: Sequence[SurfaceLevel],
    frame: Frame,
    masks: Sequence[Mask],
) -> list[SurfaceLevel]:
    """Those levels that are parallel to the one that carries most, where up is not known."""
    if not levels:
        return []
    first = max(
        levels, key=lambda level: (_load(level, frame, masks), level.pixels.sum())
    )
    return [level for level in levels if level.plane.normal @ first.plane.normal > TILT]


def _same(earlier: SurfaceLevel, level: SurfaceLevel, frame: Frame) -> bool:
    """Whether a level of an earlier frame is one of this frame."""
    apart, reach = _apart(earlier.plane, level, frame)
    return apart < reach


def _apart(plane: Plane, level: SurfaceLevel, frame: Frame) -> tuple[float, float]:
    """How far a plane of an earlier frame lies from a level, and by how much its pose may err.

    Args:
        plane: of the earlier frame.
        level: that the frame shows.
        frame: of a depth camera.

    Returns:
        Both in metres.
    """
    points = _points(level.pixels, frame)
    camera = frame.camera_to_world[:3, 3]
    away = float(np.median(np.linalg.norm(points - camera, axis=1)))
    apart = abs(float(np.median(plane.height(points))))
    return apart, float(POSE_SHIFT + np.sin(POSE_TURN) * away)
