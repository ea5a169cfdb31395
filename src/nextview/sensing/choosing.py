"""Select the instance of a frame that is the object."""

from __future__ import annotations

from itertools import compress

import numpy as np

from nextview.errors import ObservationError
from nextview.sensing.frame import Frame
from nextview.sensing.masks import SPHERE_MARGIN, inside_sphere, touching
from nextview.sensing.object_frame import ObjectFrame
from nextview.sensing.segmented_frame import SegmentedFrame
from nextview.sensing.sighting import FEWEST_OBJECT_PIXELS
from nextview.types import Float, Mask

# image widths beside the optical axis at which an instance counts 1 / e, among other objects or
# for an object that stands alone
WELL_AIMED = 0.02
ALONE_AIMED = 0.08
NO_INSTANCE = (
    "the segmentation finds nothing {where} in this frame: check its pose, aim the camera at the"
    " object, or give a mask"
)


def choose_instance(
    seen: SegmentedFrame,
    point: Float | None,
    known: ObjectFrame | None,
    alone: bool = False,
) -> Mask:
    """Select the instance of a frame that is the object.

    It is the one at the known place of the object; in a first frame, the one nearest to a point, or
    the one at which the camera is aimed.

    Args:
        seen: the frame with its instances and surfaces.
        point: on the object, (3,), world, metres; None if not given.
        known: object frame from earlier frames; None in a first frame.
        alone: whether everything that touches the object is a part of it.

    Returns:
        Its mask, (H, W) bool.

    Raises:
        ObservationError: there is no such instance.
    """
    if known is not None:
        chosen = _seen_before(seen, known)
    elif point is not None:
        chosen = _at_point(seen, point)
    else:
        chosen = _aimed_at(seen, ALONE_AIMED if alone else WELL_AIMED)
    return with_neighbours(chosen, seen) if alone else chosen


def with_neighbours(chosen: Mask, seen: SegmentedFrame) -> Mask:
    """Return an instance with everything that touches it, directly or indirectly.

    Args:
        chosen: the instance, (H, W) bool.
        seen: the frame with all instances.

    Returns:
        The pixels of all of them, (H, W) bool.
    """
    found = chosen
    left = [mask for mask in seen.masks if not (mask & chosen).any()]
    while True:
        beside = [touching(seen.frame, found, mask) for mask in left]
        if not any(beside):
            return found
        for mask in compress(left, beside):
            found = found | mask
        left = [
            mask for mask, is_beside in zip(left, beside, strict=True) if not is_beside
        ]


def _at_point(seen: SegmentedFrame, point: Float) -> Mask:
    """Return the instance nearest to a point, (3,), world, metres, on its surface or inside it."""
    frame = seen.frame
    away = float(np.linalg.norm(point - frame.camera_to_world[:3, 3]))
    if away < 0.01:  # metres: nothing is seen so near
        raise ObservationError(
            f"the object's point is {away:.2g} m from the camera: of the world?"
        )
    shown = _of_size(seen)
    if not shown:
        raise ObservationError(NO_INSTANCE.format(where="at the point"))
    distances = [_distance(mask, frame, point) for mask in shown]
    return shown[int(np.argmin(distances))]


def _distance(mask: Mask, frame: Frame, point: Float) -> float:
    """Return the distance from a point to an instance, metres.

    It is 0 behind the visible surface, down to a depth equal to the width of the instance.
    """
    rows, columns = np.nonzero(mask & (frame.depth > 0))
    few = slice(None, None, max(1, len(rows) // 1000))
    points = frame.positions(rows[few], columns[few])
    nearest = float(np.linalg.norm(points - point, axis=1).min())

    pose = frame.camera_to_world
    x, y, z = (point - pose[:3, 3]) @ pose[:3, :3]
    if z <= 0:
        return nearest
    across, down, _ = frame.intrinsics @ np.array([x / z, y / z, 1.0])
    row = int(np.floor(down))
    column = int(np.floor(across))
    height, width = frame.shape
    if not (0 <= row < height and 0 <= column < width) or not mask[row, column]:
        return nearest
    deep = z - float(frame.depth[row, column])
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    return 0.0 if 0 <= deep < size else nearest


def _seen_before(seen: SegmentedFrame, known: ObjectFrame) -> Mask:
    """Return the instance that fills most of the known place and is mostly inside it."""
    frame = seen.frame
    inside = inside_sphere(frame, known.centre, SPHERE_MARGIN * known.radius)
    shown = _of_size(seen)
    worth = [_overlap(mask & (frame.depth > 0), inside) for mask in shown]
    if not any(worth):
        raise ObservationError(NO_INSTANCE.format(where="of the object known so far"))
    return shown[int(np.argmax(worth))]


def _overlap(mask: Mask, inside: Mask) -> float:
    """Return the pixels of an instance inside a region, weighted by their share of the instance."""
    there = int(np.count_nonzero(mask & inside))
    return there**2 / max(int(np.count_nonzero(mask)), 1)


def _aimed_at(seen: SegmentedFrame, error: float) -> Mask:
    """Return the largest instance at the optical axis, or near it.

    Args:
        seen: the frame with its instances.
        error: image widths from the axis at which an instance counts 1 / e.
    """
    shown = _of_size(seen)
    if not shown:
        raise ObservationError(NO_INSTANCE.format(where="before the camera"))
    return max(shown, key=lambda mask: _weight(mask, seen.frame, error))


def _weight(mask: Mask, frame: Frame, error: float) -> float:
    """Return the number of pixels of an instance, weighted by distance from the optical axis."""
    rows, columns = np.nonzero(mask)
    column, row = frame.intrinsics[:2, 2]
    away = float(np.hypot(rows - row, columns - column).min()) / frame.shape[1]
    return float(len(rows) * np.exp(-((away / error) ** 2)))


def _of_size(seen: SegmentedFrame) -> list[Mask]:
    """Return the instances with enough pixels."""
    measured = seen.frame.depth > 0
    return [
        mask
        for mask in seen.masks
        if np.count_nonzero(mask & measured) >= FEWEST_OBJECT_PIXELS
    ]
