"""Refine the segmentation of a frame with registered scans: merge and split segments.

Edges alone do not determine where one object ends: the hollow of a bowl separates its sides, and
two boxes side by side share no edge. A registered scan does determine it. If a scan does not
explain an object well, other segmentations are tried, and kept if the scans then explain more
pixels of the image.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import combinations, permutations

import numpy as np
from scipy import ndimage

from nextview.errors import ObservationError
from nextview.recognition.poses import PoseCandidate
from nextview.sensing.masks import touching
from nextview.sensing.observed_object import ObservedObject
from nextview.sensing.sighting import FEWEST_OBJECT_PIXELS, Sighting, sighting_of
from nextview.sensing.tabletop import NEAR_TABLE, TableTop
from nextview.session.result import Recognition
from nextview.session.tracks import RenderedObject, Track, render_track
from nextview.types import Float, Index, Mask

GOOD_FIT = (
    0.85  # explained share of an object's pixels above which its mask is accepted
)
LEAST_GAIN = (
    0.03  # least gain in the explained share for another segmentation to be kept
)
# the same for splitting an unknown object, as small parts of any surface fit some thing
LEAST_OF_UNKNOWN = 0.3
# least explained share of the pixels of a known object
KNOWN_SHARE = 0.5
MOST_PLANE_SHARE = (
    0.25  # largest share of an object's pixels that may belong to the plane
)
LEAST_TRIMMED = 0.02
SHARED = 0.5  # least share of a segment explained by another object's scan to try merging them
# metres, largest gap in the image between segments that are tried as one object
NEAR_GAP = 0.02
NEAR_STEP = (
    0.1  # metres between their depths there, at most: across the hollow of a bowl
)
MOST_PIECES = 5  # into which an object is cut, at most
MOST_TRIES = 2  # frames in which an object's pixels are parted otherwise in vain
# objects that are judged anew in a frame at most, those with the most pixels first
MOST_TRIMMED = 2  # that were not known before the frame
MOST_CUT = 4  # parts of what is cut, and as many where rests are taken out
MOST_JOINED = 10  # groups that are tried as one object in a frame, at most
LEAST_TAKEN = 0.15  # share of an object's pixels that another one's scan takes over
IN_EACH_OTHER = 0.5  # radii of the smaller of two scans between their centres, at most


@dataclass(frozen=True, eq=False)
class Bench:
    """One frame on which segmentations are compared.

    Attributes:
        top: support surfaces of the frame.
        number: of the frame.
        judge: recognises objects.
        rendered: cache of rendered objects, by ``id`` of their result, the frames of their
            sightings, and whether the likeliest hypothesis was rendered. The result is stored too,
            so that its ``id`` is not reused.
    """

    top: TableTop
    number: int
    judge: Callable[[Sequence[Track]], list[Track]]
    rendered: dict[
        tuple[int, tuple[int, ...], bool],
        tuple[Recognition, RenderedObject | None],
    ] = field(default_factory=dict, repr=False)

    def render(self, track: Track) -> RenderedObject | None:
        """Render a recognised object into the frame."""
        return self._rendered(track, likeliest=False)

    def render_likeliest(self, track: Track) -> RenderedObject | None:
        """Render the likeliest hypothesis of an object into the frame."""
        return self._rendered(track, likeliest=True)

    def _rendered(self, track: Track, likeliest: bool) -> RenderedObject | None:
        """Render an object into the frame, with a cache."""
        if track.result is None:
            return None
        key = (id(track.result), track.frames, likeliest)
        if key not in self.rendered:
            posed = track.likeliest if likeliest else track.posed
            rendered = render_track(track, self.top, self.number, posed)
            self.rendered[key] = (track.result, rendered)
        return self.rendered[key][1]

    def fit(self, track: Track) -> tuple[int, int]:
        """Return the number of an object's pixels that its scan explains, and their total."""
        rendered = self.render(track)
        mask = track.mask_in(self.number)
        assert mask is not None
        if rendered is None:
            return 0, int(np.count_nonzero(mask))
        return rendered.fit(mask)

    def share(self, tracks: Sequence[Track]) -> float:
        """Return the share of the objects' pixels that their scans explain."""
        fits = [self.fit(track) for track in tracks]
        return sum(one for one, _ in fits) / max(sum(every for _, every in fits), 1)

    def is_good(self, track: Track) -> bool:
        """Return True if an object is explained so well that its mask is accepted."""
        return self.share([track]) >= GOOD_FIT


