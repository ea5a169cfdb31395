"""The object frame: centre, radius and axes of an object in the world."""

from dataclasses import dataclass, field
from itertools import chain, combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nextview.checks import number, points
from nextview.errors import ObservationError, UsageError
from nextview.geometry.axes import three
from nextview.geometry.camera import LARGEST_ENTRY
from nextview.types import Float


@dataclass(frozen=True)
class ObjectFrame:
    """The centre, the radius and the axes of an object.

    Positions in the object frame are in object radii. A UsageError is raised if the axes are not a
    rotation, or the radius is not positive.

    Attributes:
        centre: (3,), world, metres.
        radius: of the enclosing sphere around the centre, metres.
        axes: rows are the x, y and z (up) axes of the object in the world, (3, 3).
    """

    centre: Float
    radius: float
    axes: Float

    def __post_init__(self) -> None:
        number(self.radius, "the object radius, metres,", most=LARGEST_ENTRY, above=0)
        object.__setattr__(self, "centre", three(self.centre, "the object's centre"))
        object.__setattr__(self, "axes", _rotation(self.axes, "the object's axes"))

    def pose_in_object(self, pose: ArrayLike) -> Float:
        """Convert camera-to-world poses, (..., 4, 4), metres, to the object frame, object radii."""
        pose = self.pose_in_metres(pose)
        pose[..., :3, 3] /= self.radius
        return pose

    def pose_in_metres(self, pose: ArrayLike) -> Float:
        """Convert camera-to-world poses, (..., 4, 4), metres, to the object frame, metres."""
        pose = np.array(pose, np.float64)
        pose[..., :3, 3] = (pose[..., :3, 3] - self.centre) @ self.axes.T
        pose[..., :3, :3] = self.axes @ pose[..., :3, :3]
        return pose

    def pose_in_world(self, pose: ArrayLike, distance: float | None = None) -> Float:
        """Convert poses in the object frame to camera-to-world poses.

        Args:
            pose: (..., 4, 4), object frame, object radii.
            distance: new distance of the cameras from the object's centre, metres; None for no
                change.

        Returns:
            Poses, (..., 4, 4), world, metres, OpenCV axes.
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
    """An upright bounding box of the object in the world.

    A UsageError is raised if it has no volume, or the axes are not a rotation.

    Attributes:
        low: lower corner, (3,), metres, along the axes.
        high: upper corner, (3,), metres, along the axes.
        axes: rows are the x, y and z (up) axes of the box in the world, (3, 3); by default those of
            the world.
    """

    low: Float
    high: Float
    axes: Float = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        for corner in ("low", "high"):
            object.__setattr__(
                self,
                corner,
                three(getattr(self, corner), f"the {corner} corner of a box"),
            )
        if not (self.low < self.high).all():
            raise UsageError(
                f"a box has a low and a high corner, not {self.low.tolist()} and"
                f" {self.high.tolist()}"
            )
        object.__setattr__(self, "axes", _rotation(self.axes, "the axes of a box"))

    @property
    def object_frame(self) -> ObjectFrame:
        """Object frame of an object that fills the box."""
        middle = (self.low + self.high) / 2
        diagonal = float(np.linalg.norm(self.high - self.low))
        return ObjectFrame(middle @ self.axes, diagonal / 2, self.axes)


def _rotation(values: Any, what: str) -> Float:
    axes = points(values, what)
    if (
        axes.shape != (3, 3)
        or not np.allclose(axes @ axes.T, np.eye(3), atol=1e-3)
        or np.linalg.det(axes) < 0
    ):
        raise UsageError(f"{what} are the rows of a (3, 3) rotation matrix")
    return axes


def enclose(points: Float, axes: Float, floor: float | None) -> ObjectFrame:
    """Return the object frame of points on an object.

    The centre is the centre of the smallest circle around all points in the top view, halfway
    between bottom and top. For two visible sides of a box at a right angle, this is the centre of
    the whole box.

    Args:
        points: (N, 3), world, metres.
        axes: rows x, y and z of the object frame, (3, 3).
        floor: height of the support plane; None for the lowest point.

    Returns:
        The object frame.

    Raises:
        ObservationError: all points coincide.
    """
    upright = points @ axes.T
    low = upright.min(0)
    high = upright.max(0)
    if not (high - low).max() > 1e-6 * max(np.abs(upright).max(), 1e-9):
        raise ObservationError(
            "what is seen of the object is in one place, it has no size"
        )

    bottom = low[2] if floor is None else min(floor, high[2])
    centre = np.array([*smallest_circle(upright[:, :2])[0], (bottom + high[2]) / 2])
    radius = np.sqrt(((upright - centre) ** 2).sum(1).max())
    return ObjectFrame(
        centre @ axes,
        max(float(radius), float(high[2] - bottom) / 2),
        axes,
    )


def smallest_circle(points: Float) -> tuple[Float, float]:
    """Return centre, (2,), and radius of the smallest enclosing circle of points, (N, 2).

    The farthest point is added to the points that define the circle, at most three, until no point
    is outside; the circle grows in each step.
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
        for chosen in map(
            np.array,
            chain(combinations(corners, 2), combinations(corners, 3)),
        ):
            # equidistant from all points, or the midpoint of collinear ones
            edges = chosen[1:] - chosen[0]
            middle = (
                chosen[0] + np.linalg.lstsq(edges, (edges**2).sum(1) / 2, rcond=None)[0]
            )
            fits.append(
                (np.linalg.norm(corners - middle, axis=1).max(), chosen, middle)
            )
        reach, corners, centre = min(fits, key=lambda fit: fit[0])
        if reach <= radius:
            return centre, radius  # no further progress within rounding errors
        radius = float(reach)
