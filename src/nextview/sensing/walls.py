"""Walls and ceiling of a room: planes that end the scene and are no part of any object.

A wall is found among what rises above the support plane. Seen from above an upright plane is a
line, so the search is a RANSAC for lines (Fischler and Bolles 1981). An object has upright sides,
too: a wall is wider than an object, goes on to the edge of the picture, and has next to nothing
behind it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.random import Generator

from nextview.sensing.planes import Plane, Samples, steep
from nextview.types import Float, Index, Mask

LINE_TRIALS = 150  # lines that are tried for each wall
MOST_LINES = 6  # upright planes that are looked at, the largest first
FEWEST_SAMPLES = 0.02  # share of all samples that lie on a wall, at least
# metres: an upright plane that reaches a side of the picture and is as wide is a wall
WIDE_WALL = 1.5
WIDEST_OBJECT = 3.0  # metres: no object is so wide
# share of the columns of the picture over which a narrower wall extends, from side to side
WIDE_SHARE = 0.8
SIDE_CELLS = 1  # columns of the grid of samples that count as the side of the picture
# samples behind a wall, as a part of those on it, at most: flying pixels and doors ajar
MOST_SAMPLES_BEHIND = 0.1
OVER_CAMERA = 0.3  # metres of a ceiling over the camera, at least
CEILINGS_TRIED = 50  # heights
# cosine of the angle up to which two planes are parallel
PARALLEL_WALLS = np.cos(np.radians(25.0))
# how far behind a wall noise may put the camera, as a part of the distance of what it sees
CAMERA_BEHIND = 0.1
# from the next wall to a sample of a wall that meets it, as a part of its distance, at most
CORNER_GAP = 0.05
# metres that the place of an object lies before a wall, at least
NEAREST_TO_PLACE = 0.02


def find_walls(
    samples: Samples,
    plane: Plane,
    rng: Generator,
    place: Float | None = None,
    narrowest: float = WIDE_WALL,
) -> list[Plane]:
    """Find the walls in a frame, as planes whose normals point into the room.

    Args:
        samples: of the whole frame.
        plane: the support plane.
        rng: draws the lines that are tried.
        place: where the object is known to be, (3,), world, metres: it lies before every wall.
        narrowest: width of a wall that reaches one side of the picture, metres.

    Returns:
        The ceiling, if it is seen, and the walls, the one with most samples first. Empty where
        there are none.
    """
    up = plane.normal
    above = plane.height(samples.points) > samples.tolerance
    left = np.flatnonzero(above & steep(samples, up))
    wanted = max(FEWEST_SAMPLES * len(samples.points), 2)

    ceiling = _ceiling(samples, plane, place)
    walls = [] if ceiling is None else [ceiling]
    if ceiling is not None:
        left = left[ceiling.height(samples.points[left]) > samples.tolerance[left]]
    for _ in range(MOST_LINES):
        if len(left) < wanted:
            break
        upright = _largest_upright_plane(samples, left, up, rng)
        if upright is None:
            break

        on = np.abs(upright.height(samples.points[left])) < samples.tolerance[left]
        if on.sum() < wanted:
            break
        if _is_wall(
            samples,
            upright,
            left[on],
            up,
            walls,
            place,
            narrowest,
        ) and not _hides_much(samples, upright, walls, on.sum()):
            walls.append(upright)
        left = left[~on]
    return walls


def _ceiling(samples: Samples, plane: Plane, place: Float | None) -> Plane | None:
    """The level plane over the camera that reaches the top of the picture and ends the scene."""
    height = plane.height(samples.points)
    over = height - plane.height(samples.camera)
    level = np.flatnonzero((over > OVER_CAMERA) & ~steep(samples, plane.normal))
    wanted = max(FEWEST_SAMPLES * len(height), 2)
    if len(level) < wanted:
        return None

    tried = height[level][:: max(1, len(level) // CEILINGS_TRIED)]
    near = np.abs(height[level, None] - tried) < samples.tolerance[level, None]
    best = int(near.sum(0).argmax())
    on = level[near[:, best]]
    weight = 1 / samples.tolerance[on] ** 2
    ceiling = Plane(
        -plane.normal,
        float(weight @ height[on] / weight.sum()) - plane.offset,
    )
    if len(on) < wanted or (
        place is not None and ceiling.height(place) < NEAREST_TO_PLACE
    ):
        return None
    if samples.rows[on].min() > samples.rows.min() + SIDE_CELLS:
        return None
    beyond = ceiling.height(samples.points) < -2 * samples.tolerance
    return None if beyond.sum() > MOST_SAMPLES_BEHIND * len(on) else ceiling


def _largest_upright_plane(
    samples: Samples,
    chosen: Index,
    up: Float,
    rng: Generator,
) -> Plane | None:
    """The upright plane through most of the chosen samples.

    Its normal points to the side where most is seen.
    """
    points = samples.points[chosen]
    tolerance = samples.tolerance[chosen]
    one, other = points[rng.integers(len(points), size=(2, LINE_TRIALS))]
    normals = np.cross(other - one, up)
    length = np.linalg.norm(normals, axis=1)
    possible = length > 1e-9
    if not possible.any():
        return None
    normals = normals[possible] / length[possible, None]
    offsets = -(normals * one[possible]).sum(1)

    on = np.abs(points @ normals.T + offsets) < tolerance[:, None]
    best = int(on.sum(0).argmax())
    plane = _refined(points, tolerance, normals[best], on[:, best], up)
    # a camera that looks along a wall may stand on either side by noise
    distance = plane.height(samples.points)
    off = np.abs(distance) > samples.tolerance
    facing = 1.0 if np.sign(distance[off]).sum() >= 0 else -1.0
    return Plane(facing * plane.normal, facing * plane.offset)


def _refined(
    points: Float,
    tolerance: Float,
    normal: Float,
    on: Mask,
    up: Float,
) -> Plane:
    """The upright plane of least squares through some points, weighted by how exact each is."""
    weight = 1 / tolerance[on] ** 2
    centre = weight @ points[on] / weight.sum()
    spread = points[on] - centre
    along = np.cross(up, normal)
    across = np.stack([spread @ along, spread @ normal], 1)
    vectors = np.linalg.eigh((weight[:, None] * across).T @ across)[1]
    better = vectors[0, 0] * along + vectors[1, 0] * normal
    better /= np.linalg.norm(better)
    return Plane(better, float(-better @ centre))


def _is_wall(
    samples: Samples,
    upright: Plane,
    on: Index,
    up: Float,
    walls: Sequence[Plane],
    place: Float | None,
    narrowest: float,
) -> bool:
    """Whether an upright plane is as wide as a wall and reaches the edge of the picture."""
    if place is not None and upright.height(place) < NEAREST_TO_PLACE:
        return False
    away = float(np.median(np.linalg.norm(samples.points[on] - samples.camera, axis=1)))
    if upright.height(samples.camera) < -CAMERA_BEHIND * away:
        return False

    first = samples.columns.min() + SIDE_CELLS
    last = samples.columns.max() - SIDE_CELLS
    columns = samples.columns[on]
    at_left = columns.min() <= first
    at_right = columns.max() >= last
    along = samples.points[on] @ np.cross(up, upright.normal)
    width = float(np.ptp(along))

    from_side_to_side = (
        at_left and at_right and len(np.unique(columns)) >= WIDE_SHARE * (last - first)
    )
    gap = CORNER_GAP * away + float(np.median(samples.tolerance[on]))
    met = [
        wall for wall in walls if (np.abs(wall.height(samples.points[on])) < gap).any()
    ]
    corners = sum(abs(wall.normal @ up) < PARALLEL_WALLS for wall in met)
    to_the_top = (
        len(met) > corners  # as high as the ceiling
        or samples.rows[on].min() <= samples.rows.min() + SIDE_CELLS
    )
    in_corner = to_the_top and corners > 0
    between_walls = to_the_top and corners > 1
    wide = width > narrowest or in_corner
    at_side = wide and (at_left or at_right)
    return bool(width > WIDEST_OBJECT or at_side or from_side_to_side or between_walls)


def _hides_much(
    samples: Samples,
    upright: Plane,
    walls: Sequence[Plane],
    many: int,
) -> bool:
    """Whether more is seen behind an upright plane than flying pixels explain.

    Walls that cross it are left out.
    """
    behind = upright.height(samples.points) < -2 * samples.tolerance
    for wall in walls:
        if abs(wall.normal @ upright.normal) < PARALLEL_WALLS:
            behind &= np.abs(wall.height(samples.points)) > samples.tolerance
    return bool(behind.sum() > MOST_SAMPLES_BEHIND * many)