def part(
    tracks: Sequence[Track],
    bench: Bench,
    before: Mapping[int, Track],
) -> list[Track]:
    """Merge and split the objects of one frame if the scans then explain more of it.

    Args:
        tracks: all objects in the frame, verified.
        bench: the frame.
        before: the objects before this frame, by number.

    Returns:
        The objects, verified. New ones have negative numbers.
    """
    tracks = _trimmed(tracks, bench, before)
    tracks = _joined(tracks, bench)
    tracks = _cut(tracks, bench)
    tracks = _without_rests(tracks, bench)
    return [
        track if bench.is_good(track) else replace(track, tries=track.tries + 1)
        for track in tracks
    ]


def taken_over(tracks: Sequence[Track], benches: Sequence[Bench]) -> list[Track]:
    """Reassign pixels of earlier frames to the objects whose scans explain them.

    Two objects that one frame shows as one are thereby separated once another frame shows them
    apart.

    Args:
        tracks: all objects, already judged.
        benches: all frames, in order.

    Returns:
        The objects; those whose pixels changed are judged again.
    """
    found = list(tracks)
    changed: set[int] = set()
    for bench in benches:
        doubtful = [
            row
            for row, track in enumerate(found)
            if track.mask_in(bench.number) is not None and not bench.is_good(track)
        ]
        for row in doubtful:
            for other, taker in enumerate(found):
                if other == row or not taker.frames or taker.posed is None:
                    continue
                pair = _taken(found[row], taker, bench)
                if pair is not None:
                    found[row], found[other] = pair
                    changed |= {row, other}

    rows = [row for row in sorted(changed) if found[row].frames]
    judged = benches[-1].judge([found[row] for row in rows])
    for row, track in zip(rows, judged, strict=True):
        found[row] = track
    return [
        track for row, track in enumerate(found) if row not in changed or track.frames
    ]


def merged(tracks: Sequence[Track], benches: Sequence[Bench]) -> list[Track]:
    """Merge two objects whose scans intersect, which is physically impossible.

    This happens if two frames show two sides of one thing. Two objects are kept if they explain
    more pixels than one.

    Args:
        tracks: all objects, already judged.
        benches: all frames, in order.
    """
    pairs = []
    for one, other in combinations(range(len(tracks)), 2):
        if _in_each_other(tracks[one].posed, tracks[other].posed):
            with suppress(ObservationError):
                pairs.append(
                    (one, other, _union([tracks[one], tracks[other]], benches[-1]))
                )

    judged = benches[-1].judge([union for _, _, union in pairs])
    found: dict[int, Track | None] = dict(enumerate(tracks))
    changed: set[int] = set()
    for (one, other, _), union in zip(pairs, judged, strict=True):
        before = _explained([tracks[one], tracks[other]], benches)
        if (
            not changed & {one, other}
            and _explained([union], benches) >= before - LEAST_GAIN
        ):
            changed |= {one, other}
            found[one], found[other] = union, None
    return [track for track in found.values() if track is not None]


def _in_each_other(one: PoseCandidate | None, other: PoseCandidate | None) -> bool:
    """Return True if two things intersect in their estimated poses."""
    first, second = _sphere_of(one), _sphere_of(other)
    if first is None or second is None:
        return False
    apart = float(np.linalg.norm(first[0] - second[0]))
    return apart < IN_EACH_OTHER * min(first[1], second[1])


def _sphere_of(posed: PoseCandidate | None) -> tuple[Float, float] | None:
    """Return centre, (3,), world, and radius of a posed thing, metres; None without a scan."""
    if posed is None or posed.vertices is None:
        return None
    low = posed.vertices.min(0)
    high = posed.vertices.max(0)
    middle = posed.pose[:3, :3] @ ((low + high) / 2) + posed.pose[:3, 3]
    return middle, float(np.linalg.norm(high - low)) / 2


