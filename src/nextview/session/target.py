"""The object of a session among others: its pixels are parted from theirs as in a scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial

import numpy as np

from nextview.errors import ObservationError
from nextview.sensing.choosing import NO_INSTANCE, choose_instance, with_neighbours
from nextview.sensing.masks import above_plane, touching
from nextview.sensing.observed_object import ObservedObject
from nextview.sensing.segmented_frame import SegmentedFrame
from nextview.sensing.tabletop import TableTop
from nextview.session.following import STEP_BEHIND, assign, points_in
from nextview.session.parting import (
    NEAR_GAP,
    NEAR_STEP,
    Bench,
    new_tracks,
    part,
    taken_over,
)
from nextview.session.result import Recognition
from nextview.session.tracks import Track, judged
from nextview.types import Float, Mask


def parted_from_neighbours(
    thing: ObservedObject,
    seen: SegmentedFrame,
    judge: Callable[[Sequence[ObservedObject]], list[Recognition]],
    before: Track | None,
) -> Mask | None:
    """Part one object from its neighbours in a frame, as the objects of a scene are parted.

    Args:
        thing: the object after the frame.
        seen: the frame with its instances.
        judge: recognises objects.
        before: the object before the frame, already judged, with the number 0; None in a first
            frame.

    Returns:
        The pixels of the object, (H, W) bool; None if they stay as they are.

    Raises:
        ObservationError: something hides the object.
    """
    number = len(thing.sightings) - 1
    sighting = thing.sightings[-1]
    top = TableTop.of(seen, thing.object_frame.axes[2], sighting.plane)
    bench = Bench(top, number, partial(judged, judge=judge))
    segments = seen.segments()
    chosen = sighting.mask
    if before is None or before.posed is None:
        target = Track(0, thing, tuple(range(number + 1)))
        others = [mask & ~chosen for mask in segments]
        known = {}
    else:
        target, others = _followed(before, segments, bench)
        known = {0: before}
    own = target.mask_in(number)
    assert own is not None
    if _near(own, others, bench) or len(seen.pieces_of(own)) > 1:
        if target.result is None:
            [target] = bench.judge([target])
        if target.likeliest is None:
            target = _more_familiar(target, bench)
        else:
            tracks = part(_with_neighbours(target, others, bench), bench, known)
            target = _asked_for(tracks, thing, before, bench)
    if before is None and thing.point is not None:
        target = _without_others(target, thing.point, bench)

    found = target.mask_in(number)
    assert found is not None
    return None if np.array_equal(found, chosen) else found


def _followed(
    before: Track, segments: Sequence[Mask], bench: Bench
) -> tuple[Track, list[Mask]]:
    """Return a named object with its pixels in a frame, and the masks of everything else.

    Raises:
        ObservationError: something hides the object.
    """
    own, others = assign(segments, [before], bench.top)
    if own:
        return before.with_mask(bench.number, own[0], bench.top), others
    tracks = taken_over([before, *new_tracks(others, bench)], [bench])
    target = next((track for track in tracks if track.number == 0), before)
    if target.mask_in(bench.number) is None:
        raise ObservationError(NO_INSTANCE.format(where="of the object known so far"))
    masks = [one.mask_in(bench.number) for one in tracks if one.number != 0]
    return target, [mask for mask in masks if mask is not None]


def _near(own: Mask, masks: Sequence[Mask], bench: Bench) -> list[Mask]:
    """Return the masks, (H, W) bool, of what may touch an object."""
    frame = bench.top.frame
    return [mask for mask in masks if touching(frame, own, mask, NEAR_GAP, NEAR_STEP)]


def _with_neighbours(target: Track, masks: Sequence[Mask], bench: Bench) -> list[Track]:
    """Recognise the neighbours of an object, and those of neighbours that no scan explains.

    Args:
        target: the object, already judged.
        masks: everything else in the frame, (H, W) bool each.
        bench: the frame.

    Returns:
        The object and its neighbours, judged.
    """
    found = [target]
    left = list(masks)
    for track in found:  # it grows
        own = track.mask_in(bench.number)
        if own is None or (track is not target and bench.is_good(track)):
            continue
        beside = _near(own, left, bench)
        left = [mask for mask in left if not any(mask is one for one in beside)]
        found += bench.judge(new_tracks(beside, bench))
    return found


def _more_familiar(target: Track, bench: Bench) -> Track:
    """Join an object with everything that touches it if that is more like a known class.

    No scan tells where an object of a class ends.
    """
    result = target.result
    mask = target.mask_in(bench.number)
    assert result is not None
    assert mask is not None
    if result.familiarity >= 1:
        return target
    whole = with_neighbours(mask, bench.top.seen)
    with suppress(ObservationError):
        [other] = bench.judge([target.with_mask(bench.number, whole, bench.top)])
        found = other.result
        assert found is not None
        if not found.unknown and found.familiarity > result.familiarity:
            return other
    return target


def _without_others(target: Track, point: Float, bench: Bench) -> Track:
    """Return the part of an object on which a point lies, unless its scan explains the point.

    Args:
        target: the object.
        point: on the object that is asked for, (3,), world, metres.
        bench: the frame.

    Raises:
        ObservationError: the segmentation does not part what the point is on.
    """
    top = bench.top
    mask = target.mask_in(bench.number)
    assert mask is not None
    at, off = points_in(point[None], top.frame)
    high = above_plane(top.frame, top.under(mask), top.noise)
    if not (high[at] & (np.abs(off) < STEP_BEHIND)).any():
        return target  # the frame does not show the point, or it is on the support

    if target.result is None:
        if mask[at].all():
            return target
        [target] = bench.judge([target])
    rendered = bench.render(target)
    if rendered is None or rendered.around(mask.shape)[at].all():
        return target

    shown = [mask, *(one for one in top.seen.masks if one[at].any())]
    rests = np.any(shown, axis=0) & high & ~rendered.around(mask.shape)
    for rest in top.seen.pieces_of(rests):
        if rest[at].any():
            return target.with_mask(bench.number, rest, top)
    raise ObservationError(NO_INSTANCE.format(where="of its own at the point"))


def _asked_for(
    tracks: Sequence[Track],
    thing: ObservedObject,
    before: Track | None,
    bench: Bench,
) -> Track:
    """Return the object that the session asks for."""
    if before is not None and before.posed is not None:
        return next(track for track in tracks if track.number == before.number)
    masks = [track.mask_in(bench.number) for track in tracks]
    every = [mask for mask in masks if mask is not None]
    place = None if before is None else before.thing.object_frame
    chosen = choose_instance(bench.top.seen.parted(every), thing.point, place)
    row = next(row for row, mask in enumerate(masks) if mask is chosen)
    return tracks[row]
