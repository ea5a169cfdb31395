"""An entropy that no slanted plane can raise: of the directions in which the visible surface faces.

The depth of a table top that is seen at a slant takes many values, and so has a high depth-entropy,
but shows a rectangle. The thesis suggests to take the gradient of the depth into account (section
6).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, rfft2

from nextview_lab.data.measures import MeasuredView
from research.area import bits

ACCURACY = 0.1
"""Standard deviation of the error with which a direction is taken to be known, along each axis,
radians: 6 degrees.
"""
CELLS = 80
"""Of the histogram of directions along each of its two axes: 2 to one standard deviation."""
BACKGROUND = np.float32(1e30)
"""Inverse depth where nothing is seen: no step from there is less than one on the surface."""


def gradient_entropy(view: MeasuredView) -> float:
    """What the view tells of the directions in which the surface faces, bits.

    The gradient of the inverse depth is the same all over a plane: together with its value it is
    the plane's normal, whatever the slant. The normals of all visible pixels are laid out in an
    equal-area map, as a histogram that is blurred by the accuracy of a direction. Its entropy, less
    that of the blur itself, is what a look at one random pixel tells of the surface there. It is
    the same for a plane seen from the front and at a slant, 0, and is made by directions that
    differ. Holes and the background do not count.

    Returns:
        Bits: 0 for a plane, or where nothing is seen; 1 for two that are seen equally large.
    """
    a, b, c = visible_normals(view)
    if len(c) == 0:
        return 0.0
    # Lambert's map: the hemisphere that faces the camera is the disc of radius sqrt(2), the other
    # lies around it.
    outward = CELLS / 4 * np.sqrt(2 / np.maximum(1 + c, 1e-6))
    across, down = (
        (slope * outward + CELLS / 2).astype(np.int64).clip(0, CELLS - 1)
        for slope in (a, b)
    )
    counts = np.bincount(across * CELLS + down, minlength=CELLS**2).reshape(
        CELLS,
        CELLS,
    )
    blur, own = _blur()
    spread = irfft2(rfft2(counts) * blur)
    return max(bits(spread / spread.sum()) - own, 0.0)


def visible_normals(view: MeasuredView) -> NDArray[np.float32]:
    """Unit normals of the visible pixels in the camera's axes, (3, n) float32, away from the
    camera.

    From the inverse depth's change to the neighbour at which it changes less, which lies on the
    same surface. Pixels without a neighbour to the side, or above and below, are left out.
    """
    if len(view.depths) == 0:
        return np.zeros((3, 0), np.float32)
    inverse = np.full(view.near.shape, BACKGROUND)
    np.divide(1, view.near, out=inverse, where=view.seen, casting="same_kind")
    a, b = (_change(inverse, axis) for axis in (1, 0))
    known = view.seen & (np.maximum(np.abs(a), np.abs(b)) < BACKGROUND / 2)
    a = a[known] * np.float32(view.intrinsics[0, 0])
    b = b[known] * np.float32(view.intrinsics[1, 1])
    (rows, columns), (fx, _, cx), (_, fy, cy) = view.box, *view.intrinsics[:2]
    x = ((np.arange(columns.start, columns.stop) + 0.5 - cx) / fx).astype(np.float32)
    y = ((np.arange(rows.start, rows.stop) + 0.5 - cy) / fy).astype(np.float32)
    x, y = (np.broadcast_to(slopes, known.shape)[known] for slopes in (x, y[:, None]))
    normals = np.stack([a, b, inverse[known] - a * x - b * y])
    return normals / np.sqrt((normals**2).sum(0))


def _change(inverse: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """To the next pixel along an axis, or from the one before, whichever is less; huge where
    neither is seen.
    """
    back = [slice(None)] * 2
    on = [slice(None)] * 2
    back[axis], on[axis] = slice(None, -1), slice(1, None)
    step = np.diff(inverse, axis=axis)
    change = np.full(inverse.shape, BACKGROUND)
    change[*back] = step
    np.copyto(change[*on], step, where=np.abs(step) <= np.abs(change[*on]))
    return change


@lru_cache(maxsize=1)
def _blur() -> tuple[NDArray[np.complex128], float]:
    """What the blur multiplies each frequency of the histogram by, and the entropy of a single
    cell that is blurred.
    """
    apart = np.minimum(np.arange(CELLS), CELLS - np.arange(CELLS)) * 4 / CELLS
    blur = np.exp(-((apart / ACCURACY) ** 2) / 2)
    blur /= blur.sum()
    return rfft2(np.outer(blur, blur)), 2 * bits(blur)
