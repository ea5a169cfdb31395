"""From the network's output to instances: pixels that are likely to belong together are joined."""

from __future__ import annotations

from heapq import heapify, heappop, heappush

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from nextview.segmentation.features import SmallPicture
from nextview.segmentation.network import (
    AFFINITY_OUTPUTS,
    AFFINITY_STEPS,
    OUTPUT_CLASSES,
)
from nextview.types import Float32, Index, Mask

THING_CLASS = OUTPUT_CLASSES.index("thing")
BACKGROUND_CLASS = OUTPUT_CLASSES.index("background")
SURFACE_CLASS = OUTPUT_CLASSES.index("surface")
# added to all log-odds: the training counts pairs of different things four times
JOINING_ODDS = 1.05
# of a pair, below which the network is in doubt whether to join: pieces are joined above it
DOUBTFUL_ODDS = 2.0
LIMIT_OF_ODDS = 4.0  # log-odds of one pair beyond which it says no more
# steps of a sixtieth of the depth count as much as a pixel of the picture
EDGE_SHARPNESS = 60.0
SCRAP_PIXELS = 16  # of an instance that is none of its own, but a piece of an edge
# of all neighbours around a pixel, to be joined before all others; and of what is background
CERTAIN_ODDS = 2.0


def part(output: Float32, valid: Mask, doubt: float = 0.0) -> Index:
    """Join pixels of things to instances, those first whose pairs speak most for it.

    Each pair of pixels that the network compares has log-odds of belonging to one thing. Regions
    are joined as long as the sum over the pairs between two of them is positive (greedy additive
    edge contraction: Keuper et al., ICCV 2015).

    Args:
        output: of the network, (15, h, w).
        valid: pixels with depth, (h, w) bool.
        doubt: log-odds that are taken from those of each pair: only what clearly belongs together
            is joined.

    Returns:
        The instance of each pixel from 1 on, 0 for none, (h, w) int64.
    """
    thing = valid & (output[: len(OUTPUT_CLASSES)].argmax(0) == THING_CLASS)
    size = thing.size
    at = np.arange(size).reshape(thing.shape)
    of_pairs = output[AFFINITY_OUTPUTS] + (JOINING_ODDS - doubt)
    certain = _certain(of_pairs)
    ends = []
    odds = []
    joining = []
    for values, step in zip(of_pairs, AFFINITY_STEPS, strict=True):
        first, second = pair_slices(thing.shape, *step)
        both = thing[first] & thing[second]
        ends.append(np.stack([at[first][both], at[second][both]]))
        odds.append(np.clip(values[first][both], -LIMIT_OF_ODDS, LIMIT_OF_ODDS))
        near = (certain[first] & certain[second])[both]
        joining.append(near if sum(map(abs, step)) == 1 else np.zeros_like(near))
    pairs = np.concatenate(ends, 1)
    weight = np.concatenate(odds)
    joined = np.concatenate(joining)

    graph = coo_array((np.ones(joined.sum()), pairs[:, joined]), shape=(size, size))
    component = connected_components(graph, directed=False)[1].astype(np.int64)
    region = _renumbered(np.where(thing.ravel(), component + 1, 0), size + 1)
    label = _contracted(region[pairs], weight, int(region.max(initial=0)) + 1)
    return _without_scraps(label[region], pairs, weight).reshape(thing.shape)


