"""Candidate viewpoints around an object, their neighbours, and the cost of moving.

The world is z up, the object sits at the origin inside the unit sphere, and every viewpoint looks
at the origin. On a ``ViewSphere`` they lie on rings of equal elevation, evenly spaced in azimuth;
``view = ring * azimuths + azimuth_index``. ``Directions`` lie anywhere.
"""

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nextview.checks import number, one_line, points, whole
from nextview.errors import UsageError
from nextview.types import Float, Index

# distance of the camera from the object's centre, in object radii
CAMERA_DISTANCE = 3.0
# elevation and azimuth of a cell, in which travel off any grid is counted
TRAVEL_CELL = np.radians((18.0, 45.0))
# viewpoints that there may be: distances between all of them are kept, 200 MB at this number
MOST_VIEWPOINTS = 5_000
# radians within which a camera stands at a candidate. What is more is a place of its own
SNAP = 1e-6
# candidate views within this angle of a camera position count as visited
VISITED_ANGLE = np.radians(6.0)


def rotation_z(angle: ArrayLike) -> Float:
    """Rotations about +z, counter-clockwise, (..., 3, 3) float64, by angles in radians, (...)."""
    cosine = np.cos(angle)
    sine = np.sin(angle)
    turned = np.zeros((*np.shape(angle), 3, 3))
    turned[..., 0, 0] = cosine
    turned[..., 0, 1] = -sine
    turned[..., 1, 0] = sine
    turned[..., 1, 1] = cosine
    turned[..., 2, 2] = 1
    return turned


def look_at_origin(
    elevation: ArrayLike,
    azimuth: ArrayLike,
    distance: float = CAMERA_DISTANCE,
) -> Float:
    """Return the poses of cameras that look at the origin with a level horizon.

    Args:
        elevation: above the horizontal plane, radians, (...).
        azimuth: about +z, counter-clockwise from +x, radians, (...).
        distance: from the origin, object radii.

    Returns:
        Camera-to-world poses, (..., 4, 4) float64, OpenCV axes: x right, y down, z forward.
    """
    elevation, azimuth = np.broadcast_arrays(
        np.asarray(elevation, float),
        np.asarray(azimuth, float),
    )

    ce = np.cos(elevation)
    se = np.sin(elevation)
    ca = np.cos(azimuth)
    sa = np.sin(azimuth)

    outward = np.stack([ce * ca, ce * sa, se], -1)
    right = np.stack([-sa, ca, np.zeros_like(sa)], -1)

    pose = np.zeros((*elevation.shape, 4, 4))
    pose[..., :3, :] = np.stack(
        [right, np.cross(-outward, right), -outward, distance * outward],
        -1,
    )
    pose[..., 3, 3] = 1.0
    return pose


def level_pose(direction: Float, distance: float = CAMERA_DISTANCE) -> Float:
    """Return the pose of a level camera that looks at the origin from a direction.

    Args:
        direction: from the origin to the camera, (3,), of any length.
        distance: from the origin, object radii.

    Returns:
        Camera-to-world pose, (4, 4) float64, OpenCV axes.
    """
    return look_at_origin(elevation_of(direction), azimuth_of(direction), distance)


def great_circle(a: Float, b: Float, n: int = 25) -> Float:
    """Interpolate between two directions on the great circle through both.

    Args:
        a: first unit vector, (3,).
        b: second unit vector, (3,); if it is opposite to ``a``, the path leads over the top.
        n: number of directions, both ends included.

    Returns:
        Unit vectors, (n, 3) float64.
    """
    angle = angle_between(a, b)
    side = b - (a @ b) * a
    for up in np.eye(3)[[2, 0]]:
        side = side if np.linalg.norm(side) > SNAP else up - (up @ a) * a
    turned = np.linspace(0, angle, n)[:, None]
    return np.cos(turned) * a + np.sin(turned) * side / np.linalg.norm(side)


def _fixed(array: NDArray) -> NDArray:
    array.flags.writeable = False
    return array


