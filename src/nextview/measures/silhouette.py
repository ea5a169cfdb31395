"""Silhouette measures: how long the object's outline is, and how variously it turns (thesis, section 3.4.2)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nextview.measures.area import bits
from nextview.measures.measured_view import MeasuredView

ARM = 1 / 24
"""Length of outline on both sides of a point between which its turn is measured, sides of the image. Over that much, 9
pixels of 224, the steps of pixels even out."""
ACCURACY = np.radians(5)
"""Standard deviation of the error with which a turn is taken to be known."""
CELLS = 360
"""Of the histogram of turns, once round."""


def silhouette_length(view: MeasuredView) -> float:
    """Length of the object's outline, holes included, in sides of the image.

    By Cauchy and Crofton: the length of a curve is half the mean number of times that lines cross it, over all lines.
    Counted over the lines through the pixels' centres in four directions, which is right within a few per cent where
    counting edge pixels is wrong by up to 41 % on slopes. Polonsky et al. 2005, Secord et al. 2011 ("silhouette
    length"); thesis, section 3.4.2.

    Returns:
        0 where nothing is seen.
    """
    seen = np.pad(view.seen, 1)
    straight = np.count_nonzero(seen[1:] != seen[:-1]) + np.count_nonzero(seen[:, 1:] != seen[:, :-1])
    diagonal = np.count_nonzero(seen[1:, 1:] != seen[:-1, :-1]) + np.count_nonzero(seen[1:, :-1] != seen[:-1, 1:])
    # Lines along the diagonals are 1/sqrt(2) pixels apart; the four directions share pi.
    return float(np.pi / 8 * (straight + diagonal / np.sqrt(2)) / max(view.depth.shape))


def silhouette_entropy(view: MeasuredView) -> float:
    """Shannon entropy of the distribution of turns along the object's outline, holes included.

    At every pixel's length of outline, the angle between what comes before and what comes after; their histogram is
    blurred by the accuracy of an angle, whose own entropy is taken off again, so that no border between two cells
    decides. Page et al. 2003, Polonsky et al. 2005 ("silhouette entropy"); thesis, section 3.4.2: the curvature entropy
    of the silhouette.

    Returns:
        Bits; 0 for a circle, which turns everywhere alike, but for its pixels, and where nothing is seen.
    """
    from skimage.measure import find_contours  # takes longer to import than all other measures

    if len(view.depths) == 0:
        return 0.0
    arm = ARM * max(view.depth.shape)
    outlines = find_contours(np.pad(view.seen, 1).astype(np.float32), 0.5)
    turns = np.concatenate([_turns(outline, arm) for outline in outlines])
    counts = np.bincount(np.rint((turns / (2 * np.pi) + 0.5) * CELLS).astype(np.int64) % CELLS, minlength=CELLS)
    blur, own = _blur()
    return max(bits(blur @ (counts / counts.sum())) - own, 0.0)


@lru_cache(maxsize=1)
def _blur() -> tuple[NDArray[np.float64], float]:
    """The blur of the histogram, as a matrix, and the entropy of a single cell that is blurred."""
    apart = np.angle(np.exp(2j * np.pi / CELLS * np.subtract.outer(np.arange(CELLS), np.arange(CELLS))))
    blur = np.exp(-((apart / ACCURACY) ** 2) / 2)
    blur /= blur[0].sum()
    return blur, bits(blur[0])


def _turns(outline: NDArray[np.float64], arm: float) -> NDArray[np.float64]:
    """Signed turns along a closed outline, (n,) radians, at every pixel's length of it."""
    along = np.concatenate([[0], np.cumsum(np.sqrt((np.diff(outline, axis=0) ** 2).sum(1)))])
    n = max(int(along[-1]), 8)
    at = np.arange(n) * along[-1] / n
    points = np.interp(at, along, outline[:, 0]) + 1j * np.interp(at, along, outline[:, 1])
    # Nothing is smaller than a few pixels: on a short outline the arms are a quarter of it.
    k = max(min(round(arm), n // 4), 1)
    return np.angle((np.roll(points, -k) - points) * np.conj(points - np.roll(points, k)))
