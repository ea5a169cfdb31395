"""Propose things and poses from pairs of points with normals, where outlines say little.

Two points of a surface and their normals have four numbers that no motion changes: a distance and
three angles. Pairs of a view vote for the pairs of the taught things with the same numbers (Drost
et al., "Model globally, match locally: efficient and robust 3D object recognition", 2010). A part
of a thing is enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.sensing.view import View
from nextview.types import Float, Float32, Floats, Index, Mask

THING_POINTS = 80  # of each thing
DRAWN_POINTS = 1500  # of each thing, from which these are chosen
SEEN_POINTS = 100  # of a segment
REFERENCES = 25  # of these, whose pairs are compared
# metres: steps of short distances, and the distance from which on they grow with it; and how many
# steps there are
DISTANCE_STEP, LONG_DISTANCE, DISTANCES = 0.008, 0.15, 64
ANGLE_STEP = np.radians(15)  # between a normal and a line, or two normals
ANGLES = 13  # steps of an angle
TURNS = 20  # steps of the turn about a normal
COMMONEST, COMMON_WEIGHT = 600, 0.25  # pairs that are alike at most, and what more tell
FEWEST_VOTES = 2  # of a pose that is proposed
# half the side of the patch around a point that gives its normal: metres and standard deviations of
# the depth at least, pixels of the grid at most
PATCH, PATCH_SIGMAS, MOST_REACH = 0.009, 3, 8
FEWEST = 12  # points of such a patch


@dataclass(frozen=True, eq=False)
class PointPairs:
    """All pairs of points of taught things, by their numbers.

    Attributes:
        points: of each thing, relative to its centre, (T, N, 3) float64, metres.
        normals: their unit normals, (T, N, 3) float64.
        starts: of the pairs with each key, in the order of all pairs, (K + 1,) int64.
        common: keys of which only some pairs are kept, (K,) bool.
        first: number of the first point of each pair, counted over all things, (P,) int32.
        turns: of its second point about the normal of the first one, steps, (P,) float32.
    """

    points: Float
    normals: Float
    starts: Index
    common: Mask
    first: NDArray[np.int32]
    turns: Float32

    @classmethod
    def of(cls, points: Float32, normals: Float32) -> PointPairs:
        """Return the pairs of points that are spread over T things.

        Args:
            points: that can be seen of each, relative to its centre, (T, P, 3) float32, metres.
            normals: their unit normals, (T, P, 3) float32.
        """
        rng = np.random.default_rng(0)
        drawn = rng.integers(points.shape[1], size=(len(points), DRAWN_POINTS))
        row = np.arange(len(points))[:, None]
        some = np.take_along_axis(
            drawn, spread(points[row, drawn], THING_POINTS), axis=1
        )
        own = points[row, some].astype(np.float64)
        facing = normals[row, some].astype(np.float64)

        one, two = np.nonzero(~np.eye(THING_POINTS, dtype=bool))
        keys, turns = [], []
        for at, away in zip(own, facing, strict=True):
            keys.append(keys_of(at, away, one, two))
            turns.append(turns_of(at, away, one, two))
        first = (one + THING_POINTS * row).astype(np.int32).ravel()
        every = np.concatenate(keys)
        counts = np.bincount(every, minlength=DISTANCES * ANGLES**3)

        # of pairs that are everywhere, some of all of them
        lengths = np.minimum(counts, COMMONEST)
        starts = np.append(0, np.cumsum(lengths))
        place = np.arange(starts[-1]) - np.repeat(starts[:-1], lengths)
        place = place * np.repeat(counts, lengths) // np.repeat(lengths, lengths)
        place += np.repeat(np.cumsum(counts) - counts, lengths)
        kept = np.argsort(every, kind="stable")[place]
        return cls(
            own,
            facing,
            starts,
            counts > COMMONEST,
            first[kept],
            np.concatenate(turns)[kept],
        )

    def propose(
        self, view: View, mask: Mask, among: Mask, most: int, of_one: int
    ) -> tuple[Index, Float, Float]:
        """Propose poses of things that a segment may show a part of.

        Args:
            view: the view.
            mask: pixels of the segment, (H, W) bool.
            among: things that it may show, (T,) bool.
            most: number of poses, at most.
            of_one: number of poses of one thing, at most, unless there are few things.

        Returns:
            M poses, the most votes first: the number of the thing, (M,) int64; its rotation from
            the axes of its scan to the world, (M, 3, 3); and its centre in the world, (M, 3),
            metres.
        """
        points, normals = oriented(view, mask)
        if len(points) < FEWEST:
            return np.zeros(0, np.int64), np.zeros((0, 3, 3)), np.zeros((0, 3))

        # what no motion changes of the pairs of each reference
        some = spread(points[None], REFERENCES)[0]
        one = np.repeat(some, len(points))
        two = np.tile(np.arange(len(points)), len(some))
        keys = keys_of(points, normals, one, two).reshape(len(some), -1)
        turns = turns_of(points, normals, one, two).reshape(len(some), -1)
        apart = np.linalg.norm(points[one] - points[two], axis=1).reshape(keys.shape)
        found = [
            (np.full(len(places), reference), places, votes)
            for reference, key, turn, far in zip(
                some, keys, turns, apart > DISTANCE_STEP, strict=True
            )
            for places, votes in [self._votes(key[far], turn[far])]
        ]
        references, places, votes = (
            np.concatenate(each) for each in zip(*found, strict=True)
        )
        things, places = np.divmod(places, THING_POINTS * TURNS)

        # whole numbers of few bits are sorted fastest
        order = np.argsort((-votes / COMMON_WEIGHT).astype(np.int16), kind="stable")
        order = order[among[things[order]]]
        of_one = max(of_one, most // len(self.points))
        order = order[rank_within(things[order]) < of_one][:most]
        things = things[order]
        references = references[order]
        places = places[order]
        own, turn = np.divmod(places, TURNS)

        # both normals are turned to one axis, and the thing about that axis
        to_scan = frames(self.normals[things, own])
        to_view = frames(normals[references])
        angle = turn * (2 * np.pi / TURNS)
        about = np.zeros((len(order), 3, 3))
        about[:, 0, 0] = 1
        about[:, 1, 1] = about[:, 2, 2] = np.cos(angle)
        about[:, 2, 1] = np.sin(angle)
        about[:, 1, 2] = -np.sin(angle)
        rotations = to_view.swapaxes(1, 2) @ about @ to_scan
        middles = np.einsum("nij,nj->ni", rotations, self.points[things, own])
        return things, rotations, points[references] - middles

    def _votes(self, keys: Index, turns: Float32) -> tuple[Index, Float]:
        """Return what a point of a view may be, and how many of its pairs say so.

        Args:
            keys: of its pairs, (N,) int64.
            turns: of the second point of each about the normal of the first one, steps, (N,).

        Returns:
            Points of things, counted over all, times TURNS, plus the step of the turn about the
            normal, (K,); and the votes of each, (K,).
        """
        start = self.starts[keys]
        lengths = self.starts[keys + 1] - start
        ends = np.cumsum(lengths)
        pairs = np.repeat(start - ends + lengths, lengths) + np.arange(lengths.sum())
        steps = np.rint(np.repeat(turns, lengths) - self.turns[pairs]).astype(np.int32)
        places = self.first[pairs] * TURNS + steps % TURNS
        tells = np.where(self.common[keys], COMMON_WEIGHT, 1.0)
        votes = np.asarray(np.bincount(places, np.repeat(tells, lengths)), np.float64)
        leading = np.flatnonzero(votes >= FEWEST_VOTES)
        return leading, votes[leading]


def oriented(view: View, mask: Mask) -> tuple[Float, Float]:
    """Return points of a segment and their normals towards the camera, (N, 3) each, world axes.

    Args:
        view: the view.
        mask: pixels of the segment, (H, W) bool.
    """
    grid = view.grid()
    stride = view.stride
    own = mask[::stride, ::stride] & (grid.depth > 0)
    cells = np.flatnonzero(own)
    if len(cells) < FEWEST:
        return np.zeros((0, 3)), np.zeros((0, 3))
    rng = np.random.default_rng(0)
    drawn = rng.permutation(cells)[: 4 * SEEN_POINTS]
    drawn = drawn[spread(view.points(drawn)[None], SEEN_POINTS)[0]]

    # the pixels of a patch around each
    line, column = np.divmod(drawn, own.shape[1])
    apart = float(np.median(grid.depth.ravel()[drawn])) * grid.pitch
    sigma = float(np.median(grid.sigma.ravel()[drawn]))
    size = max(PATCH, PATCH_SIGMAS * sigma, 2 * apart)
    reach = min(round(size / apart), MOST_REACH)
    step = np.arange(-reach, reach + 1)
    lines = (line[:, None, None] + step[:, None]).clip(0, own.shape[0] - 1)
    columns = (column[:, None, None] + step).clip(0, own.shape[1] - 1)
    around = (lines * own.shape[1] + columns).reshape(len(drawn), -1)
    points = view.points(around.ravel()).reshape(len(drawn), -1, 3)

    # a plane through those that are near
    here = view.points(drawn)
    near = own.ravel()[around] & (
        np.linalg.norm(points - here[:, None], axis=2) < 2 * size
    )
    count = np.maximum(near.sum(1), 1)[:, None]
    mean = (points * near[..., None]).sum(1) / count
    off = (points - mean[:, None]) * near[..., None]
    normals = np.linalg.eigh(off.swapaxes(1, 2) @ off)[1][..., 0]
    towards = view.camera[:3, 3] - mean
    normals *= np.where((normals * towards).sum(1) < 0, -1, 1)[:, None]
    kept = count[:, 0] >= FEWEST
    return mean[kept], normals[kept]


def spread(points: Floats, count: int) -> Index:
    """Return the numbers of points of each set that lie far from each other.

    Args:
        points: T sets of points, (T, P, 3).
        count: number of points that are chosen of each.

    Returns:
        Numbers, (T, count) int64, or all if there are fewer.
    """
    row = np.arange(len(points))
    chosen = [np.zeros(len(points), np.int64)]
    far = np.full(points.shape[:2], np.inf)
    for _ in range(min(count, points.shape[1]) - 1):
        off = points - points[row, chosen[-1]][:, None]
        far = np.minimum(far, np.einsum("tpi,tpi->tp", off, off))
        chosen.append(far.argmax(1))
    return np.stack(chosen, 1)


def keys_of(points: Float, normals: Float, one: Index, two: Index) -> Index:
    """Return the distance and the three angles of pairs of points, rounded, as one number each.

    Args:
        points: (N, 3), metres.
        normals: their unit normals, (N, 3).
        one: first points of the pairs, (P,) int64.
        two: their second points, (P,) int64.
    """
    way = points[two] - points[one]
    length = np.linalg.norm(way, axis=1)
    way = way / np.maximum(length, 1e-9)[:, None]
    steps = LONG_DISTANCE / DISTANCE_STEP * np.arcsinh(length / LONG_DISTANCE)
    key = np.minimum(np.rint(steps), DISTANCES - 1).astype(np.int64)
    for a, b in (
        (normals[one], way),
        (normals[two], way),
        (normals[one], normals[two]),
    ):
        angle = np.arccos(np.clip((a * b).sum(1), -1, 1))
        key = key * ANGLES + np.rint(angle / ANGLE_STEP).astype(np.int64)
    return key


def frames(normals: Floats) -> Float:
    """Return rotations that turn unit normals to the first axis, (N, 3, 3)."""
    x = np.asarray(normals, np.float64)
    aside = np.where(np.abs(x[:, :1]) < 0.7, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    y = np.cross(x, aside)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], 1)


def turns_of(points: Float, normals: Float, one: Index, two: Index) -> Float32:
    """Return the turn of the second point of each pair about the normal of the first, steps.

    Args:
        points: (N, 3), metres.
        normals: their unit normals, (N, 3).
        one: first points of the pairs, (P,) int64.
        two: their second points, (P,) int64.
    """
    way = np.einsum("nij,nj->ni", frames(normals)[one], points[two] - points[one])
    turn = np.arctan2(way[:, 2], way[:, 1]) * (TURNS / (2 * np.pi))
    return turn.astype(np.float32)


def rank_within(things: Index) -> Index:
    """Return the number of earlier equal elements of each element, (N,) int64."""
    order = np.argsort(things, kind="stable")
    first = np.searchsorted(things[order], things[order])
    rank = np.empty(len(things), np.int64)
    rank[order] = np.arange(len(things)) - first
    return rank
