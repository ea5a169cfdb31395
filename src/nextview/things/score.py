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
POSE_ERROR = 0.005  # standard deviation of the pose of a thing, radii
FARTHEST = 4.0  # standard deviations within which a pixel may show the surface
OWN_SHARE = 0.3  # of a piece, from which on all of it should be explained
FEWEST_OWN = 8  # pixels of a piece, from which on it should end where the thing ends
STEEPEST = 0.15  # cosine of the steepest surface that is measured
BLOCK = 5  # pixels of the grid whose errors are alike, along each side
BATCH = 30_000  # rays that are cast at once
NEAREST = 0.05  # metres in front of the camera, from which on things are seen
BESIDE = 3  # pixels of the grid that a window shows beside a thing


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
        compared = _compared(library, view, some[rows], grid, window)
        for row, one in zip(rows, compared.scores(grid), strict=True):
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


def total_scores(library: Library, view: View, some: Hypotheses, coarser: int) -> Float:
    """Compare hypotheses with a view, as ``score`` does, and return no more than the totals.

    Args:
        library: the things.
        view: the view.
        some: M hypotheses.
        coarser: factor of the distance between the pixels that are compared.

    Returns:
        Nats, (M,); -infinity for one that lies outside of the image.
    """
    grid = view.grid(coarser)
    found = np.full(len(some), -np.inf)
    for rows, window in _windows(library, view, some, grid):
        one = _compared(library, view, some[rows], grid, window)
        total = np.bincount(one.row, one.gain, len(rows)) + one.paid
        found[rows] = np.where(one.inside, coarser**2 * total, -np.inf)
    return found


