"""Find planes in a frame by RANSAC and refine them by least squares."""

from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from scipy.spatial import ConvexHull, QhullError

from nextview.sensing.frame import Frame
from nextview.sensing.noise import Noise
from nextview.types import Float, Floats, Index, Mask

# cosine of the largest tilt of a support plane, due to calibration errors
TILT = np.cos(np.radians(12.0))
# cosine of the tilt at which the weight of a plane is zero
STEEPEST_SUPPORT = np.cos(np.radians(15.0))
# least share of the samples on a support plane; more if gravity is not known
LEAST_SUPPORT = 0.04
STEEP_LAG = 2  # distance of two samples whose slope is measured
# largest pose error, which displaces a known plane in a new frame
POSE_SHIFT = 0.02  # metres
POSE_TURN = np.radians(2.0)  # radians, of the same error
# distance from a visible plane, in tolerances, up to which few samples are off the plane
TOLERANCES_ASIDE = 3.0


@dataclass(frozen=True)
class Samples:
    """A grid of points of a frame, with their tolerances.

    Attributes:
        points: (N, 3), world, metres.
        tolerance: largest distance of each point from a plane that it belongs to, metres, (N,).
        rows: of the blocks in the image, (N,).
        columns: of the blocks in the image, (N,).
        camera: position of the camera, (3,), world, metres.
    """

    points: Float
    tolerance: Float
    rows: Index
    columns: Index
    camera: Float

    def some(self, which: Mask) -> "Samples":
        """Return a subset, (N,) bool, of the samples."""
        return Samples(
            self.points[which],
            self.tolerance[which],
            self.rows[which],
            self.columns[which],
            self.camera,
        )


def sample(frame: Frame, pixels: Mask, noise: Noise) -> Samples:
    """Average a frame over blocks of pixels.

    For pixels of a plane, the mean inverse depth is exact at their mean image position, with less
    noise than a single pixel. Blocks with fewer than half of their pixels given are left out.

    Args:
        frame: the frame.
        pixels: pixels to use, (H, W) bool; all with valid depth.
        noise: of the frame.

    Returns:
        The samples.
    """
    step = 1
    # some 1500 blocks of pixels are enough
    side = max(1, int(np.sqrt(np.count_nonzero(pixels) / 1500)))
    if side >= 8:  # every second pixel is enough, as neighbouring errors are correlated
        step = 2
        side //= step
    few = (slice(None, None, step), slice(None, None, step))
    given = pixels[few]
    count = _block_sums(given.astype(np.float32), side)
    rows, columns = np.nonzero(2 * count >= side**2)
    count = count[rows, columns]

    inverse = np.zeros(given.shape, np.float32)
    np.divide(1, frame.depth[few], out=inverse, where=given)
    ray_x, ray_y = frame.rays
    z = count / _block_sums(inverse, side)[rows, columns]
    x = _block_sums(given * ray_x[None, ::step], side)[rows, columns] / count
    y = _block_sums(given * ray_y[::step, None], side)[rows, columns] / count

    pose = frame.camera_to_world
    points = (np.stack([x, y, np.ones(len(z))], 1) * z[:, None]) @ pose[
        :3,
        :3,
    ].T + pose[:3, 3]
    erring_together = max(1.0, (2 * noise.grain + 1) / step)  # pixels across
    # square root of the number of independent errors
    # largest gain of precision by averaging a block, limited by errors of the lens
    alone = np.clip(np.sqrt(count) / erring_together, 1, 4.0)
    return Samples(
        points,
        3 * noise.at(z) * z**2 / alone + 0.003 * z,
        rows,
        columns,
        pose[:3, 3],
    )


