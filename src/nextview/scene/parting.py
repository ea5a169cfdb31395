"""Which pixels belong together, by what explains them: hypotheses join segments and cut them.

Edges alone do not tell where one object ends: the sides of a bowl are parted by its hollow, and
two boxes side by side have no edge between them. What a scan in its pose explains does. So where
an object is not explained well, other ways to part the pixels are tried, and kept where the scans
explain more of the picture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from nextview.errors import ObservationError
from nextview.scene.tracks import Rendered, Track, render_track
from nextview.sensing.observed_object import ObservedObject
from nextview.sensing.tabletop import NEAR_PLANE, TableTop

Mask = NDArray[np.bool_]

GOOD_FIT = 0.85  # share of an object's pixels that its scan explains, from which none is in doubt
LEAST_GAIN = 0.03  # by which another parting explains more of the pixels, at least
MOST_TRIMMED = 0.25  # share of an object's pixels that may be the plane's
LEAST_TRIMMED = 0.02
SHARED = 0.5  # share of a segment that another object's scan explains, from which they may be one
MOST_GROUP = 5  # segments that touch and are tried as one object


@dataclass(frozen=True, eq=False)
class Bench:
    """What partings are tried on: one frame.

    Attributes:
        top: what the frame shows.
        number: of the frame.
        judge: says what objects are.
    """

    top: TableTop
    number: int
    judge: Callable[[Sequence[Track]], list[Track]]

    def render(self, track: Track) -> Rendered | None:
        """What the frame would see of an object that was named."""
        return render_track(track, self.top, self.number, track.posed)

    def render_likeliest(self, track: Track) -> Rendered | None:
        """What the frame would see of an object if it were what it is most like."""
        return render_track(track, self.top, self.number, track.likeliest)

    def fit(self, track: Track) -> tuple[int, int]:
        """How many of an object's pixels its scan explains, and how many there are."""
        rendered = self.render(track)
        mask = track.mask_in(self.number)
        assert mask is not None
        if rendered is None:
            return 0, int(np.count_nonzero(mask))
        return rendered.fit(mask)

    def share(self, tracks: Sequence[Track]) -> float:
        """Share of the pixels of some objects that their scans explain."""
        fits = [self.fit(track) for track in tracks]
        return sum(one for one, _ in fits) / max(sum(every for _, every in fits), 1)

    def is_good(self, track: Track) -> bool:
        """Whether an object is explained so well that its pixels are not in doubt."""
        return self.share([track]) >= GOOD_FIT


def part(tracks: Sequence[Track], bench: Bench) -> list[Track]:
    """Join and cut the objects of one frame where scans explain more of it then.

    Args:
        tracks: all objects that the frame shows, judged.
        bench: the frame.

    Returns:
        The objects, judged. Numbers of new ones are negative.
    """
    tracks = _trimmed(tracks, bench)
    tracks = _joined(tracks, bench)
    tracks = _cut(tracks, bench)
    return _without_rests(tracks, bench)


def _trimmed(tracks: Sequence[Track], bench: Bench) -> list[Track]:
    """Take away low pixels at the rim of objects that are explained by the plane alone."""
    changed = {}
    for row, track in enumerate(tracks):
        mask = track.mask_in(bench.number)
        rendered = bench.render_likeliest(track)
        if mask is None or rendered is None or bench.is_good(track):
            continue
        kept = mask & (rendered.around(mask.shape) | (bench.top.height > NEAR_PLANE))
        lost = 1 - float(kept.sum() / max(mask.sum(), 1))
        if LEAST_TRIMMED < lost < MOST_TRIMMED:
            with suppress(ObservationError):
                changed[row] = track.with_mask(bench.number, kept, bench.top)

    judged = bench.judge(list(changed.values()))
    tracks = list(tracks)
    for row, track in zip(changed, judged, strict=True):
        if bench.share([track]) > bench.share([tracks[row]]):
            tracks[row] = track
    return tracks


def _joined(tracks: Sequence[Track], bench: Bench) -> list[Track]:
    """Join objects that touch where one scan explains them all better than several do."""
    groups = _groups(tracks, bench)
    unions = []
    for group in groups:
        with suppress(ObservationError):
            unions.append((group, _union([tracks[row] for row in group], bench)))
    judged = bench.judge([union for _, union in unions])

    gains = []
    for (group, _), union in zip(unions, judged, strict=True):
        before = bench.share([tracks[row] for row in group])
        gains.append((bench.share([union]) - before, group, union))
    gains.sort(key=lambda item: -item[0])

    taken: set[int] = set()
    found = []
    for gain, group, union in gains:
        if gain >= LEAST_GAIN and not taken & set(group):
            taken |= set(group)
            found.append(union)
    return [track for row, track in enumerate(tracks) if row not in taken] + found


