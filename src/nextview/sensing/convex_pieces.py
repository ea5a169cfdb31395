"""Cut what stands on a plane into pieces along concave edges and depth jumps.

After the convexity rule of LCCP (Stein et al., "Object Partitioning Using Local Convexity", CVPR
2014), on the image. Objects have concave edges too: ``clusters`` joins the pieces of one object
again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from nextview.sensing.facets import Noise
from nextview.sensing.frame import holes_of, within
from nextview.types import Float32, Index, Mask

WIDTH = 320  # columns in which edges are searched: a wider image is taken in steps
LAG = 4  # pixels from an edge at which the surfaces to both sides of it are looked at
VALLEY = 0.004  # depth of a concave edge, as a part of the distance, from which it cuts
# part of the distance by which a pixel lies behind another one LAG away, from which it is cut at an
# end
CUT_STEP = 0.08
FEWEST_PIECE_PIXELS = 12  # pixels of a piece
GROWN = 12  # pixels that a piece grows at its edges, at most
LED = 2, 5  # pixels from a border that tell to which depth a surface leads at it
# height over the plane, as a part of the distance, down to which a piece is seen if it stands there
STANDS = 0.02
# height of a bottom over the plane, as a part of the distance, from which it is no hole
BOTTOM = 0.002
# pixels in which two pieces touch, as a part of the root of those of the smaller one: fewer are a
# corner
CONTACT = 0.3
ENCLOSED = 0.7
"""Share of the border of a piece that it has to one other, from which it lies inside it: the
bottom of a bathtub.
"""
NEXT: Any = ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:]))
"""All pairs of pixels side by side: the first of each, and the second."""
HELD = 0.1
HIDING_STEP = 0.1
"""Share of the lower edge of a piece under which what holds it shows, at least; and behind a
nearer one, at most.
"""
LOW_PIXELS = 5  # pixels of a piece that may be so low by noise
LOW = 2  # pixels, that low, of the border of two things that stand side by side


@dataclass(frozen=True)
class Pieces:
    """Pieces of what stands on a plane.

    Attributes:
        label: of each pixel, (H, W); 0 for no piece.
        grown: the same, with the less certain pixels at edges, (H, W).
        stands: whether each piece reaches down to the plane, (pieces + 1,), by label.
        touch: whether two pieces touch in space, (pieces + 1, pieces + 1).
        low: whether the border between two pieces reaches down to the plane, same shape.
        inside: whether the first piece lies inside the outline of the second, same shape.
        hangs: whether the first piece, which does not reach the plane, is held by the second, same
            shape.
    """

    label: NDArray[np.int32]
    grown: NDArray[np.int32]
    stands: Mask
    touch: Mask
    low: Mask
    inside: Mask
    hangs: Mask


def cut(
    depth: Float32,
    above: Mask,
    height: Float32,
    noise: Noise,
    before_walls: Mask | None = None,
) -> Pieces:
    """Cut what is seen above a plane into pieces.

    Args:
        depth: metres, (H, W), 0 where nothing was measured.
        above: the pixels that are above the plane, (H, W) bool.
        height: of each pixel over the plane, metres, (H, W).
        noise: of the depth.
        before_walls: pixels that show no wall, (H, W) bool: others are seen through a hole, and are
            no bottom of one. All by default.
    """
    label, grown = np.zeros((2, *depth.shape), np.int32)
    part = within(above)
    if not above[part].size:
        return Pieces(label, grown, np.zeros(1, bool), *np.zeros((4, 1, 1), bool))
    step = max(1, round(depth.shape[1] / WIDTH))
    few = (slice(None, None, step),) * 2
    z = depth[part][few]
    mask = above[part][few]
    high = height[part][few]
    bottom = _bottoms(z, mask, high)
    if before_walls is not None:
        bottom &= before_walls[part][few]
    mask = mask | bottom
    inverse = _smooth(z, mask)
    usual = np.where(mask, z, 1).astype(np.float32)
    # as a part of the distance
    error = (2 * noise.at(usual) * usual).astype(np.float32)
    tolerance = (VALLEY + error) / usual
    found: Any
    found, count = ndimage.label(mask & ~_concave(inverse, tolerance))
    kept = np.bincount(found.ravel(), minlength=count + 1) >= FEWEST_PIECE_PIXELS
    kept[0] = False
    found = np.asarray(np.cumsum(kept) * kept)[found]
    # A pixel of an edge goes to the nearest piece that is as near to the camera.
    away, nearest = ndimage.distance_transform_edt(found == 0, return_indices=True)
    close = away <= 2 * LAG
    found_near = found[tuple(nearest)]
    around = np.where((mask | (z == 0)) & close, found_near, found)
    with np.errstate(invalid="ignore"):
        joins = (
            mask & close & (np.abs(inverse[tuple(nearest)] - inverse) < 4 * tolerance)
        )
    found = np.where(joins, found_near, 0)
    low = mask & (high / usual - 2 * error < STANDS)
    stands = np.bincount(found[low], minlength=kept.sum() + 1) > LOW_PIXELS
    stands[0] = False
    shape = above[part].shape
    kept_pixels = (
        above[part] | _enlarged(bottom, step, shape) if bottom.any() else above[part]
    )
    for shown, small in (
        (label, found),
        (grown, _grown(found, mask, inverse, tolerance)),
    ):
        np.copyto(
            shown[part],
            _enlarged(small, step, shape),
            where=kept_pixels,
            casting="unsafe",
        )
    whole = _grown(found, mask, inverse, 4 * tolerance)
    at_plane = _borders(whole, [low[a] | low[b] for a, b in NEXT]) >= LOW
    touch = _touching(whole, inverse, 2 * tolerance)
    hangs = _hanging(whole, inverse, tolerance, stands)
    return Pieces(label, grown, stands, touch, at_plane, _enclosed(around), hangs)


def _grown(label: Index, mask: Mask, inverse: Float32, tolerance: Float32) -> Index:
    """Assign the pixels of edges to the adjacent piece with the most similar depth."""
    wide = np.pad(label, 1)
    deep = np.pad(inverse, 1).ravel()
    limit = np.pad(tolerance, 1).ravel()
    flat = wide.ravel()
    row = wide.shape[1]
    bare = np.flatnonzero(np.pad(mask & (label == 0), 1))

    for _ in range(GROWN):
        beside = bare[:, None] + (1, row, -1, -row)
        off = np.where(
            flat[beside] > 0,
            np.abs(deep[beside] - deep[bare, None]),
            np.inf,
        )
        nearest = np.arange(len(bare)), off.argmin(1)
        joins = off[nearest] < limit[bare]
        if not joins.any():
            break
        flat[bare[joins]] = flat[beside[nearest][joins]]
        bare = bare[~joins]

    return wide[1:-1, 1:-1]


def _enlarged(small: NDArray[Any], step: int, shape: tuple[int, ...]) -> NDArray[Any]:
    """Every pixel ``step`` times as wide and as high, cut off to a shape."""
    return np.repeat(np.repeat(small, step, 0), step, 1)[: shape[0], : shape[1]]


def _bottoms(depth: Float32, mask: Mask, height: Float32) -> Mask:
    """Return holes of the mask that lie over the plane, (H, W) bool, such as a bowl's bottom."""
    holes = holes_of(mask) & (depth > 0)
    label, count = ndimage.label(holes)
    if not count:
        return holes
    middle = ndimage.median(
        height[holes] / depth[holes],
        label[holes],
        np.arange(1, count + 1),
    )
    return np.append(False, np.asarray(middle) > BOTTOM)[label]


