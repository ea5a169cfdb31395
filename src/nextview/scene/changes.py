"""What a new view says of the things that are known: they stand, have moved, or are gone.

Each is a ratio of two totals of the score: of the thing where it was, where it is now, and nowhere.
So is the question whether the camera stands where it is said to: one error of its pose, or several
things that have moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nextview.sensing.view import View
from nextview.things.library import Hypotheses
from nextview.things.register import register
from nextview.things.score import score, total
from nextview.things.world import (
    CLEAR_SHARE,
    MOVED,
    MOVED_SHARE,
    NEW_OBJECT,
    Thing,
    World,
    corrected,
    world_points,
)
from nextview.types import Float, Index

ALONE = (
    0.5,
    0.3,
    0.2,
    0.12,
    0.06,
    0.03,
)  # reaches of the registration in one view, radii
MOST_GONE = 0.7  # share of a stranger that is seen through when it is gone
BEHIND = 0.015  # metres behind a stranger, from which on it is seen through


@dataclass(frozen=True, eq=False)
class Changes:
    """What a view changes in a world, before new things are searched for.

    Attributes:
        world: the things that still stand, and those that have moved.
        view: with the pose of its camera corrected.
        moved: numbers of things that stand elsewhere.
        gone: things that are no longer where they were.
        stand: numbers of things that the view shows where they were.
        wrong_pose: whether most of several things are not where they were, though the camera may
            have moved: its pose is likely to be wrong.
    """

    world: World
    view: View
    moved: tuple[int, ...] = ()
    gone: tuple[Thing, ...] = ()
    stand: tuple[int, ...] = ()
    wrong_pose: bool = False


def changes(world: World, view: View, camera_stands: bool) -> Changes:
    """Compare a view with what is known.

    Args:
        world: before the view.
        view: the view.
        camera_stands: whether the camera has not moved since a frame that fits.
    """
    named = [one for one in world.things if one.row >= 0]
    if named:
        rows = np.array([one.row for one in named])
        if not camera_stands:
            view = corrected(world, view)
        return _compared(world, view, named, rows, camera_stands)
    return _without_gone_strangers(Changes(world, view))


def _compared(
    world: World,
    view: View,
    named: Sequence[Thing],
    rows: Index,
    camera_stands: bool,
) -> Changes:
    """Compare the view with each named thing."""
    library = world.library
    there = world.hypotheses[rows]
    before = np.array([total(world.scores[row]) for row in rows])
    # one pose in all views, or another one in the new view
    joint = register(library, [*world.views, view], there, (0.06, 0.03, 0.02), 96)
    columns = [score(library, one, joint) for one in world.views]
    after = np.array([total(row) for row in zip(*columns, strict=True)])
    now = score(library, view, joint)
    alone = register(library, [view], there, ALONE, 96)
    elsewhere = score(library, view, alone)

    moved, gone, stand = [], [], []
    new_poses: dict[int, int] = {}
    for k, one in enumerate(named):
        found, other = now[k], elsewhere[k]
        if found is None or found.seen == 0:
            continue
        if one.share < CLEAR_SHARE:
            # a doubtful name or pose tells nothing about moves
            stand += [one.number] * (found.total > NEW_OBJECT)
            continue
        if other is not None and other.total > NEW_OBJECT:
            apart = before[k] + other.total
            least = MOVED + MOVED_SHARE * min(before[k], other.total)
            if apart - (after[k] + found.total) > least:
                moved.append(one.number)
                new_poses[one.row] = k
                continue
        if found.total < -NEW_OBJECT and found.through > found.seen / 2:
            gone.append(one)
        elif found.total > NEW_OBJECT:
            stand.append(one.number)
    changed = len(moved) + len(gone)
    wrong = not camera_stands and changed > 1 and changed > len(stand)
    told = Changes(world, view, tuple(moved), tuple(gone), tuple(stand), wrong)
    if wrong or not changed:
        return _without_gone_strangers(told)
    return _without_gone_strangers(
        replace(told, world=_after(world, told, alone, new_poses))
    )


def _after(
    world: World, told: Changes, alone: Hypotheses, new_poses: dict[int, int]
) -> World:
    """Return the world without what moved or is gone, and with the new poses."""
    left = [one for one in world.things if one.number in told.moved or one in told.gone]
    dropped: set[int] = set()
    for one in left:
        dropped |= set(world.rivals(one.row).tolist())
    dropped -= {one.row for one in world.things if one.row >= 0 and one not in left}
    world = _forgotten(world, [one.number for one in left])
    kept = np.array(
        [row for row in range(len(world.scores)) if row not in dropped], np.int64
    )
    world = world.with_rows(kept)
    some = alone[np.array(list(new_poses.values()), np.int64)]
    nothing = ((None,) * len(world.views),) * len(some)
    moved = [one for one in left if one.number in told.moved]
    return replace(
        world,
        hypotheses=Hypotheses.joined([world.hypotheses, some]),
        scores=(*world.scores, *nothing),
        keys=np.append(world.keys, world.next_key + np.arange(len(some))),
        next_key=world.next_key + len(some),
        given={
            **world.given,
            **{world.next_key + k: one.number for k, one in enumerate(moved)},
        },
    )


def _forgotten(world: World, numbers: Sequence[int]) -> World:
    """Return the world without the pixels that some things explained: they say nothing any more."""
    views, held = [], []
    for view, owner in zip(world.views, world.owners, strict=True):
        cells = np.isin(owner, numbers)
        held.append(cells)
        shape = view.grid().depth.shape
        views.append(view.without(cells.reshape(shape)) if cells.any() else view)

    # what is no longer there was no stranger, either
    kept = []
    for row in world.strangers:
        shown = [(one, cells) for one, cells in zip(row, held, strict=True) if one]
        count = sum(len(one.cells) for one, _ in shown)
        left = sum(np.count_nonzero(~cells[one.cells]) for one, cells in shown)
        if 2 * left > count:
            kept.append(row)
    owners = tuple(
        np.where(cells, 0, owner).astype(np.int32)
        for cells, owner in zip(held, world.owners, strict=True)
    )
    return replace(world, views=tuple(views), strangers=tuple(kept), owners=owners)


def _without_gone_strangers(told: Changes) -> Changes:
    """Return the changes with the strangers that the view sees through."""
    world, view = told.world, told.view
    gone = [
        one
        for one in world.things
        if one.row < 0
        and _seen_through(world_points(world, one.scores), view) > MOST_GONE
    ]
    if not gone:
        return told
    kept = [
        row for row in world.strangers if not any(row is one.scores for one in gone)
    ]
    world = _forgotten(world, [one.number for one in gone])
    things = tuple(one for one in world.things if one not in gone)
    world = replace(world, strangers=tuple(kept), things=things)
    return replace(told, world=world, gone=(*told.gone, *gone))


def _seen_through(points: Float, view: View) -> float:
    """Return the share of points, (N, 3), world, behind which a view measures something."""
    camera = view.camera
    seen = (points - camera[:3, 3]) @ camera[:3, :3]
    ahead = seen[:, 2] > 0.05
    at = view.frame.pinhole.project(seen[ahead])
    column, row = np.floor(at).astype(np.int64).T
    height, width = view.frame.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    depth = view.depth[row[inside], column[inside]]
    measured = depth > 0
    if np.count_nonzero(measured) < 0.5 * len(points) or not len(points):
        return 0.0
    behind = depth[measured] > seen[ahead][inside, 2][measured] + BEHIND
    return float(behind.mean())
