"""Clean a depth image: a small plane for every pixel of the object, fitted to its neighbourhood on the same surface.

This is the sloped facet model of Haralick and Watson (A facet model for image data, Computer Graphics and Image
Processing 15, 1981), on inverse depth, where planes of the world are planes of the image: 1/z = n . (x, y, 1) for the
ray (x, y, 1) of a pixel, which says that n . P = 1 for every point P of the plane. Noise is averaged, holes are filled,
normals come with it, and edges stay sharp because a pixel may take the plane of a window beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from nextview.sensing.noise import ROWS, Noise, estimate_noise

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

CLOSE_ENOUGH = 1.5
"""Deviation of a window's pixels from its plane up to which they are taken for noise, in its standard deviations."""
STEEPEST_ERROR = 0.1
"""Error of the slope (tangent) that noise may leave: six degrees of the normal."""
FINEST = 2e-4
"""Relative noise of depth that even the best frame is taken to have."""
STEEPEST = np.tan(np.radians(85.0))
"""Slope towards the ray beyond which neighbouring pixels are taken for two surfaces."""


@dataclass(frozen=True)
class Facets:
    """Planes of the pixels of an object, in the camera's frame.

    Attributes:
        planes: n of each, with n . P = 1 for points P of the plane, (N, 3) float64, 1/metres.
        rays: (x, y, 1) through each pixel's centre, (N, 3) float64.
        rows: of each in the frame, (N,) int64.
        columns: of each in the frame, (N,) int64.
        pitch: distance between neighbouring rays along x and y at depth 1, (2,) float64.
    """

    planes: Float
    rays: Float
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    pitch: Float

    @property
    def points(self) -> Float:
        """Where the rays meet the planes, camera frame, (N, 3) float64, metres."""
        return self.rays / np.einsum("ni,ni->n", self.planes, self.rays)[:, None]


def drop_flying(depth: NDArray[np.float32], usable: Mask, noise: float, pitch: float) -> Mask:
    """The usable pixels without those that hang in the air between two surfaces.

    A pixel stays if at least three of its eight neighbours are on its surface: as near in depth as noise and a steep
    slope allow.

    Args:
        depth: (H, W), metres, all that was measured.
        usable: pixels of the object, (H, W) bool.
        noise: of inverse depth, 1/metres.
        pitch: angle between neighbouring pixels, radians.
    """
    h, w = depth.shape
    padded = np.pad(depth, 1)
    tolerance = 5 * noise * depth**2 + STEEPEST * pitch * depth
    friends = np.zeros((h, w), np.uint8)
    for row in range(3):
        for column in range(3):
            friends += np.abs(padded[row : row + h, column : column + w] - depth) < tolerance
    return usable & (friends >= 4)  # a pixel is its own friend