@dataclass(frozen=True, eq=False)
class _Window:
    """Rectangles of the grid, all of one size.

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

    def cells(self, pixels: Index, grid: Grid) -> tuple[Index, Index]:
        """Return the rectangle and the pixel of the grid of some pixels of all, (N,) each."""
        row, place = np.divmod(pixels, self.height * self.width)
        line, column = np.divmod(place, self.width)
        line, column = line + self.top[row], column + self.left[row]
        return row, line * grid.depth.shape[1] + column


def _windows(
    library: Library, view: View, some: Hypotheses, grid: Grid
) -> Iterator[tuple[Index, _Window]]:
    """Return batches of hypotheses of similar size, and the windows that show them."""
    axes, place = view.camera[:3, :3], view.camera[:3, 3]
    own = library.corners[some.things] * some.sizes[:, None]
    turn = axes.T @ some.rotations
    middle = (some.centres - place) @ axes
    points = turn @ own.swapaxes(1, 2) + middle[..., None]
    slopes = points[:, :2] / np.maximum(points[:, 2:], NEAREST)
    ends = []
    for side, lines in enumerate((grid.y, grid.x)):
        low, high = slopes[:, 1 - side].min(1), slopes[:, 1 - side].max(1)
        first = np.searchsorted(lines, low) - BESIDE
        last = np.searchsorted(lines, high) + BESIDE
        ends.append(np.stack([first, last]).clip(0, len(lines)))
    (top, bottom), (left, right) = ends
    height, width = bottom - top, right - left
    seen = np.flatnonzero(
        (middle[:, 2] > NEAREST) & (height > BESIDE) & (width > BESIDE)
    )
    order = seen[np.lexsort((width[seen], np.log2(height[seen]).astype(int)))]
    while len(order):
        # from the last on, as many as fit
        tallest = np.maximum.accumulate(height[order[::-1]])
        widest = np.maximum.accumulate(width[order[::-1]])
        rays = tallest * widest * np.arange(1, len(order) + 1)
        most = max(1, int(np.searchsorted(rays, BATCH, "right")))
        rows = np.sort(order[-most:])
        order = order[:-most]
        tall, wide = int(tallest[most - 1]), int(widest[most - 1])
        yield (
            rows,
            _Window(
                np.minimum(top[rows], len(grid.y) - tall),
                np.minimum(left[rows], len(grid.x) - wide),
                tall,
                wide,
            ),
        )


@dataclass(frozen=True, eq=False)
class _Compared:
    """What M hypotheses say of a view: a row for each of N pixels that show one, and their sums.

    Attributes:
        row: number of the hypothesis, (N,) int64.
        cells: pixel of the grid, (N,) int64.
        gain: nats, (N,) float32.
        on: whether its surface is measured, (N,) bool.
        front: whether something in front of it is measured, (N,) bool.
        paid: for what is not as it should be, nats, (M,).
        seen: number of pixels that should show each, (M,).
        through: number of those that show what is behind it, (M,).
        hidden: number of pixels that show what is in front of it, (M,).
        inside: whether each lies within the image, (M,) bool.
    """

    row: Index
    cells: Index
    gain: Float32
    on: Mask
    front: Mask
    paid: Float
    seen: Float
    through: Float
    hidden: Float
    inside: Mask

    def scores(self, grid: Grid) -> Iterator[Score | None]:
        """Return the score of each; None for one outside of the image."""
        count = len(self.paid)
        kept = self.on | self.front
        row = self.row[kept]
        cells = self.cells[kept]
        # blocks of different hypotheses are different
        apart = -(-grid.depth.shape[0] // BLOCK) * BLOCK * grid.depth.shape[1]
        even = evened(
            self.gain[kept], cells + row * apart, self.on[kept], grid.depth.shape[1]
        )
        ends = np.searchsorted(row, np.arange(count + 1))
        for one in range(count):
            if not self.inside[one]:
                yield None
                continue
            part = slice(ends[one], ends[one + 1])
            yield Score(
                cells[part].astype(np.int32),
                even[part],
                float(self.paid[one]),
                float(self.seen[one]),
                float(self.through[one]),
                float(self.hidden[one]),
            )


def _compared(
    library: Library, view: View, some: Hypotheses, grid: Grid, window: _Window
) -> _Compared:
    """Compare hypotheses with windows of one size."""
    shown, z, cosine = _rendered(library, view, some, grid, window)
    pixels = np.flatnonzero(shown)
    row, cells = window.cells(pixels, grid)
    inner = ~_grown(~shown).ravel()[pixels]
    weight = np.where(inner, np.float32(1), np.float32(EDGE_WEIGHT))

    measured = grid.depth.ravel()[cells]
    radius = library.radii[some.things] * some.sizes.max(1)
    own = library.caster.errors[some.things] ** 2 + (POSE_ERROR * radius) ** 2
    slope = np.sqrt(1 - cosine**2) / cosine * z * np.float32(grid.pitch / 2)
    variance = grid.sigma.ravel()[cells] ** 2 + slope**2
    variance += own.astype(np.float32)[row]
    off = measured - z
    margin = FARTHEST * np.sqrt(variance)
    likely = np.log(np.exp(-(off**2) / 2 / variance) + np.exp(OUTLIER))

    got = measured > 0
    front = got & (off < -margin)
    behind = got & (off > margin)
    on = got & ~front & ~behind
    most = np.where(some.taught, PIXEL_GAIN, PIXEL_GAIN - SIZE_COST)
    gain = np.where(on, (likely + most.astype(np.float32)[row]) * weight, np.float32(0))
    carries = grid.surface.ravel()[cells]
    # a surface explains itself
    gain = np.where(on & carries, np.minimum(gain, 0), gain)

    count = len(some)
    through = np.bincount(row, weight * behind, count)
    paid = OUTLIER * through
    paid += NOT_MEASURED * np.bincount(row, cosine * weight * ~got, count)
    key = row * len(grid.sizes) + grid.piece.ravel()[cells]
    mine = np.bincount(key[on & (likely > -2)], minlength=count * len(grid.sizes))
    held = np.bincount(key[got], minlength=len(mine))
    ahead = np.bincount(key[front], minlength=len(mine))
    paid += LEFT_OVER * _left_over(grid, window, shown, mine, held, ahead)
    # what is on a surface may be the surface: it says nothing
    seen = np.bincount(row, weight * (got & ~front & ~(on & carries)), count)
    hidden = np.bincount(row, weight * front, count)

    return _Compared(
        row,
        cells,
        gain,
        on,
        front,
        np.asarray(paid, np.float64),
        np.asarray(seen, np.float64),
        np.asarray(through, np.float64),
        np.asarray(hidden, np.float64),
        np.asarray(shown.any((1, 2))),
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
    block = line // BLOCK * (columns // BLOCK + 1) + column // BLOCK
    sums = np.bincount(block[on], gain[on], minlength=int(block.max(initial=0)) + 1)
    counts = np.bincount(block[on], minlength=len(sums))
    mean = sums / np.maximum(counts, 1)
    return np.where(on, mean[block], 0).astype(np.float32)


def _grown(mask: Mask) -> Mask:
    """Return masks, (M, h, w) bool, with the neighbours of their pixels."""
    grown = mask.copy()
    grown[:, 1:] |= mask[:, :-1]
    grown[:, :-1] |= mask[:, 1:]
    grown[..., 1:] |= mask[..., :-1]
    grown[..., :-1] |= mask[..., 1:]
    return grown


def _left_over(
    grid: Grid, window: _Window, shown: Mask, mine: Index, held: Index, ahead: Index
) -> Float:
    """Count the pixels of its own pieces that each hypothesis does not explain, (M,) float64.

    Args:
        grid: of the view.
        window: of the hypotheses.
        shown: pixels in which they show, (M, h, w) bool.
        mine: pixels of each piece, P in all, that each hypothesis explains, (M * P,).
        held: those that it shows, (M * P,).
        ahead: those of them that are in front of it, (M * P,).
    """
    every = np.tile(grid.sizes, len(shown))
    all_of_it = mine > OWN_SHARE * np.maximum(every, 1)
    all_of_it[:: len(grid.sizes)] = False  # no piece
    left = np.where(all_of_it, every - held + ahead, 0)
    left = left.reshape(len(shown), -1).sum(1).astype(np.float64)

    ends_here = mine >= FEWEST_OWN
    ends_here[:: len(grid.sizes)] = False
    outline = _grown(shown)
    ring = _grown(outline) & ~outline
    for beside, weight in ((outline & ~shown, EDGE_WEIGHT), (ring, 1.0)):
        row, cells = window.cells(np.flatnonzero(beside), grid)
        key = row * len(grid.sizes) + grid.piece.ravel()[cells]
        counts = ends_here[key] & (grid.depth.ravel()[cells] > 0)
        left += weight * np.bincount(row[counts], minlength=len(shown))
    return left


def _rendered(
    library: Library, view: View, some: Hypotheses, grid: Grid, window: _Window
) -> tuple[Mask, Float32, Float32]:
    """Render M hypotheses in windows of a view.

    Returns:
        Pixels that show each, (M, h, w) bool; and for each of them in this order the depth, (N,)
        float32, metres, and the cosine of the angle between ray and normal, (N,) float32.
    """
    lines = window.top[:, None] + np.arange(window.height)
    columns = window.left[:, None] + np.arange(window.width)
    x = grid.x[columns].astype(np.float32)
    y = grid.y[lines].astype(np.float32)
    rays, depth, normals = cast(library, view, some, x, y)
    shown = np.isfinite(depth)
    pixels = np.flatnonzero(shown)
    row, place = np.divmod(pixels, shown.shape[1])
    line, column = np.divmod(place, window.width)
    normals = normals.reshape(-1, 3)[pixels]
    against = np.abs(np.einsum("ni,ni->n", rays.reshape(-1, 3)[pixels], normals))
    # a normal of a stretched thing, in the axes of the scan
    normals = normals / some.sizes.astype(np.float32)[row]
    length = np.sqrt(np.einsum("ni,ni->n", normals, normals)) + np.float32(1e-12)
    far = np.sqrt(x[row, column] ** 2 + y[row, line] ** 2 + 1)
    cosine = (against / length / far).clip(STEEPEST, 1)
    shape = (len(some), window.height, window.width)
    return shown.reshape(shape), depth.ravel()[pixels], cosine


def cast(
    library: Library, view: View, some: Hypotheses, x: Float32, y: Float32
) -> tuple[Float32, Float32, Float32]:
    """Cast rays of a view at M hypotheses.

    Args:
        library: the things.
        view: the view.
        some: M hypotheses.
        x: slope x/z of each column for each, (M, w) float32.
        y: slope y/z of each row for each, (M, h) float32.

    Returns:
        The rays in the axes of the scan, (M, h * w, 3) float32; depth along the axis of the camera,
        (M, h * w) float32, metres, infinite where nothing is hit; and unit normals of the scan,
        (M, h * w, 3) float32.
    """
    # a ray of a stretched thing, in its own axes
    axes = view.camera[:3, :3].T @ some.rotations / some.sizes[:, None]
    turn = axes.astype(np.float32)[:, :, None]
    across = x[..., None] * turn[:, 0]
    down = y[..., None] * turn[:, 1] + turn[:, 2]
    rays = (down[:, :, None] + across[:, None]).reshape(len(some), -1, 3)
    start = np.einsum("mji,mj->mi", some.rotations, view.camera[:3, 3] - some.centres)
    start = start / some.sizes + library.centres[some.things]
    return rays, *library.caster.cast(some.things, start, rays)


def total(scores: Sequence[Score | None]) -> float:
    """Return the sum over views, nats; a view that does not contain the hypothesis says nothing."""
    return sum(one.total for one in scores if one is not None)
