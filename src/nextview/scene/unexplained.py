"""Find points that are neither ground nor an object.

A scene with many of them is not empty, and not done.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from nextview.geometry.axes import upright_axes
from nextview.sensing.masks import inside_box
from nextview.sensing.object_frame import Box
from nextview.sensing.tabletop import TableTop
from nextview.things.world import World
from nextview.types import Float, Mask

NEAR_DEVIATIONS = (
    4.0  # largest deviation of ground pixels, in standard deviations of the noise
)
# largest standard deviation of the noise at 1 m, metres; a larger estimate comes from clutter
NOISIEST_CAMERA = 0.005
CONSIDERABLE_AREA = 1e-3  # square metres, visible area of a relevant patch, 3 cm wide
PATCH_GAP = 0.02  # metres, largest gap inside a patch
EDGE_WIDTH = 2  # pixels of the grid around an object that may show it
PATCH_POINTS = 400  # sampled points of a patch
GROUND_POINTS = 2000  # sampled points of the ground, for its convex hull
REGION_CELL = 0.02  # metres, side of a cell of the ground in a region
LOWEST_SHARE = 0.012  # of the distance: least height of an object, for noisy depth
# metres, least width of an object at its thickest part, to exclude edges
THINNEST = 0.006
# metres, height above the plane within which pixels are likely to belong to it
NEAR_TABLE = 0.015
SEEN_OF_REGION = 0.5  # least share of cells with visible ground for a visible ground


@dataclass(frozen=True, eq=False)
class UnexplainedPatch:
    """A part of an image that is neither ground nor an object.

    Attributes:
        points: sampled points, (N, 3), world, metres.
        area: visible area, square metres.
    """

    points: Float
    area: float


def unexplained(
    world: World, tops: Sequence[TableTop], region: Box | None
) -> list[UnexplainedPatch]:
    """Find the larger parts of the last frame that are neither ground nor an object.

    The test does not depend on how the objects were found. With a region, all points inside count,
    above and below the ground; without a region, points above the visible ground.

    Args:
        world: what explains the frames.
        tops: support surfaces of the frames.
        region: search region; None for everywhere.
    """
    if not tops:
        return []
    top, view = tops[-1], world.views[-1]
    frame = top.frame
    left = ~_near_ground(top) & (frame.depth > 0)
    left &= (top.height > 0) if region is None else inside_box(frame, region)
    left &= ~top.seen.background
    if frame.mask is not None:
        left &= frame.mask
    for mask in top.seen.carried_by_none:
        left &= ~mask

    owned = world.owners[-1].reshape(view.grid().depth.shape) > 0
    owned = ndimage.binary_dilation(owned, iterations=EDGE_WIDTH)
    left &= ~view.enlarged(owned)
    if not left.any():
        return []

    focal = frame.intrinsics[0, 0] * frame.intrinsics[1, 1]
    away = float(np.median(frame.depth[left]))
    half = max(1, round(float(np.sqrt(focal)) * THINNEST / 2 / away))
    left = ndimage.binary_opening(left, np.ones((3, 3), bool), half)
    # neighbouring parts form one patch, for example a heap of small objects
    beside = round(float(np.sqrt(focal)) * PATCH_GAP / 2 / away)
    label, _ = ndimage.label(ndimage.binary_dilation(left, iterations=max(beside, 1)))
    label[~left] = 0
    areas = np.bincount(label.ravel(), (frame.depth**2 / focal).ravel())
    areas[0] = 0.0
    axes = upright_axes(top.up)
    ground = _ground_of(top) @ axes[:2].T

    found = []
    for part in np.flatnonzero(areas >= CONSIDERABLE_AREA):
        rows, columns = np.nonzero(label == part)
        few = slice(None, None, max(1, len(rows) // PATCH_POINTS))
        points = frame.positions(rows[few], columns[few])
        if region is None and not _on_ground(points @ axes[:2].T, ground).mean() > 0.5:
            continue
        found.append(UnexplainedPatch(points, float(areas[part])))
    return found


def ground_seen(tops: Sequence[TableTop], region: Box | None) -> bool:
    """Return True if enough of the ground is visible to rule out further objects.

    Args:
        tops: support surfaces of the frames.
        region: search region; None for everywhere.
    """
    if region is None:
        return any(top.shows_ground for top in tops)
    extent = np.maximum(region.high - region.low, REGION_CELL)[:2]
    shape = np.ceil(extent / REGION_CELL).astype(int)
    shown = np.zeros(shape, bool)
    for top in tops:
        rows, columns = np.nonzero(_near_ground(top) & (top.frame.depth > 0))
        points = top.frame.positions(rows, columns) @ region.axes[:2].T
        cell = np.floor((points - region.low[:2]) / REGION_CELL).astype(np.int64)
        inside = ((cell >= 0) & (cell < shape)).all(1)
        shown[tuple(cell[inside].T)] = True
    return bool(shown.mean() >= SEEN_OF_REGION)


def _near_ground(top: TableTop) -> Mask:
    """Return the pixels that are close enough to the ground to belong to it, (H, W) bool."""
    depth = top.frame.depth
    near = np.maximum(NEAR_TABLE, LOWEST_SHARE * depth)
    sigma = np.minimum(top.noise.at(depth), NOISIEST_CAMERA) * depth**2
    near = np.maximum(near, NEAR_DEVIATIONS * sigma)
    return np.asarray(np.abs(top.height) <= near)


def _ground_of(top: TableTop) -> Float:
    """Sample points of the ground in a frame, (N, 3), world, metres."""
    shown = _near_ground(top) & (top.frame.depth > 0) & ~top.other_surfaces
    rows, columns = np.nonzero(shown)
    few = slice(None, None, max(1, len(rows) // GROUND_POINTS))
    return top.frame.positions(rows[few], columns[few])


def _on_ground(points: Float, ground: Float) -> Mask:
    """Return which points, (N, 2), lie within the convex hull of the visible ground, (N,) bool.

    Args:
        points: horizontal coordinates.
        ground: points of the ground, (M, 2).
    """
    try:
        sides = ConvexHull(ground).equations
    except (QhullError, ValueError):  # too few or collinear points
        return np.ones(len(points), bool)
    return np.asarray((points @ sides[:, :2].T + sides[:, 2] <= 0).all(1))
