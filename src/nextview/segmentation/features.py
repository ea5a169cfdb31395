"""What the network of the segmentation is given: a small picture of a frame's geometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from nextview.types import Float, Float32, Mask

LONG_SIDE = 213  # pixels of the longer side of the network's picture, about
SIDE_MULTIPLE = 16  # its sides are padded to multiples of this
# pixels of a block whose depths differ by less, relatively, are averaged
NEAR_IN_DEPTH = 0.015
PLANES = 4  # largest planes of a frame, input of the network
# along each side of the picture, a plane through its surface is tried
PLANE_TRIALS = 12
PLANE_SAMPLES = 40  # along each side, pixels that a plane is compared with
PLANE_TOLERANCE = 0.012  # of the depth, within which a pixel lies on a plane
HEIGHT_SCALE = 30.0  # heights of a thirtieth of the distance differ clearly from 0
PICTURE_CHANNELS = 15  # of the picture that the network gets
# part of a direction that lies in the picture, from which on it tells how the picture is turned
LEAST_UPRIGHT = 0.3


@dataclass(frozen=True, eq=False)
class SmallPicture:
    """A frame at the resolution of the network.

    Attributes:
        depth: (h, w) float32, metres; 0 where nothing was measured.
        rays: slopes x/z of its columns, (w,), and y/z of its rows, (h,).
        factor: rows and columns of the frame in one of its own.
    """

    depth: Float32
    rays: tuple[Float32, Float32]
    factor: int

    @property
    def points(self) -> Float32:
        """Positions of its pixels in the camera's axes, (h, w, 3) float32, metres."""
        x, y = self.rays
        return np.stack(
            [x[None, :] * self.depth, y[:, None] * self.depth, self.depth],
            -1,
        ).astype(np.float32)


def quarter_turns(up: Float | None) -> int:
    """By how many quarters, counter-clockwise, a picture is turned so that up is up in it.

    Args:
        up: direction against gravity in the camera's axes, (3,); None where it is not known.
    """
    if up is None or np.hypot(up[0], up[1]) < LEAST_UPRIGHT:
        return 0
    return round(float(np.arctan2(up[0], -up[1])) / (np.pi / 2)) % 4


def turned(
    picture: SmallPicture,
    up: Float | None,
    quarters: int,
) -> tuple[SmallPicture, Float | None]:
    """Turn a picture counter-clockwise, as if its camera were turned clockwise.

    Args:
        picture: the picture.
        up: direction against gravity in the camera's axes, (3,); None where it is not known.
        quarters: of a whole turn.

    Returns:
        The picture and the direction in its axes.
    """
    depth = picture.depth
    x, y = picture.rays
    for _ in range(quarters):
        depth = np.rot90(depth)
        x, y = y, -x[::-1]
        up = None if up is None else np.array([up[1], -up[0], up[2]])
    return SmallPicture(np.ascontiguousarray(depth), (x, y), picture.factor), up


