"""How likely a line of sight to a thing is clear where no view has looked yet.

What stands around a thing hides it from many sides, and a camera sees only the near side of it.
Space that no view has looked into may hold more of the same, standing on the same support: a place
near the support is filled more often than one higher up. A metre of it blocks a line of sight more
often than one of the space that is known, because views that show the thing are views from where
little stands in the way.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nextview.geometry.observation import Observation
from nextview.types import Float, Float32, Mask

SIGHT_STEPS = 20  # places on each line of sight that are looked up
UNSEEN_FILLED = 4.0  # how much oftener unknown space is filled than known space
# metres before a measured surface, from which on space is known to be free
BEFORE = 0.01


@dataclass(frozen=True, eq=False)
class MeasuredDepth:
    """All depth that one view measured.

    Attributes:
        depth: along the optical axis, (H, W) float32, metres; 0 where nothing was measured.
        pose: camera-to-object, (4, 4) float64, metres.
        intrinsics: pinhole matrix, (3, 3) float64, pixels; the first pixel's centre is at 0.5.
    """

    depth: Float32
    pose: Float
    intrinsics: Float

    @classmethod
    def of(cls, observation: Observation) -> "MeasuredDepth | None":
        """What the camera of a view saw, the thing and all else; None if that is not known."""
        scene = observation.scene
        if scene is None or observation.radius is None:
            return None
        pose = scene.pose.astype(np.float64)
        pose[:3, 3] *= observation.radius
        depth = scene.depth * np.float32(observation.radius)
        return cls(depth, pose, scene.intrinsics.astype(np.float64))

    def shows_free(self, points: Float32) -> Mask:
        """Whether the camera looked through some places.

        Where nothing was measured, nothing is taken to stand: most often what is behind is too far
        away.

        Args:
            points: (..., 3), object frame, metres.

        Returns:
            (...) bool; not for places outside of the image.
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
    """How likely lines of sight are clear where it is not known what stands on them.

    Args:
        seen: the views that were taken.
        ends: where each line meets the thing, (V, P, 3), object frame, metres; NaN for a line that
            does not.
        rays: unit vectors from the cameras along the lines, (V, P, 3).
        hidden: lines that something is known to block, (V, P).
        reach: metres before the thing, within which something may stand.
        floor: height of the support, metres.
        top: height of what is known to stand around, metres; what is not known is no higher, and
            may be of any height up to it.

    Returns:
        Chances, (V, P) float32: 1 where all is known to be free.
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