def _without_scraps(labels: Index, pairs: Index, weight: Float32) -> Index:
    """Join each scrap of few pixels to the instance with which its pairs have the highest odds.

    Args:
        labels: instance of each pixel from 1 on, 0 for none, (P,).
        pairs: pixels of the two ends of each pair, (2, E).
        weight: log-odds of each, (E,).
    """
    sizes = np.bincount(labels)
    scrap = sizes < SCRAP_PIXELS
    scrap[0] = False

    ends = labels[pairs]
    other = np.concatenate([ends, ends[::-1]], 1)
    odds = np.concatenate([weight, weight])
    out = scrap[other[0]] & ~scrap[other[1]] & (other[1] > 0)
    if not out.any():
        return labels

    one, two = other[:, out]
    keys, which, count = np.unique(
        one * len(sizes) + two, return_inverse=True, return_counts=True
    )
    mean = np.bincount(which, odds[out]) / count

    order = np.argsort(mean, kind="stable")  # the last one that is written stays
    owner = np.arange(len(sizes))
    owner[keys[order] // len(sizes)] = keys[order] % len(sizes)
    return _renumbered(owner[labels], len(sizes))


def _renumbered(labels: Index, count: int) -> Index:
    """Number the labels that occur from 1 on, in their order; 0 stays 0.

    Args:
        labels: (P,).
        count: more than the largest label.
    """
    occurs = np.zeros(count, bool)
    occurs[labels] = True
    occurs[0] = True
    return (np.cumsum(occurs) - 1)[labels]


def surface_of(output: Float32, valid: Mask) -> Mask:
    """Return the pixels of what carries things, (h, w) bool.

    Args:
        output: of the network, (15, h, w).
        valid: pixels with depth, (h, w) bool.
    """
    return valid & (output[: len(OUTPUT_CLASSES)].argmax(0) == SURFACE_CLASS)


def background_of(output: Float32, valid: Mask) -> Mask:
    """Return the pixels that are clearly neither a thing nor a surface, (h, w) bool.

    Args:
        output: of the network, (15, h, w).
        valid: pixels with depth, (h, w) bool.
    """
    odds = output[: len(OUTPUT_CLASSES)]
    others = np.logaddexp(odds[THING_CLASS], odds[SURFACE_CLASS])
    return valid & (odds[BACKGROUND_CLASS] - others > CERTAIN_ODDS)


def pair_slices(
    shape: tuple[int, ...], down: int, right: int
) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Where the first pixels of all pairs with a step lie in a picture, and the second ones.

    Args:
        shape: rows and columns of the picture.
        down: rows of the step, not negative.
        right: columns of the step.
    """
    height, width = shape
    left = max(0, -right)
    first = np.s_[: max(0, height - down), left : max(left, width - max(0, right))]
    start = left + right
    second = np.s_[down:, start : start + max(0, width - abs(right))]
    return first, second


def _certain(odds: Float32) -> Mask:
    """Pixels around which all pairs of neighbours are clearly of one thing, (h, w) bool.

    Args:
        odds: log-odds of each of AFFINITY_STEPS, (S, h, w).
    """
    near = [k for k, step in enumerate(AFFINITY_STEPS) if sum(map(abs, step)) == 1]
    return ndimage.minimum_filter(odds[near].min(0), 3) > CERTAIN_ODDS


def _contracted(
    pairs: Index,
    weight: Float32,
    count: int,
) -> Index:
    """Join regions greedily by the sums of the weights between them.

    Args:
        pairs: regions of the two ends of each edge, (2, E); 0 is none.
        weight: of each edge, (E,).
        count: of regions, with 0.

    Returns:
        The label of each region from 1 on, (count,); region 0 is none and keeps 0.
    """
    low = np.minimum(*pairs)
    high = np.maximum(*pairs)
    apart = low != high
    keys, which = np.unique(low[apart] * count + high[apart], return_inverse=True)
    sums = np.bincount(which, weight[apart], len(keys))
    ends = zip(*(one.tolist() for one in np.divmod(keys, count)), strict=True)
    beside: list[dict[int, float]] = [{} for _ in range(count)]
    heap = []
    for (one, other), value in zip(ends, sums.tolist(), strict=True):
        beside[one][other] = value
        beside[other][one] = value
        if value > 0:
            heap.append((-value, one, other))

    owner = np.arange(count)
    heapify(heap)
    while heap:
        value, one, other = heappop(heap)
        if beside[one].get(other) != -value:
            continue  # one of the two was joined with a third since
        if len(beside[one]) < len(beside[other]):
            one, other = other, one
        owner[other] = one
        of_one = beside[one]
        of_other = beside[other]
        beside[other] = {}
        del of_one[other]
        del of_other[one]
        for third, sum_there in of_other.items():
            of_third = beside[third]
            del of_third[other]
            total = of_one.get(third, 0.0) + sum_there
            of_one[third] = total
            of_third[one] = total
            if total > 0:
                heappush(heap, (-total, one, third))

    while (owner != owner[owner]).any():
        owner = owner[owner]
    return _renumbered(owner, count)


def sharpen(
    labels: Index,
    picture: SmallPicture,
    depth: Float32,
) -> Index:
    """Bring labels to the resolution of the frame.

    A pixel of the frame at a border takes the label of that pixel of the small picture nearby
    whose surface it continues.

    Args:
        labels: of the small picture, (h, w); 0 for none.
        picture: the small picture.
        depth: of the frame, (H, W), metres.

    Returns:
        Labels, (H, W) int64; 0 where nothing was measured.
    """
    factor = picture.factor
    height, width = depth.shape
    fine = np.repeat(np.repeat(labels, factor, 0), factor, 1)[:height, :width].copy()
    fine[depth == 0] = 0
    around = ndimage.maximum_filter(labels, 3) != ndimage.minimum_filter(labels, 3)
    around |= (labels > 0) & (ndimage.minimum_filter(picture.depth, 3) == 0)
    edge = np.repeat(np.repeat(around, factor, 0), factor, 1)[:height, :width] & (
        depth > 0
    )
    rows, columns = np.nonzero(edge)
    if not len(rows):
        return fine

    z = depth[rows, columns]
    best = np.full(len(rows), np.inf, np.float32)
    chosen = np.zeros(len(rows), np.int64)
    row = rows // factor
    column = columns // factor
    middle = (factor - 1) / 2
    last_row, last_column = np.subtract(labels.shape, 1)
    for down in (-1, 0, 1):
        r = np.clip(row + down, 0, last_row)
        below = rows - r * factor - middle
        for right in (-1, 0, 1):
            c = np.clip(column + right, 0, last_column)
            at = r * labels.shape[1] + c
            there = picture.depth.take(at)
            aside = np.hypot(below, columns - c * factor - middle)
            apart = np.abs(there - z) / z * EDGE_SHARPNESS + aside / factor
            apart = np.where(there > 0, apart, np.inf).astype(np.float32)
            nearer = np.flatnonzero(apart < best)
            best[nearer] = apart[nearer]
            chosen[nearer] = labels.take(at[nearer])
    fine[rows, columns] = chosen
    return fine
