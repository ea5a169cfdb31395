"""What the camera sees and the projector beside it does not reach, computed from the depth alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview.cameras.sensors.surface_angle import STEP, Image, slopes
from nextview.errors import UsageError

LEAST = 1.0
"""Width of the narrowest shadow, pixels."""
WIDEST = 8
"""Projector columns that two neighbouring pixels of one surface may lie apart."""

MOST = 2**26
"""Projector columns in all rows together."""


def in_shadow(q: Image, focal: float, baseline: float) -> NDArray[np.bool_]:
    """Which pixels lie in the shadow of something nearer, as seen from a projector, or from the other of two cameras.

    The projector stands ``baseline`` along the camera's x axis and looks the same way, so that a row of the camera is a
    row of the projector: the pixel of column u and inverse depth q is lit from column u - focal * baseline * q. There
    the nearest surface is lit; all others that the camera sees are in its shadow.

    Args:
        q: inverse depth, (H, W), 1/metres, 0 where there is nothing.
        focal: along x, pixels.
        baseline: metres.

    Raises:
        UsageError: it is so wide that no memory is enough.
    """
    height, width = q.shape
    disparity = focal * baseline * q
    column = np.arange(width) - disparity
    offset = int(np.ceil(abs(disparity).max(initial=0.0))) + 1
    if height * 2 * offset > MOST:
        raise UsageError(
            f"a shadow of {baseline} m at this focal length reaches {offset:,} pixels, more than can be drawn"
        )
    lit = np.zeros((height, width + 2 * offset + 2))  # the largest disparity in each column of the projector
    row = np.broadcast_to(np.arange(height)[:, None], q.shape)
    seen = q > 0
    # A surface covers all projector columns from one of its pixels to the next.
    along, _ = slopes(q)
    step = np.zeros_like(q)
    step[:, :-1] = q[:, 1:] - q[:, :-1]
    joined = np.zeros(q.shape, bool)
    joined[:, :-1] = seen[:, :-1] & seen[:, 1:] & (np.abs(step - along)[:, :-1] <= STEP * q[:, :-1])
    last = np.where(joined, np.roll(column, -1, 1), column)
    first_index, last_index = np.rint(column).astype(int) + offset, np.rint(last).astype(int) + offset
    for k in range(WIDEST):
        at = first_index + k
        some = seen & ((k == 0) | (at < last_index))
        np.maximum.at(lit, (row[some], at[some]), disparity[some])
    narrow = LEAST + focal * abs(baseline) * np.abs(along)
    return seen & (lit[row, np.where(seen, first_index, 0)] > disparity + narrow)
