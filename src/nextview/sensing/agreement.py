"""Test whether posed depth frames agree with one rigid scene.

Surface points of each frame are projected into all other frames. A point is confirmed if the other
frame measures the same depth, and contradicted if the other frame measures a greater one. Points
that are occluded, outside the image or without measured depth do not count.

Every point is tested twice: with a rough tolerance that accepts usual calibration errors, and with
a sharp tolerance that detects pose errors of a few degrees. The score of the frames is the share of
all these judgements that are confirmed.

Points above the largest plane of a frame can be tested separately: a table looks the same after any
rotation about its normal, so its points agree even if those of the object do not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from nextview.sensing.displacement import CAMERA_AIM, CAMERA_PLACE
from nextview.sensing.facets import Noise, noise_of
from nextview.sensing.frame import Frame
from nextview.sensing.planes import find_plane, sample
from nextview.types import Float, Float32, Index, Mask

POINT_GRID = 160  # columns of the grid from which surface points are drawn
AGREEMENT_POINTS = 200  # points of each frame that are projected into the others
QUICK_POINTS = 500  # the same for a frame that is compared only with the last one
NOISE_TOLERANCE = 3.0  # standard deviations of the noise
# largest relative variation of the depth around a projected point, to avoid edges
SMOOTH_STEP = 0.05
# relative height above the largest plane from which a point is not on it
ABOVE_PLANE = 0.012
# multiple of the depth in the centre of the image beyond which points are background
FAR_BEHIND = 1.5
SMALLEST_MIDDLE = 20  # least number of valid grid points in the centre of the image
LEAST_DEPTH = 1e-6  # metres in front of a camera


@dataclass(frozen=True)
class Sharpness:
    """Tolerance of the comparison of two frames.

    Attributes:
        columns: of the image in which points are looked up. A point agrees with any depth in its
            block of pixels and in the neighbouring blocks.
        deviations: largest difference of depth, in standard deviations of the error that two usual
            camera poses cause, in addition to the noise of both frames.
    """

    columns: int
    deviations: float

    def tolerance(self, depth: Float) -> Float:
        """Return the difference of depth, metres, of points at some depths, (N,), metres."""
        of_pose = np.hypot(CAMERA_PLACE, CAMERA_AIM * depth)
        return np.asarray(self.deviations * np.sqrt(2) * of_pose)


ROUGH = Sharpness(160, 2.4)
"""Tolerates usual errors of camera poses; contradictions are gross errors."""
SHARP = Sharpness(320, 0.7)
"""Separates poses that differ by a few degrees.