def _explained(tracks: Sequence[Track], benches: Sequence[Bench]) -> float:
    """Return the share of some objects' pixels that their scans explain, over all frames."""
    fits = [
        bench.fit(track)
        for bench in benches
        for track in tracks
        if track.mask_in(bench.number) is not None
    ]
    return sum(one for one, _ in fits) / max(sum(every for _, every in fits), 1)


def _taken(loser: Track, taker: Track, bench: Bench) -> tuple[Track, Track] | None:
    """Let one object take over the pixels of another that its scan explains; None if too few."""
    mask = loser.mask_in(bench.number)
    rendered = bench.render(taker)
    if mask is None or rendered is None:
        return None

    count = int(np.count_nonzero(mask[rendered.part] & rendered.agrees))
    if count < FEWEST_OBJECT_PIXELS or count < LEAST_TAKEN * np.count_nonzero(mask):
        return None

    own = mask & rendered.explained(mask.shape)
    rest = mask & ~rendered.around(mask.shape)
    before = taker.mask_in(bench.number)
    own = own if before is None else own | before

    try:
        grown = taker.with_mask(bench.number, own, bench.top)
        if bench.top.is_thing(rest):
            smaller = loser.with_mask(bench.number, rest, bench.top)
            return replace(smaller, result=loser.result), replace(
                grown,
                result=taker.result,
            )
        left = loser.without(bench.number, bench.top.up)
    except ObservationError:
        return None

    grown = replace(grown, result=taker.result)
    if left is not None:
        return replace(left, result=loser.result), grown
    ended = (*taker.absorbed, *loser.absorbed, loser.number)
    absorbed = tuple(number for number in ended if number >= 0)
    return replace(loser, frames=(), again=()), replace(grown, absorbed=absorbed)


def _trimmed(
    tracks: Sequence[Track],
    bench: Bench,
    before: Mapping[int, Track],
) -> list[Track]:
    """Remove pixels outside the rendered outline of objects.

    For new objects only low pixels are removed, which the plane explains. For objects that were
    recognised before this frame all are removed, as they may belong to another object.
    """
    smaller = {}
    known = []
    for row, track in enumerate(tracks):
        mask = track.mask_in(bench.number)
        if mask is None or bench.is_good(track):
            continue
        named = before[track.number].posed if track.number in before else None
        rendered = render_track(
            track,
            bench.top,
            bench.number,
            named or track.likeliest,
        )
        if rendered is None:
            continue
        kept = mask & rendered.around(mask.shape)
        if named is not None:
            kept[rendered.part] &= ~(rendered.hidden | rendered.through)
        else:
            kept |= mask & (bench.top.height > NEAR_TABLE)
        lost = 1 - float(kept.sum() / max(mask.sum(), 1))
        if LEAST_TRIMMED < lost < MOST_PLANE_SHARE:
            smaller[row] = kept
            if named is not None:
                known.append(row)

    changed = {}
    new = [row for row in _largest(smaller) if row not in known]
    for row in [*known, *new[:MOST_TRIMMED]]:
        with suppress(ObservationError):
            changed[row] = tracks[row].with_mask(bench.number, smaller[row], bench.top)
    judged = bench.judge(list(changed.values()))
    tracks = list(tracks)
    for row, track in zip(changed, judged, strict=True):
        if bench.share([track]) > bench.share([tracks[row]]):
            tracks[row] = track
    return tracks


def _largest(masks: Mapping[int, Mask]) -> list[int]:
    """Return the rows of masks, (H, W) bool each, by decreasing number of pixels."""
    return sorted(masks, key=lambda row: -np.count_nonzero(masks[row]))


def _joined(tracks: Sequence[Track], bench: Bench) -> list[Track]:
    """Join objects that touch if one scan explains them all better than several do.

    Joined objects are tried with their remaining neighbours until no more are joined.
    """
    found = list(tracks)
    tried: list[Track] = []
    while True:
        joined = _joined_once(found, bench, tried)
        if len(joined) == len(found):
            return joined
        tried = found
        found = joined


