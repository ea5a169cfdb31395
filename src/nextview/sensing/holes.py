"""Fill regular gaps in depth images, as aligning a low resolution to a high one leaves them.

Gaps that come again every few pixels are an artefact of the grid; all other holes are left as they
are: what a sensor could not measure says something.
"""

import numpy as np

from nextview.types import Float32, Index, Mask

LONGEST_PERIOD = 8  # pixels after which gaps come again, at most
# so many gaps begin in a row or a column for each measured pixel, at least
FEWEST_GAPS = 0.01
# share of the gaps after which another one begins one period later, at least
SAME_STEP = 0.35
# times as often as after some other distance: random gaps begin anywhere
DISTINCT = 2.0
# part by which inverse depth may change from pixel to pixel on one surface
ONE_SURFACE = 0.015
PASSES = 2  # first between two measured pixels, then between rows or columns that were filled


def fill_regular_gaps(depth: Float32) -> tuple[Float32, Index | None]:
    """Fill gaps that come again every few pixels; an image without any is given back as it is.

    Between two pixels of one surface inverse depth is interpolated. Between two surfaces the gap
    takes the depth of the nearer pixel of the two: no depth in between is made up. Outside of what
    was measured, and in holes that are larger than the gaps, nothing is filled.

    Args:
        depth: (H, W) float32, metres, 0 where nothing was measured.

    Returns:
        The depth image, and for each pixel the index of the measured pixel that it takes the
        surface of, row * W + column, (H, W): its own unless it was filled. None if there are no
        regular gaps.
    """
    measured = depth > 0
    period = max(_period(measured), _period(measured.T))
    if period == 0:
        return depth, None

    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=measured)
    source = np.arange(depth.size).reshape(depth.shape)
    for _ in range(PASSES):
        _fill_once(inverse, source, period)
    filled = np.divide(1, inverse, out=np.zeros_like(depth), where=inverse > 0)
    return np.where(measured, depth, filled), source


def filled_mask(mask: Mask, source: Index) -> Mask:
    """Fill the gaps of a mask where the image had the same gaps.

    Args:
        mask: (H, W) bool.
        source: of each pixel, from ``fill_regular_gaps``.
    """
    added = mask.ravel()[source] & (
        source != np.arange(source.size).reshape(source.shape)
    )
    # A mask from a colour image has no gaps: it knows better where the object ends.
    has_gaps = np.count_nonzero(added & ~mask) > np.count_nonzero(added & mask)
    return mask | added if has_gaps else mask.copy()


def _period(measured: Mask) -> int:
    """After how many columns gaps come again; 0 if they do not, or there are next to none."""
    begins = measured[:, :-1] & ~measured[:, 1:]
    count = np.count_nonzero(begins)
    if count < FEWEST_GAPS * np.count_nonzero(measured) or count == 0:
        return 0
    lags = [k for k in range(2, LONGEST_PERIOD + 1) if k < begins.shape[1]]
    again = [np.count_nonzero(begins[:, :-k] & begins[:, k:]) / count for k in lags]
    best = int(np.argmax(again)) if again else 0
    regular = bool(again) and again[best] > max(SAME_STEP, DISTINCT * min(again))
    return lags[best] if regular else 0


def _fill_once(inverse: Float32, source: Index, widest: int) -> None:
    """Fill holes in rows and columns in place, at most ``widest`` pixels wide."""
    best_span = np.full(inverse.size, np.iinfo(np.int32).max, np.int32)
    best_value = inverse.ravel().copy()
    best_source = source.ravel().copy()
    for along_rows in (True, False):
        hole, first, second, before, after = _gaps(inverse, widest, along_rows)
        one = inverse.ravel()[first]
        other = inverse.ravel()[second]
        span = before + after

        one_surface = np.abs(one - other) <= ONE_SURFACE * span * np.minimum(one, other)
        # Of two that are equally near, the one farther from the camera: no thing grows.
        nearer_first = (before < after) | ((before == after) & (one < other))
        on_plane = (one * after + other * before) / span
        value = np.where(one_surface, on_plane, np.where(nearer_first, one, other))
        taken = source.ravel()[np.where(nearer_first, first, second)]

        # Two surfaces count only where the other direction does not lie on one.
        span = np.where(one_surface, span, span + 2 * LONGEST_PERIOD)
        better = span < best_span[hole]
        at = hole[better]
        best_span[at] = span[better]
        best_value[at] = value[better]
        best_source[at] = taken[better]
    inverse[:] = best_value.reshape(inverse.shape)
    source[:] = best_source.reshape(inverse.shape)


def _gaps(inverse: Float32, widest: int, along_rows: bool) -> tuple[Index, ...]:
    """Holes with a measured pixel before and after them in their row, or their column.

    Returns:
        Indices of the holes, of the pixels before and after them, and how far off these are, (N,)
        each.
    """
    measured = inverse > 0
    axis = 1 if along_rows else 0
    size = inverse.shape[axis]
    place = np.arange(size, dtype=np.int32)
    place = place[None, :] if along_rows else place[:, None]
    last = np.maximum.accumulate(np.where(measured, place, -size), axis)
    ahead = np.flip(
        np.minimum.accumulate(np.flip(np.where(measured, place, 2 * size), axis), axis),
        axis,
    )
    hole = np.flatnonzero(~measured & (ahead - last <= widest + 1))

    row, column = np.divmod(hole, inverse.shape[1])
    here = column if along_rows else row
    before = here - last.ravel()[hole]
    after = ahead.ravel()[hole] - here
    step = 1 if along_rows else inverse.shape[1]
    return hole, hole - before * step, hole + after * step, before, after
