"""Detect frames of a capture that have the poses of earlier or later frames.

If a camera drops an image, or a recorder drops a pose, all later frames have the pose of a
neighbour. Frames within each part are still consistent, but those of different parts are not. A
rotation about the normal of the table does not change the table, so only points above it are
compared.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from nextview.sensing.agreement import Agreement, SurfaceView, compare
from nextview.sensing.mistakes import LEAST_EXPLAINED, explains, relative_change
from nextview.types import Float, Index, Mask

FRAME_SHIFTS = (1, -1, 2, -2)  # possible delays of the poses of a part, frames
MOST_SHIFTED = 4  # largest total delay of several parts, frames
# largest number of parts, nested or consecutive
MOST_PARTS = 3
LEAST_OF_ALL = 0.1  # least share of all contradictions that a further part explains
SAME_EXPLAINED = (
    1e-3  # least number of contradictions that a further frame in a part explains
)
# the first frames are taken as correct if the parts then still explain this share
AS_GOOD = 0.5


@dataclass(frozen=True)
class Shift:
    """A range of the compared frames whose poses are late.

    Attributes:
        first: the first of these frames.
        end: the first frame after them; the number of frames if there is none.
        frames: delay of their poses in frames; negative if they are early.
    """

    first: int
    end: int
    frames: int


@dataclass(frozen=True)
class Shifted:
    """Agreement of frames if some have the poses of their neighbours.

    Attributes:
        views: N frames, with the compared points.
        indices: of these frames in the capture, (N,).
        poses: of all frames, camera-to-world, (M, 4, 4).
    """

    views: Sequence[SurfaceView]
    indices: Index
    poses: Float
    _known: dict[tuple[int, int], Agreement] = field(default_factory=dict)

    def agreement(self, late: Index, late_there: Index) -> Agreement:
        """Return the agreement of frames with late poses or images.

        Args:
            late: delay of the pose of each frame, by row, in frames, (N,).
            late_there: the same for the frames that it is compared with, by column, (N,).

        Returns:
            The agreement.
        """
        count = len(self.views)
        confirmed = np.zeros((count, count))
        contradicted = np.zeros((count, count))
        for here in np.unique(late):
            for there in np.unique(late_there):
                pairs = np.ix_(late == here, late_there == there)
                found = self._all_late(int(here), int(there))
                confirmed[pairs] = found.confirmed[pairs]
                contradicted[pairs] = found.contradicted[pairs]
        return Agreement(confirmed, contradicted)

    def poses_of(self, late: Index) -> Float:
        """Return the correct poses, (N, 4, 4), if those of the capture are late."""
        return self.poses[np.clip(self.indices + late, 0, len(self.poses) - 1)]

    def has_pose(self, late: Index) -> Mask:
        """Return which frames still have a pose if those in the capture are late, (N,)."""
        where = self.indices + late
        return (where >= 0) & (where < len(self.poses))

    def _all_late(self, here: int, there: int) -> Agreement:
        """Return ``agreement`` with the same delay for all frames."""
        if (here, there) not in self._known:
            late = np.full(len(self.views), here)
            late_there = np.full(len(self.views), there)
            looked_up_with = self.poses_of(late_there)
            found = compare(
                self.views,
                self.poses_of(late),
                looked_up_with=looked_up_with,
            )
            usable = self.has_pose(late)[:, None] & self.has_pose(late_there)
            self._known[here, there] = found.among(usable)
        return self._known[here, there]


def find_shifts(
    views: Sequence[SurfaceView],
    indices: Index,
    poses: Float,
) -> list[Shift]:
    """Find ranges of a capture whose poses are late or early.

    Ranges are added one by one, each where it explains most contradictions.

    Args:
        views: N frames, in the order of the capture.
        indices: of these frames in the capture, (N,).
        poses: of all frames, camera-to-world, as read, (M, 4, 4).

    Returns:
        The ranges, ordered by their first frames, without overlap.
    """
    standing = [view.some(view.standing) for view in views]
    shifted = Shifted(standing, indices, poses)
    as_read = np.zeros(len(views), np.int64)
    contradicted = shifted.agreement(as_read, as_read).contradicted.sum()
    least = max(LEAST_EXPLAINED, LEAST_OF_ALL * contradicted)
    if contradicted < least:
        return []

    late = as_read
    for _ in range(MOST_PARTS):
        found = _best_part(shifted, late, least)
        if found is None:
            break
        late = late.copy()
        late[found.first : found.end] += found.frames

    # On a uniform path around an object only differences between delays are observable. Then the
    # first frames are taken as correct.
    others = late - late[1]
    others[0] = min(others[0], 0, key=abs)
    if _explained(shifted, as_read, others) >= AS_GOOD * _explained(
        shifted,
        as_read,
        late,
    ):
        late = others
    return _parts(late) if _is_explained(shifted, as_read, late) else []


def _best_part(shifted: Shifted, late: Index, least: float) -> Shift | None:
    """Return the range that explains most contradictions with later poses; or None."""
    best = None
    most_explained = least
    for frames in FRAME_SHIFTS:
        later = late + frames
        if np.abs(later).max() > MOST_SHIFTED:
            continue
        explained = _explained_by_parts(shifted, late, later)
        first, last = np.unravel_index(explained.argmax(), explained.shape)
        if explained[first, last] >= most_explained:
            most_explained = float(explained[first, last])
            without_pose = np.flatnonzero(shifted.has_pose(later)[last + 1 :])
            end = (
                len(late)
                if not len(without_pose)
                else int(last) + 1 + int(without_pose[0])
            )
            best = Shift(int(first), end, frames)

    return best


def _explained_by_parts(shifted: Shifted, late: Index, later: Index) -> Float:
    """Count the contradictions that are resolved by later poses, by first and last frame.

    Frames without a later pose explain nothing.
    """
    before = shifted.agreement(late, late).contradicted
    usable = shifted.has_pose(later)
    inside = shifted.agreement(later, later).contradicted
    leaving = shifted.agreement(later, late).contradicted
    entering = shifted.agreement(late, later).contradicted

    # A frame without a pose is left out of the range, and keeps its contradictions.
    row = usable[:, None]
    column = usable[None]
    within_part = np.where(row & column, before - inside, 0)
    from_part = np.where(row, before - leaving, 0)
    into_part = np.where(column, before - entering, 0)

    count = len(late)
    found = np.full((count, count), -np.inf)
    sums_within = _corner_sums(within_part)
    sums_from = _corner_sums(from_part)
    sums_into = _corner_sums(into_part)
    for first in range(count):
        for last in range(first, count):
            part = slice(first, last + 1)
            found[first, last] = (
                _sum(sums_within, part, part)
                + _sum(sums_from, part, slice(0, count))
                - _sum(sums_from, part, part)
                + _sum(sums_into, slice(0, count), part)
                - _sum(sums_into, part, part)
            )
    # Of ranges that explain the same, the shortest is preferred.
    length = np.arange(count)[None] - np.arange(count)[:, None]
    found -= SAME_EXPLAINED * np.maximum(length, 0)
    return found


def _corner_sums(values: Float) -> Float:
    """Return sums of (N, N) over all rows and columns before each element, (N + 1, N + 1)."""
    return np.pad(values.cumsum(0).cumsum(1), ((1, 0), (1, 0)))


def _sum(sums: Float, rows: slice, columns: slice) -> float:
    """Return the sum over some rows and columns, from ``_corner_sums``."""
    low = rows.start
    high = rows.stop
    left = columns.start
    right = columns.stop
    return float(
        sums[high, right] - sums[low, right] - sums[high, left] + sums[low, left]
    )


def _explained(shifted: Shifted, late: Index, later: Index) -> float:
    """Count the contradictions that are resolved by later poses."""
    usable = shifted.has_pose(later)
    pairs = usable[:, None] & usable
    before = shifted.agreement(late, late).contradicted[pairs]
    after = shifted.agreement(later, later).contradicted[pairs]
    return float(before.sum() - after.sum())


def _is_explained(shifted: Shifted, as_read: Index, late: Index) -> bool:
    """Return True if frames contradict each other much less with later poses."""
    usable = shifted.has_pose(late)
    changed = relative_change(shifted.poses_of(as_read), shifted.poses_of(late))
    changed &= usable[:, None] & usable
    before = shifted.agreement(as_read, as_read).among(changed)
    return explains(before, shifted.agreement(late, late).among(changed))


def _parts(late: Index) -> list[Shift]:
    """Return ranges of frames with the same delay, ignoring those without one."""
    ends = [0, *(np.flatnonzero(np.diff(late)) + 1), len(late)]
    found = []
    for first, end in pairwise(ends):
        if late[first]:
            found.append(Shift(int(first), int(end), int(late[first])))
    return found
