"""Candidate viewpoints around an object: where they are, which are neighbours, what it costs to move.

The world is z up, the object sits at the origin inside the unit sphere, and every viewpoint looks at the origin.
Viewpoints lie on rings of equal elevation, evenly spaced in azimuth; ``view = ring * azimuths + azimuth_index``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nextview.errors import UsageError

Float = NDArray[np.float64]
Index = NDArray[np.int64]

DISTANCE = 3.0
"""Distance of the camera from the object's centre, in object radii."""


def look_at_origin(elevation: ArrayLike, azimuth: ArrayLike, distance: float = DISTANCE) -> Float:
    """Camera-to-world poses of cameras that look at the origin with the horizon level.

    Args:
        elevation: angle above the horizontal plane, radians, shape (...).
        azimuth: angle about +z, counter-clockwise from +x, radians, shape (...).
        distance: distance from the origin, object radii.

    Returns:
        Poses, shape (..., 4, 4), float64, in OpenCV's camera axes: x right, y down, z forward.
    """
    elevation, azimuth = np.broadcast_arrays(np.asarray(elevation, float), np.asarray(azimuth, float))
    ce, se, ca, sa = np.cos(elevation), np.sin(elevation), np.cos(azimuth), np.sin(azimuth)
    outward = np.stack([ce * ca, ce * sa, se], -1)
    right = np.stack([-sa, ca, np.zeros_like(sa)], -1)
    pose = np.zeros((*elevation.shape, 4, 4))
    pose[..., :3, 0] = right
    pose[..., :3, 1] = np.cross(-outward, right)
    pose[..., :3, 2] = -outward
    pose[..., :3, 3] = distance * outward
    pose[..., 3, 3] = 1.0
    return pose


def degrees_between(a: Float, b: Float) -> float:
    """The angle between two directions, (3,) of any length, degrees."""
    # arctan2 keeps its precision for equal and for opposite directions, where arccos loses half the digits.
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def _fixed(array: NDArray) -> NDArray:
    array.flags.writeable = False
    return array


@dataclass(frozen=True)
class ViewSphere:
    """Viewpoints on rings around an object; ``len(sphere)`` of them.

    Its arrays are read-only: the named layouts are shared, and a change in place would move everybody's viewpoints.

    Attributes:
        elevations: elevation of each ring, degrees, ring 0 first.
        azimuths: viewpoints per ring; the first looks from +x.
        distance: distance of every viewpoint from the origin, object radii.

    >>> sphere = ViewSphere.named("40")
    >>> len(sphere), sphere.angles(11)
    (40, (18.0, 135.0))
    """

    elevations: tuple[float, ...]
    azimuths: int
    distance: float = DISTANCE

    def __post_init__(self) -> None:
        if not self.elevations or self.azimuths < 3:
            raise UsageError("a view sphere needs at least one ring of at least three viewpoints")
        if not all(-90 <= e <= 90 for e in self.elevations):
            raise UsageError(f"elevations must lie between -90 and 90 degrees, not {self.elevations}")
        if not 0 < self.distance < np.inf:
            raise UsageError(f"the distance must be a positive number of object radii, not {self.distance}")

    @classmethod
    def named(cls, name: str) -> ViewSphere:
        """The thesis's layouts: "40" (5 rings of 8, section 4.1.1) and "12" (one ring at 45 degrees)."""
        if name not in LAYOUTS:
            raise UsageError(f"no view sphere is called {name!r}; there are {', '.join(LAYOUTS)}")
        return LAYOUTS[name]

    def __len__(self) -> int:
        return self.rings * self.azimuths

    @property
    def rings(self) -> int:
        """How many rings."""
        return len(self.elevations)

    @cached_property
    def ring(self) -> Index:
        """Ring of each view, shape (V,), int64."""
        return _fixed(np.repeat(np.arange(self.rings), self.azimuths))

    @cached_property
    def azimuth_index(self) -> Index:
        """Position of each view on its ring, shape (V,), int64."""
        return _fixed(np.tile(np.arange(self.azimuths), self.rings))

    @cached_property
    def turn(self) -> Float:
        """Azimuth of each view as a part of a full turn, shape (V,), float64."""
        return _fixed(self.azimuth_index / self.azimuths)

    def angles(self, view: int) -> tuple[float, float]:
        """(elevation, azimuth) of a view, degrees."""
        return self.elevations[self.ring[view]], 360.0 * int(self.azimuth_index[view]) / self.azimuths

    @cached_property
    def poses(self) -> Float:
        """Camera-to-world pose of each view, shape (V, 4, 4), float64, OpenCV camera axes."""
        elevation, azimuth = np.radians(self.elevations)[self.ring], 2 * np.pi * self.azimuth_index / self.azimuths
        return _fixed(look_at_origin(elevation, azimuth, self.distance))

    @cached_property
    def directions(self) -> Float:
        """Unit vector from the origin towards each view, shape (V, 3), float64."""
        return _fixed(self.poses[:, :3, 3] / self.distance)

    @cached_property
    def windows(self) -> Index:
        """Neighbours of each view: all rings x azimuth -1, 0, +1 with wrap-around, shape (V, rings, 3), int64."""
        columns = (self.azimuth_index[:, None] + np.array([-1, 0, 1])) % self.azimuths
        return _fixed(np.arange(self.rings)[None, :, None] * self.azimuths + columns[:, None, :])

    def window(self, view: int) -> Index:
        """View indices around one view, shape (rings, 3), int64; the view itself is in the middle column."""
        return self.windows[view]

    @cached_property
    def travel(self) -> Float:
        """Distance between views in grid cells (Euclidean over ring and azimuth, table 9), shape (V, V), float64."""
        rings = self.ring[:, None] - self.ring[None, :]
        steps = np.abs(self.azimuth_index[:, None] - self.azimuth_index[None, :])
        return _fixed(np.hypot(rings, np.minimum(steps, self.azimuths - steps)))

    @cached_property
    def arc(self) -> Float:
        """Great-circle angle between views, radians, shape (V, V), float64."""
        # arctan2 keeps its precision for equal and for opposite directions, where arccos loses half the digits.
        a, b = self.directions[:, None], self.directions[None, :]
        return _fixed(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1)))


LAYOUTS = {
    "40": ViewSphere(elevations=(0.0, 18.0, 36.0, 54.0, 72.0), azimuths=8),
    "12": ViewSphere(elevations=(45.0,), azimuths=12),
}
