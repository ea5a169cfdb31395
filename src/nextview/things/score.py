"""How well hypotheses explain the pixels of a view.

Each hypothesis is rendered once. Where its surface is measured, a pixel gains by how likely its
depth is, against that something unknown is there. What is seen through is paid for, and so are
pixels of the same piece of the segmentation that the hypothesis does not show. What is hidden, in
the shadow of something or beyond the border of the image is not observed, and says nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from nextview.sensing.view import Grid, View
from nextview.things.library import Hypotheses, Library
from nextview.types import Float, Float32, Index, Mask

PIXEL_GAIN = 1.5  # nats, of a pixel that is measured exactly where it should be
OUTLIER = -4.0  # nats, of a pixel that is not measured where it should be
NOT_MEASURED = (
    -0.5
)  # nats, of a pixel without a measurement on a surface that faces the camera
LEFT_OVER = -1.5  # nats, of a pixel of the same piece that is not explained
SIZE_COST = 0.1  # nats, of a pixel of what has another size than it was taught in
EDGE_WEIGHT = 0.3  # of pixels on the outline, which mix two surfaces
# error of the surface of a thing: of its scan, metres, and of its pose, radii
SCAN_ERROR, POSE_ERROR = 0.0007, 0.005
FARTHEST = 4.0  # standard deviations within which a pixel may show the surface
LEAST_MARGIN = 0.005  # metres, the same at least
OWN_SHARE = 0.3  # of a piece, from which on all of it should be explained
FEWEST_OWN = 8  # pixels of a piece, from which on it should end where the thing ends
STEEPEST = 0.15  # cosine of the steepest surface that is measured
BLOCK = 5  # pixels of the grid whose errors are alike, along each side
BATCH = 100_000  # rays that are cast at once


@dataclass(frozen=True, eq=False)
class Score:
    """What one hypothesis says of one view.

    Attributes:
        cells: pixels of the grid that it explains or that are in front of it, (N,) int32.
        gain: of each, (N,) float32, nats; 0 for those in front of it.
        paid: sum of what is paid for, nats, 0 or less.
        seen: pixels of the grid in which it is measured, or seen through; those on its outline
            count less.
        through: those of them that are seen through.
        hidden: pixels in which something is in front of it.
    """

    cells: NDArray[np.int32]
    gain: Float32
    paid: float
    seen: float
    through: float
    hidden: float

    @property
    def total(self) -> float:
        """Gain of all pixels and what is paid for, nats."""
        return float(self.gain.sum()) + self.paid

    @property
    def share(self) -> float:
        """Share of the gain that it could have at most in this view."""
        return self.total / max(1.0, PIXEL_GAIN * self.seen)


def score(
    library: Library, view: View, some: Hypotheses, coarser: int = 1
) -> list[Score | None]:
    """Compare hypotheses with a view.

    Args:
        library: the things.
        view: the view.
        some: M hypotheses.
        coarser: factor of the distance between the pixels that are compared; all sums count for
            the pixels left out, too.

    Returns:
        The score of each; None if it lies outside of the image.
    """
    grid = view.grid(coarser)
    found: list[Score | None] = [None] * len(some)
    for rows, window in _windows(library, view, some, grid):
        for row, one in zip(
            rows, _scored(library, view, some[rows], grid, window), strict=True
        ):
            if one is not None and coarser > 1:
                count = coarser**2
                one = Score(
                    one.cells,
                    one.gain * count,
                    one.paid * count,
                    one.seen * count,
                    one.through * count,
                    one.hidden * count,
                )
            found[row] = one
    return found


@dataclass(frozen=True, eq=False)
class _Window:
    """Rectangles of the grid, all of one size, which may reach beyond it.

    Attributes:
        top: first row of each, (M,) int64.
        left: first column of each, (M,) int64.
        height: rows of all.
        width: columns of all.
    """

    top: Index
    left: Index
    height: int
    width: int


def _windows(
    library: Library, view: View, some: Hypotheses, grid: Grid
) -> Iterator[tuple[Index, _Window]]:
    """Return batches of hypotheses of similar size, and the windows that show them."""
    middle = (some.centres - view.camera[:3, 3]) @ view.camera[:3, :3]
    ahead = np.maximum(middle[:, 2], 1e-3)
    reach = 1.07 * library.radii[some.things] * some.sizes.max(1) / ahead
    low = np.stack([middle[:, 1] / ahead - reach, middle[:, 0] / ahead - reach], 1)
    high = low + 2 * reach[:, None]
    first = np.stack(
        [np.searchsorted(grid.y, low[:, 0]), np.searchsorted(grid.x, low[:, 1])], 1
    )
    last = np.stack(
        [np.searchsorted(grid.y, high[:, 0]), np.searchsorted(grid.x, high[:, 1])], 1
    )
    size = last - first
    seen = np.flatnonzero((middle[:, 2] > 0.05) & (size > 1).all(1))
    order = seen[np.argsort(size[seen].max(1), kind="stable")]
    while len(order):
        # from the largest on, as many as fit
        height, width = size[order[-1]]
        most = max(1, BATCH // max(1, int(size[order].max(0).prod())))
        rows = order[-most:]
        order = order[:-most]
        height, width = size[rows].max(0).tolist()
        yield (
            np.sort(rows),
            _Window(first[np.sort(rows), 0], first[np.sort(rows), 1], height, width),
        )


def _scored(
    library: Library, view: View, some: Hypotheses, grid: Grid, window: _Window
) -> Iterator[Score | None]:
    """Compare hypotheses with windows of one size."""
    lines = window.top[:, None] + np.arange(window.height)
    columns = window.left[:, None] + np.arange(window.width)
    image = grid.depth.shape
    within = ((lines >= 0) & (lines < image[0]))[:, :, None]
    within = within & ((columns >= 0) & (columns < image[1]))[:, None]
    lines = lines.clip(0, image[0] - 1)
    columns = columns.clip(0, image[1] - 1)
    at = lines[:, :, None] * image[1] + columns[:, None]

    depth, cosine = _rendered(library, view, some, grid.x[columns], grid.y[lines])
    shown = np.isfinite(depth) & within
    z = np.where(shown, depth, 1).astype(np.float32)
    inner = ndimage.binary_erosion(shown, _CROSS)
    weight = np.where(inner, np.float32(1), np.float32(EDGE_WEIGHT))

    measured = grid.depth.ravel()[at]
    radius = library.radii[some.things] * some.sizes.max(1)
    own = SCAN_ERROR**2 + (POSE_ERROR * radius) ** 2
    slope = np.sqrt(1 - cosine**2) / cosine * z * np.float32(grid.pitch / 2)
    variance = grid.sigma.ravel()[at] ** 2 + slope**2
    variance += own.astype(np.float32)[:, None, None]
    off = measured - z
    margin = np.maximum(FARTHEST * np.sqrt(variance), LEAST_MARGIN)
    likely = np.log(np.exp(-(off**2) / 2 / variance) + np.exp(OUTLIER))

    got = shown & (measured > 0)
    front = got & (off < -margin)
    behind = got & (off > margin)
    on = got & ~front & ~behind
    most = np.where(some.taught, PIXEL_GAIN, PIXEL_GAIN - SIZE_COST)
    most = most.astype(np.float32)[:, None, None]
    gain = np.where(on, (likely + most) * weight, np.float32(0))
    carries = grid.surface.ravel()[at]
    # a surface explains itself
    gain = np.where(on & carries, np.minimum(gain, 0), gain)
    through = (weight * behind).sum((1, 2))
    paid = OUTLIER * through
    paid += NOT_MEASURED * (cosine * weight * (shown & (measured == 0))).sum((1, 2))

    piece = np.where(within, grid.piece.ravel()[at], 0)
    paid += LEFT_OVER * _left_over(
        piece, grid.sizes, shown, got, on & (likely > -2), front, measured > 0
    )
    seen = (weight * (got & ~front)).sum((1, 2))
    hidden = (weight * front).sum((1, 2))
    held = on | front
    for row in range(len(some)):
        if not shown[row].any():
            yield None
            continue
        cells = at[row][held[row]]
        yield Score(
            cells.astype(np.int32),
            evened(gain[row][held[row]], cells, on[row][held[row]], image[1]),
            float(paid[row]),
            float(seen[row]),
            float(through[row]),
            float(hidden[row]),
        )


def evened(gain: Float32, cells: Index, on: Mask, columns: int) -> Float32:
    """Return the gain of pixels with its mean over blocks of the grid: noise chooses no pixel.

    Args:
        gain: of each pixel, (N,) float32.
        cells: the pixels, (N,).
        on: those whose gain counts, (N,) bool.
        columns: of the grid.
    """
    line, column = np.divmod(cells, columns)
    block = line // BLOCK * columns + column // BLOCK
    sums = np.bincount(block[on], gain[on], minlength=int(block.max(initial=0)) + 1)
    counts = np.bincount(block[on], minlength=len(sums))
    mean = sums / np.maximum(counts, 1)
    return np.where(on, mean[block], 0).astype(np.float32)


_CROSS = np.zeros((3, 3, 3), bool)
_CROSS[1] = ndimage.generate_binary_structure(2, 1)


def _left_over(
    piece: NDArray[np.int32],
    sizes: Index,
    shown: Mask,
    got: Mask,
    own: Mask,
    front: Mask,
    measured: Mask,
) -> Float:
    """Count the pixels of its own pieces that each hypothesis does not explain, (M,) float64.

    Args:
        piece: number of the piece of each pixel, (M, h, w); 0 for none.
        sizes: pixels of each piece in the whole grid, (P,).
        shown: pixels in which the hypothesis shows, (M, h, w) bool.
        got: those of them with a measurement.
        own: those of them that it explains.
        front: those of them with something in front.
        measured: pixels with a measurement.
    """
    count = len(sizes)
    key = piece + count * np.arange(len(piece))[:, None, None]
    mine = np.bincount(key[own], minlength=len(piece) * count).reshape(-1, count)
    mine[:, 0] = 0
    held = np.bincount(key[got], minlength=len(piece) * count).reshape(-1, count)
    all_of_it = mine > OWN_SHARE * np.maximum(sizes, 1)
    left = np.where(all_of_it, sizes - held, 0).sum(1).astype(np.float64)

    measured = measured & ~shown
    beside = (mine >= FEWEST_OWN).ravel()[key] & measured
    outline = ndimage.binary_dilation(shown, _CROSS)
    ring = ndimage.binary_dilation(outline, _CROSS) & ~outline
    left += EDGE_WEIGHT * np.count_nonzero(outline & beside, axis=(1, 2))
    left += np.count_nonzero(ring & beside, axis=(1, 2))
    before = all_of_it.ravel()[key]
    left += np.count_nonzero(front & before, axis=(1, 2))
    return left


def _rendered(
    library: Library, view: View, some: Hypotheses, x: Float, y: Float
) -> tuple[Float32, Float32]:
    """Render hypotheses in windows.

    Args:
        library: the things.
        view: whose camera sees them.
        some: M hypotheses.
        x: slopes of the columns of each window, (M, w).
        y: slopes of the rows of each window, (M, h).

    Returns:
        Depth, (M, h, w) float32, metres, infinity for none; and the cosine of the angle between ray
        and normal, (M, h, w) float32.
    """
    count, height, width = len(some), y.shape[1], x.shape[1]
    rays: Float32 = np.ones((count, height, width, 3), np.float32)
    rays[..., 0] = x[:, None]
    rays[..., 1] = y[:, :, None]
    rays = rays.reshape(count, -1, 3)
    turn = view.camera[:3, :3].T @ some.rotations / some.sizes[:, None]
    start = np.einsum("mji,mj->mi", some.rotations, view.camera[:3, 3] - some.centres)
    start = start / some.sizes + library.centres[some.things]
    towards = rays @ turn.astype(np.float32)
    depth, normals = library.caster.cast(some.things, start, towards)
    # a normal of a stretched thing, in its own axes
    normals = normals / some.sizes.astype(np.float32)[:, None]
    length = np.sqrt(np.einsum("mpi,mpi->mp", normals, normals)) + 1e-12
    back = (view.camera[:3, :3].T @ some.rotations).astype(np.float32)
    against = np.einsum("mpi,mpi->mp", rays @ back, normals)
    far = np.sqrt(np.einsum("mpi,mpi->mp", rays, rays))
    cosine = np.abs(against) / length / far
    shape = (count, height, width)
    return depth.reshape(shape), cosine.clip(STEEPEST, 1).reshape(shape)


def total(scores: Sequence[Score | None]) -> float:
    """Return the sum over views, nats; a view that does not contain the hypothesis says nothing."""
    return sum(one.total for one in scores if one is not None)
