"""Fill regular gaps in depth images, which result from aligning a low to a high resolution.

Gaps that repeat every few pixels are an artefact of the grid. All other holes are kept, because
missing measurements carry information.
"""

import numpy as np

from nextview.types import Float32, Index, Mask

LONGEST_PERIOD = 8  # pixels, largest period of the gaps


def fill_regular_gaps(depth: Float32) -> tuple[Float32, Index | None]:
    """Fill gaps that repeat every few pixels; an image without such gaps is returned unchanged.

    Between two pixels of one surface, inverse depth is interpolated. Between two surfaces, the gap
    is assigned to the surface of the nearer pixel; no depths in between are created. Nothing is
    filled outside the measured area, or in holes larger than the gaps.

    Args:
        depth: (H, W) float32, metres, 0 without valid depth.

    Returns:
        The depth image; and for each pixel the index of the measured pixel whose surface it belongs
        to, row * W + column, (H, W): its own unless it was filled. The indices are None if there
        are no regular gaps.
    """
    measured = depth > 0
    period = max(_period(measured), _period(measured.T))
    if period == 0:
        return depth, None

    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=measured)
    source = np.arange(depth.size).reshape(depth.shape)
    # first between measured pixels, then between filled rows or columns
    for _ in range(2):
        _fill_once(inverse, source, period)
    filled = np.divide(1, inverse, out=np.zeros_like(depth), where=inverse > 0)
    return np.where(measured, depth, filled), source


def filled_mask(mask: Mask, source: Index) -> Mask:
    """Fill the gaps of a mask that coincide with the gaps of the depth image.

    Args:
        mask: (H, W) bool.
        source: of each pixel, from ``fill_regular_gaps``.
    """
    added = mask.ravel()[source] & (
        source != np.arange(source.size).reshape(source.shape)
    )
    # A mask from a colour image has no gaps and more exact edges, so it is kept.
    has_gaps = np.count_nonzero(added & ~mask) > np.count_nonzero(added & mask)
    return mask | added if has_gaps else mask.copy()


def _period(measured: Mask) -> int:
    """Return the period of the gaps in columns; 0 if they are not periodic, or too few."""
    begins = measured[:, :-1] & ~measured[:, 1:]
    count = np.count_nonzero(begins)
    if count < 0.01 * np.count_nonzero(measured) or count == 0:
        return 0
    lags = [k for k in range(2, LONGEST_PERIOD + 1) if k < begins.shape[1]]
    again = [np.count_nonzero(begins[:, :-k] & begins[:, k:]) / count for k in lags]
    best = int(np.argmax(again)) if again else 0
    # random gaps follow each other after all distances alike
    regular = bool(again) and again[best] > max(0.35, 2 * min(again))
    return lags[best] if regular else 0


def _fill_once(inverse: Float32, source: Index, widest: int) -> None:
    """Fill holes of at most ``widest`` pixels in rows and columns, in place."""
    best_span = np.full(inverse.size, np.iinfo(np.int32).max, np.int32)
    best_value = inverse.ravel().copy()
    best_source = source.ravel().copy()
    for along_rows in (True, False):
        hole, first, second, before, after = _gaps(inverse, widest, along_rows)
        one = inverse.ravel()[first]
        other = inverse.ravel()[second]
        span = before + after

        one_surface = np.abs(one - other) <= 0.015 * span * np.minimum(one, other)
        # At equal distance the background is preferred, so that objects do not grow.
        nearer_first = (before < after) | ((before == after) & (one < other))
        on_plane = (one * after + other * before) / span
        value = np.where(one_surface, on_plane, np.where(nearer_first, one, other))
        taken = source.ravel()[np.where(nearer_first, first, second)]

        # A gap between two surfaces is used only if the other direction is not on one surface.
        span = np.where(one_surface, span, span + 2 * LONGEST_PERIOD)
        better = span < best_span[hole]
        at = hole[better]
        best_span[at] = span[better]
        best_value[at] = value[better]
        best_source[at] = taken[better]
    inverse[:] = best_value.reshape(inverse.shape)
    source[:] = best_source.reshape(inverse.shape)


def _gaps(inverse: Float32, widest: int, along_rows: bool) -> tuple[Index, ...]:
    """Find holes with a measured pixel before and after them in their row, or their column.

    Returns:
        Indices of the holes, of the pixels before and after them, and the distances to these, (N,)
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