def _smooth(depth: Float32, mask: Mask) -> Float32:
    """Return the mean inverse depth of 3 x 3 pixels of the mask, (H, W), 1/metres, else NaN."""
    weight = ndimage.uniform_filter(mask.astype(np.float32), 3, mode="constant")
    inverse = np.where(mask, 1 / np.where(mask, depth, 1), 0).astype(np.float32)
    total = ndimage.uniform_filter(inverse, 3, mode="constant")
    return np.where(
        mask,
        total / np.maximum(weight, np.float32(1e-6)),
        np.float32(np.nan),
    )


def _concave(inverse: Float32, tolerance: Float32) -> Mask:
    """Return the pixels in concave edges, (H, W) bool.

    Inverse depth is linear over the image of a plane; ``tolerance`` is of its unit, (H, W). Where
    one of the two is no pixel of a thing, as in a narrow strip that shows beside what hides the
    rest, a step in depth does.
    """
    found = np.zeros(inverse.shape, bool)
    padded = np.pad(inverse, LAG, constant_values=np.nan)
    height, width = inverse.shape
    limit = 2 * (inverse + tolerance)
    step = (1 + np.float32(CUT_STEP)) * inverse + tolerance
    with np.errstate(invalid="ignore"):
        for dy, dx in ((0, LAG), (LAG, 0), (LAG, LAG), (LAG, -LAG)):
            one = padded[LAG + dy : LAG + dy + height, LAG + dx : LAG + dx + width]
            other = padded[LAG - dy : LAG - dy + height, LAG - dx : LAG - dx + width]
            both = one + other
            found |= (both > limit) | np.isnan(both) & (np.fmax(one, other) > step)
    return found


