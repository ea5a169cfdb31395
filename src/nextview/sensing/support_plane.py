"""Find the plane on which the object stands in a first frame, or refuse the frame.

Pose and depth are checked on the way: by a wrong pose the largest plane in view leans, and depth
that is measured along the rays shows no plane where there is one.
"""

from __future__ import annotations

from copy import deepcopy

import numpy as np
from numpy.random import Generator

from nextview.errors import ObservationError
from nextview.sensing import planes, support
from nextview.sensing.frame import Frame
from nextview.sensing.object_frame import Box, ObjectFrame
from nextview.sensing.planes import Plane, Samples, find_plane, steep
from nextview.sensing.walls import find_walls
from nextview.types import Float

# share of the samples on a plane from which no other plane holds twice as many
LARGE_SHARE = 1 / 3
# metres below the support plane at which the point of an object may lie: on it, but for a pose's
# error
BELOW = 0.02
MASK_POINTS = 2000  # pixels of a mask that tell where its bottom is
NO_SUPPORT = (
    "no support plane is seen below the camera: give a mask or a box, or check the pose (inverse?"
    " OpenGL axes?) and which way is up"
)


def find_support_plane(
    frame: Frame,
    samples: Samples,
    up: Float | None,
    rng: Generator,
    point: Float | None = None,
    known: ObjectFrame | None = None,
    box: Box | None = None,
) -> Plane | None:
    """Find the plane on which the object stands.

    Args:
        frame: the frame; if it has a mask, the object is there.
        samples: of the frame.
        up: direction against gravity, (3,), world; None: the plane with most samples is taken.
        rng: draws the planes that are tried.
        point: that selects the object, (3,), world, metres; None for what the camera is aimed at.
        known: the object frame, if it is known.
        box: that the object fills, if it is known.

    Returns:
        The plane; None if none is seen, or if the point selects a level surface itself.

    Raises:
        ObservationError: the pose is wrong, or the depth is measured along the rays.
    """
    # the foot of a wall is no part of the floor
    level = samples if up is None else samples.some(~steep(samples, up))
    above = _point_above(point, known, box)
    plane = find_plane(level, rng, up, above)
    if point is not None and up is not None:
        plane = _beneath_point(plane, level, point, up, rng)

    if up is not None and frame.mask is None and _share(plane, level) < LARGE_SHARE:
        _refuse_wrong_pose(frame, samples, 2 * _share(plane, level), up, rng)
    _refuse_range(frame, plane, level, rng, up, above)
    if plane is None or up is None:
        return plane

    if known is None:
        plane = _beneath_object(frame, samples, plane, point)
    place = None if frame.mask is not None else point
    return None if support.is_named(frame, samples, plane, place) else plane


def refuse_mistakes(
    frame: Frame,
    samples: Samples,
    plane: Plane | None,
    up: Float | None,
) -> None:
    """Refuse a frame whose pose is wrong, or whose depth is a range, by its surfaces.

    Args:
        frame: the frame.
        samples: of the surfaces in it.
        plane: of these, the one that things stand on; None if none is level.
        up: direction against gravity, (3,), world; None if it is not known.

    Raises:
        ObservationError: the pose is wrong, or the depth is measured along the rays.
    """
    rng = np.random.default_rng(0)
    level = samples if up is None else samples.some(~steep(samples, up))
    if up is not None and _share(plane, level) < LARGE_SHARE:
        _refuse_wrong_pose(frame, samples, 2 * _share(plane, level), up, rng)
    _refuse_range(frame, plane, level, rng, up, None)


def _refuse_range(
    frame: Frame,
    plane: Plane | None,
    level: Samples,
    rng: Generator,
    up: Float | None,
    above: Float | None,
) -> None:
    """Refuse a frame that fits a plane better if its depth is taken along each ray."""
    if planes.lies_better_as_range(frame, plane, level, rng, up, above):
        raise ObservationError(
            "the depth is measured along the rays, a range: give it along the optical axis"
        )


def base_below_view(samples: Samples, up: Float, point: Float) -> Plane | None:
    """The level plane through the lowest points of a frame whose support is out of the picture.

    Args:
        samples: of the frame.
        up: direction against gravity, (3,), world.
        point: that selects the object, (3,), world, metres.

    Returns:
        The plane, below the point; None where no level plane is seen above it. Such a plane is a
        part of the object, as the top is of a table, and shows that the pose is right.
    """
    level = samples.some(~steep(samples, up))
    if find_plane(level, np.random.default_rng(0), up) is None:
        return None
    margin = planes.TOLERANCES_ASIDE * float(np.median(samples.tolerance))
    return support.through_lowest(samples, up, float(point @ up) - margin)


def _point_above(
    point: Float | None,
    known: ObjectFrame | None,
    box: Box | None,
) -> Float | None:
    """A point that is known to be above the support plane, (3,), world, metres."""
    if box is not None:
        quarter = (box.low + box.high) / 2
        quarter[2] = box.low[2] + (box.high[2] - box.low[2]) / 4
        return quarter @ box.axes
    if known is not None:
        return known.centre - 0.2 * known.radius * known.axes[2]
    return point


def _share(plane: Plane | None, samples: Samples) -> float:
    """Share of the samples that lie on a plane."""
    return 0.0 if plane is None else float(plane.holds(samples).mean())


def _beneath_point(
    plane: Plane | None,
    level: Samples,
    point: Float,
    up: Float,
    rng: Generator,
) -> Plane | None:
    """The plane, or one at the height of the point or a little above it that holds far more."""
    # A fit that rises over the point, above which no plane was tried, cuts through a surface.
    cuts = plane is not None and plane.height(point) < 0
    share = _share(plane, level)
    if not cuts and share >= LARGE_SHARE:
        return plane

    higher = point + (2 * np.median(level.tolerance) + BELOW) * up
    other = find_plane(level, deepcopy(rng), up, higher)
    return other if _share(other, level) > (1 if cuts else 2) * share else plane


def _refuse_wrong_pose(
    frame: Frame,
    samples: Samples,
    least: float,
    up: Float,
    rng: Generator,
) -> None:
    """Refuse a frame whose largest plane holds more than a share, and would be level otherwise."""
    largest = find_plane(samples, rng)
    if largest is None:
        return
    mistake = planes.mistake_in_pose(largest, frame.camera_to_world, up)
    if mistake and largest.holds(samples).mean() > least:
        raise ObservationError(
            f"the largest plane in view is not level: {mistake} Or up is another direction"
        )


def _beneath_object(
    frame: Frame,
    samples: Samples,
    plane: Plane,
    point: Float | None,
) -> Plane:
    """Of the level planes of a frame, the one beneath the mask, the point or the camera's aim."""
    level_planes = support.level_planes(samples, plane)
    if len(level_planes) == 1:
        return plane
    if frame.mask is not None:
        rows, columns = np.nonzero(frame.mask & (frame.depth > 0))
        few = slice(None, None, max(1, len(rows) // MASK_POINTS))
        points = frame.positions(rows[few], columns[few])
        return support.under_points(samples, level_planes, points) or plane

    walls = find_walls(samples, level_planes[-1], np.random.default_rng(0), point)
    of_walls = np.zeros(len(samples.points), bool)
    for wall in walls:
        of_walls |= wall.height(samples.points) < samples.tolerance
    return support.aimed_at(frame, samples, level_planes, of_walls, point)
