"""Detect frames of a capture that have the poses of earlier or later frames.

If a camera drops an image, or a recorder drops a pose, all later frames have the pose of a
neighbour. Frames within each part are still consistent, but those of different parts are not. A
rotation about the normal of the table does not change the table, so only points above it are
compared.
"""

from collections.abc import Sequence

import numpy as np

from nextview.sensing.agreement import Agreement, SurfaceView, compare
from nextview.types import Float, Index, Mask

FEWEST_JUDGED = 100  # judgements that tell something


def explains(before: Agreement, after: Agreement) -> bool:
    """Return True if frames contradict each other much less once a mistake is undone.

    Args:
        before: agreement as read.
        after: the same without the mistake.
    """
    explained = before.contradicted.sum() - after.contradicted.sum()
    return bool(
        explained >= max(FEWEST_JUDGED, 0.01 * before.judged)
        and after.judged >= 0.5 * before.judged
        and after.wrong <= 0.5 * before.wrong
    )


class _Delayed:
    """Agreement of frames if some have the poses of their neighbours.

    Attributes:
        indices: of the N compared frames in the capture, (N,).
        poses: of all frames, camera-to-world, (M, 4, 4).
    """

    def __init__(
        self, views: Sequence[SurfaceView], indices: Index, poses: Float
    ) -> None:
        self._views = [view.of_standing() for view in views]
        self.indices = indices
        self.poses = poses
        self._known: dict[tuple[int, int], Agreement] = {}

    def has_pose(self, late: Index) -> Mask:
        """Return which frames still have a pose if those in the capture are late, (N,)."""
        where = self.indices + late
        return (where >= 0) & (where < len(self.poses))

    def agreement(self, late: Index, late_there: Index) -> Agreement:
        """Return the agreement of frames with late poses; that of others is 0.

        Args:
            late: delay of the pose of each frame, by row, in frames, (N,).
            late_there: the same for the frames that it is compared with, by column, (N,).
        """
        found = np.zeros((2, len(late), len(late)))
        for here in np.unique(late):
            for there in np.unique(late_there):
                if (here, there) not in self._known:
                    last = len(self.poses) - 1
                    self._known[here, there] = compare(
                        self._views,
                        self.poses[np.clip(self.indices + here, 0, last)],
                        self.poses[np.clip(self.indices + there, 0, last)],
                    )

                pairs = np.ix_(late == here, late_there == there)
                known = self._known[here, there]
                found[0][pairs] = known.confirmed[pairs]
                found[1][pairs] = known.contradicted[pairs]
        found *= self.has_pose(late)[:, None] & self.has_pose(late_there)
        return Agreement(*found)


def find_late(views: Sequence[SurfaceView], indices: Index, poses: Float) -> Index:
    """Return by how many frames the pose of each frame is late, (N,); negative if it is early.

    Parts are delayed one by one, each where it explains most.

    Args:
        views: N frames, in the order of the capture.
        indices: of these frames in the capture, (N,).
        poses: of all frames, camera-to-world, as read, (M, 4, 4).
    """
    delayed = _Delayed(views, indices, poses)
    as_read = np.zeros(len(views), np.int64)
    before = delayed.agreement(as_read, as_read)
    least = max(FEWEST_JUDGED, 0.1 * before.contradicted.sum())
    late = as_read
    for _ in range(3):  # parts, nested or consecutive
        further = _best_part(delayed, late, least)
        if not further.any():
            break
        late = late + further

    # On a uniform path around an object only differences between delays are observable. Then the
    # first frames are taken as correct.
    others = late - late[1]
    others[0] = min(others[0], 0, key=abs)

    def changed(later: Index) -> tuple[Agreement, Agreement]:
        """Return the agreement as read, and with other delays, of the frames that they concern."""
        usable = delayed.has_pose(later)
        pairs = (later != 0)[:, None] | (later != 0)
        pairs &= usable[:, None] & usable
        after = delayed.agreement(later, later)
        return before.among(pairs), after.among(pairs)

    one, other = (
        as_is.contradicted.sum() - after.contradicted.sum()
        for as_is, after in map(changed, (late, others))
    )
    if other >= 0.5 * one:
        late = others
    return late if explains(*changed(late)) else as_read


def _best_part(delayed: _Delayed, late: Index, least: float) -> Index:
    """Return the further delay of each frame that explains most: of one part; 0 for none."""
    count = len(late)
    rows = np.arange(count)
    first, end = np.triu_indices(count)
    parts = (rows >= first[:, None]) & (rows <= end[:, None])
    best = np.zeros(count, np.int64)
    before = delayed.agreement(late, late).contradicted
    for frames in (1, -1, 2, -2):
        later = late + frames
        if np.abs(later).max() > 4:  # frames, by several parts together
            continue
        # A frame without a later pose explains nothing.
        usable = delayed.has_pose(later)
        inside = parts & usable
        within, leaving, entering = (
            before - delayed.agreement(*pair).contradicted
            for pair in ((later, later), (later, late), (late, later))
        )
        outside = ~inside
        gain = (
            np.einsum("ki,ij,kj->k", inside, within, inside, optimize=True)
            + np.einsum("ki,ij,kj->k", inside, leaving, outside, optimize=True)
            + np.einsum("ki,ij,kj->k", outside, entering, inside, optimize=True)
        )
        # Of parts that explain the same, the shortest is preferred.
        gain -= 1e-3 * parts.sum(1)
        part = int(gain.argmax())
        if gain[part] >= least:
            least = float(gain[part])
            best = frames * parts[part]
            if not usable[end[part] + 1 :].any():
                best[end[part] + 1 :] = frames
    return best
