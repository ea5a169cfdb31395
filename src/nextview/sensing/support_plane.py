"""Find the plane that the object stands on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from nextview.sensing.frame import AXES, Frame
from nextview.sensing.noise import Noise

Float = NDArray[np.float64]

TRIALS = 200
"""Planes that are tried: with one point in ten on the plane, 0.8 of all draws hit it at least once; with three, all."""
TILT = np.cos(np.radians(12.0))
"""A support plane leans less than this against gravity, as a cosine: errors of a calibration, not slopes."""
LEAST = 0.04
"""Share of what is seen that lies on a support plane, at least; more if gravity is not known."""
LEAST_ALONE = 0.15


SAMPLES = 1500
"""Pixels in which planes are searched."""


@dataclass(frozen=True)
class Samples:
    """Some of what a frame shows, on a grid over the picture.

    Attributes:
        points: (N, 3) float64, world, metres.
        tolerance: distance of each from a plane up to which it is on it, (N,), metres.
        rows: of each in the grid, (N,) int64.
        columns: of each in the grid, (N,) int64.
        camera: where they were seen from, (3,).
    """

    points: Float
    tolerance: Float
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    camera: Float


def sample(frame: Frame, pixels: NDArray[np.bool_], noise: Noise) -> Samples:
    """Some of the given pixels, (H, W) bool, which all have a depth."""
    step = max(1, int(np.sqrt(pixels.sum() / SAMPLES)))
    first = step // 2
    rows, columns = np.nonzero(pixels[first::step, first::step])
    points = frame.positions(first + step * rows, first + step * columns)
    z = frame.depth[first::step, first::step][rows, columns].astype(np.float64)
    return Samples(points, 3 * noise.at(z) * z**2 + 0.003 * z, rows, columns, frame.camera_to_world[:3, 3])


@dataclass(frozen=True)
class Plane:
    """Positions p with ``normal @ p + offset`` = 0; above it that is the height.

    Attributes:
        normal: upwards, (3,) float64, unit length, world.
        offset: metres.
    """

    normal: Float
    offset: float

    def height(self, points: Float) -> Float:
        """Of points (..., 3) above the plane, metres."""
        return points @ self.normal + self.offset

    def holds(self, samples: Samples) -> NDArray[np.bool_]:
        """Which samples are on it, (N,) bool."""
        return np.abs(self.height(samples.points)) < samples.tolerance

    def extent(self, samples: Samples) -> Float:
        """The samples on it, (M, 3), without those that are not connected with most of them in the picture.

        What else lies at the height of a table, on a wall behind it, is no part of the table.
        """
        on = self.holds(samples)
        if not on.any():
            return samples.points[on]
        grid = np.zeros((samples.rows.max() + 1, samples.columns.max() + 1), bool)
        grid[samples.rows, samples.columns] = on
        part = ndimage.label(grid)[0][samples.rows, samples.columns]
        return samples.points[on & (part == np.bincount(part[on]).argmax())]


def find_plane(
    samples: Samples, rng: np.random.Generator, up: Float | None = None, above: Float | None = None
) -> Plane | None:
    """The plane with most samples on it, by RANSAC (Fischler and Bolles 1981), with all trials in one product.

    Args:
        samples: of a frame; its camera is above the plane.
        rng: draws the trials.
        up: direction against gravity, (3,), unit length. None: any plane will do.
        above: something that has to be above the plane, (3,): a point on the object.

    Returns:
        The plane; None if too few samples lie on any.
    """
    points = samples.points
    if len(points) < 10:
        return None
    a, b, c = points[rng.integers(len(points), size=(3, TRIALS))]
    normals = np.cross(b - a, c - a)
    if up is not None:
        normals[::2] = up  # one point is enough where the direction is known; the triples find what leans a little
    length = np.linalg.norm(normals, axis=1)
    normals, through = normals[length > 0] / length[length > 0, None], a[length > 0]
    offsets = -(normals * through).sum(1)
    turn = np.where((normals @ samples.camera + offsets if up is None else normals @ up) < 0, -1, 1)
    normals, offsets = normals * turn[:, None], offsets * turn
    fits = normals @ samples.camera + offsets > 0
    if up is not None:
        fits &= normals @ up > TILT
    if above is not None:
        fits &= normals @ above + offsets > np.median(samples.tolerance)
    normals, offsets = normals[fits], offsets[fits]
    if len(normals) == 0:
        return None
    count = (np.abs(points @ normals.T + offsets) < samples.tolerance[:, None]).sum(0)
    best = int(count.argmax())
    plane = refine_plane(Plane(normals[best], float(offsets[best])), samples)
    level = up is None or plane.normal @ up > TILT
    return plane if level and plane.holds(samples).mean() > (LEAST_ALONE if up is None else LEAST) else None


def refine_plane(plane: Plane, samples: Samples, loose: float = 1.0) -> Plane:
    """The plane of least squares through the samples that are on one, found three times over.

    Args:
        plane: where to begin; the result where fewer than ten samples are on it.
        samples: of a frame.
        loose: so many tolerances from the plane count as on it.
    """
    points, tolerance = samples.points, loose * samples.tolerance
    for _ in range(3):
        on = np.abs(plane.height(points)) < tolerance
        if on.sum() < 10:
            return plane
        weight = 1 / tolerance[on, None] ** 2
        centre = (weight * points[on]).sum(0) / weight.sum()
        spread = points[on] - centre
        normal = np.linalg.eigh((weight * spread).T @ spread)[1][:, 0]
        normal *= np.sign(normal @ plane.normal) or 1.0
        plane = Plane(normal, float(-normal @ centre))
    return plane


def mistake_in_pose(plane: Plane, pose: Float, up: Float) -> str | None:
    """The mistake in a camera's pose without which the largest plane in view would be level, if there is one.

    Floors and tables are level and walls upright. A plane that leans in between points to a wrong pose; so does one
    that is level but lies over the camera. Of a wall nothing is said: seen from the side it would pass for a floor.

    Args:
        plane: the largest in view, the camera on its upper side.
        pose: camera-to-world, (4, 4).
        up: direction against gravity, (3,).

    Returns:
        What to tell the user.
    """
    if plane.normal @ up > TILT or abs(plane.normal @ up) < np.sqrt(1 - TILT**2):
        return None
    rotation = pose[:3, :3]
    seen = rotation.T @ plane.normal
    if rotation @ AXES["opengl"] @ seen @ up > TILT:
        return "the camera's axes are OpenGL's?"
    if rotation @ AXES["ros"] @ seen @ up > TILT:
        return "the camera's axes are those of a ROS body?"
    if rotation.T @ seen @ up > TILT:
        return "the pose is inverse, world-to-camera?"
    return None