def angle_between(a: Float, b: Float) -> Float:
    """Return the great-circle angle between unit vectors.

    Args:
        a: unit vectors, (..., 3).
        b: unit vectors, (..., 3).

    Returns:
        Angles, radians, (...) float64.
    """
    # arctan2 keeps its precision for equal and for opposite directions, where arccos loses half the
    # digits.
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1))


def elevation_of(directions: Float) -> Float:
    """Elevation of unit vectors, (..., 3), radians, (...)."""
    return np.arctan2(
        directions[..., 2],
        np.hypot(directions[..., 0], directions[..., 1]),
    )


def azimuth_of(directions: Float) -> Float:
    """Azimuth of unit vectors, (..., 3), radians, 0 to 2 pi, (...)."""
    return (
        2
        * np.pi
        * (np.arctan2(directions[..., 1], directions[..., 0]) / (2 * np.pi) % 1.0)
    )


def direction_of(pose: Float) -> Float:
    """Return the unit vector, (3,), from the origin to a camera-to-world pose, (4, 4).

    Straight above the origin the azimuth is that from which a level camera would see the same
    picture.
    """
    position = pose[:3, 3]
    outward = position / np.linalg.norm(position) if position.any() else -pose[:3, 2]
    if np.hypot(outward[0], outward[1]) < SNAP:
        outward = outward + 2e-6 * np.array([pose[0, 1], pose[1, 1], 0.0]) * np.sign(
            outward[2]
        )
        outward /= np.linalg.norm(outward)
    return outward


class Viewpoints:
    """Candidate viewpoints, V of them: what ``ViewSphere`` and ``Directions`` have in common.

    Arrays are read-only.
    """

    distance: float
    directions: Float

    def __len__(self) -> int:
        return len(self.directions)

    @cached_property
    def azimuth(self) -> Float:
        """Azimuth of each view, radians, 0 to 2 pi, shape (V,), float64."""
        return _fixed(azimuth_of(self.directions))

    @cached_property
    def elevation(self) -> Float:
        """Elevation of each view, radians, shape (V,), float64."""
        return _fixed(elevation_of(self.directions))

    def angles(self, view: int) -> tuple[float, float]:
        """(elevation, azimuth) of a view, degrees."""
        return float(np.degrees(self.elevation[view])), float(
            np.degrees(self.azimuth[view])
        )

    @cached_property
    def poses(self) -> Float:
        """Camera-to-world pose of each view, shape (V, 4, 4), float64, OpenCV camera axes."""
        return _fixed(look_at_origin(self.elevation, self.azimuth, self.distance))

    @cached_property
    def arc(self) -> Float:
        """Great-circle angle between views, radians, shape (V, V), float64."""
        return _fixed(angle_between(self.directions[:, None], self.directions[None, :]))

    @cached_property
    def travel(self) -> Float:
        """Distance between views in grid cells, shape (V, V), float64."""
        return _fixed(
            self.travel_between(self.directions[:, None], self.directions[None, :])
        )

    def cells(self, directions: Float) -> tuple[Float, Float]:
        """Return row and column of directions, (..., 3), on the grid that travel is counted in."""
        return elevation_of(directions) / TRAVEL_CELL[0], azimuth_of(
            directions
        ) / TRAVEL_CELL[1]

    def travel_between(self, a: Float, b: Float) -> Float:
        """Return the distance between directions in cells of the view grid.

        Args:
            a: directions, (..., 3).
            b: directions, (..., 3).

        Returns:
            Euclidean distance over rows and columns, (...) float64, grid cells.
        """
        row_a, column_a = self.cells(a)
        row_b, column_b = self.cells(b)
        steps = np.abs(column_a - column_b)
        return np.hypot(row_a - row_b, np.minimum(steps, self.columns - steps))

    @property
    def columns(self) -> float:
        """Cells of travel once round."""
        return float(2 * np.pi / TRAVEL_CELL[1])

    def nearest(self, direction: Float) -> tuple[int, bool]:
        """The view nearest to a direction, (3,), and whether it is that direction."""
        arc = angle_between(self.directions, direction)
        view = int(arc.argmin())
        return view, bool(arc[view] < SNAP)