def shrink(depth: Float32, rays: tuple[Float32, Float32]) -> SmallPicture:
    """Make a frame small: of each block of pixels, the mean of those near the median.

    Args:
        depth: (H, W), metres; 0 where nothing was measured.
        rays: slopes x/z of its columns, (W,), and y/z of its rows, (H,).
    """
    factor = max(1, round(max(depth.shape) / LONG_SIDE))
    height = -(-depth.shape[0] // factor)
    width = -(-depth.shape[1] // factor)
    down = height * factor - depth.shape[0]
    right = width * factor - depth.shape[1]
    blocks = np.pad(depth, ((0, down), (0, right)))
    blocks = blocks.reshape(height, factor, width, factor).swapaxes(1, 2)
    blocks = blocks.reshape(height, width, factor**2)

    ordered = np.sort(np.where(blocks > 0, blocks, np.float32(np.inf)), axis=-1)
    count = (blocks > 0).sum(-1)
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[..., None] // 2, -1)
    known = np.isfinite(middle)
    middle = np.where(known, middle, 0)
    near = (np.abs(blocks - middle) < NEAR_IN_DEPTH * middle) & (blocks > 0)
    small = (blocks * near).sum(-1) / np.maximum(near.sum(-1), 1)
    small = np.where(4 * count >= factor**2, small, 0)  # a few pixels alone are flying
    return SmallPicture(
        small.astype(np.float32),
        (_block_means(rays[0], factor), _block_means(rays[1], factor)),
        factor,
    )


def _block_means(values: Float32, factor: int) -> Float32:
    """Slopes in the middles of blocks of pixels, also of a last one that is not full."""
    if len(values) == 1:
        return values.astype(np.float32)
    at = np.arange(-(-len(values) // factor)) * factor + (factor - 1) / 2
    step = (values[-1] - values[0]) / (len(values) - 1)
    return (values[0] + at * step).astype(np.float32)


def features(picture: SmallPicture, up: Float | None) -> Float32:
    """Compute the input of the network.

    All lengths are divided by the median depth, so that a table before an arm and furniture in a
    room look alike.

    Args:
        picture: the small picture.
        up: direction against gravity in the camera's axes, (3,); None where it is not known.

    Returns:
        (PICTURE_CHANNELS, h, w) float32, 0 where nothing was measured.
    """
    depth = picture.depth
    valid = depth > 0
    found = np.zeros((PICTURE_CHANNELS, *depth.shape), np.float32)
    if not valid.any():
        return found
    scale = float(np.median(depth[valid]))
    points = picture.points
    normals = surface_normals(picture)
    middle = np.median(points[valid], axis=0)

    found[0] = 1
    found[1:4] = ((points - middle) / scale).transpose(2, 0, 1)
    found[4:7] = normals.transpose(2, 0, 1)
    for row, (normal, offset) in enumerate(largest_planes(points, normals, valid)):
        heights = points @ normal + offset
        found[7 + row] = np.tanh(heights / scale * HEIGHT_SCALE)
    if up is not None:
        upwards = np.asarray(up, np.float32)
        found[11] = normals @ upwards
        found[12] = (points - middle) @ upwards / scale
        found[13] = 1
    found[14] = np.log(scale)
    return found * valid


def surface_normals(picture: SmallPicture) -> Float32:
    """Return the normals of the surface, towards the camera, (h, w, 3) float32; 0 if not known.

    They come from slopes of the inverse depth on the side where it changes less, so edges stay.
    """
    valid = picture.depth > 0
    weight = ndimage.uniform_filter(valid.astype(np.float32), 3, mode="constant")
    inverse = np.where(valid, 1 / np.where(valid, picture.depth, 1), 0).astype(
        np.float32
    )
    smooth = ndimage.uniform_filter(inverse, 3, mode="constant") / np.maximum(
        weight, 1e-6
    )
    # no mean across an edge
    q = np.where(np.abs(smooth - inverse) < NEAR_IN_DEPTH * inverse, smooth, inverse)
    x, y = picture.rays
    step_x = float(np.mean(np.diff(x))) if len(x) > 1 else 1.0
    step_y = float(np.mean(np.diff(y))) if len(y) > 1 else 1.0
    a = _slope(q, valid) / step_x
    b = _slope(q.T, valid.T).T / step_y
    c = q - a * x - b * y[:, None]
    normals = np.stack([a, b, c], -1)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.where(valid[..., None], -normals / np.maximum(length, 1e-9), 0).astype(
        np.float32
    )


def _slope(q: Float32, valid: Mask) -> Float32:
    """Change of q a column over two columns, on the side where it is smaller, (h, w)."""
    if q.shape[1] < 3:
        return np.zeros_like(q)
    both = valid[:, 2:] & valid[:, :-2]
    difference = np.where(both, (q[:, 2:] - q[:, :-2]) / 2, np.float32(np.inf))
    nothing = np.full((len(q), 2), np.float32(np.inf))
    forth = np.hstack([difference, nothing])
    back = np.hstack([nothing, difference])
    smaller = np.where(np.abs(back) < np.abs(forth), back, forth)
    return np.where(np.isfinite(smaller), smaller, np.float32(0))


def largest_planes(
    points: Float32, normals: Float32, valid: Mask
) -> list[tuple[Float, float]]:
    """Find the planes that hold most pixels, the largest first.

    Each is tried through a pixel, along the normal there, and fitted to the pixels that it holds.

    Args:
        points: positions, (h, w, 3), metres, camera axes.
        normals: of the surface there, (h, w, 3).
        valid: pixels with depth, (h, w) bool.

    Returns:
        Up to PLANES pairs of a unit normal towards the camera, (3,), and an offset, metres: a point
        has the height ``normal @ point + offset``.
    """
    samples = _spread(points, valid, PLANE_SAMPLES)
    seeds = _spread(points, valid, PLANE_TRIALS)
    directions = _spread(normals, valid, PLANE_TRIALS)
    found: list[tuple[Float, float]] = []

    while len(found) < PLANES and len(samples) >= 3 and len(seeds):
        offsets = -(directions * seeds).sum(1)
        apart = np.abs(samples @ directions.T + offsets)
        held = (apart < PLANE_TOLERANCE * samples[:, 2:]).sum(0)
        best = int(held.argmax())

        plane = directions[best].astype(float), float(offsets[best])
        for _ in range(3):
            near = (
                np.abs(samples @ plane[0] + plane[1]) < PLANE_TOLERANCE * samples[:, 2]
            )
            if np.count_nonzero(near) < 3:
                break
            plane = _fitted(samples[near])
        found.append(plane)

        samples = samples[~_on(samples, plane)]
        left = ~_on(seeds, plane)
        seeds = seeds[left]
        directions = directions[left]
    return found


def _on(points: Float32, plane: tuple[Float, float]) -> Mask:
    """Which points, (N, 3), lie on a plane."""
    return np.abs(points @ plane[0] + plane[1]) < 1.5 * PLANE_TOLERANCE * points[:, 2]


def _fitted(points: Float32) -> tuple[Float, float]:
    """The plane through points, (N, 3): its normal towards the camera, and its offset."""
    middle = points.mean(0, dtype=float)
    normal = np.linalg.eigh((points - middle).T @ (points - middle))[1][:, 0]
    if normal @ middle > 0:
        normal = -normal
    return normal, float(-normal @ middle)


def _spread(values: Float32, valid: Mask, count: int) -> Float32:
    """Values of valid pixels on an even grid of so many a side, (N, ...)."""
    rows = np.unique(np.linspace(0, valid.shape[0] - 1, count).astype(int))
    columns = np.unique(np.linspace(0, valid.shape[1] - 1, count).astype(int))
    grid = np.ix_(rows, columns)
    return values[grid][valid[grid]]
