"""The set of posed things that explains the pixels of all frames best.

A table of hypotheses and views holds the score of each pair. It gains a column with each frame, and
rows where a frame shows something that no chosen hypothesis explains. Things are chosen greedily:
each pixel counts once, for what explains it best. Something of which no model is known, a stranger,
explains its pixels a little, so that a name has to explain them better.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nextview.sensing.view import View
from nextview.things.flat import planes
from nextview.things.library import Hypotheses, Library
from nextview.things.propose import (
    COARSER,
    COARSEST,
    RESTART,
    SAME_POSE,
    best,
    propose,
)
from nextview.things.register import camera_error, register, seen_by_camera
from nextview.things.score import NEAREST, PIXEL_GAIN, Score, score, total, total_scores
from nextview.types import Float, Float32, Index, Mask

NEW_OBJECT = 20.0  # nats that an object has to explain to be one
STRANGER_GAIN = 0.45  # nats, of a pixel of something without a model
EXPLAINED = (
    0.3  # share of a segment that is explained, from which on it is not searched
)
EXPLAINS = 0.5  # nats of a pixel from which on it is explained
AS_LIKELY = (
    0.5  # of what the best hypothesis of a place explains: of others that are kept
)
OF_ONE = 2  # hypotheses of one thing at one place that are kept
LOOKALIKES = 4  # of a new or doubtful thing that are kept
RESTARTED = 3  # hypotheses of a place that are registered from other starts, at most
RESIZED = 3  # times that a thing is tried larger or smaller
CLEAR_SHARE = 0.5  # share of the possible gain from which on pixels are explained
SURE_SHARE = 0.7  # the same, above which a later view is not searched for a better name
MOST_THROUGH = 0.6  # share of a thing that is seen through where it did not stand yet
LEAST_OWN = 0.5  # share of what a thing explains that nothing else does, at least
MOVED = 60.0  # nats that another pose has to explain better, for a thing to have moved
MOVED_SHARE = (
    0.3  # the same of what the thing explains: errors of scan and pose are alike
)
MOST_VIEWS = 6  # that are kept
SETTLED_VIEWS = 3  # views after which poses are not refined, and names not searched
SAME_DEPTH = 0.03  # metres between the points of one stranger in two views
SAME_SEGMENT = 0.5  # share of the pixels of two segments that are one stranger

_Rows = tuple[tuple[Score | None, ...], ...]


@dataclass(frozen=True, eq=False)
class Thing:
    """One thing of a world.

    Attributes:
        number: identifies it in all frames; 0 before it is numbered.
        row: of its hypothesis; -1 for a stranger.
        scores: of what explains it, in each view; None where it is not in the image.
        gain: over what the others explain, nats.
    """

    number: int
    row: int
    scores: Sequence[Score | None]
    gain: float

    @property
    def share(self) -> float:
        """Share of the gain that it could have at most."""
        seen = sum(one.seen for one in self.scores if one is not None)
        return self.gain / max(1.0, PIXEL_GAIN * seen)


@dataclass(frozen=True, eq=False)
class World:
    """Hypotheses, views, and how well each explains each.

    Attributes:
        library: the taught things.
        views: in the order of their frames.
        hypotheses: that are kept.
        scores: of each hypothesis in each view.
        strangers: of each of them the score in each view: it explains its pixels a little.
        flat: of each plane the score in each view; it is of one view.
        things: that explain the views best together.
        owners: number of the thing that explains each pixel of the grid of each view, 0 for none.
        next_number: number of the next new thing.
        keys: of each hypothesis, (M,) int64: it keeps it as long as it is kept.
        next_key: key of the next new hypothesis.
        given: number of the thing that a hypothesis has explained so far, by its key.
        alone: whether all views show one thing, which stands, and each has an error of its camera.
    """

    library: Library
    views: tuple[View, ...] = ()
    hypotheses: Hypotheses = field(default_factory=Hypotheses.none)
    scores: _Rows = ()
    strangers: _Rows = ()
    flat: _Rows = ()
    things: tuple[Thing, ...] = ()
    owners: tuple[NDArray[np.int32], ...] = ()
    next_number: int = 1
    keys: Index = field(default_factory=lambda: np.zeros(0, np.int64))
    next_key: int = 0
    given: Mapping[int, int] = field(default_factory=dict)
    alone: bool = False

    @property
    def totals(self) -> Float:
        """Score of each hypothesis alone, over all views, nats, (M,)."""
        return np.array([total(row) for row in self.scores])

    def thing(self, number: int) -> Thing:
        """Return the thing with this number."""
        return next(one for one in self.things if one.number == number)

    def with_view(self, view: View, held: NDArray[np.int32] | None = None) -> World:
        """Return the world after another view, before anything new is searched for.

        Args:
            view: the view.
            held: number of the thing that each pixel of its grid is known to show, 0 for none.
        """
        if held is None:
            held = np.zeros(view.grid().depth.size, np.int32)
        some = self.hypotheses
        views = (*self.views, view)
        if len(self.views) < SETTLED_VIEWS and len(some):
            some = register(self.library, views, some, (0.03, 0.02))
            columns = [self._column(one, some) for one in self.views]
            scores = [
                # what came later says nothing of an earlier view
                tuple(
                    None if was is None else one
                    for was, one in zip(row, new, strict=True)
                )
                for row, new in zip(
                    self.scores, zip(*columns, strict=True), strict=True
                )
            ]
        else:
            scores = list(self.scores)
        column = self._column(view, some)
        world = replace(
            self,
            views=views,
            hypotheses=some,
            scores=tuple((*row, new) for row, new in zip(scores, column, strict=True)),
            strangers=_seen_again(self, view),
            flat=(
                *((*row, None) for row in self.flat),
                *((*(None,) * len(self.views), one) for one in planes(view)),
            ),
            owners=(*self.owners, held),
        )
        return balanced(world).chosen()

    def _column(self, view: View, some: Hypotheses) -> list[Score | None]:
        """Score hypotheses in a view; if all show one thing, with the error of its camera."""
        scores = score(self.library, view, some)
        if not self.alone or not len(some):
            return scores
        seen = seen_by_camera(self.library, view, some)
        return [
            max(one, other, key=lambda each: -np.inf if each is None else each.total)
            for one, other in zip(scores, score(self.library, view, seen), strict=True)
        ]

    def searched(self, among: Mask) -> World:
        """Return the world with names for what the last view shows unexplained.

        What an earlier view from the same place has shown alike was searched before. A stranger
        among other things that an earlier view has shown is neither joined to them nor cut again,
        and after some views it is not searched any more.

        Args:
            among: things that may be there, (T,) bool.
        """
        world = self
        view = self.views[-1]
        before = np.zeros(view.grid().depth.shape, bool)
        for one in self.views[:-1]:
            before |= one.alike(view.frame)
        strange = before.copy()
        for row in self.strangers:
            last = row[-1]
            if last is not None and any(row[:-1]) and not self.alone:
                strange.ravel()[last.cells] = True
                if _settled(row):
                    before.ravel()[last.cells] = True

        # a view that one thing explains is searched, too: a handle may tell it from another one
        sure = np.inf if self.alone else SURE_SHARE
        for segments, share, known in (
            (view.instances, sure, before),
            (view.unions, CLEAR_SHARE, strange),
            (view.fragments, CLEAR_SHARE, strange),
        ):
            shown = world.explained(share) | view.enlarged(known)
            left = [mask for mask in segments() if shown[mask].mean() < EXPLAINED]
            world = world._with_proposals(left, among)

        shown = world.explained(CLEAR_SHARE) | view.enlarged(strange)
        world = world._with_proposals(view.leftovers(shown), among)
        world = world.with_lookalikes(among).with_other_starts()
        return world.with_other_sizes().pruned()

    def _with_proposals(self, segments: Iterable[Mask], among: Mask) -> World:
        """Return the world with what segments of the last view may show."""
        new = propose(self.library, self.views[-1], segments, among)
        return self if new is None else self.with_hypotheses(new).chosen()

    def with_other_starts(self) -> World:
        """Return the world with new or doubtful things, registered from turned poses.

        The likeliest others of their places are registered so, too.
        """
        totals = self.totals
        taught = self.hypotheses.taught
        rows: set[int] = set()
        for row in self._doubtful():
            near = self.rivals(row)
            near = near[taught[near] & (totals[near] > AS_LIKELY * totals[row])]
            rows.update(near[np.argsort(-totals[near])][:RESTARTED].tolist())
        if not rows:
            return self

        # of each the best one, if it is better
        some = self.hypotheses[np.array(sorted(rows), np.int64)]
        turned = some.turned(RESTART)
        of = np.arange(len(turned)) // (len(turned) // len(some))
        # another view may show which side of one thing it was
        if self.alone and len(self.views) > 1:
            alike, its = some.turned_alike(self.library)
            turned = Hypotheses.joined([turned, alike])
            of = np.append(of, its)
        closer = (0.12, 0.08, 0.06, 0.04, 0.03, 0.02)
        new = register(self.library, self.views, turned, closer)
        totals = self._coarse_totals(new)
        order = np.lexsort((-totals, of))
        first = order[np.unique(of[order], return_index=True)[1]]
        better = totals[first] > self._coarse_totals(some)
        return self.with_hypotheses(new[first[better]]).chosen()

    def with_other_sizes(self) -> World:
        """Return the world with new or doubtful things in another size, that which fits best."""
        some = self.hypotheses[self._doubtful()]
        if not len(some):
            return self
        for _ in range(RESIZED):
            new = some.in_other_sizes()
            new = register(self.library, self.views, new, (0.06, 0.04, 0.03))
            totals = self._coarse_totals(new).reshape(len(some), -1)
            some = new[totals.argmax(1) + totals.shape[1] * np.arange(len(some))]
        other = some[np.flatnonzero(~some.taught)]
        return self.with_hypotheses(other).chosen()

    def _doubtful(self) -> Index:
        """Return the rows of things that are new, or that explain too little in few views."""
        rows = [
            one.row
            for one in self.things
            if one.row >= 0
            and not _settled(one.scores)
            and (
                self.alone
                or int(self.keys[one.row]) not in self.given
                or one.share < SURE_SHARE
            )
        ]
        return np.array(rows, np.int64)

    def with_lookalikes(self, among: Mask) -> World:
        """Return the world with what may look nearly the same as new or doubtful things.

        Args:
            among: things that may be there, (T,) bool.
        """
        groups = self.hypotheses[self._doubtful()].lookalikes(self.library, among)
        if not groups:
            return self
        new = Hypotheses.joined(groups)
        new = register(self.library, self.views, new, (0.2, 0.15, 0.1, 0.06, 0.03))
        totals = self._coarse_totals(new)
        ends = np.cumsum([len(one) for one in groups])
        some = [
            best(self.library, new[rows], totals[rows], LOOKALIKES, OF_ONE)
            for rows in np.split(np.arange(len(new)), ends[:-1])
        ]
        return self.with_hypotheses(Hypotheses.joined(some)).chosen()

    def _coarse_totals(self, some: Hypotheses) -> Float:
        """Score hypotheses on a coarser grid of all views, nats, (M,)."""
        gains = [total_scores(self.library, one, some, COARSEST) for one in self.views]
        return np.where(np.isfinite(gains), gains, 0).sum(0)

    def with_hypotheses(self, new: Hypotheses) -> World:
        """Return the world with more hypotheses, registered to all views."""
        if len(self.views) > 1:
            new = register(self.library, self.views, new, (0.04, 0.03, 0.02), 64)
            columns = [self._column(one, new) for one in self.views]
        else:
            columns = [score(self.library, one, new) for one in self.views]

        rows = list(zip(*columns, strict=True))
        if not self.alone:
            rows = [_since_it_stands(row) for row in rows]
        return replace(
            self,
            hypotheses=Hypotheses.joined([self.hypotheses, new]),
            scores=(*self.scores, *rows),
            keys=np.append(self.keys, self.next_key + np.arange(len(new))),
            next_key=self.next_key + len(new),
        )

    def explained(self, share: float) -> Mask:
        """Return the pixels of the last view that named things explain, (H, W) bool.

        Args:
            share: of its possible gain that such a thing has at least.
        """
        view = self.views[-1]
        shown = np.zeros(view.grid().depth.shape, bool)
        for one in self.things:
            found = one.scores[-1]
            if one.row >= 0 and found is not None and found.share > share:
                shown.ravel()[found.cells[found.gain > EXPLAINS]] = True
        return view.enlarged(shown)

    def chosen(self, ruled_out: Collection[int] = ()) -> World:
        """Return the world with the things that explain all views best together.

        Args:
            ruled_out: rows of hypotheses that do not hold.
        """
        rows: dict[int, Sequence[Score | None]] = {
            row: scores
            for row, scores in enumerate(self.scores)
            if row not in ruled_out
        }
        sizes = [view.grid().depth.size for view in self.views]
        # what is no thing has negative rows: planes first, then strangers beside the things
        flat = {-1 - k: scores for k, scores in enumerate(self.flat)}
        kept, _ = _explaining(rows | flat, sizes, 0.0)
        rows = {row: rows[row] for row in kept if row >= 0}
        rows |= {-1 - k: scores for k, scores in enumerate(self.strangers)}
        kept, gains = _explaining(rows, sizes, LEAST_OWN)
        taught = self.hypotheses.taught
        things = [
            Thing(0, row if row >= 0 and taught[row] else -1, rows[row], gains[row])
            for row in kept
        ]
        return replace(self, things=tuple(things))

    def numbered(self) -> World:
        """Return the world with a number for each thing: that of what held its pixels before."""
        sizes = [view.grid().depth.size for view in self.views]
        owners = _owners([one.scores for one in self.things], sizes)
        count = len(self.things) + 1
        most = max(self.next_number, 1)
        shared = np.zeros((most, count))
        for before, now in zip(self.owners, owners, strict=True):
            shared += np.bincount(
                before.astype(np.int64) * count + now + 1, minlength=most * count
            ).reshape(most, count)
        before_sizes = np.maximum(shared.sum(1), 1)
        now_sizes = np.maximum(shared[1:].sum(0), 1)
        alike = shared / np.minimum(before_sizes[:, None], now_sizes)
        alike[0] = alike[:, 0] = 0

        numbers = np.array(
            [
                0 if one.row < 0 else self.given.get(int(self.keys[one.row]), 0)
                for one in self.things
            ],
            np.int64,
        )
        alike[numbers] = 0
        alike[:, 1:][:, numbers > 0] = 0
        while alike.max(initial=0) > SAME_SEGMENT:
            number, row = np.unravel_index(alike.argmax(), alike.shape)
            numbers[row - 1] = number
            alike[number] = 0
            alike[:, row] = 0
        new = np.flatnonzero(numbers == 0)
        numbers[new] = self.next_number + np.arange(len(new))
        given = np.append(numbers, 0)
        return replace(
            self,
            things=tuple(
                replace(one, number=int(number))
                for one, number in zip(self.things, numbers, strict=True)
            ),
            owners=tuple(given[owner].astype(np.int32) for owner in owners),
            next_number=self.next_number + len(new),
            given={
                int(self.keys[one.row]): int(number)
                for one, number in zip(self.things, numbers, strict=True)
                if one.row >= 0
            },
        )

    def with_numbers(self, renamed: Mapping[int, int]) -> World:
        """Return the world with other numbers for some things, by their present ones."""
        if not renamed:
            return self
        given = np.arange(self.next_number, dtype=np.int32)
        for number, other in renamed.items():
            given[number] = other
        things = (replace(one, number=int(given[one.number])) for one in self.things)
        return replace(
            self,
            things=tuple(things),
            owners=tuple(given[owner] for owner in self.owners),
            given={key: int(given[number]) for key, number in self.given.items()},
        )

    def redundant(self) -> int | None:
        """Return the number of the view that has to go for another one; None for none.

        It is the one taken nearest to another one. What shows a thing alone is kept.
        """
        if len(self.views) < MOST_VIEWS:
            return None
        places = np.array([view.camera[:3, 3] for view in self.views])
        apart = np.linalg.norm(places[:, None] - places, axis=2)
        np.fill_diagonal(apart, np.inf)
        nearest = apart.min(1)
        for one in self.things:
            shown = [k for k, found in enumerate(one.scores) if found is not None]
            if len(shown) == 1:
                nearest[shown] = np.inf
        return int(nearest.argmin()) if nearest.min() < np.inf else None

    def without_view(self, number: int) -> World:
        """Return the world without one of its views."""
        kept = [k for k in range(len(self.views)) if k != number]

        def left(rows: Sequence[Sequence[Score | None]]) -> _Rows:
            return tuple(tuple(row[k] for k in kept) for row in rows)

        return replace(
            self,
            views=tuple(self.views[k] for k in kept),
            scores=left(self.scores),
            strangers=tuple(row for row in left(self.strangers) if any(row)),
            flat=tuple(row for row in left(self.flat) if any(row)),
            things=tuple(
                replace(one, scores=scores)
                for one, scores in zip(
                    self.things, left([one.scores for one in self.things]), strict=True
                )
            ),
            owners=tuple(self.owners[k] for k in kept),
        )

    def holder(self, before: World, number: int) -> int:
        """Return the number of the thing that has most pixels of an earlier one; 0 for none.

        Args:
            before: the world in which it was.
            number: of the earlier thing.
        """
        shared = np.zeros(self.next_number, np.int64)
        count = 0
        for old, new in zip(before.owners, self.owners, strict=False):
            mine = old == number
            count += int(np.count_nonzero(mine))
            shared += np.bincount(new[mine], minlength=self.next_number)
        shared[0] = 0
        return int(shared.argmax()) if 2 * shared.max() > count else 0

    def rivals(self, row: int) -> Index:
        """Return the rows of all hypotheses at the place of one, itself among them, (N,) int64."""
        some = self.hypotheses
        radius = np.maximum(
            self.library.radii[some.things], self.library.radii[some.things[row]]
        )
        apart = np.linalg.norm(some.centres - some.centres[row], axis=1)
        return np.flatnonzero(apart < radius)

    def pruned(self) -> World:
        """Return the world with the chosen hypotheses and the likeliest others of each place."""
        some = self.hypotheses
        totals = self.totals
        taught = some.taught
        radii = self.library.radii[some.things]
        turns = some.rotations.reshape(-1, 9)
        kept = {one.row for one in self.things if one.row >= 0}
        places: list[int] = []
        for row in np.argsort(-totals).tolist():
            apart = np.linalg.norm(some.centres[places] - some.centres[row], axis=1)
            near = apart < 0.5 * np.minimum(radii[places], radii[row])
            same = near & (some.things[places] == some.things[row])
            same &= taught[places] == taught[row]
            angle = np.sqrt(np.maximum(3 - turns[places] @ turns[row], 0))
            again = same & (angle + apart / radii[row] < SAME_POSE)

            most = totals[places][near].max(initial=0.0)
            few = same.sum() < OF_ONE and not again.any()
            if row in kept or (few and totals[row] > AS_LIKELY * most):
                kept.add(row)
                places.append(row)
        return self.with_rows(np.array(sorted(kept), np.int64))

    def with_rows(self, rows: Index) -> World:
        """Return the world with some of its hypotheses, and the things that hold with them."""
        at = {int(row): k for k, row in enumerate(rows)}
        things = [
            one if one.row < 0 else replace(one, row=at[one.row])
            for one in self.things
            if one.row < 0 or one.row in at
        ]
        return replace(
            self,
            hypotheses=self.hypotheses[rows],
            scores=tuple(self.scores[row] for row in rows),
            things=tuple(things),
            keys=self.keys[rows],
        )


def corrected(world: World, view: View) -> View:
    """Return a view with the pose of its camera that explains the known things best.

    One error of the camera is compared with motions of things: the error that all things together
    tell, and that which each of them tells.

    Args:
        world: before the view.
        view: the view.
    """
    known = [
        one.row for one in world.things if one.row >= 0 and one.share > CLEAR_SHARE
    ]
    if not known:
        return view

    # one error for all things together, and that which each of them tells
    rows = np.array(known)
    some = world.hypotheses[rows]
    groups = [rows, *([row] for row in rows)] if len(rows) > 1 else [rows]
    tried = [view]
    for group in groups:
        tried.append(
            camera_error(world.library, view, world.hypotheses[np.array(group)])
        )

    usual = [_usual(world.scores[row]) for row in rows]
    values = []
    for one in tried:
        value = -_cost(view, one, world.library.camera)
        scores = score(world.library, one, some, COARSER)
        for found, most in zip(scores, usual, strict=True):
            if found is not None:
                value += max(found.total, (1 - MOVED_SHARE) * most * found.seen - MOVED)
        values.append(value)
    return tried[int(np.argmax(values))]


def aligned(world: World) -> World:
    """Return the world of one thing, with cameras that show its best hypothesis in one place."""
    totals = world.totals
    if len(world.views) < 2 or not len(totals):
        return world
    row = np.array([totals.argmax()])
    some = world.hypotheses[row]
    views = []
    for view in world.views:
        seen = seen_by_camera(world.library, view, some)
        turn = some.rotations[0] @ seen.rotations[0].T
        camera = view.camera.copy()
        camera[:3, :3] = turn @ camera[:3, :3]
        camera[:3, 3] = turn @ (camera[:3, 3] - seen.centres[0]) + some.centres[0]
        views.append(view.seen_from(camera))
    return replace(world, views=tuple(views))


def balanced(world: World) -> World:
    """Return the world, moved as a whole, so that the mean error of its cameras is zero.

    Each camera errs as much as the first one. All that was compared stays as it is.
    """
    some = world.hypotheses
    if len(world.views) < 2 or not len(some):
        return world

    middle = some.centres.mean(0)
    turns = []
    shifts = []
    for view in world.views:
        given = view.frame.camera_to_world
        turn = view.camera[:3, :3] @ given[:3, :3].T
        turns.append(Rotation.from_matrix(turn).as_rotvec())
        shifts.append(turn @ (middle - given[:3, 3]) + view.camera[:3, 3] - middle)

    back = np.eye(4)
    back[:3, :3] = Rotation.from_rotvec(-np.mean(turns, axis=0)).as_matrix()
    back[:3, 3] = middle - back[:3, :3] @ (middle + np.mean(shifts, axis=0))
    return replace(
        world,
        views=tuple(view.seen_from(back @ view.camera) for view in world.views),
        hypotheses=Hypotheses(
            some.things,
            back[:3, :3] @ some.rotations,
            some.centres @ back[:3, :3].T + back[:3, 3],
            some.sizes,
        ),
    )


def _usual(row: Sequence[Score | None]) -> float:
    """Return what a hypothesis explains in a pixel that shows it, nats."""
    seen = sum(one.seen for one in row if one is not None)
    return total(row) / max(1.0, seen)


def _cost(given: View, believed: View, error: tuple[float, float]) -> float:
    """Return the cost of an error of a camera, nats."""
    turn = believed.camera[:3, :3] @ given.camera[:3, :3].T
    angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
    shift = np.linalg.norm(believed.camera[:3, 3] - given.camera[:3, 3])
    return float((angle / error[0]) ** 2 + (shift / error[1]) ** 2) / 2


def _settled(row: Sequence[Score | None]) -> bool:
    """Whether enough earlier views have shown at least half as much of something as the last."""
    last = row[-1]
    if last is None:
        return True
    before = [one for one in row[:-1] if one is not None and 2 * one.seen > last.seen]
    return len(before) >= SETTLED_VIEWS


def _since_it_stands(row: Sequence[Score | None]) -> tuple[Score | None, ...]:
    """Leave out earlier views in which a new hypothesis was not there yet: they see through it."""

    def seen_through(views: Sequence[Score | None]) -> bool:
        shown = [one for one in views if one is not None]
        through = sum(one.through for one in shown)
        return through > MOST_THROUGH * sum(one.seen for one in shown)

    starts = [k for k in range(len(row)) if k == 0 or seen_through(row[:k])]
    start = max(starts, key=lambda k: total(row[k:]))
    return (*[None] * start, *row[start:])


def _explaining(
    rows: dict[int, Sequence[Score | None]], sizes: Sequence[int], own: float
) -> tuple[list[int], dict[int, float]]:
    """Choose rows that explain most together; each has to add to what the others explain.

    Args:
        rows: scores in each view.
        sizes: pixels of the grid of each view.
        own: share of what a row explains that the others do not, at least.

    Returns:
        The rows, and what each adds, nats.
    """
    kept = _greedy(rows, sizes, own)
    gains: dict[int, float] = {}
    while kept:
        gains = _alone(kept, rows, sizes)
        gains |= {row: 0.0 for row in kept if gains[row] < own * total(rows[row])}
        worst = min(kept, key=lambda row: gains[row])
        if gains[worst] > NEW_OBJECT:
            break
        kept.remove(worst)
    return kept, gains


def _greedy(
    rows: dict[int, Sequence[Score | None]], sizes: Sequence[int], own: float
) -> list[int]:
    """Choose rows, the one that adds most to what is explained first."""
    have = [np.zeros(size, np.float32) for size in sizes]
    bounds = {row: total(scores) for row, scores in rows.items()}
    bounds = {row: bound for row, bound in bounds.items() if bound > NEW_OBJECT}
    kept = []
    while bounds:
        row = max(bounds, key=lambda one: bounds[one])
        gain = sum(
            float(_added(one.gain, have[number][one.cells]).sum()) + one.paid
            for number, one in enumerate(rows[row])
            if one is not None
        )
        if gain <= NEW_OBJECT or gain < own * total(rows[row]):
            del bounds[row]
            continue
        if gain < max((bounds[one] for one in bounds if one != row), default=0.0):
            bounds[row] = gain
            continue

        del bounds[row]
        kept.append(row)
        for number, one in enumerate(rows[row]):
            if one is not None:
                cells = one.cells
                have[number][cells] = np.maximum(have[number][cells], one.gain)
    return kept


def _alone(
    kept: Sequence[int], rows: dict[int, Sequence[Score | None]], sizes: Sequence[int]
) -> dict[int, float]:
    """Return what each row adds to what all the others explain, nats."""
    gains = dict.fromkeys(kept, 0.0)
    for number, size in enumerate(sizes):
        best = np.zeros(size, np.float32)
        second = np.zeros(size, np.float32)
        for row in kept:
            one = rows[row][number]
            if one is not None:
                cells = one.cells
                second[cells] = np.maximum(
                    second[cells], np.minimum(one.gain, best[cells])
                )
                best[cells] = np.maximum(best[cells], one.gain)

        for row in kept:
            one = rows[row][number]
            if one is not None:
                cells = one.cells
                others = np.where(one.gain >= best[cells], second[cells], best[cells])
                gains[row] += float(_added(one.gain, others).sum()) + one.paid
    return gains


def _added(gain: Float32, have: Float32) -> Float32:
    """Return what pixels add to what is explained, nats."""
    return np.maximum(gain - have, np.minimum(gain, 0))


def _owners(
    things: Sequence[Sequence[Score | None]], sizes: Sequence[int]
) -> list[NDArray[np.int64]]:
    """Return which thing explains each pixel best, from 0 on; -1 for none."""
    found = []
    for number, size in enumerate(sizes):
        best = np.zeros(size, np.float32)
        owner = np.full(size, -1, np.int64)
        for row, scores in enumerate(things):
            one = scores[number]
            if one is not None:
                better = one.gain > best[one.cells]
                best[one.cells[better]] = one.gain[better]
                owner[one.cells[better]] = row
        found.append(owner)
    return found


def _seen_again(world: World, view: View) -> _Rows:
    """Return strangers after another view: those of before, and new ones."""
    stride = view.stride
    measured = view.grid().depth.ravel() > 0
    masks = [mask[::stride, ::stride].ravel() & measured for mask in view.strangers()]
    sizes = np.array([np.count_nonzero(mask) for mask in masks])
    expected = [_expected(world, row, view) for row in world.strangers]
    shared = np.array(
        [[np.count_nonzero(mask[cells]) for mask in masks] for cells in expected]
    ).reshape(len(expected), len(masks))
    lengths = np.array([len(cells) for cells in expected])
    shown: dict[int, Mask] = {}
    left = set(range(len(masks)))
    # a stranger is what shows most of it, and what is a part of it
    for count in (lengths[:, None], sizes):
        alike = shared / np.maximum(count, 1)
        while alike.max(initial=0) > SAME_SEGMENT:
            k, n = divmod(int(alike.argmax()), len(masks))
            shown[k] = masks[n] | shown.get(k, False)
            left.discard(n)
            shared[:, n] = alike[:, n] = 0
            if count is not sizes:
                alike[k] = 0
    column = [
        _weak(shown[k]) if k in shown else None for k in range(len(world.strangers))
    ]
    found = [(*row, last) for row, last in zip(world.strangers, column, strict=True)]
    before = (None,) * len(world.views)
    found += [(*before, _weak(masks[n])) for n in sorted(left) if sizes[n]]
    return tuple(found)


def _weak(mask: Mask) -> Score:
    """Return the score of a stranger with such pixels of the grid, (P,) bool."""
    cells = np.flatnonzero(mask).astype(np.int32)
    gain = np.full(len(cells), STRANGER_GAIN, np.float32)
    return Score(cells, gain, 0.0, float(len(cells)), 0.0, 0.0)


def _expected(world: World, row: Sequence[Score | None], view: View) -> Index:
    """Return the pixels of the grid of a view that show again what a stranger is, (N,) int64."""
    points = world_points(world, row)
    camera = view.camera
    seen = (points - camera[:3, 3]) @ camera[:3, :3]
    seen = seen[seen[:, 2] > NEAREST]
    if not len(seen):
        return np.zeros(0, np.int64)
    grid = view.grid()
    column = np.searchsorted(grid.x, seen[:, 0] / seen[:, 2])
    line = np.searchsorted(grid.y, seen[:, 1] / seen[:, 2])
    height, width = grid.depth.shape
    inside = (column > 0) & (column < width) & (line > 0) & (line < height)
    column, line, z = column[inside], line[inside], seen[inside, 2]
    there = np.abs(grid.depth[line, column] - z) < SAME_DEPTH
    return np.unique(line[there] * width + column[there])


def world_points(world: World, row: Sequence[Score | None]) -> Float:
    """Return the measured points that something explains in all views, (N, 3), metres."""
    found = [np.zeros((0, 3))]
    for view, one in zip(world.views, row, strict=False):
        if one is not None:
            found.append(view.points(one.cells[one.gain > 0]))
    return np.concatenate(found)