def _joined_once(
    tracks: Sequence[Track],
    bench: Bench,
    tried: Sequence[Track],
) -> list[Track]:
    """Join disjoint groups of objects, those with the largest gain first.

    Groups whose objects are all in ``tried`` are skipped. Tried first are those whose objects are
    most likely one.
    """
    old = {id(track) for track in tried}
    groups = [
        group
        for group in _groups(tracks, bench)
        if not all(id(tracks[row]) in old for row in group)
    ]
    masks = [track.mask_in(bench.number) for track in tracks]
    pixels = [0 if mask is None else np.count_nonzero(mask) for mask in masks]
    shared = _shared(tracks, groups, bench)
    groups.sort(
        key=lambda group: (
            -sum(shared[row, other] for row in group for other in group),
            -sum(pixels[row] for row in group),
        )
    )
    unions = []
    for group in groups[:MOST_JOINED]:
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


def _shared(
    tracks: Sequence[Track],
    groups: Sequence[Sequence[int]],
    bench: Bench,
) -> Index:
    """Return how many pixels of each object the likeliest hypothesis of each other one explains.

    Args:
        tracks: N objects.
        groups: rows of objects that may be one; others are not compared.
        bench: the frame.

    Returns:
        Pixels, (N, N): row of the hypothesis, column of the object; 0 on the diagonal.
    """
    found = np.zeros((len(tracks), len(tracks)), np.int64)
    for row, other in {pair for group in groups for pair in permutations(group, 2)}:
        rendered = bench.render_likeliest(tracks[row])
        mask = tracks[other].mask_in(bench.number)
        if rendered is not None and mask is not None:
            found[row, other] = np.count_nonzero(mask[rendered.part] & rendered.agrees)
    return found


def _groups(tracks: Sequence[Track], bench: Bench) -> list[tuple[int, ...]]:
    """Return the rows of touching objects that may be one: pairs, and connected groups."""
    masks = [track.mask_in(bench.number) for track in tracks]
    good = np.array([bench.is_good(track) for track in tracks], bool)
    linked = np.zeros((len(tracks), len(tracks)), bool)
    near = set(bench.top.neighbours(masks, NEAR_GAP))
    for one, other in combinations(range(len(tracks)), 2):
        first, second = masks[one], masks[other]
        if first is None or second is None or (good[one] and good[other]):
            continue
        linked[one, other] = linked[other, one] = (
            (
                (one, other) in near
                and touching(bench.top.frame, first, second, NEAR_GAP, NEAR_STEP)
            )
            or _shares(tracks[one], second, bench)
            or _shares(tracks[other], first, bench)
        )

    pairs = [(int(a), int(b)) for a, b in np.argwhere(np.triu(linked))]
    label, count = _components(linked & ~np.logical_or.outer(good, good))
    whole = [tuple(np.flatnonzero(label == k).tolist()) for k in range(count)]
    return pairs + [group for group in whole if len(group) > 2]


def _components(linked: Mask) -> tuple[Index, int]:
    """Return the connected component of each of N nodes, (N,), and the number of components."""
    from scipy.sparse.csgraph import connected_components

    if not len(linked):
        return np.zeros(0, np.int64), 0
    count, label = connected_components(linked, directed=False)
    return np.asarray(label, np.int64), int(count)


def _shares(track: Track, mask: Mask, bench: Bench) -> bool:
    """Return True if the scan of an object explains most pixels of another mask, (H, W) bool."""
    rendered = bench.render(track)
    if rendered is None:
        return False
    explained = np.count_nonzero(mask[rendered.part] & rendered.agrees)
    return bool(explained > SHARED * np.count_nonzero(mask))


def _union(tracks: Sequence[Track], bench: Bench) -> Track:
    """Combine objects into one, with the pixels of all of them in every frame.

    Raises:
        ObservationError: too little of it is visible.
    """
    first = min(tracks, key=lambda track: track.number if track.number >= 0 else np.inf)
    seen: dict[int, list[Sighting]] = {}
    for track in tracks:
        for number, sighting in zip(track.frames, track.thing.sightings, strict=True):
            seen.setdefault(number, []).append(sighting)

    frames = sorted(seen)
    sightings = []
    for number in frames:
        one = seen[number][0]
        if len(seen[number]) > 1:
            every = np.any([other.mask for other in seen[number]], axis=0)
            both = sighting_of(one.frame, every, one.plane, one.noise)
            one = replace(both, warnings=one.warnings)
        sightings.append(one)

    again = dict(pair for track in tracks for pair in track.again) | dict(first.again)
    ended = [number for track in tracks for number in (track.number, *track.absorbed)]
    union = replace(
        first,
        again=tuple(pair for pair in again.items() if pair[0] not in frames),
        absorbed=tuple(
            sorted({number for number in ended if number not in (-1, first.number)})
        ),
    )
    return union.seen_as(sightings, frames, bench.top.up)