@dataclass(frozen=True, eq=False)
class Directions(Viewpoints):
    """Candidate viewpoints in any directions; UsageError if they are none.

    Attributes:
        directions: from the object towards the views, (V, 3); any length but 0.
        distance: of every viewpoint from the origin, object radii.

    Example:
        >>> len(Directions.fibonacci(60))
        60
    """

    directions: Float
    distance: float = CAMERA_DISTANCE

    def __post_init__(self) -> None:
        given = points(self.directions, "directions")
        length = np.linalg.norm(given, axis=1, keepdims=True)
        if not len(given) or not (length > 0).all():
            raise UsageError("there is no direction, or one of length zero")
        whole(len(given), "the number of viewpoints", 1, MOST_VIEWPOINTS)
        number(self.distance, "the distance", above=0)
        object.__setattr__(self, "directions", _fixed(given / length))

    @classmethod
    def fibonacci(cls, n: int) -> "Directions":
        """Spread n views evenly over the upper hemisphere.

        They lie on a Fibonacci lattice (Swinbank and Purser, QJRMS 132, 2006).

        Raises:
            UsageError: n is below 1 or above MOST_VIEWPOINTS.
        """
        whole(n, "the number of viewpoints", 1, MOST_VIEWPOINTS)
        height = (np.arange(n) + 0.5) / n
        azimuth = np.arange(n) * np.pi * (3 - np.sqrt(5))
        flat = np.sqrt(1 - height**2)
        return cls(
            np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), height], 1)
        )


@dataclass(frozen=True)
class ViewSphere(Viewpoints):
    """Viewpoints on rings around an object; ``len(sphere)`` of them.

    Attributes:
        elevations: elevation of each ring, degrees, ring 0 first.
        azimuths: viewpoints per ring; the first looks from +x.
        distance: distance of every viewpoint from the origin, object radii.

    Example:
        >>> sphere = ViewSphere.named("40")
        >>> len(sphere), sphere.angles(11)
        (40, (18.0, 135.0))
    """

    elevations: tuple[float, ...]
    azimuths: int
    distance: float = CAMERA_DISTANCE

    def __post_init__(self) -> None:
        if not self.elevations:
            raise UsageError("a view sphere needs at least one ring")
        whole(self.azimuths, "the number of views on a ring", 3, MOST_VIEWPOINTS)
        whole(len(self), "the number of viewpoints", 1, MOST_VIEWPOINTS)
        for elevation in self.elevations:
            number(elevation, "an elevation", -90, 90)
        number(self.distance, "the distance", above=0)

    @classmethod
    def named(cls, name: str) -> "ViewSphere":
        """Return a layout of the thesis: "40" (5 rings of 8) or "12" (one ring at 45 degrees).

        See section 4.1.1.

        Raises:
            UsageError: there is no such layout.
        """
        if name not in VIEW_LAYOUTS:
            raise UsageError(
                f"no view sphere is called {one_line(repr(name))}; there are"
                f" {', '.join(VIEW_LAYOUTS)}"
            )
        return VIEW_LAYOUTS[name]

    def __len__(self) -> int:
        return self.rings * self.azimuths

    @property
    def rings(self) -> int:
        """How many rings."""
        return len(self.elevations)

    def same_grid(self, other: "ViewSphere") -> bool:
        """Whether another one has the same views, from whatever distance."""
        return (self.elevations, self.azimuths) == (other.elevations, other.azimuths)

    @cached_property
    def ring(self) -> Index:
        """Ring of each view, shape (V,), int64."""
        return _fixed(np.repeat(np.arange(self.rings), self.azimuths))

    @cached_property
    def azimuth_index(self) -> Index:
        """Position of each view on its ring, shape (V,), int64."""
        return _fixed(np.tile(np.arange(self.azimuths), self.rings))

    @cached_property
    def azimuth(self) -> Float:
        """Azimuth of each view, radians, 0 to 2 pi, shape (V,), float64."""
        return _fixed(2 * np.pi * self.azimuth_index / self.azimuths)

    def angles(self, view: int) -> tuple[float, float]:
        """(elevation, azimuth) of a view, degrees."""
        return self.elevations[self.ring[view]], 360.0 * int(
            self.azimuth_index[view]
        ) / self.azimuths

    @cached_property
    def poses(self) -> Float:
        """Camera-to-world pose of each view, shape (V, 4, 4), float64, OpenCV camera axes."""
        return _fixed(
            look_at_origin(
                np.radians(self.elevations)[self.ring],
                self.azimuth,
                self.distance,
            )
        )

    @cached_property
    def directions(self) -> Float:  # type: ignore[override]
        """Unit vector from the origin towards each view, shape (V, 3), float64."""
        return _fixed(self.poses[:, :3, 3] / self.distance)

    @cached_property
    def windows(self) -> Index:
        """The local window of each view, (V, rings, 3) int64.

        It holds all rings at azimuth -1, 0 and +1, with wrap-around.
        """
        columns = (self.azimuth_index[:, None] + np.array([-1, 0, 1])) % self.azimuths
        return _fixed(
            np.arange(self.rings)[None, :, None] * self.azimuths + columns[:, None, :]
        )

    @cached_property
    def travel(self) -> Float:
        """Distance between views in grid cells, (V, V) float64.

        It is Euclidean over ring and azimuth (thesis, table 9).
        """
        rings = self.ring[:, None] - self.ring[None, :]
        steps = np.abs(self.azimuth_index[:, None] - self.azimuth_index[None, :])
        return _fixed(np.hypot(rings, np.minimum(steps, self.azimuths - steps)))

    def cells(self, directions: Float) -> tuple[Float, Float]:
        """Return ring and azimuth step of directions, (..., 3), with fractions, (...) each.

        Beyond the last ring it is that ring.
        """
        order = np.argsort(self.elevations, kind="stable")
        rings = np.interp(
            elevation_of(directions),
            np.radians(self.elevations)[order],
            order,
        )
        return rings, azimuth_of(directions) / (2 * np.pi) * self.azimuths

    @property
    def columns(self) -> float:
        """Cells of travel once round."""
        return self.azimuths


