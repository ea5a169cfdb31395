"""Whether posed depth frames agree about one rigid scene, and by which change of their poses they would.

What one frame shows is looked up in the pictures of all others. A surface is confirmed where another frame measures
the same depth, and contradicted where another frame looks through it. What is hidden, outside of the picture or not
measured says nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from nextview.sensing.facets import ROWS, Noise, estimate_noise
from nextview.sensing.frame import Frame
from nextview.sensing.segmentation import find_plane, sample

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

BLOCKS_ACROSS = 160  # columns of the coarse pictures in which surfaces are looked up
SURFACE_POINTS = 200  # of each frame, that are looked up in the others
DEPTH_TOLERANCE = 0.02  # part of the depth up to which two frames agree, beside the noise of both
NOISE_TOLERANCE = 3.0  # standard deviations of the noise
SMOOTH_STEP = 0.05  # part of the depth by which it may vary around a point that is looked up: no edges
ABOVE_PLANE = 0.012  # height over the largest plane, as a part of the depth, from which a point is not on it
FAR_BEHIND = 1.5  # times the depth in the middle of the picture: what lies farther is background
SMALLEST_MIDDLE = 20  # blocks in the middle of the picture that tell its depth


@dataclass(frozen=True)
class SurfaceView:
    """A frame as it is compared with others.

    Attributes:
        intrinsics: pinhole matrix of the coarse picture, (3, 3).
        nearest: least depth around each block, (h, w), metres; infinite where nothing was measured.
        farthest: greatest depth around each block, (h, w), metres; 0 where nothing was measured.
        complete: whether something was measured in each block around each block, (h, w).
        object_near: blocks on the object or beside it, (h, w); None without a mask.
        points: on the surfaces, (N, 3), camera frame, metres.
        tolerance: difference in depth up to which another frame confirms each point, (N,), metres.
    """

    intrinsics: Float
    nearest: Float
    farthest: Float
    complete: Mask
    object_near: Mask | None
    points: Float
    tolerance: Float


@dataclass(frozen=True)
class Agreement:
    """How often points of one frame, by row, are confirmed and contradicted by another one, by column.

    Attributes:
        confirmed: number of points, (N, N).
        contradicted: number of points, (N, N).
    """

    confirmed: Float
    contradicted: Float

    @property
    def judged(self) -> float:
        """How many points could be judged in all."""
        return float(self.confirmed.sum() + self.contradicted.sum())

    @property
    def share(self) -> float:
        """Share of the judged points that are confirmed; 1 if none could be judged."""
        return 1.0 if self.judged == 0 else float(self.confirmed.sum()) / self.judged

    def among(self, pairs: Mask) -> "Agreement":
        """That of some pairs of frames, (N, N)."""
        return Agreement(np.where(pairs, self.confirmed, 0), np.where(pairs, self.contradicted, 0))

    def of_each(self) -> tuple[Float, Float]:
        """The confirmed share and the number of judged points of each frame, both ways, (N,) each."""
        confirmed = self.confirmed.sum(0) + self.confirmed.sum(1)
        judged = confirmed + self.contradicted.sum(0) + self.contradicted.sum(1)
        share = np.where(judged > 0, confirmed / np.maximum(judged, 1), 1.0)
        return share, judged


def surface_view(frame: Frame, rng: np.random.Generator) -> SurfaceView:
    """Prepare a frame for comparison.

    Points are taken from the object's mask. Without one they are taken from the middle of the picture: one half
    from the largest plane, the other half from what stands out of it, which tells a turn about the plane's normal.

    Args:
        frame: its pose is not used.
        rng: draws the points.
    """
    step = max(1, frame.shape[1] // BLOCKS_ACROSS)
    measured = np.where(frame.depth > 0, frame.depth, np.float32(np.inf))
    block_nearest = _blockwise(measured, step, np.min)
    block_farthest = _blockwise(frame.depth, step, np.max)

    nearest = ndimage.minimum_filter(block_nearest, 3, mode="nearest")
    farthest = ndimage.maximum_filter(block_farthest, 3, mode="nearest")
    complete = ndimage.minimum_filter(block_farthest > 0, 3, mode="constant")
    object_near = None
    if frame.mask is not None:
        object_near = ndimage.maximum_filter(_blockwise(frame.mask, step, np.max), 3)

    few_rows = slice(None, None, max(1, frame.shape[0] // ROWS))
    noise = estimate_noise(frame.depth[few_rows], frame.depth[few_rows] > 0)
    intrinsics = frame.intrinsics.copy()
    intrinsics[:2] /= step

    centre = step // 2
    height, width = block_farthest.shape
    grid = frame.depth[centre::step, centre::step][:height, :width]
    usable = grid > 0
    if frame.mask is not None:
        usable &= frame.mask[centre::step, centre::step][:height, :width]
    else:
        usable &= (farthest - nearest < SMOOTH_STEP * grid) & _in_the_middle(grid)
    rows, columns = np.nonzero(usable)
    points = frame.positions_in_camera(centre + step * rows, centre + step * columns)
    if frame.mask is None:
        points = _half_off_the_plane(points, frame, noise, rng)
    else:
        points = _some(points, SURFACE_POINTS, rng)
    depth = points[:, 2]
    tolerance = DEPTH_TOLERANCE * depth + NOISE_TOLERANCE * noise.at(depth) * depth**2
    return SurfaceView(intrinsics, nearest, farthest, complete, object_near, points, tolerance)


def compare(views: Sequence[SurfaceView], poses: Float, scale: float = 1.0) -> Agreement:
    """Look up the points of every frame in all others.

    Args:
        views: N frames.
        poses: of their cameras, camera-to-world, (N, 4, 4), metres.
        scale: by which all depths are multiplied.
    """
    count = len(views)
    owner = np.repeat(np.arange(count), [len(view.points) for view in views])
    tolerance = np.concatenate([view.tolerance for view in views])
    world = np.concatenate(
        [scale * v.points @ pose[:3, :3].T + pose[:3, 3] for v, pose in zip(views, poses, strict=True)]
    )

    confirmed = np.zeros((count, count))
    contradicted = np.zeros((count, count))
    for j, (view, pose) in enumerate(zip(views, poses, strict=True)):
        seen_from = (world - pose[:3, 3]) @ pose[:3, :3] / scale
        which, agrees, looks_through = _looked_up(view, seen_from, tolerance)
        other = owner[which] != j
        confirmed[:, j] = np.bincount(owner[which], agrees & other, minlength=count)
        contradicted[:, j] = np.bincount(owner[which], looks_through & other, minlength=count)
    return Agreement(confirmed, contradicted)


def _looked_up(view: SurfaceView, points: Float, tolerance: Float) -> tuple[NDArray[np.int64], Mask, Mask]:
    """Which points, (P, 3), lie in a picture; which of these it confirms, and which it contradicts."""
    height, width = view.nearest.shape
    k = view.intrinsics
    ahead = points[:, 2] > 1e-6
    z = np.where(ahead, points[:, 2], 1.0)
    column = np.floor(np.clip(points[:, 0] / z * k[0, 0] + k[0, 2], -1, width)).astype(np.int64)
    row = np.floor(np.clip(points[:, 1] / z * k[1, 1] + k[1, 2], -1, height)).astype(np.int64)
    # At the border a small error of the pose leads out of the picture.
    inside = ahead & (row >= 1) & (row < height - 1) & (column >= 1) & (column < width - 1)
    which = np.flatnonzero(inside)
    row, column, z, limit = row[which], column[which], z[which], tolerance[which]

    nearest = view.nearest[row, column]
    farthest = view.farthest[row, column]
    agrees = (z > nearest - limit) & (z < farthest + limit)
    looks_through = (z <= nearest - limit) & view.complete[row, column]
    if view.object_near is not None:
        on_object = view.object_near[row, column]
        hidden = nearest < z - limit
        # Where nothing nearer hides it, a point of the object has to be in the mask, measured or not.
        looks_through = np.where(on_object, looks_through, ~hidden)
        agrees &= on_object
    return which, agrees, looks_through


def _blockwise(image: NDArray, step: int, reduce: np.ufunc | object) -> NDArray:
    """Minimum or maximum of each square of ``step`` pixels; rows and columns that fill none are left out."""
    height, width = (size // step * step for size in image.shape)
    squares = image[:height, :width].reshape(height // step, step, width // step, step)
    return reduce(squares, axis=(1, 3))  # type: ignore[operator]


def _in_the_middle(grid: NDArray[np.float32]) -> Mask:
    """What the camera looks at: the middle of a picture, (h, w), without what lies far behind it."""
    height, width = grid.shape
    middle = grid[height // 3 : height - height // 3, width // 3 : width - width // 3]
    measured = middle[middle > 0]
    if len(measured) < SMALLEST_MIDDLE:
        return np.ones(grid.shape, bool)
    inner = np.zeros(grid.shape, bool)
    inner[height // 6 : height - height // 6, width // 6 : width - width // 6] = True
    return inner & (grid < FAR_BEHIND * np.median(measured))


def _half_off_the_plane(points: Float, frame: Frame, noise: Noise, rng: np.random.Generator) -> Float:
    """Some points, one half on the largest plane of a frame and the other half above it, if there are so many."""
    # The plane is searched in the camera's frame: the pose may be wrong.
    unposed = Frame(frame.depth, frame.intrinsics, pixel_centre=0.5)
    plane = find_plane(sample(unposed, unposed.depth > 0, noise), rng)
    if plane is None or not len(points):
        return _some(points, SURFACE_POINTS, rng)
    z = points[:, 2]
    above = plane.height(points) > ABOVE_PLANE * z + NOISE_TOLERANCE * noise.at(z) * z**2
    half = SURFACE_POINTS // 2
    on_it = _some(points[~above], max(half, SURFACE_POINTS - int(above.sum())), rng)
    off_it = _some(points[above], SURFACE_POINTS - min(half, len(on_it)), rng)
    return np.concatenate([off_it, on_it[: SURFACE_POINTS - len(off_it)]])


def _some(points: Float, most: int, rng: np.random.Generator) -> Float:
    """At most so many of the points, drawn at random."""
    if len(points) <= most:
        return points
    return points[rng.permutation(len(points))[:most]]
