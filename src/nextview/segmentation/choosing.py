"""Which instance of a segmentation a session looks at, and what it stands on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from nextview.errors import ObservationError
from nextview.segmentation.instances import Instances, Segmenter, instances_of
from nextview.sensing.clusters import AIM_SPREAD
from nextview.sensing.facets import noise_of
from nextview.sensing.frame import Frame
from nextview.sensing.levels import Supports
from nextview.sensing.object_frame import ObjectFrame
from nextview.sensing.observed_object import Carried
from nextview.sensing.segmentation import SPHERE_MARGIN, inside_box, inside_sphere
from nextview.sensing.sighting import FEWEST_OBJECT_PIXELS
from nextview.types import Float, Mask

if TYPE_CHECKING:
    from nextview.sensing.observed_object import ObservedObject

NO_INSTANCE = (
    "the segmentation finds nothing {where} in this frame: check its pose, aim the camera at the"
    " object, or give a mask"
)
POINTS_COMPARED = 1000  # of an instance with the point that chooses one


def choose_instance(
    segmentation: Segmenter,
    frame: Frame,
    object: ObservedObject,
) -> tuple[Frame, Carried | None]:
    """Choose the instance that an object is in a frame.

    A mask of the frame stays as it is. Otherwise it is the instance in the object's box, or in the
    sphere where it is known to be; or the one nearest to its point; or, after the first frame, the
    one where it stood; or the one at which the camera is aimed.

    Args:
        segmentation: that tells the instances.
        frame: of a depth camera.
        object: what is looked for, as it is known before the frame.

    Returns:
        The frame with the pixels of the instance as its mask; and what it stands on, None where the
        segmentation tells no surfaces.

    Raises:
        ObservationError: there is no such instance, or the segmentation returned no masks.
    """
    instances = instances_of(segmentation, frame)
    supports = _supports(instances, frame, object)
    if frame.mask is not None:
        mask = frame.mask
    elif object.known is not None:
        mask = _in_known_place(instances, frame, object, object.known)
    elif object.point is not None and not object.sightings:
        mask = _at_point(instances, frame, object.point)
    elif object.sightings:
        mask = _seen_before(instances, frame, object.object_frame)
    else:
        mask = _aimed_at(instances, supports, frame)

    masked = frame if frame.mask is not None else frame.with_mask(mask)
    if supports is None:
        return masked, None
    level = supports.under(mask)
    return masked, Carried(None if level is None else level.plane)


def _supports(
    instances: Instances,
    frame: Frame,
    object: ObservedObject,
) -> Supports | None:
    """The surfaces of a frame and what they carry; None where they are not told, or not asked."""
    if instances.surface is None or not object.support:
        return None
    up = None if frame.pose is None else object.up
    if object.sightings:
        up = object.object_frame.axes[2]
    masks = instances.masks
    return Supports.of(frame, masks, instances.surface, noise_of(frame), up)


def _in_known_place(
    instances: Instances,
    frame: Frame,
    object: ObservedObject,
    known: ObjectFrame,
) -> Mask:
    """What lies in a box, or in the sphere of a known object, of the instance with most there."""
    if object.box is not None:
        inside = inside_box(frame, object.box)
    else:
        inside = inside_sphere(frame, known.centre, SPHERE_MARGIN * known.radius)
    parts = [mask & inside for mask in instances.masks]
    return _largest(parts, "where the object should be")


def _at_point(instances: Instances, frame: Frame, point: Float) -> Mask:
    """The instance nearest to a point, (3,), world, metres, on its surface or inside of it."""
    shown = _of_size(instances, frame)
    if not shown:
        raise ObservationError(NO_INSTANCE.format(where="at the point"))
    distances = [_distance(mask, frame, point) for mask in shown]
    return shown[int(np.argmin(distances))]


def _distance(mask: Mask, frame: Frame, point: Float) -> float:
    """Metres from a point to an instance; 0 behind its surface, no deeper than it is wide."""
    rows, columns = np.nonzero(mask & (frame.depth > 0))
    few = slice(None, None, max(1, len(rows) // POINTS_COMPARED))
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


def _seen_before(instances: Instances, frame: Frame, known: ObjectFrame) -> Mask:
    """The instance that fills most of where the object was found, and is not much elsewhere."""
    inside = inside_sphere(frame, known.centre, SPHERE_MARGIN * known.radius)
    shown = _of_size(instances, frame)
    worth = [_overlap(mask & (frame.depth > 0), inside) for mask in shown]
    if not any(worth):
        raise ObservationError(NO_INSTANCE.format(where="of the object known so far"))
    return shown[int(np.argmax(worth))]


def _overlap(mask: Mask, inside: Mask) -> float:
    """Pixels of an instance in a place, times the share of its pixels that these are."""
    there = int(np.count_nonzero(mask & inside))
    return there**2 / max(int(np.count_nonzero(mask)), 1)


def _aimed_at(
    instances: Instances,
    supports: Supports | None,
    frame: Frame,
) -> Mask:
    """The largest instance near the optical axis; of those that a surface carries, if there are.

    Its pixels count the less, the farther it lies from the axis.
    """
    shown = _of_size(instances, frame)
    if supports is not None:
        pairs = zip(supports.masks, supports.carriers, strict=True)
        carried = {id(mask) for mask, level in pairs if level is not None}
        shown = [mask for mask in shown if id(mask) in carried] or shown
    if not shown:
        raise ObservationError(NO_INSTANCE.format(where="before the camera"))
    return max(shown, key=lambda mask: _weight(mask, frame))


def _weight(mask: Mask, frame: Frame) -> float:
    """Pixels of an instance, less the farther it lies from the optical axis."""
    rows, columns = np.nonzero(mask)
    column, row = frame.intrinsics[:2, 2]
    away = float(np.hypot(rows - row, columns - column).min()) / frame.shape[1]
    return float(len(rows) * np.exp(-((away / AIM_SPREAD) ** 2)))


def _of_size(instances: Instances, frame: Frame) -> list[Mask]:
    """The instances that show in enough pixels."""
    return [
        mask
        for mask in instances.masks
        if np.count_nonzero(mask & (frame.depth > 0)) >= FEWEST_OBJECT_PIXELS
    ]


def _largest(masks: list[Mask], where: str) -> Mask:
    """The mask with most pixels.

    Raises:
        ObservationError: none has enough.
    """
    pixels = [np.count_nonzero(mask) for mask in masks]
    if max(pixels, default=0) < FEWEST_OBJECT_PIXELS:
        raise ObservationError(NO_INSTANCE.format(where=where))
    return masks[int(np.argmax(pixels))]
