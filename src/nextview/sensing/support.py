"""Which of the level planes in a frame the object stands on: the floor, the table, or a shelf.

The largest level plane is not always the support. A monitor stands on a desk that shows less of
itself than the floor; the mattress of a bed, or the seat of a sofa, is a level plane too, and a
part of the object.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from nextview.sensing.frame import Frame
from nextview.sensing.planes import Plane, Samples, refine_plane, steep
from nextview.types import Float, Index, Mask

LEAST_LEVEL_SHARE = 0.03  # share of all samples on a further level plane, at least
MOST_PLANES = 5
HEIGHTS_TRIED = 300
# cosine of the angle up to which two planes are parallel, but for noise
PARALLEL_SUPPORTS = np.cos(np.radians(3.0))
# distances of the camera from what it is aimed at: no object is so wide, so the plane is no part
GROUND_WIDTH = 1.5
# picture widths between the optical axis and what stands on a plane, at most, if the camera is
# aimed at it
AIM = 0.12
# distances of the camera between the object's point and what stands on a plane, at most
POINT_ASIDE = 0.08
# area, seen from above, of what stands on a plane, as a part of the plane's
LARGEST_AREA_ABOVE = 0.25
# what stands on a plane has its middle in the plane's outline, drawn together to so much of it
WELL_INSIDE = 0.85
# samples of a part of a level surface, of those of its largest part: smaller ones are scraps
LARGE_PART = 0.2
# extent of a thing, as a part of that of the plane, below which it may stand at the plane's edge
NARROW = 0.35
# height of what stands on a plane, as a part of its distance, at least
LOWEST_THING = 0.015
# the same of a level surface: at a grazing angle its samples lie far apart
GROUND_STEP = 0.25
# tolerance of samples that tell a plane from the next one, as a part of the height between them
TOLD_APART = 0.5
# neighbouring samples of one surface differ by at most this part of their depth, and noise
SURFACE_STEP = 0.04
# share of a mask's points that may lie lower than its bottom: noise
BOTTOM_SHARE = 0.04
# height over a plane of the bottom of what stands on it, as a part of the distance
BOTTOM_MARGIN = 0.02
# from there, to the side, to where the plane is seen, at most, as a part of the distance
BOTTOM_ASIDE = 0.08
# height of a level plane over the ground below it, as a part of the distance: less is noise
GROUND_BELOW = 0.05
# share of what is seen that may lie lower than the lowest that counts: noise
LOWEST_SEEN = 0.01


def level_planes(samples: Samples, first: Plane) -> list[Plane]:
    """All level planes of a frame that have some samples, with the first, the highest at the head.

    Floors, tables and shelves are parallel, so the others are found by their height alone.

    Args:
        samples: of the frame.
        first: the level plane with most samples.
    """
    height = first.height(samples.points)
    left = ~steep(samples, first.normal) & (np.abs(height) > samples.tolerance)
    left &= height < first.height(samples.camera)  # ceilings carry nothing
    wanted = max(LEAST_LEVEL_SHARE * len(height), 2)

    planes = [first]
    while len(planes) < MOST_PLANES and left.sum() >= wanted:
        candidates = height[left][:: max(1, int(left.sum()) // HEIGHTS_TRIED)]
        near = np.abs(height[left, None] - candidates) < samples.tolerance[left, None]
        best = int(near.sum(0).argmax())
        if near[:, best].sum() < wanted:
            break
        on = np.flatnonzero(left)[near[:, best]]
        weight = 1 / samples.tolerance[on] ** 2
        offset = first.offset - float(weight @ height[on] / weight.sum())
        parallel = replace(first, offset=offset)
        better = refine_plane(parallel, samples.some(_only(on, len(height))), loose=2)
        planes.append(
            better if better.normal @ first.normal > PARALLEL_SUPPORTS else parallel
        )
        left &= np.abs(planes[-1].height(samples.points)) > 2 * samples.tolerance
    return sorted(planes, key=lambda plane: plane.offset)


def _only(chosen: Index, count: int) -> Mask:
    """True at some of ``count`` places, (count,) bool."""
    mask = np.zeros(count, bool)
    mask[chosen] = True
    return mask


@dataclass(frozen=True)
class GroundPlane:
    """What things stand on.

    Attributes:
        plane: level.
        seen: whether it is in the picture. Else it is as low as anything that is seen.
        wide: whether it is wider than any thing that may stand there, and so no part of one.
    """

    plane: Plane
    seen: bool = True
    wide: bool = True

    def is_below(self, other: GroundPlane, samples: Samples) -> bool:
        """Whether it shows that another ground is none: what was taken for it is a part of a thing.

        Args:
            other: as another frame shows it.
            samples: of the frame that shows this one.
        """
        middle = np.median(samples.points, axis=0)
        away = float(np.linalg.norm(middle - samples.camera))
        deeper = float(self.plane.height(middle) - other.plane.height(middle))
        step = GROUND_BELOW * away
        return deeper > step or (self.seen and not other.seen and deeper > -step)


def ground_of(samples: Samples, first: Plane, widest: float) -> GroundPlane:
    """The level plane that things of a known size stand on, not one that is a part of them.

    The top of a table carries cups, but where tables and chairs are looked for it is a part of one
    of them, and they stand on the floor. Nothing is seen below the floor. So where something is
    seen below the lowest level plane the floor is hidden or out of the picture.

    Args:
        samples: of the frame.
        first: the level plane with most samples.
        widest: diameter of the largest thing that may stand there, metres.

    Returns:
        The lowest level plane that is seen at most so far below the first; the first where there
        is none, or where it is wider than such a thing; a plane through the lowest points where
        these lie below it.
    """
    surface = first.extent(samples)
    if (
        not len(surface)
        or np.linalg.norm(np.ptp(_in_plane(surface, first), axis=0)) > widest
    ):
        return GroundPlane(first)

    step = GROUND_BELOW * float(
        np.median(np.linalg.norm(surface - samples.camera, axis=1))
    )
    middle = np.median(surface, axis=0)
    lowest = first
    for plane in reversed(level_planes(samples, first)):
        if step < plane.height(middle) < widest:
            lowest = plane
            break

    below = -lowest.height(samples.points)
    if np.mean((below > step) & (below < widest)) < LEAST_LEVEL_SHARE:
        return GroundPlane(lowest, wide=False)
    near = samples.some(below < widest)
    return GroundPlane(through_lowest(near, first.normal), seen=False, wide=False)


def through_lowest(samples: Samples, up: Float, most: float = np.inf) -> Plane:
    """The level plane through the lowest points of a frame that does not show the support.

    Args:
        samples: of the frame.
        up: direction against gravity, (3,).
        most: height of the plane along this direction, at most, metres.
    """
    lowest = float(np.quantile(samples.points @ up, LOWEST_SEEN))
    return Plane(up, -min(lowest, most))


def under_points(samples: Samples, planes: list[Plane], points: Float) -> Plane | None:
    """Return the highest plane that is seen beside the bottom of an object.

    None where no plane is seen there: the bottom is hidden, or the object hangs in the air.

    Args:
        samples: of the frame.
        planes: that were found in it.
        points: of the object's surface, (N, 3), metres.
    """
    away = float(np.median(np.linalg.norm(points - samples.camera, axis=1)))
    for plane in planes:
        height = plane.height(points)
        bottom = float(np.quantile(height, BOTTOM_SHARE))
        margin = BOTTOM_MARGIN * away + float(np.median(samples.tolerance))
        if abs(bottom) > margin:
            continue
        low = points[height < bottom + margin]
        on = samples.points[plane.holds(samples)]
        if not len(on):
            continue
        aside = _in_plane(on, plane)[:, None] - _in_plane(
            low[:: max(1, len(low) // 100)],
            plane,
        )
        if np.linalg.norm(aside, axis=2).min() < BOTTOM_ASIDE * away:
            return plane
    return None


def _distance_off(
    frame: Frame,
    samples: Samples,
    plane: Plane,
    place: Float | None,
) -> Float:
    """How far each sample lies from where the object is looked for, (N,): 1 is still there.

    Seen from above it is at a place, (3,), world, metres; without one it is what the camera is
    aimed at.
    """
    if place is not None:
        aside = _in_plane(samples.points, plane) - _in_plane(place[None], plane)
        away = np.linalg.norm(place - samples.camera)
        return np.asarray(np.linalg.norm(aside, axis=1) / (POINT_ASIDE * away))

    side = frame.shape[1] / (samples.columns.max() + 1)
    row, column = frame.intrinsics[[1, 0], [2, 2]] / side
    blocks = np.hypot(samples.rows - row, samples.columns - column)
    return np.asarray(blocks / (AIM * (frame.shape[1] / side)))


def aimed_at(
    frame: Frame,
    samples: Samples,
    planes: list[Plane],
    in_the_way: Mask,
    place: Float | None,
) -> Plane:
    """The support plane of what the camera is aimed at, or of what stands at a place.

    From the highest plane down, the first is taken that carries something there; the lowest where
    none does.

    Args:
        frame: the frame.
        samples: of the frame.
        planes: level planes, the highest first.
        in_the_way: which samples are of no object, such as walls, (N,) bool.
        place: of the object, (3,), world, metres; None for what the camera is aimed at.
    """
    level = ~in_the_way & ~steep(samples, planes[0].normal)
    for plane, lower in pairwise(planes):
        exact = samples.tolerance < TOLD_APART * np.abs(
            lower.height(samples.points) - plane.height(samples.points)
        )
        if _carries(frame, samples, plane, level & exact, ~in_the_way, place):
            return plane
    return planes[-1]


def is_named(
    frame: Frame,
    samples: Samples,
    plane: Plane,
    place: Float | None,
) -> bool:
    """Whether a point on a level surface, or below it, selects the surface itself.

    A table top is selected where nothing stands on it. The ground is never selected.

    Args:
        frame: the frame.
        samples: of the frame.
        plane: the level plane.
        place: of the object, (3,), world, metres; None where no point was given.
    """
    if place is None or plane.height(place) > np.median(samples.tolerance):
        return False
    off = _distance_off(frame, samples, plane, place)
    above = plane.height(samples.points) > samples.tolerance
    on = plane.holds(samples) & ~steep(samples, plane.normal)
    if on.sum() < 3 or _thing_there(samples, above, off) is not None:
        return False

    its_own = _surface_there(samples, on, off)
    away = float(np.linalg.norm(place - samples.camera))
    wide = (
        np.linalg.norm(np.ptp(_in_plane(samples.points[its_own], plane), 0))
        > GROUND_WIDTH * away
    )
    return not (wide and _leaves_picture(samples, its_own))


def _surface_there(samples: Samples, on: Mask, off: Float) -> Mask:
    """Which samples of a level plane belong to its surface nearest to the target, (N,) bool.

    Scraps are left out.
    """
    surface = _surfaces(samples, on, GROUND_STEP)
    size = np.bincount(surface, on)
    large = on & (size[surface] > LARGE_PART * size.max())
    return np.asarray(surface == surface[np.where(large, off, np.inf).argmin()])


def _carries(
    frame: Frame,
    samples: Samples,
    plane: Plane,
    level: Mask,
    free: Mask,
    place: Float | None,
) -> bool:
    """Whether a plane carries the target, and is no part of it."""
    on = plane.holds(samples) & level
    if on.sum() < 3:
        return False
    off = _distance_off(frame, samples, plane, place)
    its_own = _surface_there(samples, on, off)
    ground = _in_plane(samples.points[its_own], plane)
    try:
        outline = ConvexHull(ground)
    except (QhullError, ValueError):  # too few points, or all in a line
        return False

    nearest = samples.points[off.argmin()] if place is None else place
    away = float(np.linalg.norm(nearest - samples.camera))
    wide = bool(
        np.linalg.norm(np.ptp(ground[outline.vertices], 0)) > GROUND_WIDTH * away
    )
    lowest = (-1 if wide else 1) * np.median(samples.tolerance)
    if place is not None and plane.height(place) < lowest:
        return False

    above = (plane.height(samples.points) > samples.tolerance) & free
    thing = _thing_there(samples, above, off)
    if thing is None or plane.height(samples.points[thing]).max() < LOWEST_THING * away:
        return wide and _leaves_picture(samples, its_own)
    return _stands_within(samples, plane, thing, outline) and not _goes_on_below(
        samples,
        plane,
        thing,
    )


def _leaves_picture(samples: Samples, chosen: Mask) -> bool:
    """Whether a surface continues beyond the picture.

    A surface that ends inside the picture is a thing of its own.
    """
    for index in (samples.rows, samples.columns):
        if index[chosen].min() <= index.min() or index[chosen].max() >= index.max():
            return True
    return False


def _thing_there(samples: Samples, above: Mask, off: Float) -> Index | None:
    """The samples of the surface above a plane that is nearest to the target; None without one."""
    if not above.any():
        return None
    group = _surfaces(samples, above)
    off = np.where(above, off, np.inf)
    nearest = int(off.argmin())
    return np.flatnonzero(group == group[nearest]) if off[nearest] < 1 else None


def _surfaces(samples: Samples, chosen: Mask, step: float = SURFACE_STEP) -> Index:
    """Number the surfaces of the chosen samples, (N,); 0 for the other samples.

    Neighbours in the grid belong to one surface.

    Their depths differ by at most so large a part, and noise.
    """
    depth = np.linalg.norm(samples.points - samples.camera, axis=1)
    grid = np.full((samples.rows.max() + 2, samples.columns.max() + 2), -1)
    at = np.flatnonzero(chosen)
    grid[samples.rows[at], samples.columns[at]] = at
    links = []
    for down, right in ((0, 1), (1, 0)):
        other = grid[samples.rows[at] + down, samples.columns[at] + right]
        one = at[other >= 0]
        other = other[other >= 0]
        limit = step * depth[one] + samples.tolerance[one]
        joined = np.abs(depth[one] - depth[other]) < limit
        links.append(np.stack([one[joined], other[joined]]))
    return _components(len(depth), np.concatenate(links, 1), at)


def _components(count: int, links: Index, nodes: Index) -> Index:
    """The connected component of each linked node, 1 and more, (count,); 0 for other nodes."""
    graph = coo_array(
        (np.ones(links.shape[1], bool), (links[0], links[1])),
        shape=(count, count),
    )
    group = np.zeros(count, np.int64)
    group[nodes] = connected_components(graph, directed=False)[1][nodes] + 1
    return group


def _stands_within(
    samples: Samples,
    plane: Plane,
    thing: Index,
    outline: ConvexHull,
) -> bool:
    """Whether a thing covers a smaller part of the plane, away from its outline, or is narrow.

    The back of a sofa on its seat does neither.
    """
    shown = _in_plane(samples.points[thing], plane)
    extent = np.linalg.norm(np.ptp(outline.points[outline.vertices], axis=0))
    narrow = bool(np.linalg.norm(np.ptp(shown, axis=0)) < NARROW * extent)
    middle = outline.points[outline.vertices].mean(0)
    centre = middle + (np.median(shown, 0) - middle) / WELL_INSIDE
    inside = bool(
        (outline.equations[:, :2] @ centre + outline.equations[:, 2] <= 0).all()
    )
    try:
        area = float(ConvexHull(shown).volume) if len(shown) > 2 else 0.0
    except QhullError:
        area = 0.0
    return (inside or narrow) and area < LARGEST_AREA_ABOVE * float(outline.volume)


def _goes_on_below(samples: Samples, plane: Plane, thing: Index) -> bool:
    """Whether the surface of a thing goes on below the plane more often than it ends on it."""
    height = plane.height(samples.points)
    depth = np.linalg.norm(samples.points - samples.camera, axis=1)
    grid = np.full((samples.rows.max() + 2, samples.columns.max() + 1), -1)
    grid[samples.rows, samples.columns] = np.arange(len(height))
    beneath = grid[samples.rows[thing] + 1, samples.columns[thing]]
    one = thing[beneath >= 0]
    other = beneath[beneath >= 0]
    same = (
        np.abs(depth[one] - depth[other])
        < SURFACE_STEP * depth[one] + samples.tolerance[one]
    )
    on = np.abs(height[other]) < samples.tolerance[other]
    below = (height[other] < -samples.tolerance[other]) & same
    return bool(below.sum() > on.sum())


def _in_plane(points: Float, plane: Plane) -> Float:
    """Coordinates of points, (N, 3), along a level plane, (N, 2), metres."""
    return points @ axes_along(plane).T


def axes_along(plane: Plane) -> Float:
    """Two directions along a plane, perpendicular to each other, (2, 3)."""
    first = np.cross(plane.normal, np.eye(3)[np.abs(plane.normal).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(plane.normal, first)])