Correct but inexact poses also leave some contradictions.
"""


@dataclass(frozen=True)
class Picture:
    """The depth image of a frame in blocks of pixels.

    Attributes:
        intrinsics: pinhole matrix in units of blocks, (3, 3).
        nearest: least depth in each block and its neighbours, (h, w), metres; infinite without
            valid depth.
        farthest: greatest depth in each block and its neighbours, (h, w), metres; 0 without valid
            depth.
        complete: whether each block and all of its neighbours have valid depth, (h, w).
        object_near: blocks on or next to the object's mask, (h, w); None without a mask.
    """

    intrinsics: Float
    nearest: Float
    farthest: Float
    complete: Mask
    object_near: Mask | None


@dataclass(frozen=True)
class SurfaceView:
    """A frame prepared for comparison with others.

    Attributes:
        pictures: the depth image for each sharpness.
        points: surface points, (N, 3), camera frame, metres.
        noise: depth error of each point due to noise, (N,), metres.
        standing: points above the largest plane, (N,); all of them with a mask or without a plane.
    """

    pictures: dict[Sharpness, Picture]
    points: Float
    noise: Float
    standing: Mask

    def tolerance(self, sharpness: Sharpness) -> Float:
        """Largest depth difference with which another frame confirms each point, (N,), metres."""
        return sharpness.tolerance(self.points[:, 2]) + self.noise

    def some(self, which: Mask) -> "SurfaceView":
        """Return the frame with a subset of its points, (N,) bool."""
        return replace(
            self,
            points=self.points[which],
            noise=self.noise[which],
            standing=self.standing[which],
        )

    def with_focal_length(self, times: float) -> "SurfaceView":
        """Return the frame with its focal lengths multiplied by a factor."""
        pictures = {}
        for sharpness, picture in self.pictures.items():
            intrinsics = picture.intrinsics.copy()
            intrinsics[[0, 1], [0, 1]] *= times
            pictures[sharpness] = replace(picture, intrinsics=intrinsics)
        return replace(self, pictures=pictures, points=self.points / [times, times, 1])


@dataclass(frozen=True)
class Agreement:
    """Number of points of a frame (row) that another frame (column) confirms or contradicts.

    Attributes:
        confirmed: number of judgements, (N, N).
        contradicted: number of judgements, (N, N).
    """

    confirmed: Float
    contradicted: Float

    @property
    def judged(self) -> float:
        """Total number of judgements."""
        return float(self.confirmed.sum() + self.contradicted.sum())

    @property
    def share(self) -> float:
        """Confirmed share of the judgements; 1 if there are none."""
        return 1.0 if self.judged == 0 else float(self.confirmed.sum()) / self.judged

    def among(self, pairs: Mask) -> "Agreement":
        """Return the agreement of some pairs of frames, (N, N)."""
        return Agreement(
            np.where(pairs, self.confirmed, 0),
            np.where(pairs, self.contradicted, 0),
        )

    def of_frames(self, which: Index | Mask) -> "Agreement":
        """Return the agreement among some frames."""
        return Agreement(
            self.confirmed[which][:, which],
            self.contradicted[which][:, which],
        )

    def of_each(self) -> tuple[Float, Float]:
        """Return confirmed share and number of judgements of each frame, both ways, (N,) each."""
        confirmed = self.confirmed.sum(0) + self.confirmed.sum(1)
        judged = confirmed + self.contradicted.sum(0) + self.contradicted.sum(1)
        share = np.where(judged > 0, confirmed / np.maximum(judged, 1), 1.0)
        return share, judged


def surface_view(frame: Frame, rng: np.random.Generator) -> SurfaceView:
    """Prepare a frame for comparison.

    Points are taken from the object's mask. Without a mask they are taken from the centre of the
    image: one half from the largest plane, the other half from points above it.

    Args:
        frame: its pose is not used.
        rng: for drawing the points.
    """
    noise = noise_of(frame)
    points = _surface_points(frame)
    if frame.mask is None:
        points, standing = _half_off_the_plane(points, frame, noise, rng)
    else:
        points = _some(points, AGREEMENT_POINTS, rng)
        standing = np.ones(len(points), bool)

    depth = points[:, 2]
    by_noise = NOISE_TOLERANCE * noise.at(depth) * depth**2
    pictures = {
        sharpness: _picture(frame, sharpness.columns) for sharpness in (ROUGH, SHARP)
    }
    return SurfaceView(pictures, points, by_noise, standing)


def quick_view(frame: Frame) -> SurfaceView:
    """Prepare a frame for a fast comparison, at low resolution.

    Args:
        frame: its pose is not used, nor is its mask, as the whole image is compared.
    """
    side = max(1, frame.shape[1] // ROUGH.columns)
    # Each square becomes one pixel with the depth of its corner.
    intrinsics = frame.intrinsics.copy()
    intrinsics[:2, 2] -= 0.5
    intrinsics[:2] /= side
    intrinsics[:2, 2] += 0.5
    small = Frame(frame.depth[::side, ::side].copy(), intrinsics, pixel_centre=0.5)

    noise = noise_of(small)
    rows, columns = np.nonzero(_is_smooth(small.depth) & (small.depth > 0))
    points = small.positions_in_camera(rows, columns)
    points = _some(points, QUICK_POINTS, np.random.default_rng(0))
    depth = points[:, 2]
    by_noise = NOISE_TOLERANCE * noise.at(depth) * depth**2
    pictures = {ROUGH: _picture(small, ROUGH.columns)}
    pictures[SHARP] = pictures[ROUGH]
    return SurfaceView(pictures, points, by_noise, np.ones(len(points), bool))


def compare(
    views: Sequence[SurfaceView],
    poses: Float,
    looked_up_with: Float | None = None,
) -> Agreement:
    """Project the points of every frame into all others, with both tolerances.

    Args:
        views: N frames.
        poses: of their cameras, camera-to-world, (N, 4, 4), metres.
        looked_up_with: poses of the cameras into which the points are projected, (N, 4, 4); by
            default the same.
    """
    count = len(views)
    owner = np.repeat(np.arange(count), [len(view.points) for view in views])
    world = np.concatenate(
        [
            pose[:3, :3] @ view.points.T + pose[:3, 3:]
            for view, pose in zip(views, poses, strict=True)
        ],
        axis=1,
    )
    tolerances = {
        sharpness: np.concatenate([view.tolerance(sharpness) for view in views])
        for sharpness in (ROUGH, SHARP)
    }

    confirmed = np.zeros((count, count))
    contradicted = np.zeros((count, count))
    there = poses if looked_up_with is None else looked_up_with
    for j, (view, pose) in enumerate(zip(views, there, strict=True)):
        seen_from = pose[:3, :3].T @ (world - pose[:3, 3:])
        ahead = np.flatnonzero((seen_from[2] > LEAST_DEPTH) & (owner != j))
        x, y, z = seen_from.take(ahead, axis=1)
        rays = np.stack([x / z, y / z])
        for sharpness, tolerance in tolerances.items():
            which, agrees, looks_through = _looked_up(
                view.pictures[sharpness],
                rays,
                z,
                tolerance[ahead],
            )
            found = owner[ahead[which]]
            confirmed[:, j] += np.bincount(found[agrees], minlength=count)
            contradicted[:, j] += np.bincount(found[looks_through], minlength=count)
    return Agreement(confirmed, contradicted)


def _looked_up(
    picture: Picture,
    rays: Float,
    z: Float,
    tolerance: Float,
) -> tuple[Index, Mask, Mask]:
    """Return which points are inside an image, and confirmed or contradicted by it.

    Args:
        picture: the image.
        rays: x and y of the rays (x, y, 1) to P points, (2, P).
        z: depth of the points, (P,), metres.
        tolerance: of each depth, (P,), metres.
    """
    height, width = picture.nearest.shape
    (fx, _, cx), (_, fy, cy) = picture.intrinsics[:2]
    column = rays[0] * fx + cx
    row = rays[1] * fy + cy

    # A small pose error moves points near the border out of the image.
    inside = (row >= 1) & (row < height - 1) & (column >= 1) & (column < width - 1)
    which = np.flatnonzero(inside)
    at = row[which].astype(np.int64) * width + column[which].astype(np.int64)
    z = z[which]
    limit = tolerance[which]

    nearest = picture.nearest.take(at)
    farthest = picture.farthest.take(at)
    agrees = (z > nearest - limit) & (z < farthest + limit)
    looks_through = (z <= nearest - limit) & picture.complete.take(at)
    if picture.object_near is not None:
        on_object = picture.object_near.take(at)
        hidden = nearest < z - limit
        # Unless it is occluded, a point of the object must be inside the mask, even without depth.
        looks_through = np.where(on_object, looks_through, ~hidden)
        agrees &= on_object
    return which, agrees, looks_through


def _picture(frame: Frame, columns: int) -> Picture:
    """Return the depth image of a frame in blocks of pixels, with about this many columns."""
    side = max(1, frame.shape[1] // columns)
    measured = np.where(frame.depth > 0, frame.depth, np.float32(np.inf))
    block_nearest = _blockwise(measured, side, np.minimum)
    block_farthest = _blockwise(frame.depth, side, np.maximum)

    intrinsics = frame.intrinsics.copy()
    intrinsics[:2] /= side
    object_near = None
    if frame.mask is not None:
        object_near = ndimage.maximum_filter(
            _blockwise(frame.mask, side, np.maximum),
            3,
        )
    return Picture(
        intrinsics,
        nearest=ndimage.minimum_filter(block_nearest, 3, mode="nearest"),
        farthest=ndimage.maximum_filter(block_farthest, 3, mode="nearest"),
        complete=ndimage.minimum_filter(block_farthest > 0, 3, mode="constant"),
        object_near=object_near,
    )


def _surface_points(frame: Frame) -> Float:
    """Return a grid of points on the object, or on smooth surfaces in the centre, (N, 3)."""
    side = max(1, frame.shape[1] // POINT_GRID)
    first = side // 2
    grid = frame.depth[first::side, first::side]
    usable = grid > 0
    if frame.mask is None:
        usable &= _is_smooth(grid) & _in_the_middle(grid)
    else:
        usable &= frame.mask[first::side, first::side]
    rows, columns = np.nonzero(usable)
    return frame.positions_in_camera(first + side * rows, first + side * columns)


def _is_smooth(grid: Float32) -> Mask:
    """Return where the depth, (h, w), varies little between neighbouring grid points."""
    measured = np.where(grid > 0, grid, np.float32(np.inf))
    nearest = ndimage.minimum_filter(measured, 3, mode="nearest")
    farthest = ndimage.maximum_filter(grid, 3, mode="nearest")
    return farthest - nearest < SMOOTH_STEP * grid


def _blockwise(image: NDArray, side: int, choose: np.ufunc) -> NDArray:
    """Return the minimum or maximum of each square of ``side`` pixels.

    ``choose`` is ``np.minimum`` or ``np.maximum``. Rows come first: that is faster than a reduction
    over two axes.
    """
    height, width = (size // side * side for size in image.shape)
    of_rows = image[0:height:side, :width]
    for row in range(1, side):
        of_rows = choose(of_rows, image[row:height:side, :width])
    found = of_rows[:, ::side]
    for column in range(1, side):
        found = choose(found, of_rows[:, column::side])
    return found


def _in_the_middle(grid: Float32) -> Mask:
    """Return the centre of a depth image, (h, w), without the far background."""
    height, width = grid.shape
    middle = grid[height // 3 : height - height // 3, width // 3 : width - width // 3]
    measured = middle[middle > 0]
    if len(measured) < SMALLEST_MIDDLE:
        return np.ones(grid.shape, bool)
    inner = np.zeros(grid.shape, bool)
    inner[height // 6 : height - height // 6, width // 6 : width - width // 6] = True
    return inner & (grid < FAR_BEHIND * np.median(measured))


def _half_off_the_plane(
    points: Float,
    frame: Frame,
    noise: Noise,
    rng: np.random.Generator,
) -> tuple[Float, Mask]:
    """Draw points, half of them above the largest plane if possible."""
    # The plane is searched in the camera frame, because the pose may be wrong.
    unposed = Frame(frame.depth, frame.intrinsics, pixel_centre=0.5)
    plane = find_plane(sample(unposed, unposed.depth > 0, noise), rng)
    if plane is None or not len(points):
        points = _some(points, AGREEMENT_POINTS, rng)
        return points, np.ones(len(points), bool)

    z = points[:, 2]
    above = (
        plane.height(points) > ABOVE_PLANE * z + NOISE_TOLERANCE * noise.at(z) * z**2
    )
    half = AGREEMENT_POINTS // 2
    on_it = _some(points[~above], max(half, AGREEMENT_POINTS - int(above.sum())), rng)
    off_it = _some(points[above], AGREEMENT_POINTS - min(half, len(on_it)), rng)
    chosen = np.concatenate([off_it, on_it[: AGREEMENT_POINTS - len(off_it)]])
    return chosen, np.arange(len(chosen)) < len(off_it)


def _some(points: Float, most: int, rng: np.random.Generator) -> Float:
    """Draw at most this many of the points at random."""
    if len(points) <= most:
        return points
    return points[rng.permutation(len(points))[:most]]
