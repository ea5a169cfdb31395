"""Walls and ceiling of a room: planes that bound the scene and belong to no object.

Walls are found among the samples above the support plane. In the top view a vertical plane is a
line, so the search is a RANSAC for lines (Fischler and Bolles 1981). Objects have vertical sides
too, but a wall is wider than an object, extends to the border of the image, and has almost nothing
behind it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.random import Generator

from nextview.sensing.planes import Plane, Samples, steep
from nextview.types import Float, Index, Mask

LINE_TRIALS = 150  # tried lines per wall
MOST_LINES = 6  # tested vertical planes, the largest first
FEWEST_SAMPLES = 0.02  # least share of all samples on a wall
# metres, least width of a wall that reaches one side of the image
WIDE_WALL = 1.5
WIDEST_OBJECT = 3.0  # metres, largest width of an object
# least share of the image columns covered by a narrower wall that reaches both sides
WIDE_SHARE = 0.8
SIDE_CELLS = 1  # columns of the grid of samples that count as the side of the image
# largest number of samples behind a wall relative to those on it: flying pixels and open doors
MOST_SAMPLES_BEHIND = 0.1
OVER_CAMERA = 0.3  # metres, least height of a ceiling above the camera
CEILINGS_TRIED = 50  # heights
# cosine of the largest angle between parallel planes
PARALLEL_WALLS = np.cos(np.radians(25.0))
# largest distance of the camera behind a wall due to noise, relative to the distance of the samples
CAMERA_BEHIND = 0.1
# largest distance from a wall to a sample of an adjacent wall, relative to the sample's distance
CORNER_GAP = 0.05
# metres, least distance of an object in front of a wall
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
        rng: for drawing the tried lines.
        place: known position of the object, (3,), world, metres, which is in front of every wall.
        narrowest: least width of a wall that reaches one side of the image, metres.

    Returns:
        The ceiling, if it is visible, and the walls, the one with most samples first. Empty if
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
    """Find the level plane above the camera that reaches the top of the image."""
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
    """Find the vertical plane with most of the chosen samples.

    Its normal points to the side with more samples.
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
    # noise may put a camera that looks along a wall on either side
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
    """Fit a vertical plane to some points by weighted least squares."""
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
    """Return True if a vertical plane is as wide as a wall and reaches the border of the image."""
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
        len(met) > corners  # reaches the ceiling
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
    """Return True if there are more samples behind a vertical plane than flying pixels explain.

    Walls that cross it are ignored.
    """
    behind = upright.height(samples.points) < -2 * samples.tolerance
    for wall in walls:
        if abs(wall.normal @ upright.normal) < PARALLEL_WALLS:
            behind &= np.abs(wall.height(samples.points)) > samples.tolerance
    return bool(behind.sum() > MOST_SAMPLES_BEHIND * many)