def _touching(label: Index, inverse: Float32, tolerance: Float32) -> Mask:
    """Return which pieces meet in space, (pieces + 1, pieces + 1) bool."""
    # Its own pixels do not tell: where one thing hides another one, a sensor gives a slope between
    # them.
    near, far = LED
    wide = np.pad(label, far)
    deep = np.pad(inverse, far, constant_values=np.nan)
    meeting = []

    for (one, other), (down, right) in zip(NEXT, ((0, 1), (1, 0)), strict=True):
        a = label[one]
        b = label[other]
        meet = np.zeros(a.shape, bool)
        row, column = np.nonzero((a != b) & (a > 0) & (b > 0))
        a = a[row, column]
        b = b[row, column]
        limit = tolerance[row, column]
        led = []
        for piece, start, way in ((a, 0, -1), (b, 1, 1)):
            at = [
                (far + row + down * k, far + column + right * k)
                for k in (start + way * np.array([0, near, far]))
            ]
            there = (wide[at[1]] == piece) & (wide[at[2]] == piece)
            slope = (deep[at[1]] - deep[at[2]]) / (far - near)
            led.append(np.where(there, deep[at[1]] + (near + 0.5) * slope, deep[at[0]]))
        with np.errstate(invalid="ignore"):
            meet[row, column] = np.abs(led[0] - led[1]) < limit
        meeting.append(meet)
    size = np.sqrt(np.bincount(label.ravel()))
    touch = _borders(label, meeting) > np.maximum(
        CONTACT * np.minimum.outer(size, size),
        2,
    )
    touch[0] = touch[:, 0] = False

    return touch


def _enclosed(label: Index) -> Mask:
    """Which pieces have most of their border to which other one, (pieces + 1, pieces + 1) bool."""
    # a piece has a border where the part of the picture ends, too
    label = np.pad(label, 1)
    count = _borders(label, [np.ones(label[a].shape, bool) for a, _ in NEXT])
    inside = count > ENCLOSED * count.sum(1, keepdims=True)
    inside[0] = inside[:, 0] = False
    return inside


def _hanging(label: Index, inverse: Float32, tolerance: Float32, stands: Mask) -> Mask:
    """Which pieces are held by which other one, (pieces + 1, pieces + 1) bool.

    Nothing hangs in the air. Where the lower edge of a piece is in sight, and not on the plane, it
    is held by the piece that shows below: the legs of a table, which stand back under its top.
    Where a nearer piece hides the lower edge it may stand behind that.
    """
    n = len(stands)
    beneath = np.zeros_like(label)
    deep = np.full(inverse.shape, np.nan, np.float32)
    for step in range(
        LAG,
        0,
        -1,
    ):  # an edge is some pixels wide: the nearest comes last
        shown = label[step:] > 0
        beneath[:-step][shown] = label[step:][shown]
        deep[:-step][shown] = inverse[step:][shown]

    edge = np.zeros(label.shape, bool)
    edge[:-1] = (label[:-1] > 0) & (label[:-1] != label[1:])
    edge &= ~stands[label] & (beneath != label)
    with np.errstate(invalid="ignore"):
        in_front = edge & (beneath > 0) & (inverse > deep - tolerance)
    length = np.bincount(label[edge], minlength=n)
    held = np.bincount(
        label[in_front] * n + beneath[in_front],
        minlength=n * n,
    ).reshape(n, n)
    hidden = np.bincount(label[edge & (beneath > 0) & ~in_front], minlength=n)

    holder = held.argmax(1)
    enough = held[np.arange(n), holder] >= np.maximum(HELD * length, LOW)
    hangs = np.zeros((n, n), bool)
    hangs[np.arange(n), holder] = enough & (hidden < HIDING_STEP * length) & ~stands
    hangs[0] = hangs[:, 0] = False
    return hangs


def _borders(label: Index, counted: list[Mask]) -> Index:
    """Count the pairs of adjacent pixels that pieces share, (pieces + 1, pieces + 1)."""
    n = int(label.max()) + 1
    count = np.zeros((n, n), np.int64)
    for (one, other), wanted in zip(NEXT, counted, strict=True):
        a = label[one]
        b = label[other]
        use = wanted & (a != b)
        count += np.bincount(a[use] * n + b[use], minlength=n * n).reshape(n, n)
    return count + count.T
