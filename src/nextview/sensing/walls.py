"""Walls and ceiling of a room: planes that bound the scene and belong to no object.

Walls are found among the steep samples above the support plane. Objects have vertical sides too,
but a wall is wider than an object, extends to the border of the image, and has almost nothing
behind it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.random import Generator

from nextview.sensing.planes import Plane, Samples, find_plane, steep
from nextview.types import Float, Index

FEWEST_SAMPLES = 0.02  # least share of all samples on a wall
SIDE_CELLS = 1  # columns of the grid of samples that count as the side of the image
# largest number of samples behind a wall relative to those on it: flying pixels and open doors
MOST_SAMPLES_BEHIND = 0.1
# metres, least distance of an object in front of a wall
NEAREST_TO_PLACE = 0.02


def find_walls(
    samples: Samples,
    plane: Plane,
    rng: Generator,
    place: Float | None = None,
) -> list[Plane]:
    """Find the walls in a frame, as planes whose normals point into the room.

    Args:
        samples: of the whole frame.
        plane: the support plane.
        rng: for drawing the tried lines.
        place: known position of the object, (3,), world, metres, which is in front of every wall.

    Returns:
        The ceiling, if it is visible, and the walls, the one with most samples first. Empty if
        there are none.
    """
    up = plane.normal
    above = plane.height(samples.points) > samples.tolerance
    left = np.flatnonzero(above & steep(samples, up))
    wanted = max(FEWEST_SAMPLES * len(samples.points), 2)

    walls = []
    ceiling = _ceiling(samples, up, rng, place)
    if ceiling is not None:
        walls.append(ceiling)
        left = left[ceiling.height(samples.points[left]) > samples.tolerance[left]]
    for _ in range(6):
        some = np.zeros(len(samples.points), bool)
        some[left] = True
        upright = find_plane(samples.some(some), rng, up, upright=True)
        if upright is None:
            break
        # noise may put a camera that looks along a wall on either side
        distance = upright.height(samples.points)
        if np.sign(distance[np.abs(distance) > samples.tolerance]).sum() < 0:
            upright = Plane(-upright.normal, -upright.offset)

        on = np.abs(distance[left]) < samples.tolerance[left]
        if on.sum() < wanted:
            break
        if _is_wall(
            samples,
            upright,
            left[on],
            up,
            place,
        ) and not _hides_much(samples, upright, walls, on.sum()):
            walls.append(upright)
        left = left[~on]
    return walls


def _ceiling(
    samples: Samples, up: Float, rng: Generator, place: Float | None
) -> Plane | None:
    """Find the level plane above the camera that reaches the top of the image."""
    over = (samples.points - samples.camera) @ up > 0.3
    ceiling = find_plane(samples.some(over & ~steep(samples, up)), rng, -up)
    if ceiling is None:
        return None
    on = over & ceiling.holds(samples)
    if on.sum() < max(FEWEST_SAMPLES * len(on), 2):
        return None
    if place is not None and ceiling.height(place) < NEAREST_TO_PLACE:
        return None
    if samples.rows[on].min() > samples.rows.min() + SIDE_CELLS:
        return None
    beyond = ceiling.height(samples.points) < -2 * samples.tolerance
    return None if beyond.sum() > MOST_SAMPLES_BEHIND * on.sum() else ceiling


def _is_wall(
    samples: Samples,
    upright: Plane,
    on: Index,
    up: Float,
    place: Float | None,
) -> bool:
    """Return True if a vertical plane is as wide as a wall and reaches the border of the image."""
    if place is not None and upright.height(place) < NEAREST_TO_PLACE:
        return False
    away = float(np.median(np.linalg.norm(samples.points[on] - samples.camera, axis=1)))
    if upright.height(samples.camera) < -0.1 * away:  # by more than noise explains
        return False

    first = samples.columns.min() + SIDE_CELLS
    last = samples.columns.max() - SIDE_CELLS
    columns = samples.columns[on]
    at_left = columns.min() <= first
    at_right = columns.max() >= last
    along = samples.points[on] @ np.cross(up, upright.normal)
    width = float(np.ptp(along))

    from_side_to_side = (
        at_left and at_right and len(np.unique(columns)) >= 0.8 * (last - first)
    )
    at_side = width > 0.5 and (at_left or at_right)
    return bool(width > 3.0 or at_side or from_side_to_side)


def _hides_much(
    samples: Samples,
    upright: Plane,
    walls: Sequence[Plane],
    many: int,
) -> bool:
    """Return True if there are more samples behind a vertical plane than flying pixels explain.

    Walls that cross it are ignored.
    """
    behind = upright.height(samples.points) < -2 * samples.tolerance
    for wall in walls:
        if abs(wall.normal @ upright.normal) < np.cos(np.radians(25.0)):
            behind &= np.abs(wall.height(samples.points)) > samples.tolerance
    return bool(behind.sum() > MOST_SAMPLES_BEHIND * many)