VIEW_LAYOUTS = {
    "40": ViewSphere(elevations=(0.0, 18.0, 36.0, 54.0, 72.0), azimuths=8),
    "12": ViewSphere(elevations=(45.0,), azimuths=12),
}


def viewpoints_of(what: str | Viewpoints | Any) -> Viewpoints:
    """A layout of candidate viewpoints; UsageError if it is none.

    "40" or "12", the thesis's; "rings:0,30,60x12", elevations in degrees by views on each ring;
    "fibonacci:60", so many spread evenly over the upper half; directions from the object, (V, 3),
    or poses of cameras in the object frame, (V, 4, 4), of which only the directions count; or such
    a layout itself.
    """
    if isinstance(what, Viewpoints):
        return what

    if not isinstance(what, str):
        try:
            given = np.asarray(what, np.float64)
        except (TypeError, ValueError):
            raise UsageError(
                "viewpoints are a name, directions (V, 3) or poses (V, 4, 4)"
            ) from None
        return Directions(
            given[:, :3, 3] if given.ndim == 3 and given.shape[1:] == (4, 4) else given
        )

    if fibonacci := re.fullmatch(r"fibonacci:(\d{1,5})", what):
        return Directions.fibonacci(int(fibonacci[1]))
    if rings := re.fullmatch(
        r"rings:(-?\d+(?:\.\d+)?(?:,-?\d+(?:\.\d+)?)*)x(\d{1,4})",
        what,
    ):
        return ViewSphere(tuple(map(float, rings[1].split(","))), int(rings[2]))

    if what not in VIEW_LAYOUTS:
        others = "rings:ELEVATIONSxAZIMUTHS such as rings:0,30,60x12, and fibonacci:N"
        raise UsageError(
            f"no viewpoints are called {what!r}; there are {', '.join(VIEW_LAYOUTS)}, {others}"
        )

    return VIEW_LAYOUTS[what]
