"""Fit a small plane to every pixel of the object.

This is the sloped facet model of Haralick and Watson (A facet model for image data, Computer
Graphics and Image Processing 15, 1981), applied to inverse depth, where planes in the world are
planes in the image: 1/z = n . (x, y, 1) for the ray (x, y, 1) of a pixel, so n . P = 1 for every
point P of the plane. The fit averages noise, fills holes and yields normals. Edges stay sharp
because a pixel may use the plane of a neighbouring window.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from nextview.geometry.pinhole import PinholeCamera
from nextview.sensing.noise import LEAST_NOISE, ROWS_MEASURED, Noise, estimate_noise
from nextview.types import Float, Float32, Floats, Index, Mask

SIZE = 224  # side of the observation images, the input size of the bundled networks


@dataclass(frozen=True)
class Facets:
    """Planes of the N pixels of an object, in the camera's frame.

    Attributes:
        planes: n of each, with n . P = 1 for points P of the plane, (N, 3), 1/metres.
        rays: (x, y, 1) through the pixels' centres, (N, 3).
        rows: of the pixels, (N,).
        columns: of the pixels, (N,).
        pitch: distance between neighbouring rays along x and y at depth 1, (2,).
    """

    planes: Float
    rays: Float
    rows: Index
    columns: Index
    pitch: Float

    @cached_property
    def points(self) -> Float:
        """Points where the rays meet the planes, camera frame, (N, 3) float64, metres."""
        return self.rays / np.einsum("ni,ni->n", self.planes, self.rays)[:, None]

    def some(self, which: slice | Mask | Index) -> "Facets":
        """Return the facets of some of the pixels."""
        return Facets(
            self.planes[which],
            self.rays[which],
            self.rows[which],
            self.columns[which],
            self.pitch,
        )


def drop_flying(depth: Float32, usable: Mask, noise: float, pitch: float) -> Mask:
    """Return the usable pixels without flying pixels.

    Pixels stay if at least three of their eight neighbours are on their surface: as close in depth
    as the noise and a steep slope allow.

    Args:
        depth: (H, W) float32, metres.
        usable: pixels with a depth, (H, W) bool.
        noise: of inverse depth, 1/metres.
        pitch: angle between neighbouring pixels, radians.

    Returns:
        The remaining pixels, (H, W) bool.
    """
    steep = np.tan(np.radians(85.0))  # neighbours beyond belong to two surfaces
    tolerance = 5 * noise * depth**2 + steep * pitch * depth
    return usable & (count_beside(depth, tolerance) >= 3)


def count_beside(picture: Float32, limit: Floats) -> NDArray[np.uint8]:
    """Count the neighbours of each pixel that differ from it by less than its limit.

    Args:
        picture: (H, W) float32.
        limit: of each pixel, (H, W).

    Returns:
        Counts, (H, W) uint8, 0 to 8.
    """
    height, width = picture.shape
    count = np.zeros(picture.shape, np.uint8)
    for down, right in ((0, 1), (1, -1), (1, 0), (1, 1)):
        first = np.s_[: height - down, max(0, -right) : width - max(0, right)]
        second = np.s_[down:, max(0, right) : width - max(0, -right)]
        apart = np.abs(picture[first] - picture[second])
        count[first] += apart < limit[first]
        count[second] += apart < limit[second]
    return count


def fit_facets(
    depth: Float32,
    mask: Mask,
    intrinsics: Float,
    corner: tuple[int, int] = (0, 0),
    denoise: bool = True,
    coarse: int = 1,
    frame_noise: Noise | None = None,
) -> Facets:
    """Fit facets to the pixels of an object in a depth image, or in a part of it.

    There is one facet per square of ``coarse`` pixels, except where too few pixels are valid.

    Args:
        depth: (H, W) float32, metres; of the frame or of a part of it.
        mask: pixels of the object, (H, W) bool.
        intrinsics: pinhole matrix of the whole frame, (3, 3), pixels.
        corner: row and column in the frame at which the part starts.
        denoise: whether to smooth the depth, fill holes and drop flying pixels.
        coarse: side of the squares, pixels.
        frame_noise: noise of the whole frame, for thin objects with too few pixels in a row; None
            to measure it here.

    Returns:
        The facets.
    """
    camera = PinholeCamera.of(intrinsics, depth.shape)
    focal = np.array([camera.fx, camera.fy])
    h, w = depth.shape
    usable = mask & (depth > 0)
    wanted = usable
    noise = 0.0
    grain = 1
    if denoise:
        if usable.any():
            noise, grain = _typical_noise(depth, usable, frame_noise)
        usable = drop_flying(depth, usable, noise, 1 / focal.mean())
        wanted = _without_holes(usable, mask | (depth == 0))
    if not usable.any():
        none = np.zeros(0, np.int64)
        return Facets(np.zeros((0, 3)), np.zeros((0, 3)), none, none, coarse / focal)

    # moments of the pixels, centred for their precision
    x, y = camera.slopes(corner[0] + np.arange(h), corner[1] + np.arange(w))
    inverse = np.where(usable, 1 / np.where(usable, depth, 1), 0).astype(np.float64)
    weight = usable.astype(np.float64)
    middle = np.array([x.mean(), y.mean(), inverse.sum() / weight.sum()])
    sums = _moments(
        weight,
        x - middle[0],
        y - middle[1],
        np.where(usable, inverse - middle[2], 0),
    )
    pitch = coarse / focal
    if coarse > 1:
        sums = _blocks(sums, coarse)
        wanted = _blocks(wanted[None].astype(np.float64), coarse)[0] >= coarse**2 / 2
        x, y = (_middles(slopes, coarse) for slopes in (x, y))

    # a plane of inverse depth for each square
    rows, columns = np.divmod(np.flatnonzero(wanted), wanted.shape[1])
    here = np.stack([x[columns] - middle[0], y[rows] - middle[1]], 1)
    count = sums[0, rows, columns]
    own = np.where(count > 0, sums[6, rows, columns] / np.maximum(count, 1e-9), np.nan)
    if denoise:
        noise = max(noise, LEAST_NOISE * float(middle[2]))
        radii = _radii(noise, float(middle[2]), pitch, max(1, grain / coarse))
        planes = _choose(sums, own, rows, columns, here, noise, radii)
    else:
        planes = _fit(sums, 1, 1)[rows * sums.shape[2] + columns, :3]
        planes[:, 2] = own - (planes[:, :2] * here).sum(1)

    # back from centred coordinates
    planes[:, 2] += middle[2] - planes[:, 0] * middle[0] - planes[:, 1] * middle[1]
    rays = np.stack([x[columns], y[rows], np.ones(len(rows))], 1)
    # inverse depth; NaN where there is no plane
    towards = np.einsum("ni,ni->n", planes, rays)
    good = np.isfinite(towards) & (towards > 0.2 * middle[2])
    half = (coarse - 1) // 2
    rows = corner[0] + coarse * rows + half
    columns = corner[1] + coarse * columns + half
    facets = Facets(planes, rays, rows, columns, pitch)
    return facets if good.all() else facets.some(np.flatnonzero(good))


def _without_holes(usable: Mask, fillable: Mask) -> Mask:
    """Return the usable pixels, and those between them that may be filled, (H, W) bool."""
    near = ndimage.maximum_filter(usable, 5, mode="constant")
    closed = ~ndimage.maximum_filter(~near, 5, mode="constant", cval=0)
    return usable | (closed & fillable)


def _middles(slopes: Float, side: int) -> Float:
    """Return the middles of groups of equally spaced slopes; the last group may be incomplete."""
    spacing = slopes[1] - slopes[0]
    first = np.arange(0, len(slopes), side)
    return slopes[0] + spacing * (first + (side - 1) / 2)


def _typical_noise(
    depth: Float32,
    usable: Mask,
    frame_noise: Noise | None,
) -> tuple[float, int]:
    """Return the noise at the object's median depth, and its grain."""
    few = slice(None, None, max(1, len(depth) // ROWS_MEASURED))
    typical = float(np.median(depth[usable]))
    measured = estimate_noise(depth[few], usable[few])
    if frame_noise is not None and measured.at(typical) >= frame_noise.at(typical):
        measured = frame_noise
    return float(measured.at(typical)), measured.grain


def _moments(weight: Float, x: Float, y: Float, q: Float) -> Float:
    """Return the moments for plane fits, (10, H, W): 1, x, y, xx, xy, yy, q, xq, yq, qq."""
    x = x[None, :]
    y = y[:, None]
    moments = np.empty((10, *weight.shape))
    moments[0] = weight
    moments[6] = q

    for product, one, other in (
        (1, 0, x),
        (2, 0, y),
        (3, 1, x),
        (4, 1, y),
        (5, 2, y),
        (7, 6, x),
        (8, 6, y),
    ):
        np.multiply(moments[one], other, out=moments[product])
    np.multiply(q, q, out=moments[9])

    return moments


def _blocks(images: Float, side: int) -> Float:
    """Return sums over squares of pixels; squares at the border may be incomplete."""
    for axis in (1, 2):
        every = np.moveaxis(images, axis, 0)
        sums = every[::side].copy(order="K")
        for first in range(1, side):
            more = every[first::side]
            sums[: len(more)] += more
        images = np.moveaxis(sums, 0, axis)
    return images


def _radii(noise: float, inverse: float, pitch: Float, grain: float) -> tuple[int, int]:
    """Return half sides of two windows that grow with the noise, pixels, larger first.

    The slope of a plane fitted to k x k pixels with independent errors has the standard deviation
    sigma sqrt(12) / k^2 per pixel; if errors are correlated in grains of g x g pixels, it is g
    times as large.
    """
    # noise of depth in units of the pixel spacing on the surface
    per_pixel = noise / inverse / pitch.mean()
    # noise may turn the normal by six degrees
    side = np.sqrt(np.sqrt(12) * grain * per_pixel / 0.1)
    small = int(np.clip(np.ceil((side - 1) / 2), 1, 8))
    return 2 * small, small


def _fit(sums: Float, radius: int, enough: float) -> Float:
    """Fit planes to windows around every cell, (H W, 4): slopes, value, variance.

    The last, of the residuals, is infinite for windows with fewer than ``enough`` pixels.
    """
    side = 2 * radius + 1
    means = ndimage.uniform_filter(sums, (1, side, side), mode="constant")
    n = means[0] * side**2
    x, y, xx, xy, yy, q, xq, yq, qq = means[1:] / np.maximum(means[0], 1e-9)
    for square, a, b in (
        (xx, x, x),
        (xy, x, y),
        (yy, y, y),
        (xq, x, q),
        (yq, y, q),
        (qq, q, q),
    ):
        square -= a * b
    # collinear pixels determine no plane: regularise towards zero slope
    ridge = 1e-5 * max(float(xx.max()), float(yy.max())) + 1e-30
    xx = xx + ridge
    yy = yy + ridge
    determinant = xx * yy - xy * xy
    along_x = (xq * yy - yq * xy) / determinant
    along_y = (yq * xx - xq * xy) / determinant
    variance = (
        np.maximum(qq - along_x * xq - along_y * yq, 0) * n / np.maximum(n - 3, 1)
    )
    variance[n < enough] = np.inf
    return np.stack(
        [along_x, along_y, q - along_x * x - along_y * y, variance],
        -1,
    ).reshape(-1, 4)


def _choose(
    sums: Float,
    own: Float,
    rows: Index,
    columns: Index,
    here: Float,
    noise: float,
    radii: tuple[int, int],
) -> Float:
    """Return the plane of the largest window on each cell's own surface, (N, 3), or NaN.

    Windows around the cell are tried first, the larger before the smaller; then small windows with
    the cell at their border. Windows are so dense that one is centred within half the small radius
    of every cell.

    Args:
        sums: moments, (10, H, W).
        own: inverse depth of the wanted cells, (N,), NaN in holes.
        rows: of the wanted cells, (N,).
        columns: of the wanted cells, (N,).
        here: x and y of the wanted cells, (N, 2).
        noise: of inverse depth, 1/metres.
        radii: half sides of the windows, larger first.
    """
    step = max(1, radii[1] // 2)
    if step > 1:
        sums = _blocks(sums, step)
    h, w = sums.shape[1:]
    rows = rows // step
    columns = columns // step
    found = np.full((len(rows), 3), np.nan)
    left = np.arange(len(rows))
    for radius in radii:
        windows = _fit(
            sums,
            max(1, radius // step),
            4 if radius == radii[-1] else 0.3 * (2 * radius + 1) ** 2,
        )
        guess = windows[rows[left] * w + columns[left]]
        good = guess[:, 3] < (1.5 * noise) ** 2
        # NaN: holes accept any plane
        good &= ~(np.abs(_deviation(guess, here[left], own[left])) > 3 * noise)
        found[left[good]] = guess[good, :3]
        left = left[~good]
    found[left] = _nearest_window(
        windows,
        (h, w),
        rows[left],
        columns[left],
        here[left],
        own[left],
        radii[-1] // step,
    )
    return found


def _nearest_window(
    windows: Float,
    shape: tuple[int, int],
    rows: Index,
    columns: Index,
    here: Float,
    own: Float,
    reach: int,
) -> Float:
    """Return the best-fitting plane of windows at and beside each cell, (N, 3), or NaN."""
    steps = (-max(1, reach), 0, max(1, reach))
    down = np.stack(
        [np.clip(rows + step, 0, shape[0] - 1) * shape[1] for step in steps]
    )

    right = np.stack([np.clip(columns + step, 0, shape[1] - 1) for step in steps])
    window = (down[:, None] + right).reshape(len(steps) ** 2, -1)
    guess = windows[window]
    cost = guess[..., 3] + np.nan_to_num(_deviation(guess, here, own)) ** 2 / 4
    best = cost.argmin(0)
    every = np.arange(len(rows))
    return np.where(
        np.isfinite(cost[best, every])[:, None],
        guess[best, every, :3],
        np.nan,
    )


def _deviation(planes: Float, here: Float, own: Float) -> Float:
    """Return the distance of planes from the cells' own inverse depth, (N,), or NaN."""
    return (
        planes[..., 0] * here[:, 0] + planes[..., 1] * here[:, 1] + planes[..., 2] - own
    )
