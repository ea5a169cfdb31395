"""Assign the pixels of a frame to known objects."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from nextview.geometry.axes import upright_axes
from nextview.sensing.frame import Frame
from nextview.sensing.tabletop import TableTop
from nextview.session.tracks import Track, render_track
from nextview.types import Float, Index, Mask

# metres around the outline of an object in the top view within which pixels may belong to it
SEGMENT_MARGIN = 0.012
# least share of a segment inside an object's outline for the segment to be that object
SAME_OBJECT_SHARE = 0.5
SECOND = (
    0.2  # least share of a segment inside another outline for the segment to be divided
)
SEGMENT_POINTS = 400  # sampled points of a segment
FEWEST_TESTED = 30  # least number of tested pixels before an object may be called gone
GONE = 0.6  # least share of tested pixels that show the background of a gone object
STEP_BEHIND = 0.02  # metres, least distance of that background behind the object


@dataclass(frozen=True, eq=False)
class Outline:
    """Outline of an object in the top view.

    Attributes:
        sides: lines a x + b y + c <= 0 inside, metres, (K, 3).
        axes: x and y in the world, (2, 3).
    """

    sides: Float
    axes: Float

    @classmethod
    def of(cls, track: Track, up: Float) -> Outline | None:
        """Compute the outline of an object.

        It is that of the scan if the object was recognised, and otherwise of its visible points.

        Args:
            track: the object, already judged.
            up: direction against gravity in the world, (3,).
        """
        axes = upright_axes(up)[:2]
        posed = track.posed
        if posed is not None and posed.vertices is not None:
            points = posed.vertices @ posed.pose[:3, :3].T + posed.pose[:3, 3]
        else:
            points = np.concatenate(
                [sighting.hull for sighting in track.thing.sightings]
            )
        flat = points @ axes.T
        around = SEGMENT_MARGIN / 4 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
        with suppress(QhullError):
            hull = ConvexHull((flat[:, None] + around).reshape(-1, 2))
            return cls(hull.equations, axes)
        return None

    def holds(self, points: Float) -> Mask:
        """Return which points, (N, 3), lie inside the outline or within its margin, (N,) bool."""
        flat = points @ self.axes.T
        return np.asarray(
            (flat @ self.sides[:, :2].T + self.sides[:, 2] <= SEGMENT_MARGIN).all(1)
        )


def assign(
    segments: Sequence[Mask],
    tracks: Sequence[Track],
    top: TableTop,
) -> tuple[dict[int, Mask], list[Mask]]:
    """Assign the segments of a frame to objects.

    Args:
        segments: masks of the frame, (H, W) bool each.
        tracks: the objects so far.
        top: support surfaces of the frame.

    Returns:
        The pixels of each object in the frame, by its row in ``tracks``; and the segments that
        belong to no known object.
    """
    outlines = [Outline.of(track, top.up) for track in tracks]
    own: dict[int, Mask] = {}
    new = []

    for segment in segments:
        points = _points(segment, top.frame)
        shares = np.array(
            [
                0.0 if one is None else float(one.holds(points).mean())
                for one in outlines
            ]
        )
        rows = np.flatnonzero(shares >= SECOND)
        best = int(shares.argmax()) if len(shares) else -1
        if best < 0 or shares[best] < SAME_OBJECT_SHARE:
            part = _seen_in(segment, tracks, top.frame)
            if part is None:
                new.append(segment)
            else:
                own[part] = own.get(part, np.zeros_like(segment)) | segment
        elif len(rows) == 1:
            own[best] = own.get(best, np.zeros_like(segment)) | segment
        else:
            for row, mask in _divided(segment, rows, tracks, outlines, top).items():
                own[row] = own.get(row, np.zeros_like(segment)) | mask

    return own, new


def _seen_in(segment: Mask, tracks: Sequence[Track], frame: Frame) -> int | None:
    """Find the object without a scan that a segment belongs to.

    The points of the segment are projected into the last frame of each object. Most of those that
    are visible there must lie in the mask of the object.

    Args:
        segment: mask, (H, W) bool.
        tracks: the objects so far.
        frame: of the segment.

    Returns:
        The row of the object with the most of these points; None if there is none.
    """
    points = _points(segment, frame)
    best = None
    most = FEWEST_TESTED - 1
    for row, track in enumerate(tracks):
        if track.likeliest is not None:
            continue
        last = track.thing.sightings[-1]
        at, off = points_in(points, last.frame)
        both = np.abs(off) < STEP_BEHIND
        inside = int(np.count_nonzero(both & last.mask[at]))
        if inside > most and inside > SAME_OBJECT_SHARE * np.count_nonzero(both):
            best = row
            most = inside
    return best


def _points(mask: Mask, frame: Frame) -> Float:
    """Sample points of a mask, (N, 3), world, metres."""
    rows, columns = np.nonzero(mask & (frame.depth > 0))
    few = slice(None, None, max(1, len(rows) // SEGMENT_POINTS))
    return frame.positions(rows[few], columns[few])


def _divided(
    segment: Mask,
    rows: Index,
    tracks: Sequence[Track],
    outlines: Sequence[Outline | None],
    top: TableTop,
) -> dict[int, Mask]:
    """Divide the pixels of a segment among several objects.

    Each pixel goes to the object that explains it, or else to the object of the nearest explained
    pixel.
    """
    label = np.zeros(segment.shape, np.int64)
    for row in rows:
        outline = outlines[row]
        rendered = render_track(tracks[row], top, -1, tracks[row].posed)
        if rendered is not None:
            explained = rendered.explained(segment.shape) & segment
        else:
            assert outline is not None
            at = np.nonzero(segment)
            explained = np.zeros_like(segment)
            explained[at] = outline.holds(top.frame.positions(*at))
        label[explained & (label == 0)] = row + 1
    if not label.any():
        return {int(rows[0]): segment}

    nearest = ndimage.distance_transform_edt(
        label == 0,
        return_distances=False,
        return_indices=True,
    )
    label = np.where(segment, label[tuple(nearest)], 0)

    return {int(row): label == row + 1 for row in rows if (label == row + 1).any()}


def points_in(points: Float, frame: Frame) -> tuple[tuple[Index, Index], Float]:
    """Project points into a frame.

    Args:
        points: (N, 3), world, metres.
        frame: the frame.

    Returns:
        Row and column of each point that falls on a pixel with depth, (M,) each; and measured depth
        minus depth of the point, metres, (M,).
    """
    now = frame.camera_to_world
    in_camera = (points - now[:3, 3]) @ now[:3, :3]
    in_camera = in_camera[in_camera[:, 2] > 0.01]
    column, row = np.floor(frame.pinhole.project(in_camera)).astype(np.int64).T
    inside = (
        (row >= 0) & (row < frame.shape[0]) & (column >= 0) & (column < frame.shape[1])
    )
    row, column = row[inside], column[inside]
    depth = frame.depth[row, column]
    seen = depth > 0
    return (row[seen], column[seen]), (depth - in_camera[inside, 2])[seen]


def seen_through(points: Float, frame: Frame) -> float:
    """Return the share of points behind which the frame measures something else.

    Args:
        points: (N, 3), world, metres.
        frame: the frame.

    Returns:
        The share; 0 if too few points fall on pixels with depth.
    """
    _, off = points_in(points, frame)
    if len(off) < FEWEST_TESTED:
        return 0.0
    return float((off > STEP_BEHIND).mean())
