"""What one view yields, and what can take a view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from nextview.errors import ObservationError

POINTS = 1024
"""Points in the partial cloud of one view (thesis, section 4.1.2)."""
FARTHEST = 50.0
"""Depth at which nothing counts as an object any more, object radii: depth cameras have large numbers for "nothing"."""


@dataclass(frozen=True)
class Observation:
    """One view of an object.

    Attributes:
        image: grey image, (H, W) uint8, 0 where there is no object.
        depth: distance along the optical axis, (H, W) float32, object radii, 0 where there is no object. What a sensor
            gives for nothing else (see ``object_depth``) becomes 0 here.
        points: on the visible surface, (1024, 3) float32, object frame, object radii; all zero if nothing is visible.
        pose: camera-to-world, (4, 4) float64, OpenCV axes (x right, y down, z forward).
        intrinsics: pinhole matrix, (3, 3) float64, pixels; pixel (row, column) has its centre at
            (column + 0.5, row + 0.5).
        radius: the object radius, metres: what positions were divided by. None if the camera does not know its scale.

    Raises:
        ObservationError: a radius that is not a positive number.
    """

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    points: NDArray[np.float32]
    pose: NDArray[np.float64]
    intrinsics: NDArray[np.float64]
    radius: float | None = None

    def __post_init__(self) -> None:
        if self.radius is not None and not 0 < self.radius < np.inf:
            raise ObservationError(f"the object radius is a positive number of metres, or None, not {self.radius}")
        object.__setattr__(self, "depth", object_depth(self.depth))


class Camera(Protocol):
    """Anything that can look at the object from a given pose."""

    def observe(self, pose: NDArray[np.float64]) -> Observation:
        """Look from a camera-to-world pose, (4, 4), OpenCV axes, object frame, object radii."""
        ...


def object_depth(depth: NDArray[np.floating]) -> NDArray[np.floating]:
    """Depth as all of nextview understands it: 0 where a sensor gives NaN, infinity, a negative or a huge number.

    Args:
        depth: any shape, object radii.

    Returns:
        The same array if it holds nothing of the kind, else a mended copy.
    """
    if depth.min() >= 0 and depth.max() < FARTHEST:  # not so if there is a NaN
        return depth
    return np.where((depth > 0) & (depth < FARTHEST), depth, 0)


def pinhole(size: int, distance: float) -> NDArray[np.float64]:
    """Intrinsics of a square image that just holds the unit sphere seen from a distance.

    Args:
        size: side of the image, pixels.
        distance: from the sphere's centre, object radii, greater than 1.

    Returns:
        (3, 3) float64.

    Raises:
        ObservationError: the camera stands inside the sphere.
    """
    if not distance > 1:
        raise ObservationError(f"the camera has to stand more than one object radius from the centre, not {distance}")
    focal = size / 2 * np.sqrt(distance**2 - 1)  # size/2 over the tangent of the half angle asin(1/distance)
    return np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
