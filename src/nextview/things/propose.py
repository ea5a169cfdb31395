"""Propose things and poses where a view shows something that is not explained.

Moments give poses of things that fit a segment, pairs of points also those that fit a part of it.
They are registered, and those that match best are scored. Few points of each are enough to reject
most. The best ones are registered again from poses beside their own: the way to the best pose of a
thing with thin or hollow parts is often barred by worse ones.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from nextview.sensing.view import View
from nextview.things.library import Hypotheses, Library
from nextview.things.register import Outline, Projected, register
from nextview.things.score import NEAREST, total_scores
from nextview.types import Float, Float32, Mask

PROPOSED = 600  # poses that pairs of points propose, at most
PROPOSED_OF_ONE = 20  # the same of one thing
BY_MOMENTS = 150  # poses that moments propose, at most
BY_MOMENTS_OF_ONE = 6  # the same of one thing
REGISTERED = 120  # poses that are registered after a first look, at most
MATCHED = 40  # hypotheses that are registered more closely, at most
MATCHED_OF_ONE = 4  # the same of one thing
RESTARTED = 12  # hypotheses that are registered from turned poses, too, at most
RESTARTED_OF_ONE = 2  # the same of one thing
RESTART = 0.25  # radians, by which these are turned
SCORED = 16  # hypotheses that are rendered, at most
SCORED_OF_ONE = 3  # the same of one thing
KEPT = 8  # hypotheses of one segment that are kept, at most
KEPT_OF_ONE = 2  # the same of one thing
ROUGH = (
    0.03  # standard deviation of the depth of a pose that is not registered yet, radii
)
ASIDE = 0.08  # radii, within which such a pose may be off to the side
SAME_POSE = 0.1  # radians, and radii of the thing, within which two poses are one
COARSER, COARSEST = 2, 3  # grids on which they are rendered to choose among them


def propose(
    library: Library,
    view: View,
    segments: Iterable[Mask],
    among: Mask,
) -> Hypotheses | None:
    """Propose what segments of a view may show.

    Args:
        library: the things.
        view: the view.
        segments: pixels that may be one thing, (H, W) bool each.
        among: things that they may be, (T,) bool.

    Returns:
        Some hypotheses for each segment; None for none.
    """
    instances = Outline.of((view.labels > 0) & ~view.surface)
    found = []
    for mask in segments:
        one = _of_segment(library, view, mask, instances, among)
        if one is not None:
            found.append(one)
    return Hypotheses.joined(found) if found else None


def _of_segment(
    library: Library, view: View, mask: Mask, instances: Outline, among: Mask
) -> Hypotheses | None:
    """Propose what one segment, (H, W) bool, may show.

    A thing may go on in other instances, so at last it is drawn into these, too.
    """
    pairs = library.visible.pairs
    by_pairs = pairs.propose(view, mask, among, PROPOSED, PROPOSED_OF_ONE)
    moments = library.visible.moments
    by_moments = moments.propose(view, mask, among, BY_MOMENTS, BY_MOMENTS_OF_ONE)
    found = Hypotheses.joined([Hypotheses.of(*by_pairs), Hypotheses.of(*by_moments)])
    if not len(found):
        return None

    # many at first, with few points each
    outline = Outline.of(mask)
    found = register(library, [view], found, (0.3,), 32, outline)
    match = matched(library, view, found, mask, 32)
    found = found[np.argsort(-match)[:REGISTERED]]
    found = register(library, [view], found, (0.2, 0.12), 48, outline)
    match = matched(library, view, found, mask, 64)
    found = best(library, found, match, MATCHED, MATCHED_OF_ONE)

    # fewer closer, then by their score
    closer = (0.15, 0.1, 0.08, 0.06, 0.05, 0.04)
    found = register(library, [view], found, closer, outline=instances)
    totals = total_scores(library, view, found, COARSEST)
    some = best(library, found, totals, RESTARTED, RESTARTED_OF_ONE)
    some = register(library, [view], some.turned(RESTART), closer, outline=instances)
    found = Hypotheses.joined([found, some])
    totals = np.append(totals, total_scores(library, view, some, COARSEST))
    found = best(library, found, totals, SCORED, SCORED_OF_ONE)
    found = register(library, [view], found, (0.03, 0.03), 128, instances)
    found = register(library, [view], found, (0.02,), 128)
    totals = total_scores(library, view, found, COARSER)
    explain = np.flatnonzero(totals > 0)
    if not len(explain):
        return None
    return best(library, found[explain], totals[explain], KEPT, KEPT_OF_ONE)


def best(
    library: Library, some: Hypotheses, values: Float, most: int, of_one: int
) -> Hypotheses:
    """Return the hypotheses with the highest values, no pose twice and few of one thing.

    Args:
        library: the things.
        some: M hypotheses.
        values: of each, (M,).
        most: number that is returned, at most.
        of_one: number of those of one thing, at most, unless there are few things.
    """
    of_one = max(of_one, most // len(library))
    turns = some.rotations.reshape(-1, 9)
    left = np.ones(len(some), bool)
    counts = np.zeros(len(library), np.int64)
    kept: list[int] = []
    for row in np.argsort(-values, kind="stable").tolist():
        thing = some.things[row]
        if not left[row] or counts[thing] == of_one:
            continue
        kept.append(row)
        if len(kept) == most:
            break
        counts[thing] += 1

        # nor another one in nearly the same pose
        angle = np.sqrt(np.maximum(3 - turns @ turns[row], 0))
        apart = np.linalg.norm(some.centres - some.centres[row], axis=1)
        same = angle + apart / library.radii[thing] < SAME_POSE
        left &= ~same | (some.things != thing)
    return some[np.array(kept, np.int64)]


def matched(
    library: Library, view: View, some: Hypotheses, mask: Mask, count: int
) -> Float:
    """Return how much of hypotheses and of a segment match, without rendering, (M,) float64.

    Args:
        library: the things.
        view: the view.
        some: M hypotheses.
        mask: pixels of the segment, (H, W) bool.
        count: number of points of each hypothesis.
    """
    seen = Projected.of(library, view, some, count)
    radius = library.radii[some.things][:, None]
    off, own, measured = _beside(view, seen, mask, ASIDE * radius)
    sigma = np.hypot(ROUGH * radius, view.noise.at(seen.depth) * seen.depth**2)
    margin = 3 * sigma
    match = measured & (np.abs(off) < margin)
    through = measured & (off >= margin)
    front = measured & (off <= -margin)
    visible = np.maximum((seen.inside & ~(front & ~own)).sum(1), 1)
    share = (match.sum(1) - 2 * through.sum(1) - (front & own).sum(1)) / visible

    # number of pixels that the hypothesis would show, and how much of the segment it covers
    side = 2 * np.sqrt(25 / 24) * library.radii[some.things]
    side *= view.frame.pinhole.fx / np.maximum(seen.middle[:, 2], NEAREST)
    covered = (
        seen.fill * side**2 * (match & own).mean(1) / max(1, np.count_nonzero(mask))
    )
    return np.where(share > 0, share * np.minimum(1, covered), share)


def _beside(
    view: View, seen: Projected, mask: Mask, aside: Float
) -> tuple[Float32, Mask, Mask]:
    """Compare points with the pixels at and beside them, and keep those that fit best.

    Args:
        view: the view.
        seen: points of M hypotheses in it.
        mask: pixels of the segment, (H, W) bool.
        aside: how far the pixels beside are away, (M, 1), metres.

    Returns:
        How far what is measured lies behind each point, (M, N) float32, metres; whether it belongs
        to the segment, (M, N) bool; and whether anything is measured, (M, N) bool.
    """
    height, width = view.frame.shape
    pixels = aside * view.frame.pinhole.fx / np.maximum(seen.middle[:, 2:], NEAREST)
    step = np.rint(pixels).astype(np.int32)
    off = np.full(seen.row.shape, np.inf, np.float32)
    own = np.zeros(seen.row.shape, bool)
    for down, right in ((0, 0), (0, 1), (0, -1), (1, 0), (-1, 0)):
        row = (seen.row + down * step).clip(0, height - 1)
        column = (seen.column + right * step).clip(0, width - 1)
        depth = view.depth[row, column]
        gap = np.where(depth > 0, depth - seen.points[:, 2], np.float32(np.inf))
        better = np.abs(gap) < np.abs(off)
        off = np.where(better, gap, off)
        own = np.where(better, mask[row, column], own)
    return off, own, seen.inside & np.isfinite(off)
