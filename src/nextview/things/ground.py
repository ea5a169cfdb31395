"""The support plane of a thing, fitted to the depth beside it in one view."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nextview.types import Float, Floats, Mask

FEWEST_PLANE_POINTS = 50  # fewest points on the plane
LEAST_PLANE_SHARE = 0.1  # smallest share of the points beside the thing
# thickness of the horizontal layer in the search, half sizes of the thing
PLANE_LAYER = 0.15
THINNEST_LAYER = 0.006  # metres
# smallest vertical component of the normal: the vertical is known to 15 degrees
LEAST_VERTICAL = np.cos(np.radians(15.0))
FITS = 4
NEAR_THING = 2.0  # reach of what is near a thing, half sizes of its visible part
# largest share of the rays through a plane that noise explains, of those that reach it
LEAST_BELOW = 0.02
NORMAL_MEDIAN = 0.6745  # median of the absolute value of a standard normal variable


@dataclass(frozen=True, eq=False)
class Ground:
    """The plane that supports a thing.

    Attributes:
        normal: unit vector upwards, object frame, (3,) float64.
        offset: height of the origin of the object frame above the plane, metres.
        noise: standard deviation of the inverse depth on the plane, 1/metres, including errors that
            neighbouring pixels share.
    """

    normal: Float
    offset: float
    noise: float

    @property
    def height(self) -> float:
        """Height of the plane at the origin of the object frame, metres; negative below it."""
        return -self.offset / float(self.normal[2])

    def crossed(
        self,
        origin: Float,
        points: Float,
        centre: Float,
        reach: float,
    ) -> Mask:
        """Find the rays that cross the plane near a place.

        Args:
            origin: start of the rays, (3,), metres.
            points: points on the rays, (N, 3), metres; those above the plane count, too.
            centre: the place, (3,), metres.
            reach: largest horizontal distance from it, metres.

        Returns:
            Mask, (N,) bool.
        """
        above = float(self.heights(origin))
        along = above / np.maximum(above - self.heights(points), 1e-9)
        at = origin + along[:, None] * (points - origin)
        return np.linalg.norm((at - centre)[:, :2], axis=1) < reach

    def heights(self, points: Floats) -> Floats:
        """Heights of points above the plane.

        Args:
            points: object frame, (..., 3), metres.

        Returns:
            Heights, (...,), metres.
        """
        normal = self.normal.astype(points.dtype)
        return points @ normal + points.dtype.type(self.offset)


def find_planes(
    beside: Float,
    thing: Float,
    origin: Float,
    axis: Float,
) -> tuple[Ground | None, Ground | None]:
    """Find the level planes below the visible part of a thing, in the depth beside it.

    The ground is the highest plane that contains a sufficient share of the points: the floor below
    a small table may fill more of the image. It may also be the top of a box in front of the thing,
    and then the hidden part of the thing reaches below it. The camera sees below such a plane
    beside its edges. The floor is the highest plane below which it sees nothing near the thing.

    Args:
        beside: measured points beside the thing, object frame, (N, 3), metres.
        thing: measured points of the thing, (M, 3).
        origin: position of the camera, (3,).
        axis: optical axis of the camera, (3,).

    Returns:
        Ground and floor, often the same plane; None if too few of the points lie on one.
    """
    if not len(thing):
        return None, None
    half_size = float(np.linalg.norm(np.ptp(thing, axis=0))) / 2
    layer = max(PLANE_LAYER * half_size, THINNEST_LAYER)
    middle = np.median(thing, axis=0)

    highest = float(np.quantile(thing[:, 2], 0.1)) + layer
    ground = floor = _highest_plane(beside, thing, origin, axis, layer, highest)
    while floor is not None:
        near = floor.crossed(origin, beside, middle, NEAR_THING * half_size)
        heights = floor.heights(beside[near])
        below = np.count_nonzero(heights < -layer)
        if below <= LEAST_BELOW * np.count_nonzero(heights < layer):
            break
        under = float(middle[2] - floor.heights(middle) / floor.normal[2])
        highest = min(under, highest) - layer
        floor = _highest_plane(beside, thing, origin, axis, layer, highest)
    return ground, floor


def _highest_plane(
    beside: Float,
    thing: Float,
    origin: Float,
    axis: Float,
    layer: float,
    limit: float,
) -> Ground | None:
    """Find the highest level plane that contains a sufficient share of the points.

    Args:
        beside: measured points beside the thing, object frame, (N, 3), metres.
        thing: measured points of the thing, (M, 3).
        origin: position of the camera, (3,).
        axis: optical axis of the camera, (3,).
        layer: thickness of a plane in the search, metres.
        limit: of its height, metres.

    Returns:
        The plane; None if too few of the points lie on one.
    """
    enough = max(FEWEST_PLANE_POINTS, LEAST_PLANE_SHARE * len(beside))
    if len(beside) < enough:
        return None

    heights = np.sort(beside[:, 2])
    inside = np.searchsorted(heights, heights + layer) - np.arange(len(heights))
    below = (inside >= enough) & (heights <= limit)
    if not below.any():
        return None
    highest = heights[below].max()
    lowest = heights[np.where(heights >= highest - layer, inside * below, 0).argmax()]
    near = (beside[:, 2] >= lowest) & (beside[:, 2] <= lowest + layer)

    centre = beside.mean(0) * (1, 1, 0)
    level = np.column_stack([(beside - centre)[:, :2], np.ones(len(beside))])
    plane = np.zeros(3)
    off = np.zeros(len(beside))

    for _ in range(FITS):
        if near.sum() < enough:
            return None
        plane = np.linalg.lstsq(level[near], beside[near, 2], rcond=None)[0]
        off = beside[:, 2] - level @ plane
        typical = np.median(np.abs(off[near])) / NORMAL_MEDIAN
        near = np.abs(off) < np.clip(3 * typical, THINNEST_LAYER / 2, layer)

    normal = np.array([-plane[0], -plane[1], 1.0]) / np.sqrt(1 + plane[:2] @ plane[:2])
    offset = -(plane[2] - plane[:2] @ centre[:2]) * normal[2]
    ground = Ground(
        normal,
        float(offset),
        _noise(off[near] * normal[2], beside[near], normal, origin, axis),
    )
    bottom = np.quantile(ground.heights(thing), 0.1)
    if normal[2] < LEAST_VERTICAL or bottom < -layer:
        return None
    return ground


def floor_under(ground: Ground, support: Float) -> Ground:
    """Return the plane below which nothing can be, given what supports the thing.

    It is the ground, unless that is the top of other things: a thing beside them reaches below
    their tops, but not below what carries them all.

    Args:
        ground: highest level plane under the visible part of the thing.
        support: the plane that supports the thing by the segmentation of the whole frame, (4,):
            normal and height of the origin, metres.
    """
    lower = replace(ground, normal=support[:3], offset=float(support[3]))
    return lower if ground.height - lower.height > THINNEST_LAYER else ground


def _noise(
    off: Float,
    points: Float,
    normal: Float,
    origin: Float,
    axis: Float,
) -> float:
    """Standard deviation of the inverse depth from a plane, 1/metres, given heights of points,
    (N,).
    """
    away = points - origin
    depth = away @ axis
    # change of the height per metre of depth
    along = np.abs(away @ normal) / depth
    deviation = np.abs(off) / np.maximum(along, 0.05) / depth**2
    return float(np.median(deviation)) / NORMAL_MEDIAN


def levelling(grounds: Sequence[Ground]) -> Float:
    """The smallest rotation that levels the mean of some ground planes.

    Args:
        grounds: ground planes of some views, none or more.

    Returns:
        Rotation matrix, (3, 3); the identity without a ground.
    """
    if not grounds:
        return np.eye(3)
    up = np.sum([ground.normal for ground in grounds], axis=0)
    up = up / np.linalg.norm(up)
    axis = np.array([up[1], -up[0], 0.0])  # up x z
    skew = np.array([[0, 0, axis[1]], [0, 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1 + up[2])
