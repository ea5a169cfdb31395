"""Where the object is in the world: the frame in which nextview thinks of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nextview.arguments import as_line
from nextview.errors import ObservationError, UsageError
from nextview.observation import LARGEST, numbers

Float = NDArray[np.float64]


@dataclass(frozen=True)
class ObjectFrame:
    """The object's centre, size and axes in the world. Positions in the object frame are in object radii.

    Attributes:
        centre: (3,) float64, metres, world.
        radius: object radius, metres: of the sphere about the centre that holds the object.
        axes: (3, 3) float64; rows are the object's x, y and z (up) in the world.

    Raises:
        UsageError: the axes are no rotation, or the radius is not positive.
    """

    centre: Float
    radius: float
    axes: Float

    def __post_init__(self) -> None:
        if not (isinstance(self.radius, Real) and 0 < self.radius < LARGEST):
            raise UsageError(f"the object radius is a positive number of metres, not {as_line(self.radius)}")
        centre = three(self.centre)
        if centre is None:
            raise UsageError(f"the object's centre is three numbers, metres, not {as_line(self.centre)}")
        object.__setattr__(self, "centre", centre)
        object.__setattr__(self, "axes", _rotation(self.axes, "the object's axes"))

    def pose_in_object(self, pose: ArrayLike) -> Float:
        """A camera-to-world pose, (..., 4, 4), metres, as a pose in the object frame, object radii."""
        pose = np.array(pose, np.float64)
        pose[..., :3, 3] = (pose[..., :3, 3] - self.centre) @ self.axes.T / self.radius
        pose[..., :3, :3] = self.axes @ pose[..., :3, :3]
        return pose

    def pose_in_world(self, pose: ArrayLike, distance: float | None = None) -> Float:
        """A pose in the object frame, such as those of a ``ViewSphere``, as a camera-to-world pose in metres.

        Args:
            pose: (..., 4, 4), object radii, OpenCV axes.
            distance: stand so far from the object's centre instead, metres, in the same direction.

        Returns:
            (..., 4, 4) float64, OpenCV axes.
        """
        pose = np.array(pose, np.float64)
        position = pose[..., :3, 3] * self.radius
        if distance is not None:
            position *= distance / np.linalg.norm(position, axis=-1, keepdims=True)
        pose[..., :3, 3] = position @ self.axes + self.centre
        pose[..., :3, :3] = self.axes.T @ pose[..., :3, :3]
        return pose


@dataclass(frozen=True)
class Box:
    """An upright box in the world that an object just fits into.

    Attributes:
        low: its lowest corner along each of its axes, metres, (3,).
        high: its highest corner, (3,).
        axes: (3, 3), rows are the box's x, y and z (up) in the world: ``low <= axes @ position <= high`` inside. The
            world's own by default.

    Raises:
        UsageError: a box without an inside, or axes that are no rotation.
    """

    low: Float
    high: Float
    axes: Float = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        low, high = three(self.low), three(self.high)
        if low is None or high is None or not (low < high).all():
            given = f"{as_line(self.low)} and {as_line(self.high)}"
            raise UsageError(f"a box has a low and a high corner of three numbers, not {given}")
        axes = _rotation(self.axes, "the axes of a box")
        for name, value in (("low", low), ("high", high), ("axes", axes)):
            object.__setattr__(self, name, value)

    @property
    def object_frame(self) -> ObjectFrame:
        """That of an object which fills the box to its corners."""
        middle, diagonal = (self.low + self.high) / 2, float(np.linalg.norm(self.high - self.low))
        return ObjectFrame(middle @ self.axes, diagonal / 2, self.axes)


def three(values: Any) -> Float | None:
    """Three real numbers that can be metres, (3,) float64; None if they are not."""
    try:
        array = numbers(values, "").astype(np.float64)
    except ObservationError:
        return None
    return array if array.shape == (3,) and bool((np.abs(array) < LARGEST).all()) else None


def _rotation(values: Any, what: str) -> Float:
    try:
        axes = numbers(values, what).astype(np.float64)
    except ObservationError as error:
        raise UsageError(str(error)) from None
    fits = axes.shape == (3, 3) and (np.abs(axes) < 2).all()
    if not fits or not np.allclose(axes @ axes.T, np.eye(3), atol=1e-3) or np.linalg.det(axes) < 0:
        raise UsageError(f"{what} are the rows of a (3, 3) rotation matrix")
    return axes


def upright_axes(up: ArrayLike, front: ArrayLike | None = None) -> Float:
    """Axes with z along ``up`` and x as near to the front as can be.

    Args:
        up: direction in the world, (3,), any length.
        front: direction in the world, (3,), not along ``up``. The world's x by default; its y where x is up.

    Returns:
        Rows x, y, z, (3, 3) float64.

    Raises:
        UsageError: no direction.
    """
    z = three(up)
    if z is None or not z.any():
        raise UsageError(f"up is a direction, three numbers, not {as_line(up)}")
    z = z / np.abs(z).max()  # first, or squares of the smallest numbers would be zero
    z = z / np.linalg.norm(z)
    x = np.eye(3)[0 if abs(z[0]) < 0.9 else 1] if front is None else np.asarray(front, np.float64)
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def enclose(points: Float, axes: Float, floor: float | None) -> ObjectFrame:
    """The object frame of what has been seen of an object.

    As for meshes, the centre is in the middle: of the smallest circle around all seen from above, and half way between
    top and bottom. The radius is the distance of the farthest point. A circle, because of two walls of a box that meet
    at a right angle it gives the middle of the whole box.

    Args:
        points: on the object, (N, 3), world, metres.
        axes: rows x, y, z (up) in the world, (3, 3).
        floor: height along z of the plane that the object stands on, to which it reaches unseen; None if there is none.

    Raises:
        ObservationError: the points have no extent.
    """
    upright = points @ axes.T
    low, high = upright.min(0), upright.max(0)
    if not (high - low).max() > 1e-6 * max(np.abs(upright).max(), 1e-9):
        raise ObservationError("what is seen of the object is in one place, it has no size")
    bottom = low[2] if floor is None else min(floor, high[2])
    flat = upright[:, :2]
    centre = np.array([*smallest_circle(flat)[0], (bottom + high[2]) / 2])
    radius = np.sqrt(((upright - centre) ** 2).sum(1).max())
    return ObjectFrame(centre @ axes, max(float(radius), float(high[2] - bottom) / 2), axes)


def smallest_circle(points: Float) -> tuple[Float, float]:
    """The smallest circle that holds all points.

    The farthest point joins those that hold the circle, at most three, until none is outside; each time it grows.

    Args:
        points: (N, 2).

    Returns:
        Centre (2,) and radius.
    """
    corners = points[:1]
    centre, radius = points[0], 0.0
    while True:
        distance = np.linalg.norm(points - centre, axis=1)
        farthest = int(distance.argmax())
        if distance[farthest] <= radius * (1 + 1e-9) + 1e-12:
            return centre, radius
        corners = np.vstack([corners, points[farthest]])
        fits = []
        for count in (2, 3):
            for chosen in combinations(corners, count):
                middle = _circumcentre(np.array(chosen))
                reach = np.linalg.norm(corners - middle, axis=1).max()
                fits.append((reach, np.array(chosen), middle))
        reach, corners, centre = min(fits, key=lambda fit: fit[0])
        if reach <= radius:
            return centre, radius  # rounding: no better circle is to be had
        radius = float(reach)


def _circumcentre(points: Float) -> Float:
    """The point in the plane of two or three points that is equally far from all; their middle if they are in line."""
    edges = points[1:] - points[0]
    return points[0] + np.linalg.lstsq(edges, (edges**2).sum(1) / 2, rcond=None)[0]