def _cut(tracks: Sequence[Track], bench: Bench) -> list[Track]:
    """Split objects into the pieces of the segmentation if several scans explain them better."""
    parts: dict[int, list[Mask]] = {}
    for row in _doubtful(tracks, bench):
        mask = tracks[row].mask_in(bench.number)
        found = [] if mask is None else bench.top.seen.pieces_of(mask)
        if 1 < len(found) <= MOST_PIECES:
            parts[row] = found
    return _better(tracks, parts, bench)


def _doubtful(tracks: Sequence[Track], bench: Bench) -> list[int]:
    """Return the rows of objects that may be split, those with the most pixels first."""
    masks = {
        row: mask
        for row, track in enumerate(tracks)
        if (mask := track.mask_in(bench.number)) is not None
        and track.tries < MOST_TRIES
        and not bench.is_good(track)
    }
    return _largest(masks)


def _without_rests(tracks: Sequence[Track], bench: Bench) -> list[Track]:
    """Separate the pixels that a scan explains from the rest, whose pieces become new objects."""
    parts: dict[int, list[Mask]] = {}
    for row in _doubtful(tracks, bench):
        mask = tracks[row].mask_in(bench.number)
        rendered = bench.render_likeliest(tracks[row])
        if mask is None or rendered is None:
            continue
        around = ndimage.binary_dilation(rendered.around(mask.shape), iterations=2)
        rests = bench.top.seen.pieces_of(mask & ~around)
        if rests:
            parts[row] = [mask & ~np.any(rests, axis=0), *rests]
    return _better(tracks, parts, bench)


def _parts(track: Track, masks: Sequence[Mask], bench: Bench) -> list[Track]:
    """Create objects from masks; the first one continues the original object."""
    first = track.with_mask(bench.number, masks[0], bench.top)
    return [first, *(new_track(mask, bench) for mask in masks[1:])]


def new_track(mask: Mask, bench: Bench) -> Track:
    """Create an object that no earlier frame showed.

    Args:
        mask: its pixels in the frame, (H, W) bool.
        bench: the frame.

    Raises:
        ObservationError: too little of it is visible.
    """
    top = bench.top
    up = None if top.frame.pose is None else top.up
    return Track(-1, ObservedObject(up), ()).with_mask(bench.number, mask, top)


def new_tracks(masks: Sequence[Mask], bench: Bench) -> list[Track]:
    """Create objects that no earlier frame showed.

    Args:
        masks: pixels of each in the frame, (H, W) bool.
        bench: the frame.

    Returns:
        Those that are visible enough.
    """
    found = []
    for mask in masks:
        with suppress(ObservationError):
            found.append(new_track(mask, bench))
    return found


def _better(
    tracks: Sequence[Track],
    parts: Mapping[int, Sequence[Mask]],
    bench: Bench,
) -> list[Track]:
    """Replace objects by their parts if the scans then explain more pixels.

    ``parts`` holds the masks of the parts of some objects by row, in the order in which they are
    tried.
    """
    tries: dict[int, list[Track]] = {}
    left = MOST_CUT
    for row, masks in parts.items():
        if len(masks) <= left:
            with suppress(ObservationError):
                tries[row] = _parts(tracks[row], masks, bench)
                left -= len(masks)

    judged = iter(bench.judge([one for some in tries.values() for one in some]))
    by_parts = {row: [next(judged) for _ in some] for row, some in tries.items()}
    found = []
    for row, track in enumerate(tracks):
        if row not in by_parts:
            found.append(track)
            continue
        before = bench.share([track])
        wanted = LEAST_GAIN if before >= KNOWN_SHARE else LEAST_OF_UNKNOWN
        if bench.share(by_parts[row]) >= before + wanted:
            found.extend(by_parts[row])
        else:
            found.append(track)
    return found
