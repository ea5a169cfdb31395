"""Probability of a clear line of sight to a thing through space that no view has observed.

Objects around a thing occlude it from many sides, and a camera sees only their near side.
Unobserved space may contain more of them on the same support surface, so a point near the support
is more likely occupied than one higher up. A metre of unobserved space blocks a line of sight more
often than a metre of observed space, because views that show the thing were taken where little is
in the way.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nextview.types import Float, Float32, Mask

SIGHT_STEPS = 20  # sample points on each line of sight
UNSEEN_FILLED = 4.0  # occupancy of unobserved space relative to observed space
# distance before a measured surface from which space counts as free, metres
BEFORE = 0.01


@dataclass(frozen=True, eq=False)
class MeasuredDepth:
    """All depth that one view measured.

    Attributes:
        depth: depth along the optical axis, (H, W) float32, metres; 0 without a measurement.
        pose: camera-to-object, (4, 4) float64, metres.
        intrinsics: pinhole matrix, (3, 3) float64, pixels; the first pixel's centre is at 0.5.
    """

    depth: Float32
    pose: Float
    intrinsics: Float

    def shows_free(self, points: Float32) -> Mask:
        """Whether the camera observed free space at some points.

        A pixel without a measurement counts as free: most often its background is too far away.

        Args:
            points: object frame, (..., 3), metres.

        Returns:
            Mask, (...) bool; False for points outside the image.
        """
        turn = self.pose[:3, :3].astype(np.float32)
        in_camera = (points - self.pose[:3, 3].astype(np.float32)) @ turn
        away = in_camera[..., 2]
        ahead = np.maximum(away, 1e-3)
        k = self.intrinsics
        column = in_camera[..., 0] / ahead * np.float32(k[0, 0]) + np.float32(k[0, 2])
        row = in_camera[..., 1] / ahead * np.float32(k[1, 1]) + np.float32(k[1, 2])
        height, width = self.depth.shape
        inside = (
            (away > 0) & (row >= 0) & (row < height) & (column >= 0) & (column < width)
        )

        rows = np.where(inside, row, 0).astype(np.int32)
        columns = np.where(inside, column, 0).astype(np.int32)
        measured = self.depth[rows, columns]
        return inside & ((measured == 0) | (measured > away + BEFORE))


def chance_of_sight(
    seen: Sequence[MeasuredDepth],
    ends: Float32,
    rays: Float32,
    hidden: Mask,
    reach: float,
    floor: float,
    top: float,
) -> Float32:
    """Probability that lines of sight are clear, given that some of the space is unobserved.

    Args:
        seen: the views so far.
        ends: intersection of each line with the thing, (V, P, 3), object frame, metres; NaN for a
            line without one.
        rays: unit vectors from the cameras along the lines, (V, P, 3).
        hidden: lines that a known obstacle blocks, (V, P).
        reach: distance from the thing within which an obstacle may stand, metres.
        floor: height of the support surface, metres.
        top: height of the known obstacles, metres; unobserved obstacles have any height up to it.

    Returns:
        Probabilities, (V, P) float32: 1 if all space on the line is known to be free.
    """
    steps = (np.arange(SIGHT_STEPS, dtype=np.float32) + 0.5) / SIGHT_STEPS
    back = (reach * steps)[:, None] * rays[:, :, None]
    places = (ends[:, :, None] - back).astype(np.float32)
    height = np.nan_to_num(places[..., 2], nan=top)
    filled = np.clip((top - height) / max(top - floor, 1e-6), 0, 1)
    free = np.zeros(filled.shape, bool)
    for image in seen:
        free |= image.shows_free(places)

    step = reach / SIGHT_STEPS
    unknown = step * (filled * ~free).sum(2)
    known = step * float((filled * free)[~hidden].sum())
    blocked = np.count_nonzero(hidden)
    if not blocked:
        return np.ones(hidden.shape, np.float32)
    rate = UNSEEN_FILLED * blocked / max(known, step)
    return np.exp(-rate * unknown).astype(np.float32)
