"""Where the object is in the world: the frame in which nextview thinks of it."""

from dataclasses import dataclass, field
from itertools import chain, combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nextview.checks import number, points
from nextview.errors import ObservationError, UsageError
from nextview.geometry.observation import LARGEST

Float = NDArray[np.float64]


@dataclass(frozen=True)
class ObjectFrame:
    """The object's centre, (3,) metres, world, radius and axes. Positions in the object frame are
    in object radii.

    ``radius``, metres, is that of the sphere about the centre that holds the object; the rows of
    ``axes``, (3, 3), are the object's x, y and z (up) in the world. UsageError if they are no
    rotation, or the radius is not positive.
    """

    centre: Float
    radius: float
    axes: Float

    def __post_init__(self) -> None:
        number(self.radius, "the object radius, metres,", most=LARGEST, above=0)
        object.__setattr__(self, "centre", three(self.centre, "the object's centre"))
        object.__setattr__(self, "axes", _rotation(self.axes, "the object's axes"))

    def pose_in_object(self, pose: ArrayLike) -> Float:
        """A camera-to-world pose, (..., 4, 4), metres, as a pose in the object frame, object
        radii.
        """
        pose = np.array(pose, np.float64)
        pose[..., :3, 3] = (pose[..., :3, 3] - self.centre) @ self.axes.T / self.radius
        pose[..., :3, :3] = self.axes @ pose[..., :3, :3]
        return pose

    def pose_in_world(self, pose: ArrayLike, distance: float | None = None) -> Float:
        """A pose in the object frame, (..., 4, 4), object radii, as a camera-to-world pose in
        metres; OpenCV axes.

        With a ``distance`` it stands so far from the object's centre instead, metres, in the same
        direction.
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
    """An upright box in the world that an object just fits into: ``low <= axes @ position <= high``
    inside.

    The corners ``low`` and ``high`` are (3,), metres; the rows of ``axes``, (3, 3), are the box's
    x, y and z (up) in the world, by default the world's own. UsageError if it has no inside, or the
    axes are no rotation.
    """

    low: Float
    high: Float
    axes: Float = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        for corner in ("low", "high"):
            object.__setattr__(
                self, corner, three(getattr(self, corner), f"the {corner} corner of a box")
            )
        if not (self.low < self.high).all():
            raise UsageError(
                f"a box has a low and a high corner, not {self.low.tolist()} and"
                f" {self.high.tolist()}"
            )
        object.__setattr__(self, "axes", _rotation(self.axes, "the axes of a box"))

    @property
    def object_frame(self) -> ObjectFrame:
        """That of an object which fills the box to its corners."""
        middle = (self.low + self.high) / 2
        diagonal = float(np.linalg.norm(self.high - self.low))
        return ObjectFrame(middle @ self.axes, diagonal / 2, self.axes)


def three(values: Any, what: str) -> Float:
    """Three real numbers that can be metres, (3,) float64; UsageError if they are not."""
    given = points([values], f"{what}, in a list,")[0]
    if not (np.abs(given) < LARGEST).all():
        raise UsageError(f"{what} is three numbers, metres, not {given.tolist()}")
    return given


def _rotation(values: Any, what: str) -> Float:
    axes = points(values, what)
    if (
        axes.shape != (3, 3)
        or not np.allclose(axes @ axes.T, np.eye(3), atol=1e-3)
        or np.linalg.det(axes) < 0
    ):
        raise UsageError(f"{what} are the rows of a (3, 3) rotation matrix")
    return axes


def upright_axes(up: ArrayLike, front: ArrayLike | None = None) -> Float:
    """Axes with z along ``up``, (3,), and x as near to the ``front``, (3,), as can be: rows x, y,
    z, (3, 3) float64.

    The front is the world's x by default; its y where x is up.
    """
    z = three(up, "up")
    if not z.any():
        raise UsageError("up is a direction, three numbers, not 0, 0, 0")
    z = z / np.abs(z).max()  # first, or squares of the smallest numbers would be zero
    z = z / np.linalg.norm(z)
    x = np.eye(3)[0 if abs(z[0]) < 0.9 else 1] if front is None else np.asarray(front, np.float64)
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def enclose(points: Float, axes: Float, floor: float | None) -> ObjectFrame:
    """The object frame of points on an object, (N, 3), world, metres.

    The centre is the middle of the smallest circle around all seen from above, and half way between
    top and bottom, which is the ``floor`` where the object stands on one. Of two walls of a box
    that meet at a right angle a circle gives the middle of the whole box.
    """
    upright = points @ axes.T
    low = upright.min(0)
    high = upright.max(0)
    if not (high - low).max() > 1e-6 * max(np.abs(upright).max(), 1e-9):
        raise ObservationError("what is seen of the object is in one place, it has no size")
    bottom = low[2] if floor is None else min(floor, high[2])
    centre = np.array([*smallest_circle(upright[:, :2])[0], (bottom + high[2]) / 2])
    radius = np.sqrt(((upright - centre) ** 2).sum(1).max())
    return ObjectFrame(centre @ axes, max(float(radius), float(high[2] - bottom) / 2), axes)


def smallest_circle(points: Float) -> tuple[Float, float]:
    """Centre (2,) and radius of the smallest circle that holds all points, (N, 2).

    The farthest point joins those that hold the circle, at most three, until none is outside; each
    time it grows.
    """
    corners = points[:1]
    centre = points[0]
    radius = 0.0
    while True:
        distance = np.linalg.norm(points - centre, axis=1)
        farthest = int(distance.argmax())
        if distance[farthest] <= radius * (1 + 1e-9) + 1e-12:
            return centre, radius
        corners = np.vstack([corners, points[farthest]])
        fits = []
        for chosen in map(np.array, chain(combinations(corners, 2), combinations(corners, 3))):
            edges = chosen[1:] - chosen[0]  # equally far from all, or the middle of those in line:
            middle = chosen[0] + np.linalg.lstsq(edges, (edges**2).sum(1) / 2, rcond=None)[0]
            fits.append((np.linalg.norm(corners - middle, axis=1).max(), chosen, middle))
        reach, corners, centre = min(fits, key=lambda fit: fit[0])
        if reach <= radius:
            return centre, radius  # rounding: no better circle is to be had
        radius = float(reach)