def _groups(tracks: Sequence[Track], bench: Bench) -> list[tuple[int, ...]]:
    """Rows of objects that touch and may be one: pairs, and all that hang together."""
    masks = [track.mask_in(bench.number) for track in tracks]
    good = np.array([bench.is_good(track) for track in tracks], bool)
    linked = np.zeros((len(tracks), len(tracks)), bool)
    for one, other in combinations(range(len(tracks)), 2):
        first, second = masks[one], masks[other]
        if first is None or second is None or (good[one] and good[other]):
            continue
        linked[one, other] = linked[other, one] = (
            bench.top.touching(first, second)
            or _shares(tracks[one], second, bench)
            or _shares(tracks[other], first, bench)
        )

    pairs = [(int(a), int(b)) for a, b in np.argwhere(np.triu(linked))]
    label, count = _components(linked & ~np.logical_or.outer(good, good))
    whole = [tuple(np.flatnonzero(label == k).tolist()) for k in range(count)]
    return pairs + [group for group in whole if 2 < len(group) <= MOST_GROUP]


def _components(linked: NDArray[np.bool_]) -> tuple[NDArray[np.int64], int]:
    """The connected component of each of N nodes, (N,), and how many there are."""
    from scipy.sparse.csgraph import connected_components

    if not len(linked):
        return np.zeros(0, np.int64), 0
    count, label = connected_components(linked, directed=False)
    return np.asarray(label, np.int64), int(count)


def _shares(track: Track, mask: Mask, bench: Bench) -> bool:
    """Whether the scan of one object explains most of another one's pixels, (H, W) bool."""
    rendered = bench.render(track)
    if rendered is None:
        return False
    explained = np.count_nonzero(mask[rendered.part] & rendered.agrees)
    return bool(explained > SHARED * np.count_nonzero(mask))


def _union(tracks: Sequence[Track], bench: Bench) -> Track:
    """Some objects as one: the first of them, with the pixels of all in this frame."""
    first = min(tracks, key=lambda track: track.number if track.number >= 0 else np.inf)
    masks = [track.mask_in(bench.number) for track in tracks]
    every = np.any([mask for mask in masks if mask is not None], axis=0)
    return first.with_mask(bench.number, every, bench.top)


def _cut(tracks: Sequence[Track], bench: Bench) -> list[Track]:
    """Cut objects along their concave edges where several scans explain them better than one."""
    tries: dict[int, list[Track]] = {}
    for row, track in enumerate(tracks):
        mask = track.mask_in(bench.number)
        if mask is None or bench.is_good(track):
            continue
        parts = bench.top.segments(mask, "never")
        if 1 < len(parts) <= MOST_GROUP:
            with suppress(ObservationError):
                tries[row] = _parts(track, parts, bench)
    return _better(tracks, tries, bench)


def _without_rests(tracks: Sequence[Track], bench: Bench) -> list[Track]:
    """Take out what each scan explains; what stays of its pixels is segmented anew."""
    tries: dict[int, list[Track]] = {}
    for row, track in enumerate(tracks):
        mask = track.mask_in(bench.number)
        rendered = bench.render_likeliest(track)
        if mask is None or rendered is None or bench.is_good(track):
            continue
        around = ndimage.binary_dilation(rendered.around(mask.shape), iterations=2)
        rests = bench.top.segments(mask & ~around)
        if rests:
            own = mask & ~np.any(rests, axis=0)
            with suppress(ObservationError):
                tries[row] = _parts(track, [own, *rests], bench)
    return _better(tracks, tries, bench)


def _parts(track: Track, masks: Sequence[Mask], bench: Bench) -> list[Track]:
    """Objects of some pixels each; the first goes on as the object that they were cut from."""
    first = track.with_mask(bench.number, masks[0], bench.top)
    return [first, *(new_track(mask, bench) for mask in masks[1:])]


def new_track(mask: Mask, bench: Bench) -> Track:
    """An object that no earlier frame showed.

    Raises:
        ObservationError: too little is seen of it.
    """
    top = bench.top
    up = None if top.frame.pose is None else top.up
    return Track(-1, ObservedObject(up), ()).with_mask(bench.number, mask, top)


def _better(tracks: Sequence[Track], tries: dict[int, list[Track]], bench: Bench) -> list[Track]:
    """The objects, each as it is or as its parts, whichever scans explain better."""
    judged = iter(bench.judge([one for parts in tries.values() for one in parts]))
    found = []
    for row, track in enumerate(tracks):
        if row not in tries:
            found.append(track)
            continue
        parts = [next(judged) for _ in tries[row]]
        if bench.share(parts) >= bench.share([track]) + LEAST_GAIN:
            found.extend(parts)
        else:
            found.append(track)
    return found
