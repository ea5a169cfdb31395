"""What a frame shows that is neither ground nor an object: as long as there is much, no scene is
empty, and none is done.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from nextview.geometry.axes import upright_axes
from nextview.scene.following import GONE, SAME_OBJECT_SHARE, Outline, seen_through
from nextview.scene.tracks import EDGE_WIDTH, Track
from nextview.sensing.masks import inside_box
from nextview.sensing.object_frame import Box
from nextview.sensing.tabletop import LOWEST_SHARE, NEAR_TABLE, THINNEST, TableTop
from nextview.types import Float, Mask

NEAR_DEVIATIONS = 4.0  # of the noise by which the ground's pixels deviate, at most
# metres at a distance of 1 m, standard deviation: what is noisier is no noise, but many small steps
NOISIEST_CAMERA = 0.005
CONSIDERABLE_AREA = 1e-3  # square metres that are seen: a patch of 3 cm
PATCH_GAP = 0.02  # metres between the parts of a patch, at most
PATCH_POINTS = 400  # points of a patch that are looked at
GROUND_POINTS = 2000  # points of the ground whose outline is taken
REGION_CELL = 0.02  # metres, side of a cell of a region's ground
SEEN_OF_REGION = 0.5  # share of these cells that show ground where the ground is seen


@dataclass(frozen=True, eq=False)
class UnexplainedPatch:
    """A part of a picture that is neither ground nor an object.

    Attributes:
        points: some of what it shows, (N, 3), world, metres.
        area: square metres, as the camera sees it.
    """

    points: Float
    area: float


def unexplained(
    tops: Sequence[TableTop],
    tracks: Sequence[Track],
    region: Box | None,
) -> list[UnexplainedPatch]:
    """Find the considerable parts of all pictures that are neither ground nor an object.

    It does not matter how the objects were found. With a region all that lies in it counts, above
    and below the ground; without one what stands on the ground that is seen. What lies over an
    object, and what a later frame sees through, is explained.

    Args:
        tops: what the frames show.
        tracks: the objects.
        region: where is looked; None: everywhere.
    """
    outlines = [Outline.of(track, tops[0].up) for track in tracks]
    found = []
    for number, top in enumerate(tops):
        for patch in _patches(number, top, tracks, region):
            later = tops[number + 1 :]
            over = (one.holds(patch.points).mean() for one in outlines if one)
            if any(share >= SAME_OBJECT_SHARE for share in over):
                continue
            if any(seen_through(patch.points, one.frame) >= GONE for one in later):
                continue
            found.append(patch)
    return found


def ground_seen(tops: Sequence[TableTop], region: Box | None) -> bool:
    """Whether so much of the ground is seen that nothing else can stand there.

    Args:
        tops: what the frames show.
        region: where is looked; None: everywhere.
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
    """Pixels so near to the ground that they are likely to be its own, (H, W) bool."""
    depth = top.frame.depth
    near = np.maximum(NEAR_TABLE, LOWEST_SHARE * depth)
    sigma = np.minimum(top.noise.at(depth), NOISIEST_CAMERA) * depth**2
    near = np.maximum(near, NEAR_DEVIATIONS * sigma)
    return np.asarray(np.abs(top.height) <= near)


def _patches(
    number: int,
    top: TableTop,
    tracks: Sequence[Track],
    region: Box | None,
) -> list[UnexplainedPatch]:
    """The considerable parts of one picture that are neither ground nor an object."""
    frame = top.frame
    left = ~_near_ground(top) & (frame.depth > 0)
    if region is not None:
        left &= inside_box(frame, region)
    else:
        left &= top.height > 0
    left &= ~top.background
    if frame.mask is not None:
        left &= frame.mask
    for mask in top.carried_by_none:
        left &= ~mask
    for track in tracks:
        own = track.mask_in(number)
        if own is not None:
            left &= ~ndimage.binary_dilation(own, iterations=EDGE_WIDTH)
    if not left.any():
        return []

    focal = frame.intrinsics[0, 0] * frame.intrinsics[1, 1]
    away = float(np.median(frame.depth[left]))
    half = max(1, round(float(np.sqrt(focal)) * THINNEST / 2 / away))
    left = ndimage.binary_opening(left, np.ones((3, 3), bool), half)
    # what lies side by side is one patch: so is a heap of small things
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


def _ground_of(top: TableTop) -> Float:
    """Some points of the ground that a frame shows, (N, 3), world, metres."""
    shown = _near_ground(top) & (top.frame.depth > 0) & ~top.other_surfaces
    rows, columns = np.nonzero(shown)
    few = slice(None, None, max(1, len(rows) // GROUND_POINTS))
    return top.frame.positions(rows[few], columns[few])


def _on_ground(points: Float, ground: Float) -> Mask:
    """Which points, (N, 2), lie within the convex hull of what is seen of the ground, (N,) bool.

    Args:
        points: along the ground.
        ground: points of it, (M, 2).
    """
    try:
        sides = ConvexHull(ground).equations
    except (QhullError, ValueError):  # only a line is seen of it, or nothing
        return np.ones(len(points), bool)
    return np.asarray((points @ sides[:, :2].T + sides[:, 2] <= 0).all(1))
