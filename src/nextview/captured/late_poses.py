"""Find the frames of a capture whose poses are those of frames before or after them.

A camera that drops an image, or a recorder that drops a pose, leaves all later frames with the pose
of a neighbour. Within each part the frames still fit together, and between the parts they do not. A
turn about the normal of the table leaves the table where it is, so only what stands on it is
judged.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from nextview.sensing.agreement import Agreement, SurfaceView, compare
from nextview.sensing.mistakes import LEAST_EXPLAINED, explains, relative_change
from nextview.types import Float, Index, Mask

FRAME_SHIFTS = (1, -1, 2, -2)  # frames by which the poses of a part may be late
MOST_SHIFTED = 4  # frames by which poses may be late after several parts
# parts that are searched for, one inside the other or one after the other
MOST_PARTS = 3
LEAST_OF_ALL = 0.1  # part of all contradictions that each further part has to explain
SAME_EXPLAINED = 1e-3  # contradictions that one more frame in a part has to explain
# part of what parts explain that the same parts explain where the first frames are taken to be
# right
AS_GOOD = 0.5


@dataclass(frozen=True)
class Shift:
    """Neighbouring frames, among those that are compared, whose poses are late.

    Attributes:
        first: the first of these frames.
        end: the first frame after them; the number of frames if there is none.
        frames: by how many frames their poses are late; negative where they are early.
    """

    first: int
    end: int
    frames: int


@dataclass(frozen=True)
class Shifted:
    """Agreement of frames when some have the poses of their neighbours.

    Attributes:
        views: N frames, with the points that are judged.
        indices: which of all frames of the capture they are, (N,).
        poses: of all frames, camera-to-world, (M, 4, 4).
    """

    views: Sequence[SurfaceView]
    indices: Index
    poses: Float
    _known: dict[tuple[int, int], Agreement] = field(default_factory=dict)

    def agreement(self, late: Index, late_there: Index) -> Agreement:
        """Return the agreement of frames whose poses or pictures are late.

        Args:
            late: by how many frames the pose of each frame is late, by row, (N,).
            late_there: the same of the frames that it is compared with, by column, (N,).

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
        """Return the right poses, (N, 4, 4), if those of the capture are late."""
        return self.poses[np.clip(self.indices + late, 0, len(self.poses) - 1)]

    def has_pose(self, late: Index) -> Mask:
        """Which frames still have a pose if those in the capture are late, (N,)."""
        where = self.indices + late
        return (where >= 0) & (where < len(self.poses))

    def _all_late(self, here: int, there: int) -> Agreement:
        """As ``agreement``, with the same shift for all."""
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
    """Find parts of a capture whose poses are late or early.

    Parts are added one by one, each where it explains most contradictions.

    Args:
        views: N frames, in the order of the capture.
        indices: which of all frames of the capture they are, (N,).
        poses: of all frames, camera-to-world, as read, (M, 4, 4).

    Returns:
        The parts in the order of their first frames, which do not overlap.
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

    # On a steady way around a thing only differences between shifts show. Then the first frames are
    # taken to be right.
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
    """Return the part that explains most contradictions with later poses; or None."""
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
    """Count the contradictions that vanish with later poses, by first and last frame.

    Frames that have no later pose explain nothing.
    """
    before = shifted.agreement(late, late).contradicted
    usable = shifted.has_pose(later)
    inside = shifted.agreement(later, later).contradicted
    leaving = shifted.agreement(later, late).contradicted
    entering = shifted.agreement(late, later).contradicted

    # A frame without a pose is left out of the part: what it contradicts stays as it was.
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
    # Of parts that explain the same, the shortest is right.
    length = np.arange(count)[None] - np.arange(count)[:, None]
    found -= SAME_EXPLAINED * np.maximum(length, 0)
    return found


def _corner_sums(values: Float) -> Float:
    """Sums of (N, N) over all rows and columns before each, (N + 1, N + 1)."""
    return np.pad(values.cumsum(0).cumsum(1), ((1, 0), (1, 0)))


def _sum(sums: Float, rows: slice, columns: slice) -> float:
    """Sum over some rows and columns, from what ``_corner_sums`` gives."""
    low = rows.start
    high = rows.stop
    left = columns.start
    right = columns.stop
    return float(
        sums[high, right] - sums[low, right] - sums[high, left] + sums[low, left]
    )


def _explained(shifted: Shifted, late: Index, later: Index) -> float:
    """Count the contradictions that vanish with later poses."""
    usable = shifted.has_pose(later)
    pairs = usable[:, None] & usable
    before = shifted.agreement(late, late).contradicted[pairs]
    after = shifted.agreement(later, later).contradicted[pairs]
    return float(before.sum() - after.sum())


def _is_explained(shifted: Shifted, as_read: Index, late: Index) -> bool:
    """Return whether frames contradict each other much less with later poses."""
    usable = shifted.has_pose(late)
    changed = relative_change(shifted.poses_of(as_read), shifted.poses_of(late))
    changed &= usable[:, None] & usable
    before = shifted.agreement(as_read, as_read).among(changed)
    return explains(before, shifted.agreement(late, late).among(changed))


def _parts(late: Index) -> list[Shift]:
    """Neighbouring frames with the same shift, but for those without one."""
    ends = [0, *(np.flatnonzero(np.diff(late)) + 1), len(late)]
    found = []
    for first, end in pairwise(ends):
        if late[first]:
            found.append(Shift(int(first), int(end), int(late[first])))
    return found