def _block_sums(values: Floats, side: int) -> Float:
    """Return sums over squares of pixels; incomplete squares are left out."""
    height, width = (n // side for n in values.shape)
    blocks = values[: height * side, : width * side].reshape(height, side, width, side)
    return np.asarray(blocks.sum(3).sum(1), np.float64)


@dataclass(frozen=True)
class Plane:
    """A plane: ``normal @ p + offset`` is the height of a position p, metres.

    Attributes:
        normal: unit vector, (3,).
        offset: metres.
        lean_error: standard deviation of the tilt, from thickness and extent of the visible part,
            radians; 0 if not known.
    """

    normal: Float
    offset: float
    lean_error: float = 0.0

    def height(self, points: Float) -> Float:
        """Return the height of points, (..., 3), above the plane, metres."""
        return points @ self.normal + self.offset

    def holds(self, samples: Samples) -> Mask:
        """Return which samples are on the plane, (N,) bool."""
        return np.abs(self.height(samples.points)) < samples.tolerance


def axes_along(plane: Plane) -> Float:
    """Return two orthonormal directions along a plane, (2, 3)."""
    first = np.cross(plane.normal, np.eye(3)[np.abs(plane.normal).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(plane.normal, first)])


def sides_of(points: Float) -> Float | None:
    """Return the sides of the convex hull of points, (N, 2), metres.

    Returns:
        The sides, (K, 3): a point (x, y) is inside if no element of ``sides @ (x, y, 1)`` is above
        0. None for collinear points.
    """
    try:
        return ConvexHull(points).equations
    except (QhullError, ValueError):
        return None


def steep(samples: Samples, up: Float) -> Mask:
    """Return the samples on surfaces that rise steeply.

    Args:
        samples: the samples.
        up: direction against gravity, (3,).

    Returns:
        Whether each is on such a surface, by its neighbours above and below in the image, (N,)
        bool.
    """
    upright = np.zeros(len(samples.points), bool)
    if not len(upright):
        return upright
    grid = np.full((samples.rows.max() + 1 + STEEP_LAG, samples.columns.max() + 1), -1)
    grid[samples.rows, samples.columns] = np.arange(len(samples.points))
    lower = grid[samples.rows + STEEP_LAG, samples.columns]
    pairs = np.stack([np.arange(len(lower)), lower], 1)[lower >= 0]
    step = samples.points[pairs[:, 0]] - samples.points[pairs[:, 1]]
    # some 45 degrees
    rising = np.abs(step @ up) > 0.7 * np.linalg.norm(step, axis=1)

    upright[pairs[rising].ravel()] = True
    return upright


def find_plane(
    samples: Samples,
    rng: Generator,
    up: Float | None = None,
    upright: bool = False,
) -> Plane | None:
    """Find the plane with the most samples by RANSAC (Fischler and Bolles 1981).

    Args:
        samples: the samples.
        rng: source of all random numbers.
        up: normal of the plane, up to a small tilt, (3,); None for any plane.
        upright: whether ``up`` lies in the plane instead, as in a wall.

    Returns:
        The plane, with the camera above it; None if no plane has enough samples.
    """
    points = samples.points
    if len(points) < 10:
        return None
    # hypotheses per search: with one point in ten on the plane, 0.8 of all searches find it
    a, b, c = points[rng.integers(len(points), size=(3, 200))]
    normals = np.cross(b - a, c - a)
    if up is not None:
        # fewer points are enough if the normal is known; triples find slightly tilted planes
        normals[::2] = np.cross(b - a, up)[::2] if upright else up
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 0] / length[length > 0, None]
    through = a[length > 0]
    offsets = -(normals * through).sum(1)
    over = normals @ samples.camera + offsets
    level = up is not None and not upright
    turn = np.where((normals @ up if level else over) < 0, -1, 1)
    normals = normals * turn[:, None]
    offsets = offsets * turn
    fits = over * turn > 0

    def tilted(normals: Float) -> Float:
        """Return the cosine of the tilt of planes against what is searched."""
        if up is None:
            return np.ones(normals.shape[:-1])
        rise = normals @ up
        return np.sqrt(np.maximum(1 - rise**2, 0)) if upright else rise

    fits &= tilted(normals) > TILT
    normals = normals[fits]
    offsets = offsets[fits]
    if len(normals) == 0:
        return None
    # Relative to the camera, so that single precision is enough.
    away = (points - samples.camera).astype(np.float32) @ normals.T.astype(np.float32)
    away += (offsets + normals @ samples.camera).astype(np.float32)
    count = (np.abs(away) < samples.tolerance[:, None].astype(np.float32)).sum(0)
    # A strongly tilted plane is more likely to pass through objects than to support them.
    count = count * (1 - (1 - tilted(normals)) / (1 - STEEPEST_SUPPORT))
    best = int(count.argmax())
    plane = refine_plane(Plane(normals[best], float(offsets[best])), samples)
    least = 0.15 if up is None else LEAST_SUPPORT
    fits_well = tilted(plane.normal) > TILT and plane.holds(samples).mean() > least
    return plane if fits_well else None


def refine_plane(plane: Plane, samples: Samples) -> Plane:
    """Fit a plane to the samples near it by least squares, three times.

    Args:
        plane: the plane.
        samples: the samples.

    Returns:
        The refined plane; the plane itself if fewer than ten samples are near.
    """
    points = samples.points
    tolerance = samples.tolerance
    for _ in range(3):
        on = np.abs(plane.height(points)) < tolerance
        if on.sum() < 10:
            return plane
        weight = 1 / tolerance[on, None] ** 2
        centre = (weight * points[on]).sum(0) / weight.sum()
        spread = points[on] - centre
        squares, directions = np.linalg.eigh((weight * spread).T @ spread)
        normal = directions[:, 0] * (np.sign(directions[:, 0] @ plane.normal) or 1.0)
        # As errors of neighbours are correlated, half the deviation at the edge is assumed.
        error = float(np.sqrt(max(squares[0], 0.0) / max(squares[1], 1e-12))) / 2
        plane = Plane(normal, float(-normal @ centre), error)
    return plane


def gain_as_range(
    frame: Frame,
    plane: Plane | None,
    samples: Samples,
    rng: Generator,
) -> float:
    """Return the share of samples that lie on a plane only with the depth read as range.

    Args:
        frame: the frame.
        plane: found with the depth as it is; None if there is none.
        samples: of the frame.
        rng: source of all random numbers.
    """
    along = samples.points - samples.camera
    depth = along @ frame.camera_to_world[:3, 2]
    nearer = replace(
        samples,
        points=samples.camera
        + along * (depth / np.linalg.norm(along, axis=1))[:, None],
    )
    other = find_plane(nearer, deepcopy(rng))
    usual = 0.0 if plane is None else float(plane.holds(samples).mean())
    held = 0.0 if other is None else float(other.holds(nearer).mean())
    return max(0.0, held - usual)
