"""Which pieces of what stands on a plane are one object, seen from above and in several frames.

From above the parts of one object lie over each other even where it hides itself, such as the far
legs of a table under its top; things that stand side by side lie apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy import ndimage
from scipy.linalg import block_diag
from scipy.spatial import ConvexHull, QhullError

from nextview.sensing.convex_pieces import Pieces
from nextview.sensing.frame import Frame
from nextview.types import Float, Index, Mask

# whether things that touch are one thing
Joins = Literal["by their border", "never", "always"]

# side of a cell of the footprint, in distances of the camera from the object
FOOTPRINT_CELL = 0.01
# share of the cells of a piece that lie over another one of the same frame, from which they are one
OVERLAP = 0.25
# strength of the link of two pieces that touch: what lies over each other in two frames is joined
# first
TOUCH = 0.45
# share of the smaller of two clusters that a piece which joins them has at least: no leg joins two
BRIDGE = 0.25
# of the area of a cell, as the camera sees it, that a piece shows over it, at least
LEAST_COVER = 0.15
FEWEST_CELL_PIXELS = 2  # that show it
# share of the cells of a piece that lie over, or beside, one of another frame, from which they are
# one
LIES_OVER = 0.5
CELLS_BESIDE = 2  # cells up to which two pieces stand side by side
# share of the cells of a piece that lie within the outline of another one, from which they are one
WITHIN = 0.8
ON_OUTLINE = 0.5  # cells up to which one outside of an outline lies on it
OUTLINED = 25  # cells of a piece with an outline, at least
MOST_COMPARED_CELLS = 50  # cells of a piece that are compared with those of another one
FOOTPRINT_DIRECTIONS = 24
# share of the directions from what lies within a piece in which it has cells
SURROUNDED = 0.85
TWO = 0.25  # share of the cells of an object that a part of it has which may be another thing
# share of a thing's pixels over what is seen of the plane, at least: it may hide most of it
OVER_PLANE = 0.1
BOTTOM_ROWS = 2  # rows of that picture that are its lower edge
AIM_WIDTH = 160  # columns of the picture in which is seen how far from the optical axis things lie
# picture widths from the optical axis at which a thing counts for 1 / e of its pixels
AIM_SPREAD = 0.08
CELLS_REACHED = 250
BEYOND_REACH = 1000
"""Cells to each side of where the object is looked for: farther things are left out. And cells from
those of the first frame beyond which nothing can be a part of the same object."""


@dataclass(frozen=True)
class Footprint:
    """The cells that the pieces of a frame cover, seen from above.

    They are K pairs of a cell and a piece; each pair occurs once.

    Attributes:
        cells: indices of the cells along x and y, (K, 2).
        piece: label of the piece in each pair, (K,).
        pieces: all pieces of the frame.
        area: surface area of each pair, square metres, (K,).
        pixels: number of pixels that show it, (K,).
        cell: side of a cell, metres.
    """

    cells: Index
    piece: Index
    pieces: Pieces
    area: Float
    pixels: Index
    cell: float

    @cached_property
    def outlines(self) -> dict[int, Float]:
        """Convex outline of each larger piece: K lines (a, b, c), a x + b y + c <= 0, cells."""
        found = {}
        many = np.bincount(self.piece, minlength=1)
        for piece in np.flatnonzero(many >= OUTLINED):
            with suppress(QhullError):  # all in a line
                found[int(piece)] = ConvexHull(
                    self.cells[self.piece == piece]
                ).equations
        return found

    def pixels_of(self, chosen: Mask) -> Mask:
        """Pixels of the pieces that have one of the chosen pairs, (H, W) bool."""
        its_own = np.zeros(len(self.pieces.stands), bool)
        its_own[self.piece[chosen]] = True
        return np.take(its_own, self.pieces.grown)


def footprint(
    frame: Frame,
    pieces: Pieces,
    axes: Float,
    cell: float,
    middle: Float,
) -> Footprint:
    """The footprint of the pieces of a frame, seen from above, near a place.

    Args:
        frame: what the pieces are cut from.
        pieces: of what stands on the plane.
        axes: upright, rows x, y and z in the world, (3, 3).
        cell: side of a cell, metres.
        middle: where the object is, or is looked for, along x and y, (2,), cells: what is more than
            CELLS_REACHED cells from there is left out.
    """
    rows, columns = np.divmod(np.flatnonzero(pieces.label), pieces.label.shape[1])
    label = pieces.label[rows, columns]
    z = frame.depth[rows, columns]
    pose = frame.camera_to_world
    x, y = frame.rays
    ij = []

    for axis in axes[:2]:
        a, b, c = (pose[:3, :3].T @ axis / cell).astype(np.float32)
        position = z * (a * x[columns] + b * y[rows] + c) + np.float32(
            axis @ pose[:3, 3] / cell
        )
        ij.append(np.floor(position).astype(np.int64))
    there = np.floor(middle).astype(np.int64)
    i, j = ij
    within = (np.abs(i - there[0]) <= CELLS_REACHED) & (
        np.abs(j - there[1]) <= CELLS_REACHED
    )
    z = z[within]
    label = label[within]
    i = i[within]
    j = j[within]
    low = np.array([i.min(initial=there[0]), j.min(initial=there[1])])
    side = int(j.max(initial=there[1])) - low[1] + 1
    place = (i - low[0]) * side + j - low[1]
    shown = np.bincount(place) > 0
    many = len(pieces.stands)
    used = np.flatnonzero(shown)
    key = many * (np.cumsum(shown) - 1)[place] + label
    count = np.bincount(key, minlength=many * len(used))
    focal = frame.intrinsics[0, 0] * frame.intrinsics[1, 1]
    area = np.bincount(key, z * z, len(count)) / focal
    pairs = np.flatnonzero(
        (area > LEAST_COVER * cell**2) & (count >= FEWEST_CELL_PIXELS)
    )
    area = area[pairs]
    at, piece = np.divmod(pairs, many)
    cells = np.stack(np.divmod(used[at], side), 1) + low
    pixels = count[pairs]

    return Footprint(cells, piece, pieces, area, pixels, cell)


def clusters(
    footprints: Sequence[Footprint],
    joins: Joins = "by their border",
) -> tuple[list[Index], Mask]:
    """Which pieces of some frames are of one object.

    Pieces of one frame are joined where they overlap seen from above; and where they touch, unless
    both stand on the plane and their border comes down to it: a handle and the back of a chair are
    joined. Things that stand side by side stay apart, also where only their tops show. Pieces of
    two frames are joined where half of the smaller one lies over the other, unless a frame shows
    both side by side.

    Args:
        footprints: of the frames.
        joins: whether pieces that touch are joined: by their border, "never" or "always".

    Returns:
        The label of each pair in each footprint, (K,) int64 each: 1, 2, ... for the clusters; 0 for
        what lies far from all that the first footprint shows. And for each label, (labels + 1,)
        bool, whether it may be two things, or a part of one: one frame joins to the cluster what
        stands beside it in another one, or no frame shows whether what is beside it stands for
        itself.
    """
    sizes = [len(f.cells) for f in footprints]
    if not sum(sizes):
        return [np.zeros(n, np.int64) for n in sizes], np.zeros(1, bool)

    first = np.cumsum([0, *(len(f.pieces.stands) for f in footprints)])
    node = np.concatenate(
        [f.piece + start for f, start in zip(footprints, first, strict=False)]
    )
    cells = np.concatenate([f.cells for f in footprints])
    near = np.abs(cells - cells[0]).max(1) <= BEYOND_REACH
    here, around = _cells_over(cells[near], node[near], int(first[-1]))
    size = np.maximum(here.sum(1), 1)
    shared = here @ here.T / np.minimum.outer(size, size)
    beside = around @ here.T > 0
    within = _within_outlines(footprints, shared)
    strength, apart, either = _links(footprints, shared, beside, within, joins)
    cluster, doubtful = _joined(strength, apart, size)

    for a, b in np.argwhere(np.triu(either)):  # in doubt until a frame shows which
        if (
            cluster[a] != cluster[b]
            and not apart[np.ix_(cluster == cluster[a], cluster == cluster[b])].any()
        ):
            doubtful.append((int(a), int(b)))
    two = np.zeros(cluster.max() + 2, bool)
    whole = np.bincount(cluster, size)

    for a, b in doubtful:
        if min(size[a], size[b]) > TWO * max(whole[cluster[a]], whole[cluster[b]]):
            two[[cluster[a] + 1, cluster[b] + 1]] = True

    return np.split(np.where(near, cluster[node] + 1, 0), np.cumsum(sizes)[:-1]), two


def _cells_over(cells: Index, node: Index, nodes: int) -> tuple[Float, Float]:
    """Which cells are over each node, and which are near it, (nodes, cells) each.

    Near is up to CELLS_BESIDE cells.

    Only cells over which anything lies are listed.
    """
    at = cells - cells.min(0) + CELLS_BESIDE
    width = int(at[:, 1].max()) + 1 + CELLS_BESIDE
    place = at[:, 0] * width + at[:, 1]
    used = (
        np.bincount(place, minlength=(int(at[:, 0].max()) + 1 + CELLS_BESIDE) * width)
        > 0
    )
    number = np.where(used, np.cumsum(used) - 1, -1)
    here, around = np.zeros((2, nodes, used.sum() + 1))  # the last is that of -1
    here[node, number[place]] = 1
    steps = np.arange(-CELLS_BESIDE, CELLS_BESIDE + 1)
    around[
        node[:, None],
        number[place[:, None] + np.add.outer(width * steps, steps).ravel()],
    ] = 1
    return here[:, :-1], around[:, :-1]


def _within_outlines(footprints: Sequence[Footprint], shared: Float) -> Mask:
    """Which pieces lie within the outline of which other piece of the same object, (N, N) bool.

    Outlines are seen from above.

    Of one frame that is one which surrounds them: the sides of a bathtub its bottom, the top of a
    table its foot, and the rim of a lid its knob, with nothing but the plane between them; what
    stands in a corner is not surrounded. Of another frame it may also be one beside which they lie:
    other sides of a box. Those that share cells anyway, by a share of the cells of the smaller one,
    (N, N), are not looked at.
    """
    first = np.cumsum([0, *(len(foot.pieces.stands) for foot in footprints)])
    node = np.concatenate(
        [foot.piece + start for foot, start in zip(footprints, first, strict=False)]
    )
    cells = np.concatenate([foot.cells for foot in footprints]).astype(np.float64)
    many = np.maximum(np.bincount(node, minlength=first[-1]), 1)

    within = np.zeros((first[-1], first[-1]), bool)
    for k, foot in enumerate(footprints):
        for piece, outline in foot.outlines.items():
            its_node = first[k] + piece
            outer = cells[node == its_node]
            near = np.flatnonzero(
                ((cells >= outer.min(0)) & (cells <= outer.max(0))).all(1)
            )
            inside = (cells[near] @ outline[:, :2].T + outline[:, 2] <= ON_OUTLINE).all(
                1
            )
            share = np.bincount(node[near], inside, minlength=first[-1]) / many
            share[its_node] = 0  # of itself all
            for inner in np.flatnonzero(
                (share >= WITHIN) & (shared[its_node] < LIES_OVER)
            ):
                own = cells[node == inner]
                other_frame = not first[k] <= inner < first[k + 1]
                within[inner, its_node] = _surrounds(outer, own) or (
                    other_frame and _lie_beside(own, outer)
                )
    return within


def _surrounds(outer: Float, inner: Float) -> bool:
    """Whether some cells, (N, 2), lie in most directions from the middle of others, (M, 2)."""
    away = outer - np.median(inner, 0)
    direction = np.floor(
        (np.arctan2(away[:, 1], away[:, 0]) / (2 * np.pi) + 0.5) * FOOTPRINT_DIRECTIONS
    ).astype(np.int64)
    seen = (
        np.bincount(
            np.minimum(direction, FOOTPRINT_DIRECTIONS - 1),
            minlength=FOOTPRINT_DIRECTIONS,
        )
        > 0
    )
    return bool(seen.mean() >= SURROUNDED)


def _lie_beside(some: Float, others: Float) -> bool:
    """Whether half of some cells, (N, 2), lie on others, (M, 2), or beside them."""
    gap = (
        np.abs(some[:: max(1, len(some) // MOST_COMPARED_CELLS), None] - others)
        .max(2)
        .min(1)
    )
    return bool((gap <= CELLS_BESIDE).mean() >= LIES_OVER)


def _links(
    footprints: Sequence[Footprint],
    shared: Float,
    beside: Mask,
    within: Mask,
    joins: Joins,
) -> tuple[Float, Mask, Mask]:
    """How strongly two pieces are linked, which stand apart, and which may; (N, N) each.

    A strength of 0 is no link.
    """
    every = [f.pieces for f in footprints]
    same = block_diag(*(np.ones_like(p.touch) for p in every)) > 0
    stands = np.concatenate([p.stands for p in every])
    names = "touch", "low", "inside", "hangs"
    touch, low, inside, hangs = (
        block_diag(*(getattr(p, name) for p in every)) > 0 for name in names
    )
    inside |= within | hangs
    inside |= inside.T
    both = np.logical_and.outer(stands, stands)
    neither = ~np.logical_or.outer(stands, stands)
    strength = np.where(shared >= np.where(same, OVERLAP, LIES_OVER), shared, 0)
    touch &= ~(both & low) if joins == "by their border" else joins == "always"
    strength[touch | inside] = TOUCH
    side_by_side = same & beside & (strength == 0)

    return (
        strength,
        same & beside & both & (shared < OVERLAP) & ~inside & ~touch,
        side_by_side & neither,
    )


def _joined(
    strength: Float,
    apart: Mask,
    size: Float,
) -> tuple[Index, list[tuple[int, int]]]:
    """Cluster N pieces of given sizes, (N,), by their links, strong ones first.

    A strength, (N, N), of 0 is no link.

    A link that would join two pieces that stand apart is refused; these links are given too. A
    piece that is small beside two clusters does not join them.
    """
    cluster = np.arange(len(strength))
    refused = []
    a, b = np.nonzero(np.triu(strength, 1))
    for k in np.argsort(-strength[a, b], kind="stable"):
        one = cluster[a[k]]
        other = cluster[b[k]]
        largest = min(size[cluster == one].max(), size[cluster == other].max())
        if one == other or min(size[a[k]], size[b[k]]) < BRIDGE * largest:
            continue
        if apart[np.ix_(cluster == one, cluster == other)].any():
            refused.append((int(a[k]), int(b[k])))
        else:
            cluster[cluster == other] = one
    return cluster, refused


def on_ground(points: Float, plane: Float) -> Mask:
    """Which points lie within the convex hull of what was seen of the plane, (N,) bool.

    Args:
        points: (N, 2), in the plane.
        plane: points of the plane that were seen, (M, 2).
    """
    if len(plane) < 3:
        return np.ones(len(points), bool)
    try:
        sides = ConvexHull(plane).equations
    except QhullError:  # a plane of which only a line is seen
        return np.ones(len(points), bool)
    return np.asarray((points @ sides[:, :2].T + sides[:, 2] <= 0).all(1))


def central(foot: Footprint, labels: Index, plane: Float, optical_axis: Float) -> int:
    """The cluster on the plane at which the camera is aimed; 0 if there is none.

    It is the one with most pixels, each of which counts the less the farther the cluster lies from
    the optical axis.

    Args:
        foot: the footprint of a frame.
        labels: the cluster of each of its pairs, (K,).
        plane: points of the support plane that are seen, in cells, (M, 2).
        optical_axis: the pixel, column and row, through which it passes, (2,).
    """
    if not labels.any():
        return 0
    pixels = np.bincount(labels, foot.pixels)
    over_plane = np.bincount(
        labels,
        foot.pixels * on_ground(foot.cells.astype(np.float64) + 0.5, plane),
    )

    cluster_of = np.zeros(len(foot.pieces.stands), np.int64)
    cluster_of[foot.piece] = labels
    label = foot.pieces.label
    step = max(1, label.shape[1] // AIM_WIDTH)
    cluster = cluster_of[label[::step, ::step]]
    stands = over_plane >= OVER_PLANE * pixels
    # cut off by the picture: nothing tells where it ends below
    stands[cluster[-BOTTOM_ROWS:]] = True
    stands[0] = False

    rows, columns = (step * np.arange(n) for n in cluster.shape)
    away = (
        np.hypot(columns[None] - optical_axis[0], rows[:, None] - optical_axis[1])
        / label.shape[1]
    )
    nearest_pixel = np.asarray(ndimage.minimum(away, cluster, np.arange(len(pixels))))

    weight = stands * pixels * np.exp(-((nearest_pixel / AIM_SPREAD) ** 2))
    return int(weight.argmax()) if weight.max() > 0 else 0


def nearest(
    footprints: Sequence[Footprint],
    labels: Sequence[Index],
    point: Float,
) -> int:
    """Return the cluster that is nearest to a point in most frames, seen from above.

    The result is 0 if there is none.

    Args:
        footprints: of the frames.
        labels: the cluster of each piece, one array a footprint.
        point: (2,), cells, seen from above.
    """
    cells = np.concatenate([f.cells for f in footprints])
    label = np.concatenate(labels)
    if not label.any():
        return 0
    distance = np.where(label > 0, np.linalg.norm(cells + 0.5 - point, axis=1), np.inf)
    return int(np.bincount(label[distance < distance.min() + CELLS_BESIDE]).argmax())