def fit_facets(
    depth: NDArray[np.float32],
    mask: Mask,
    intrinsics: Float,
    corner: tuple[int, int] = (0, 0),
    denoise: bool = True,
    coarse: int = 1,
    frame_noise: Noise | None = None,
) -> Facets:
    """The facets of an object in a depth image.

    Args:
        depth: (H, W) float32, metres, 0 = nothing: a frame or a part of it.
        mask: the object's pixels, (H, W) bool. With ``denoise`` holes in it are filled.
        intrinsics: of the frame, pixels, first pixel's centre at 0.5.
        corner: row and column of the part's first pixel in the frame.
        denoise: smooth, fill holes and drop flying pixels. If not, every pixel keeps its depth.
        coarse: one facet for a square of so many pixels.
        frame_noise: that of the whole frame, because a thin object has too few pixels in a row to tell.

    Returns:
        The facets; none where there are too few pixels to fit one.
    """
    focal = intrinsics[[0, 1], [0, 1]]
    h, w = depth.shape
    usable = mask & (depth > 0)
    noise, grain, wanted = 0.0, 1, usable
    if denoise:
        if usable.any():
            noise, grain = _noise(depth, usable, frame_noise)
        usable = drop_flying(depth, usable, noise, 1 / focal.mean())
        wanted = _without_holes(usable, mask, depth > 0)
    if not usable.any():
        none = np.zeros(0, np.int64)
        return Facets(np.zeros((0, 3)), np.zeros((0, 3)), none, none, coarse / focal)
    x = (corner[1] + np.arange(w) + 0.5 - intrinsics[0, 2]) / focal[0]
    y = (corner[0] + np.arange(h) + 0.5 - intrinsics[1, 2]) / focal[1]
    inverse = np.where(usable, 1 / np.where(usable, depth, 1), 0).astype(np.float64)
    weight = usable.astype(np.float64)
    middle = np.array([x.mean(), y.mean(), inverse.sum() / weight.sum()])
    sums = _moments(weight, x - middle[0], y - middle[1], np.where(usable, inverse - middle[2], 0))
    pitch = coarse / focal
    if coarse > 1:
        sums, wanted = _blocks(sums, coarse), _blocks(wanted[None].astype(np.float64), coarse)[0] >= coarse**2 / 2
        x, y = ((v[0] + coarse * np.arange(-(-len(v) // coarse)) * (v[1] - v[0])) for v in (x, y))
        x, y = x + (coarse - 1) / 2 / focal[0], y + (coarse - 1) / 2 / focal[1]
    rows, columns = np.divmod(np.flatnonzero(wanted), wanted.shape[1])
    here = np.stack([x[columns] - middle[0], y[rows] - middle[1]], 1)
    count = sums[0, rows, columns]
    own = np.where(count > 0, sums[6, rows, columns] / np.maximum(count, 1e-9), np.nan)
    if denoise:
        noise = max(noise, FINEST * float(middle[2]))
        planes = _choose(
            sums, own, rows, columns, here, noise, _radii(noise, float(middle[2]), pitch, max(1, grain / coarse))
        )
    else:
        planes = _fit(sums, 1, 1)[rows * sums.shape[2] + columns, :3]
        planes[:, 2] = own - (planes[:, :2] * here).sum(1)
    # Back from coordinates about the middle:
    planes[:, 2] += middle[2] - planes[:, 0] * middle[0] - planes[:, 1] * middle[1]
    rays = np.stack([x[columns], y[rows], np.ones(len(rows))], 1)
    good = np.asarray(np.isfinite(planes).all(1))
    good[good] = (planes[good] * rays[good]).sum(1) > 0.2 * middle[2]
    half = (coarse - 1) // 2
    rows, columns = corner[0] + coarse * rows + half, corner[1] + coarse * columns + half
    return Facets(planes[good], rays[good], rows[good], columns[good], pitch)


def _noise(depth: NDArray[np.float32], usable: Mask, frame_noise: Noise | None) -> tuple[float, int]:
    """Standard deviation of inverse depth and grain of an object's pixels: no more than those of the whole frame."""
    few = slice(None, None, max(1, len(depth) // ROWS))
    own = estimate_noise(depth[few], usable[few])
    middle = float(np.median(depth[usable]))
    if frame_noise is None or own.at(middle) < frame_noise.at(middle):
        return float(own.at(middle)), own.grain
    return float(frame_noise.at(middle)), frame_noise.grain


def _without_holes(usable: Mask, mask: Mask, measured: Mask) -> Mask:
    """The usable pixels and what was not measured, or dropped, among them."""
    near = ndimage.maximum_filter(usable, 5, mode="constant")
    closed = ~ndimage.maximum_filter(~near, 5, mode="constant", cval=0)
    return usable | (closed & (mask | ~measured))


def _moments(weight: Float, x: Float, y: Float, q: Float) -> Float:
    """What a fit of planes sums over pixels, (10, H, W): 1, x, y, xx, xy, yy, q, xq, yq, qq."""
    x, y = x[None, :], y[:, None]
    wx, wy = weight * x, weight * y
    return np.stack([weight, wx, wy, wx * x, wx * y, wy * y, q, x * q, y * q, q * q])


def _blocks(images: Float, side: int) -> Float:
    """Sums over squares of pixels; those at the end may be cut off by the image."""
    h, w = images.shape[1:]
    padded = np.pad(images, ((0, 0), (0, -h % side), (0, -w % side)))
    rows = np.add.reduce([padded[:, i::side] for i in range(side)])
    return np.add.reduce([rows[:, :, i::side] for i in range(side)])


def _radii(noise: float, inverse: float, pitch: Float, grain: float) -> tuple[int, int]:
    """Windows that grow with the noise: half sides of the small one, which leaves slopes as good as they should be,
    and of one twice as large, pixels.

    The slope of a plane fitted to k x k pixels that err for themselves has the standard deviation sigma sqrt(12) / k^2
    per pixel; where grains of g x g pixels err together it is g times that.
    """
    per_pixel = noise / inverse / pitch.mean()  # of depth, in units of the distance between pixels on the surface
    side = np.sqrt(np.sqrt(12) * grain * per_pixel / STEEPEST_ERROR)
    small = int(np.clip(np.ceil((side - 1) / 2), 1, 8))
    return 2 * small, small


def _fit(sums: Float, radius: int, enough: float) -> Float:
    """Planes of windows of (2 radius + 1)^2 cells around every cell.

    Returns:
        For each cell in turn the plane's slopes along x and y, its value at x = y = 0, and the variance of the
        residuals, infinite for windows with fewer than ``enough`` pixels: (H W, 4).
    """
    side = 2 * radius + 1
    means = np.stack([ndimage.uniform_filter(image, side, mode="constant") for image in sums])
    n = means[0] * side**2
    x, y, xx, xy, yy, q, xq, yq, qq = means[1:] / np.maximum(means[0], 1e-9)
    xx -= x * x
    xy -= x * y
    yy -= y * y
    xq -= x * q
    yq -= y * q
    qq -= q * q
    ridge = 1e-5 * max(float(xx.max()), float(yy.max())) + 1e-30  # pixels in one line have no plane: a level one
    xx += ridge
    yy += ridge
    determinant = xx * yy - xy * xy
    along_x = (xq * yy - yq * xy) / determinant
    along_y = (yq * xx - xq * xy) / determinant
    variance = np.maximum(qq - along_x * xq - along_y * yq, 0) * n / np.maximum(n - 3, 1)
    variance[n < enough] = np.inf
    return np.stack([along_x, along_y, q - along_x * x - along_y * y, variance], -1).reshape(-1, 4)


def _choose(
    sums: Float,
    own: Float,
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    here: Float,
    noise: float,
    radii: tuple[int, int],
) -> Float:
    """For every wanted cell the plane of the largest window that shows one surface, which is the cell's own.

    First the windows around the cell, the larger one before the smaller; then small ones that have it at their rim.
    Windows lie so densely that one is centred within half the small radius of every cell.

    Args:
        sums: moments, (10, H, W).
        own: inverse depth of the wanted cells, (N,), NaN in holes.
        rows: of these, (N,).
        columns: of these, (N,).
        here: their x and y, (N, 2).
        noise: of inverse depth.
        radii: of the windows, the larger first.

    Returns:
        (N, 3); NaN where no window has enough pixels.
    """
    step = max(1, radii[1] // 2)
    if step > 1:
        sums = _blocks(sums, step)
    h, w = sums.shape[1:]
    rows, columns = rows // step, columns // step
    found = np.full((len(rows), 3), np.nan)
    left = np.arange(len(rows))
    for radius in radii:
        windows = _fit(sums, max(1, radius // step), 4 if radius == radii[-1] else 0.3 * (2 * radius + 1) ** 2)
        guess = windows[rows[left] * w + columns[left]]
        good = guess[:, 3] < (CLOSE_ENOUGH * noise) ** 2
        good &= ~(np.abs(_deviation(guess, here[left], own[left])) > 3 * noise)  # NaN: a hole takes what there is
        found[left[good]] = guess[good, :3]
        left = left[~good]
    rows, columns, here, own = rows[left], columns[left], here[left], own[left]
    best, cost = np.full((len(left), 3), np.nan), np.full(len(left), np.inf)
    reach = max(1, radii[-1] // step)
    for dy in (-reach, 0, reach):
        row = np.clip(rows + dy, 0, h - 1) * w
        for dx in (-reach, 0, reach):
            guess = windows[row + np.clip(columns + dx, 0, w - 1)]
            its_cost = guess[:, 3] + np.nan_to_num(_deviation(guess, here, own)) ** 2 / 4
            better = its_cost < cost
            best[better], cost[better] = guess[better, :3], its_cost[better]
    found[left] = best
    return found


def _deviation(planes: Float, here: Float, own: Float) -> Float:
    """How far planes (N, 3 or more) at x and y (N, 2) are from the cells' own inverse depth (N,), NaN in holes."""
    return planes[:, 0] * here[:, 0] + planes[:, 1] * here[:, 1] + planes[:, 2] - own
