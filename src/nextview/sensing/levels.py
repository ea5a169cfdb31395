"""Level support surfaces of a frame, such as floors, tables and shelf boards, and their loads.

A segmentation labels the surface pixels. This module fits planes to them and finds the plane that
carries each instance. A plane carries objects only where it is visible or hidden by them: a person
behind a table is above the plane of its top, but does not stand on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress
from operator import lt

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from nextview.sensing.facets import Noise
from nextview.sensing.frame import Frame, within
from nextview.sensing.planes import (
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
    """

    plane: Plane
    axes: Float
    sides: Float
    tolerance: float
    pixels: Mask

    def holds(self, points: Float) -> Mask:
        """Return which points are over the visible part of the surface, or close to it, (N,) bool.

        Args:
            points: (N, 3), world, metres.
        """
        along = points @ self.axes.T
        outside = along @ self.sides[:, :2].T + self.sides[:, 2]
        # 5 cm around its visible part may be hidden
        return np.asarray((outside <= 0.05).all(1))


def levels_of(
    frame: Frame,
    masks: Sequence[Mask],
    surface: Mask,
    noise: Noise,
    up: Float | None,
    earlier: Sequence[SurfaceLevel] = (),
) -> tuple[list[SurfaceLevel], list[SurfaceLevel | None]]:
    """Find the levels of a frame, by decreasing number of instance pixels that they carry.

    Args:
        frame: of a depth camera.
        masks: of each instance, (H, W) bool each.
        surface: pixels of all surfaces, (H, W) bool.
        noise: of the frame.
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

    levels = _found(frame, surface & (frame.depth > 0), noise, up)
    if up is None and levels:
        alone = [[carrier_of(mask, frame, [one]) for mask in masks] for one in levels]
        worth = [
            (load(one, carriers), one.pixels.sum())
            for one, carriers in zip(levels, alone, strict=True)
        ]
        first = levels[worth.index(max(worth))]
        along = [one.plane.normal @ first.plane.normal > TILT for one in levels]
        levels = list(compress(levels, along))
    none = np.zeros(frame.shape, bool)
    hidden = [
        replace(level, pixels=none)
        for level in earlier
        if not any(lt(*apart_from(level.plane, other, frame)) for other in levels)
    ]
    every = [*levels, *hidden]
    carriers = [carrier_of(mask, frame, every) for mask in masks]
    every.sort(key=lambda one: -load(one, carriers))
    if every and None in carriers:
        upright = every[0].plane.normal if up is None else up
        carriers = _on_others(carriers, masks, frame, noise, upright)
    return every, carriers


def carrier_of(
    mask: Mask,
    frame: Frame,
    levels: Sequence[SurfaceLevel],
    stands: bool = False,
) -> SurfaceLevel | None:
    """Return the level below an object: in contact with it, or the next one below and hidden by it.

    Args:
        mask: of the object, (H, W) bool.
        frame: of the mask.
        levels: of the frame.
        stands: whether the object is known not to hang in the air.

    Returns:
        The level; None if the visible bottom touches none, or the surface below is not visible.
    """
    points = points_of(mask, frame)
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
    if not _hangs(mask, frame, best.plane, away):
        return best
    return None


def _hangs(mask: Mask, frame: Frame, plane: Plane, away: float) -> bool:
    """Return True if the bottom of an object is visible and the surface below is far behind it.

    Args:
        mask: of the object, (H, W) bool.
        frame: of the mask.
        plane: below the object.
        away: distance of the object, metres.
    """
    part = within(mask, RING_WIDTH + 1)
    own = mask[part] & (frame.depth[part] > 0)
    height = frame.along(plane.normal, plane.offset, part)
    bottom = float(np.quantile(height[own], BOTTOM_SHARE))
    low = own & (height < bottom + BOTTOM_MARGIN * away)
    ring = ndimage.binary_dilation(low, iterations=RING_WIDTH) & ~mask[part]
    border = np.ones(frame.shape, bool)
    border[1:-1, 1:-1] = False
    if not ring.any() or (low & border[part]).any():
        return False
    depth = frame.depth[part]
    # one surface has no such step between neighbouring pixels
    behind = depth[ring] > 1.04 * float(np.median(depth[low]))
    return bool(behind.mean() > 0.8)


def _found(
    frame: Frame,
    surface: Mask,
    noise: Noise,
    up: Float | None,
) -> list[SurfaceLevel]:
    """Find the planes of a frame's surfaces one by one with RANSAC.

    The remaining pixels are resampled after each plane, so that a small table is found beside a
    large floor.

    Args:
        frame: of a depth camera.
        surface: pixels of surfaces, (H, W) bool; all with valid depth.
        noise: of the frame.
        up: direction against gravity, (3,), world; None for planes of any direction.
    """
    rng = np.random.default_rng(0)
    apart = frame.depth * (3 * noise.at(frame.depth) * frame.depth + 0.003)
    left = surface
    found: list[SurfaceLevel] = []
    for _ in range(6):  # levels at most
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


def _sides(points: Float, plane: Plane) -> Float | None:
    """Return the sides of the convex hull of points on a plane.

    Args:
        points: (N, 3), metres.
        plane: of the points.

    Returns:
        The sides, (K, 3), see ``SurfaceLevel``; None for collinear points.
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
    """Find carriers among the other instances for instances that no surface carries.

    Args:
        carriers: of each instance.
        masks: of each instance, (H, W) bool.
        frame: of the masks.
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


def points_of(mask: Mask, frame: Frame) -> Float:
    """Sample points of a mask, (H, W) bool, as (N, 3), world, metres."""
    part = within(mask)
    rows, columns = np.nonzero(mask[part] & (frame.depth[part] > 0))
    few = slice(None, None, max(1, len(rows) // 500))
    return frame.positions(rows[few] + part[0].start, columns[few] + part[1].start)


def apart_from(plane: Plane, level: SurfaceLevel, frame: Frame) -> tuple[float, float]:
    """Return the distance between an earlier plane and a level, and its largest pose error.

    Args:
        plane: of the earlier frame.
        level: of this frame.
        frame: of a depth camera.

    Returns:
        Both in metres.
    """
    points = points_of(level.pixels, frame)
    camera = frame.camera_to_world[:3, 3]
    away = float(np.median(np.linalg.norm(points - camera, axis=1)))
    apart = abs(float(np.median(plane.height(points))))
    return apart, float(POSE_SHIFT + np.sin(POSE_TURN) * away)
