"""Silhouette measures: how long the object's outline is, and how variously it turns (thesis,
section 3.4.2).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from contourpy import LineType, contour_generator
from numpy.typing import NDArray
from scipy.fft import irfft, rfft

from nextview_lab.data.measures import MeasuredView
from research.area import bits

ARM = 1 / 24
"""Length of outline on both sides of a point between which its turn is measured, sides of the
image. Over that much, 9 pixels of 224, the steps of pixels even out."""
ACCURACY = np.radians(5)
"""Standard deviation of the error with which a turn is taken to be known."""
CELLS = 360
"""Of the histogram of turns, once round."""


def silhouette_length(view: MeasuredView) -> float:
    """Length of the object's outline, holes included, in sides of the image.

    By Cauchy and Crofton: the length of a curve is half the mean number of times that lines cross
    it, over all lines. Counted over the lines through the pixels' centres in four directions, which
    is right within a few per cent where counting edge pixels is wrong by up to 41 % on slopes.
    Polonsky et al. 2005, Secord et al. 2011 ("silhouette length"); thesis, section 3.4.2.

    Returns:
        0 where nothing is seen.
    """
    seen = np.pad(view.seen, 1)
    straight = np.count_nonzero(seen[1:] != seen[:-1]) + np.count_nonzero(
        seen[:, 1:] != seen[:, :-1]
    )
    diagonal = np.count_nonzero(seen[1:, 1:] != seen[:-1, :-1]) + np.count_nonzero(
        seen[1:, :-1] != seen[:-1, 1:]
    )
    # Lines along the diagonals are 1/sqrt(2) pixels apart; the four directions share pi.
    return float(np.pi / 8 * (straight + diagonal / np.sqrt(2)) / max(view.depth.shape))


def silhouette_entropy(view: MeasuredView) -> float:
    """Shannon entropy of the distribution of turns along the object's outline, holes included.

    At every pixel's length of outline, the angle between what comes before and what comes after;
    their histogram is blurred by the accuracy of an angle, whose own entropy is taken off again, so
    that no border between two cells decides. Page et al. 2003, Polonsky et al. 2005 ("silhouette
    entropy"); thesis, section 3.4.2: the curvature entropy of the silhouette.

    Returns:
        Bits; 0 for a circle, which turns everywhere alike, but for its pixels, and where nothing is
        seen.
    """
    if len(view.depths) == 0:
        return 0.0
    arm = ARM * max(view.depth.shape)
    seen = np.pad(view.seen, 1).astype(np.float64)
    outlines: Any = contour_generator(
        z=seen,
        line_type=LineType.ChunkCombinedOffset,
    ).lines(0.5)
    (points,), (offsets,) = outlines
    turns = _turns(points, offsets.astype(np.int64), arm)
    counts = np.bincount(
        np.rint((turns / (2 * np.pi) + 0.5) * CELLS).astype(np.int64) % CELLS,
        minlength=CELLS,
    )
    blur, own = _blur()
    spread = irfft(rfft(counts) * blur)
    return max(bits(spread / spread.sum()) - own, 0.0)


@lru_cache(maxsize=1)
def _blur() -> tuple[NDArray[np.complex128], float]:
    """What the blur multiplies each frequency of the histogram by, and the entropy of a single
    cell that is blurred.
    """
    apart = np.minimum(np.arange(CELLS), CELLS - np.arange(CELLS)) * 2 * np.pi / CELLS
    blur = np.exp(-((apart / ACCURACY) ** 2) / 2)
    blur /= blur.sum()
    return rfft(blur), bits(blur)


def _turns(
    points: NDArray[np.float64],
    offsets: NDArray[np.int64],
    arm: float,
) -> NDArray[np.float64]:
    """Signed turns along closed outlines, (n,) radians, at every pixel's length of them.

    Outline i has the points (P, 2) from offset i up to offset i + 1; its last is its first.
    """
    step = np.sqrt((np.diff(points, axis=0) ** 2).sum(1))
    # also from one outline to the next, where nobody looks
    along = np.concatenate([[0], np.cumsum(step)])
    begin = along[offsets[:-1]]
    length = along[offsets[1:] - 1] - begin
    n = np.maximum(length.astype(np.int64), 8)
    first = np.cumsum(n) - n
    of = np.repeat(np.arange(len(n)), n)
    i = np.arange(len(of)) - first[of]
    at = begin[of] + i * (length / n)[of]
    places = np.interp(at, along, points[:, 0]) + 1j * np.interp(
        at,
        along,
        points[:, 1],
    )
    # Nothing is smaller than a few pixels: on a short outline the arms are a quarter of it.
    k = np.maximum(np.minimum(n // 4, round(arm)), 1)[of]
    ahead, behind = (places[first[of] + (i + way) % n[of]] for way in (k, -k))
    return np.angle((ahead - places) * np.conj(places - behind))
