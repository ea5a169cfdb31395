"""An entropy that no slanted plane can raise: of the directions in which the visible surface faces.

The depth of a table top that is seen at a slant takes many values, and so has a high depth-entropy, but shows a
rectangle. The thesis suggests to take the gradient of the depth into account (section 6).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nextview.measures.area import bits
from nextview.measures.measured_view import MeasuredView

ACCURACY = 0.1
"""Standard deviation of the error with which a direction is taken to be known, along each axis, radians: 6 degrees."""
CELLS = 120
"""Of the histogram of directions along each of its two axes: 3 to one standard deviation."""


def gradient_entropy(view: MeasuredView) -> float:
    """What the view tells of the directions in which the surface faces, bits.

    The gradient of the inverse depth is the same all over a plane: together with its value it is the plane's normal,
    whatever the slant. The normals of all visible pixels are laid out in an equal-area map, as a histogram that is
    blurred by the accuracy of a direction. Its entropy, less that of the blur itself, is what a look at one random
    pixel tells of the surface there. It is the same for a plane seen from the front and at a slant, 0, and is made by
    directions that differ. Holes and the background do not count.

    Returns:
        Bits: 0 for a plane, or where nothing is seen; 1 for two that are seen equally large.
    """
    normals = visible_normals(view)
    if len(normals) == 0:
        return 0.0
    # Lambert's map: the hemisphere that faces the camera is the disc of radius sqrt(2), the other lies around it.
    across = normals[:, :2] * np.sqrt(2 / np.maximum(1 + normals[:, 2:], 1e-6))
    cell = ((across / 4 + 0.5) * CELLS).astype(np.int64).clip(0, CELLS - 1)
    counts = np.bincount(cell[:, 0] * CELLS + cell[:, 1], minlength=CELLS**2).reshape(CELLS, CELLS)
    blur, own = _blur()
    spread = blur @ (counts / len(normals)) @ blur.T
    return max(bits(spread / spread.sum()) - own, 0.0)


def visible_normals(view: MeasuredView) -> NDArray[np.floating]:
    """Unit normals of the visible pixels in the camera's axes, (n, 3), away from the camera.

    From the inverse depth's change to the neighbour at which it changes less, which lies on the same surface. Pixels
    without a neighbour to the side, or above and below, are left out.
    """
    if len(view.depths) == 0:
        return np.zeros((0, 3))
    inverse = np.divide(1, view.near, out=np.full(view.near.shape, np.nan), where=view.seen)
    a = _change(inverse) * view.intrinsics[0, 0]
    b = _change(inverse.T).T * view.intrinsics[1, 1]
    x, y = view.rays
    normals = np.stack([a, b, inverse - a * x - b * y[:, None]], -1)[np.isfinite(a) & np.isfinite(b)]
    return normals / np.sqrt((normals**2).sum(1, keepdims=True))


def _change(rows: NDArray[np.floating]) -> NDArray[np.floating]:
    """From each number to the next one in its row, or from the one before, whichever is less; NaN without either."""
    steps = np.pad(np.diff(rows), ((0, 0), (1, 1)), constant_values=np.nan)
    before, after = steps[:, :-1], steps[:, 1:]
    return np.where((np.abs(before) <= np.abs(after)) | np.isnan(after), before, after)


@lru_cache(maxsize=1)
def _blur() -> tuple[NDArray[np.float64], float]:
    """The blur along one axis, as a matrix, and the entropy of a single cell that is blurred along both."""
    apart = np.subtract.outer(np.arange(CELLS), np.arange(CELLS)) * 4 / CELLS
    blur = np.exp(-((apart / ACCURACY) ** 2) / 2)
    blur /= blur[CELLS // 2].sum()
    middle = blur[:, CELLS // 2]
    return blur, 2 * bits(middle)
