"""The support plane, and which pixels show the object: clusters, seen from above, of what stands on it.

From above the parts of one object lie together even where it hides itself, such as the far legs of a table under its
top; things that stand side by side lie apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from nextview.sensing.facets import Noise
from nextview.sensing.frame import AXES, Frame
from nextview.sensing.object_frame import Box

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

CELL = 0.01
"""Side of a cell of the footprint, in distances of the camera from the object. Gaps of up to two cells are bridged."""
CROWD = 3
"""Pixels that make a cell occupied."""
REACH, FAR = 250, 1000
"""Cells to each side of the middle of what is seen above the plane: farther things are left out. And cells from those
of the first frame beyond which nothing can be a part of the same object."""
TRIALS = 200
"""Planes that are tried: with one point in ten on the plane, 0.8 of all draws hit it at least once."""
TILT = np.cos(np.radians(12.0))
"""Cosine of the lean of a support plane against gravity, at most: errors of a calibration."""
LEAST = 0.04
"""Share of what is seen that lies on a support plane, at least; more if gravity is not known."""
LEAST_ALONE = 0.15
SAMPLES = 1500
"""Pixels in which planes are searched."""


@dataclass(frozen=True)
class Samples:
    """A grid of points of a frame, world, metres, with the distance from a plane up to which each is on it."""

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
    """Positions p with ``normal @ p + offset`` = 0, normal of unit length; above it that is the height in metres."""

    normal: Float
    offset: float

    def height(self, points: Float) -> Float:
        """Of points (..., 3) above the plane, metres."""
        return points @ self.normal + self.offset

    def holds(self, samples: Samples) -> NDArray[np.bool_]:
        """Which samples are on it, (N,) bool."""
        return np.abs(self.height(samples.points)) < samples.tolerance

    def extent(self, samples: Samples) -> Float:
        """The samples on it, (M, 3), connected with most of them in the picture: no wall at its height."""
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

    The camera and a point ``above``, (3,), lie above it, and it is level against ``up``, (3,), where these are given.
    None if too few samples lie on any.
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
    """The plane of least squares through the samples within ``loose`` tolerances of one, if ten are; three times."""
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
    """The mistake in a camera-to-world pose, (4, 4), without which the largest plane in view would be level; or None.

    Floors and tables are level and walls upright. A plane that leans in between points to a wrong pose; so does one
    that is level but lies over the camera. Of a wall nothing is said: seen from the side it would pass for a floor.
    """
    if plane.normal @ up > TILT or abs(plane.normal @ up) < np.sqrt(1 - TILT**2):
        return None
    rotation = pose[:3, :3]
    mistakes = {
        "the camera's axes are OpenGL's?": rotation @ AXES["opengl"],
        "the camera's axes are those of a ROS body?": rotation @ AXES["ros"],
        "the pose is inverse, world-to-camera?": rotation.T,
    }
    seen = rotation.T @ plane.normal
    return next((mistake for mistake, right in mistakes.items() if right @ seen @ up > TILT), None)


def inside_box(frame: Frame, box: Box) -> Mask:
    """Pixels whose position lies in an upright box, (H, W) bool."""
    inside = frame.depth > 0
    for axis, low, high in zip(box.axes, box.low, box.high, strict=True):
        position = frame.along(axis)
        inside &= (position >= low) & (position <= high)
    return inside


def inside_sphere(frame: Frame, centre: Float, radius: float) -> Mask:
    """Pixels whose position lies in a sphere, (H, W) bool."""
    x, y, z = (frame.along(axis, float(-at)) for axis, at in zip(np.eye(3), centre, strict=True))
    return (frame.depth > 0) & (x * x + y * y + z * z < radius**2)


def above_plane(frame: Frame, plane: Plane, noise: Noise) -> Mask:
    """Pixels that are higher above a plane than the noise of the frame explains, (H, W) bool."""
    height = frame.along(plane.normal, plane.offset)
    high = height > np.float32(0.003) * frame.depth
    high &= frame.depth > 0
    rows, columns = np.divmod(np.flatnonzero(high), high.shape[1])
    # Noise moves a point along its ray: it rises by so much as the ray does.
    a, b, c = (frame.camera_to_world[:3, :3].T @ plane.normal).astype(np.float32)
    (x, y), z = frame.rays, frame.depth[rows, columns]
    rise = np.abs((a * x)[columns] + (b * y + c)[rows])
    high[rows, columns] = height[rows, columns] > z * (4 * noise.at(z) * z * rise + 0.003)
    return high


@dataclass(frozen=True)
class Footprint:
    """The cells, seen from above, over which a frame shows something above the plane: (K, 2) indices, each once.

    ``area`` is that of the surface over each, square metres, ``pixels`` how many show it, ``cell_of`` the cell of each
    pixel of the frame, (H, W) int32, -1 for none.
    """

    cells: NDArray[np.int64]
    area: Float
    pixels: NDArray[np.int64]
    cell_of: NDArray[np.int32]

    def pixels_over(self, chosen: Mask) -> Mask:
        """Pixels that show something over the chosen cells, (H, W) bool."""
        return np.append(chosen, False)[self.cell_of]  # the last is that of -1


def footprint(frame: Frame, above: Mask, axes: Float, cell: float) -> Footprint:
    """The footprint of the pixels ``above``, (H, W) bool, along upright axes, (3, 3), in cells of a side in metres."""
    rows, columns = np.divmod(np.flatnonzero(above), above.shape[1])
    z = frame.depth[rows, columns]
    pose, (x, y) = frame.camera_to_world, frame.rays
    ij = []
    for axis in axes[:2]:
        a, b, c = (pose[:3, :3].T @ axis / cell).astype(np.float32)
        position = z * (a * x[columns] + b * y[rows] + c) + np.float32(axis @ pose[:3, 3] / cell)
        ij.append(np.floor(position).astype(np.int64))
    low = np.array([np.median(v[::50]) if len(v) else 0 for v in ij]).astype(np.int64) - REACH
    side = 2 * REACH + 1
    i, j = ij[0] - low[0], ij[1] - low[1]
    within = (i >= 0) & (i < side) & (j >= 0) & (j < side)
    rows, columns, z, keys = rows[within], columns[within], z[within], (i * side + j)[within]
    pixels = np.bincount(keys, minlength=side**2)
    used = np.flatnonzero(pixels)
    area = np.bincount(keys, z * z, side**2)[used] / (frame.intrinsics[0, 0] * frame.intrinsics[1, 1])
    number = np.zeros(side**2, np.int32)
    number[used] = np.arange(len(used))
    cell_of = np.full(frame.shape, -1, np.int32)
    cell_of[rows, columns] = number[keys]
    return Footprint(np.stack(np.divmod(used, side), 1) + low, area, pixels[used], cell_of)


def clusters(footprints: Sequence[Footprint]) -> list[NDArray[np.int64]]:
    """Label of each cell in each footprint, (K,) int64 each: 1, 2, ... for the clusters of all taken together.

    0 for cells that too few pixels saw, or that lie far from all that the first footprint shows.
    """
    cells = np.concatenate([f.cells for f in footprints])
    if len(cells) == 0:
        return [np.zeros(0, np.int64) for _ in footprints]
    near = [np.abs(f.cells - cells[0]).max(1) <= FAR for f in footprints]
    kept = cells[np.concatenate(near)]
    low = kept.min(0) - 1
    grid = np.zeros(np.ptp(kept, axis=0) + 3, np.int64)
    np.add.at(grid, tuple((kept - low).T), np.concatenate([f.pixels[n] for f, n in zip(footprints, near, strict=True)]))
    occupied = grid >= CROWD
    labels, _ = ndimage.label(ndimage.binary_dilation(occupied, np.ones((3, 3), bool)), np.ones((3, 3)))
    labels = np.where(occupied, labels, 0)
    return [
        np.where(n, labels[tuple((np.where(n[:, None], f.cells, low) - low).T)], 0)
        for f, n in zip(footprints, near, strict=True)
    ]


def on_ground(points: Float, plane: Float) -> Mask:
    """Which points, (N, 2), lie within the hull of what was seen of the plane, (M, 2), (N,) bool."""
    if len(plane) < 3:
        return np.ones(len(points), bool)
    try:
        sides = ConvexHull(plane).equations
    except QhullError:  # a plane of which only a line is seen
        return np.ones(len(points), bool)
    return np.asarray((points @ sides[:, :2].T + sides[:, 2] <= 0).all(1))


def largest(foot: Footprint, labels: NDArray[np.int64], plane: Float) -> int:
    """The cluster with most surface in view on the plane, whose points are given in cells, (M, 2); or 0."""
    if not labels.any():
        return 0
    area = np.bincount(labels, foot.area)
    middles = np.stack([np.bincount(labels, foot.area * x) for x in foot.cells.T], 1) / np.maximum(area, 1e-30)[:, None]
    area[~on_ground(middles, plane)] = 0
    area[0] = 0
    return int(area.argmax()) if area.max() > 0 else 0


def nearest(foot: Footprint, labels: NDArray[np.int64], point: Float) -> int:
    """The cluster nearest to a point, in cells, (2,), seen from above; 0 if there is none."""
    distance = np.where(labels > 0, np.linalg.norm(foot.cells + 0.5 - point, axis=1), np.inf)
    return int(labels[distance.argmin()]) if labels.any() else 0
