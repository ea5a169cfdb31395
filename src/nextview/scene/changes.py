"""What a new view says of the things that are known: they stand, have moved, or are gone.

Each is a ratio of two totals of the score: of the thing where it was, where it is now, and nowhere.
So is the question whether the camera stands where it is said to: one error of its pose, or several
things that have moved. Of a thing without a clear name, the surface that was measured is compared.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from nextview.scene.followed import SURPRISE
from nextview.sensing.frame import Frame
from nextview.sensing.noise import LEAST_ERROR
from nextview.sensing.view import FEWEST_PIXELS, View, stride_of
from nextview.things.library import Hypotheses, Library
from nextview.things.register import register
from nextview.things.score import BLOCK, OUTLIER, STEEPEST, Score, score, total
from nextview.things.surface import Surface
from nextview.things.visible_points import ALL_AROUND
from nextview.things.world import (
    CLEAR_SHARE,
    EXPLAINED,
    NEW_OBJECT,
    STRANGER_GAIN,
    Thing,
    World,
    corrected,
)
from nextview.types import Float, Index, Mask

STILL = 0.9  # share of the pixels of a thing that look as they did if it has not moved
ALONE = (
    0.5,
    0.3,
    0.2,
    0.12,
    0.06,
    0.03,
)  # reaches of the registration in one view, radii


@dataclass(frozen=True, eq=False)
class Changes:
    """What a view changes in a world, before new things are searched for.

    Attributes:
        world: the things that still stand, and those that have moved.
        view: with the pose of its camera corrected.
        held: number of the moved thing that each pixel of the grid of the view shows, 0 for none.
        moved: numbers of things that stand elsewhere.
        gone: things that are no longer where they were.
        stand: numbers of things that the view shows where they were.
        wrong_pose: whether most of several things are not where they were, though the camera may
            have moved: its pose is likely to be wrong.
    """

    world: World
    view: View
    held: NDArray[np.int32]
    moved: tuple[int, ...] = ()
    gone: tuple[Thing, ...] = ()
    stand: tuple[int, ...] = ()
    wrong_pose: bool = False


@dataclass(frozen=True, eq=False)
class _Compared:
    """A known thing in a view.

    Attributes:
        thing: in the world.
        now: what the view shows of it: "hidden" where it is not in the view.
        pose: that explains the view best.
        cells: pixels of the grid that it explains where it is now, (N,).
    """

    thing: Thing
    now: Literal["stands", "moved", "gone", "hidden"]
    pose: Hypotheses
    cells: Index


def changes(world: World, view: View, camera_stands: bool) -> Changes:
    """Compare a view with what is known.

    Args:
        world: before the view.
        view: the view.
        camera_stands: whether the camera has not moved since a frame that fits.
    """
    still = _still(world, view)
    if still is not None:
        return still
    if not camera_stands:
        view = corrected(world, view)
    found = _by_scan(world, view)
    found += _by_measured_surface(world, view, found)

    moved = [one for one in found if one.now == "moved"]
    gone = tuple(one.thing for one in found if one.now == "gone")
    stand = tuple(one.thing.number for one in found if one.now == "stands")
    held = np.zeros(view.grid().depth.size, np.int32)
    for one in moved:
        held[one.cells] = one.thing.number
    changed = len(moved) + len(gone)
    return Changes(
        _after(world, moved, gone) if changed else world,
        view,
        held,
        tuple(one.thing.number for one in moved),
        gone,
        stand,
        wrong_pose=not camera_stands and changed > 1 and changed > len(stand),
    )


def nothing_new(world: World, frame: Frame) -> bool:
    """Return True if a frame is taken from where the last view was, and looks as it did.

    Args:
        world: before the frame.
        frame: of a depth camera.
    """
    # another mask asks for other things
    if not world.views or frame.mask is not world.views[-1].frame.mask:
        return False
    alike = world.views[-1].alike(frame)
    if not alike.any() or _standing(world, world.owners[-1], alike) is None:
        return False
    stride = stride_of(frame)
    depth = frame.depth[::stride, ::stride]
    new = (depth > 0) & ~alike
    new = ndimage.binary_opening(new, np.ones((3, 3), bool))
    return int(np.count_nonzero(new)) < FEWEST_PIXELS


def _still(world: World, view: View) -> Changes | None:
    """Return that all stands where it was: the same place was seen before, and looks as it did."""
    for before, owner in zip(world.views[::-1], world.owners[::-1], strict=True):
        alike = before.alike(view.frame)
        if not alike.any():
            continue
        stand = _standing(world, owner, alike)
        if stand is None:
            return None
        held = np.zeros(len(owner), np.int32)
        return Changes(world, view.seen_from(before.camera), held, stand=stand)
    return None


def _standing(
    world: World, owner: NDArray[np.int32], alike: Mask
) -> tuple[int, ...] | None:
    """Return the numbers of the things that a view showed and that look as they did.

    Args:
        world: with the view.
        owner: number of the thing that each pixel of its grid shows, 0 for none, (P,).
        alike: pixels of its grid that look as they did, (h, w) bool.

    Returns:
        The numbers; None if one of the things looks different.
    """
    counts = np.bincount(owner, minlength=world.next_number)
    same = np.bincount(owner, alike.ravel(), minlength=world.next_number)
    numbers = [one.number for one in world.things if counts[one.number]]
    if any(same[number] < STILL * counts[number] for number in numbers):
        return None
    return tuple(numbers)


def _clear(one: Thing) -> bool:
    """Whether a thing is explained so well that its name and pose tell where it stands."""
    return one.row >= 0 and one.share >= CLEAR_SHARE


def _by_scan(world: World, view: View) -> list[_Compared]:
    """Compare the things with clear names, by their scans."""
    things = [one for one in world.things if _clear(one)]
    rows = np.array([one.row for one in things], np.int64)
    there = world.hypotheses[rows]
    return _compared(world, view, things, world.library, there, ()) if things else []


def _by_measured_surface(
    world: World, view: View, others: Sequence[_Compared]
) -> list[_Compared]:
    """Compare the surfaces that were measured of all other things.

    Args:
        world: before the view.
        view: the view.
        others: things with clear names.
    """
    things, surfaces = [], []
    for one in world.things:
        surface = None if _clear(one) else _measured(world, one.number)
        if surface is not None:
            things.append(one)
            surfaces.append(surface)
    if not things:
        return []

    # points that these cameras may see are enough
    cameras = np.array([one.camera[:3, 3] for one in (*world.views, view)])
    away = np.concatenate([cameras - surface.centre for surface in surfaces])
    nearest = np.unique((away @ ALL_AROUND.T).argmax(1))
    library = Library(surfaces, directions=ALL_AROUND[nearest])
    turns = np.tile(np.eye(3), (len(things), 1, 1))
    there = Hypotheses.of(np.arange(len(things)), turns, library.centres)
    return _compared(world, view, things, library, there, others)


def _compared(
    world: World,
    view: View,
    things: Sequence[Thing],
    library: Library,
    there: Hypotheses,
    others: Sequence[_Compared],
) -> list[_Compared]:
    """Compare the view with things where they were: one pose in all views, or another one now.

    Args:
        world: before the view.
        view: the view.
        things: M things of the world.
        library: with their surfaces.
        there: where they were.
        others: things that were compared before.
    """
    whole = library is world.library

    def scores(one: View, some: Hypotheses) -> list[Score | None]:
        found = score(library, one, some)
        return found if whole else [each and _of_part(each) for each in found]

    # a view from before a thing came to where it stands says nothing
    stood = [[one is not None for one in thing.scores] for thing in things]

    def totals(some: Hypotheses) -> list[float]:
        columns = [scores(one, some) for one in world.views]
        rows = zip(*columns, strict=True)
        return [
            total([each for each, was in zip(row, since, strict=True) if was])
            for row, since in zip(rows, stood, strict=True)
        ]

    known = [total(one.scores) for one in things] if whole else totals(there)
    stays = known, scores(view, there)
    better = register(library, [*world.views, view], there, (0.06, 0.03, 0.02))
    refined = totals(better), scores(view, better)
    stand = [
        max(
            ((each[0][k], each[1][k]) for each in (stays, refined)),
            key=lambda each: each[0] + total(each[1:]),
        )
        for k in range(len(things))
    ]

    # where they may be now: near where they were, or where the view shows something else
    taken = np.zeros(view.grid().depth.size, bool)
    for settled in others:
        taken[settled.cells] = True
    for _, found in stand:
        if found is not None and found.total > NEW_OBJECT:
            taken[_explained(found)] = True
    left = np.flatnonzero([total([found]) <= NEW_OBJECT for _, found in stand])
    middles = [_middle(world, things[int(k)].number) for k in left]
    rows, centres = [np.arange(len(things))], [there.centres]
    for place in _free(view, taken):
        rows.append(left)
        centres.append(there.centres[left] + place - np.reshape(middles, (-1, 3)))
    every = np.concatenate(rows)
    starts = replace(there[every], centres=np.concatenate(centres))
    tried = register(library, [view], starts, ALONE)
    shown = scores(view, tried)
    values = np.array([total([each]) for each in shown])
    apart = _displaced(library, view, there[every], tried)

    compared = []
    for k, one in enumerate(things):
        before, found = stand[k]
        mine = np.flatnonzero(every == k)
        now: Literal["stands", "moved", "gone", "hidden"] = "hidden"
        best = int(mine[values[mine].argmax()])
        other = shown[best]
        cells: Index = np.zeros(0, np.int64)
        if found is not None and found.seen > 0:
            if found.total > NEW_OBJECT:
                now = "stands"
                cells = _explained(found)
            elif found.total < -NEW_OBJECT and found.through > found.seen / 2:
                now = "gone"
            # a move has to explain more than a stranger that came there
            if (
                other is not None
                and other.total > NEW_OBJECT + STRANGER_GAIN * other.seen
            ):
                gained = stays[0][k] + other.total - before - found.total
                if min(gained / BLOCK**2, apart[best]) > SURPRISE:
                    now = "moved"
                    cells = _explained(other)
        compared.append(_Compared(one, now, tried[best : best + 1], cells))
    return compared


def _free(view: View, taken: Mask) -> Iterator[Float]:
    """Yield the middle of each instance that things do not explain, (3,), metres.

    Args:
        view: the view.
        taken: pixels of its grid that things explain, (P,) bool.
    """
    stride = view.stride
    for mask in view.instances():
        cells = np.flatnonzero(mask[::stride, ::stride])
        if len(cells) and taken[cells].mean() < EXPLAINED:
            yield view.points(cells).mean(0)


def _middle(world: World, number: int) -> Float:
    """Return the middle of what was measured of a thing, (3,), metres."""
    shown = [
        view.points(np.flatnonzero(owner == number))
        for view, owner in zip(world.views, world.owners, strict=True)
    ]
    return np.concatenate(shown).mean(0)


def _displaced(
    library: Library, view: View, there: Hypotheses, now: Hypotheses
) -> Float:
    """Return how unlikely errors of a view are to show things where they are not, nats, (M,).

    Depth is bent, and edges lie within a pixel.
    """
    ray = there.centres - view.camera[:3, 3]
    away = np.linalg.norm(ray, axis=1)
    shift = now.centres - there.centres
    along = (shift * ray).sum(1) / away
    # of points on a surface about its centre: a third of their largest squared motion
    turn = ((now.rotations - there.rotations) ** 2).sum((1, 2)) / 2
    turned = library.radii[there.things] ** 2 * turn / 3
    square = (shift**2).sum(1) - along**2 + turned
    pixel = away / view.frame.pinhole.fx
    return ((along / LEAST_ERROR / away) ** 2 + square / pixel**2) / 2


def _explained(one: Score) -> Index:
    """Return the pixels of the grid that something explains, (N,) int64."""
    return one.cells[one.gain > 0].astype(np.int64)


def _of_part(one: Score) -> Score:
    """Return the score of a part of a thing: what shows beside it may be more of the thing."""
    return replace(one, paid=OUTLIER * one.through)


def _measured(world: World, number: int) -> Surface | None:
    """Return the surface that the views have measured of a thing, in the world; None for none."""
    vertices, faces = [], []
    count = 0
    for view, owner in zip(world.views, world.owners, strict=True):
        grid = view.grid()
        own = (owner == number).reshape(grid.depth.shape)
        at = np.where(own, count + np.cumsum(own).reshape(own.shape) - 1, -1)
        for corners in (np.s_[:-1, :-1], np.s_[1:, 1:]):
            across = at[:-1, 1:], at[corners], at[1:, :-1]
            depth = np.stack(
                [grid.depth[:-1, 1:], grid.depth[corners], grid.depth[1:, :-1]]
            )

            # no triangle reaches over an edge of what was measured
            whole = np.min(across, axis=0) >= 0
            whole &= np.ptp(depth, axis=0) < grid.pitch / STEEPEST * depth.min(0)
            faces.append(np.stack(across, -1)[whole])
        vertices.append(view.points(np.flatnonzero(own)))
        count += len(vertices[-1])

    every = np.concatenate(faces).astype(np.int32)
    if not len(every):
        return None
    points = np.concatenate(vertices).astype(np.float32)
    return Surface(str(number), points, every)


def _after(world: World, moved: Sequence[_Compared], gone: Sequence[Thing]) -> World:
    """Return the world without what moved or is gone, and with the new poses."""
    left = [*(one.thing for one in moved), *gone]
    dropped: set[int] = set()
    for one in left:
        if one.row >= 0:
            dropped |= set(world.rivals(one.row).tolist())
    dropped -= {one.row for one in world.things if one.row >= 0 and one not in left}
    world = _forgotten(world, [one.number for one in left])
    kept = np.array(
        [row for row in range(len(world.scores)) if row not in dropped], np.int64
    )
    world = world.with_rows(kept)

    named = [one for one in moved if _clear(one.thing)]
    nothing = ((None,) * len(world.views),) * len(named)
    return replace(
        world,
        hypotheses=Hypotheses.joined([world.hypotheses, *(one.pose for one in named)]),
        scores=(*world.scores, *nothing),
        keys=np.append(world.keys, world.next_key + np.arange(len(named))),
        next_key=world.next_key + len(named),
        given={
            **world.given,
            **{world.next_key + k: one.thing.number for k, one in enumerate(named)},
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
