"""All objects in the frames of a depth camera: which of the known things are where, and where to
look next.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from nextview.checks import number, one_line
from nextview.errors import ObservationError, SessionError
from nextview.scene.floating import floating
from nextview.scene.following import (
    SegmentAgreement,
    agreement,
    assign,
    contradicted,
    parts_of,
    same_objects,
)
from nextview.scene.fragments import fragments
from nextview.scene.judging import Judge
from nextview.scene.next_view import (
    FEWEST_HIDDEN,
    TableGround,
    best,
    candidates,
    is_sure,
    values,
)
from nextview.scene.objects import SceneObject
from nextview.scene.parting import GOOD_FIT, Bench, merged, new_track, part, taken_over
from nextview.scene.tracks import Track, render_track
from nextview.sensing.frame import Frame
from nextview.sensing.object_frame import Box, upright_axes
from nextview.sensing.plausibility import ViewWarning, check_frame
from nextview.sensing.support import GroundPlane
from nextview.sensing.tabletop import TableTop
from nextview.session.system import System, load
from nextview.types import Float, Mask

if TYPE_CHECKING:
    from matplotlib.figure import Figure


ENOUGH_FRAMES = 2  # of an object that is sure, after which it is not judged anew
CORES = 2  # objects that are judged at the same time
WRONG_POSE = (
    "this frame does not fit the others and is left out: most objects are not where they were, so"
    " its pose is likely to be wrong"
)
MOVED_OR_POSE = ViewWarning(
    "pose",
    "what was known is not where it was, and nothing else stands where it was: it is taken to have"
    " moved, but the frame's pose may be wrong",
)
LOWER_GROUND = ViewWarning(
    "ground",
    "this frame shows that the ground is lower than it was taken to be: all frames are judged anew",
)
EMPTY_WARNING = ViewWarning("empty", "nothing stands on the plane in this frame")


@dataclass(frozen=True)
class Look:
    """What one frame changed.

    Attributes:
        taken: whether the frame was taken in.
        appeared: numbers of objects that were not known before.
        moved: numbers of objects that stand elsewhere now.
        gone: numbers of objects that are no longer there.
        joined: number of each object that turned out to be a part of another one, and the number of
            that one: the first is used no more.
        warnings: what is likely to be wrong with the frame; usually nothing.
    """

    taken: bool
    appeared: tuple[int, ...] = ()
    moved: tuple[int, ...] = ()
    gone: tuple[int, ...] = ()
    joined: tuple[tuple[int, int], ...] = ()
    warnings: tuple[ViewWarning, ...] = ()


class Scene:
    """All objects on a table, or a floor, as a depth camera sees them in one or more frames.

    >>> scene = nextview.Scene("ycb")                                           # doctest: +SKIP
    >>> scene.update(Frame(depth, intrinsics, pose))  # of nextview.sensing     # doctest: +SKIP
    >>> for thing in scene.objects:                                             # doctest: +SKIP
    ...     print(thing.name, thing.confidence, thing.pose)

    Threads that share one wait for each other.

    Args:
        models: a system of ``nextview.load``, or what it takes as models.
        up: direction against gravity in the world, (3,); z by default. None: the normal of the
            support plane, as always for frames without a pose.
        region: upright box in the world; what is outside is left out.
        distance: of the camera from the middle of the scene in ``target``, metres; by default that
            of the last frame.
        reachable: says of a camera-to-world pose, (4, 4), whether the camera can be brought there.
    """

    def __init__(
        self,
        models: System | str | Path | Sequence[str | Path] = "ycb",
        up: ArrayLike | None = (0.0, 0.0, 1.0),
        region: Box | None = None,
        distance: float | None = None,
        reachable: Callable[[Float], bool] | None = None,
    ) -> None:
        self.distance = (
            None if distance is None else number(distance, "the distance", above=0)
        )

        self.reachable = reachable
        self.system = models if isinstance(models, System) else load(models)
        self.up = None if up is None else upright_axes(up)[2]
        self.region = region
        self._judge = Judge(self.system, CORES)
        self._widest = self._judge.widest
        self._tops: list[TableTop] = []
        self._tracks: list[Track] = []
        self._target: Float | None = None
        self._touching: set[tuple[int, int]] = set()
        self._next_number = 1
        self._lock = RLock()

    @property
    def objects(self) -> tuple[SceneObject, ...]:
        """What is on the table, in the order in which it was found."""
        tracks = sorted(self._tracks, key=lambda track: track.number)
        return tuple(SceneObject.of(track, self._touching) for track in tracks)

    @property
    def tops(self) -> tuple[TableTop, ...]:
        """What each frame that was taken in shows on the plane."""
        return tuple(self._tops)

    @property
    def frames(self) -> tuple[Frame, ...]:
        """The frames that were taken in."""
        return tuple(top.frame for top in self._tops)

    @property
    def done(self) -> bool:
        """Whether more views would tell little, or as many were taken as the system may take."""
        with self._lock:
            if len(self._tops) >= self.system.stopping.max_views:
                return True
            if not self._tops or not all(is_sure(track) for track in self._tracks):
                return False
            if not self._tracks:
                return True
            return (
                TableGround.of(self._tops, self._tracks).largest_hidden < FEWEST_HIDDEN
            )

    @property
    def target(self) -> Float | None:
        """Where to look next so that all objects are sure soonest, camera-to-world, (4, 4).

        The sum of what a view is expected to tell of each object that is not sure, and of the part
        of the table that is hidden in all frames, less a little for the way. None before the first
        frame, where nothing was found, or no view is left.
        """
        with self._lock:
            if not self._tracks:
                return None
            if self._target is None:
                views = candidates(self.system, self._tops, self._tracks, self.distance)
                if self.reachable is not None:
                    can = [bool(self.reachable(pose)) for pose in views.poses]
                    views = replace(views, free=views.free & np.array(can))
                worth = values(self.system, self._tops, self._tracks, views)
                row = best(views, worth, self._tops[-1].frame.camera_to_world[:3, 3])
                self._target = None if row is None else views.poses[row]
            return self._target

    def update(self, frame: Frame) -> Look:
        """Take in what the camera sees.

        Where this raises, nothing is taken in.

        Args:
            frame: of a depth camera; all frames but a single one need a pose. Its mask, if it has
                one, limits where is looked.

        Returns:
            What the frame changed. A frame whose pose does not fit is left out with a warning.

        Raises:
            ObservationError: no support plane is seen, or this is no frame, or has no pose.
        """
        self._refuse(frame)
        with self._lock:
            top = self._top_of(frame, self._tops[0].ground if self._tops else None)
            if top.lower:
                return self._begin_anew(top)
            found = [agreement(track, top) for track in self._tracks]
            if contradicted(found):
                return Look(False, warnings=(ViewWarning("pose", WRONG_POSE),))
            return self._take(top, found)

    def plot(self, path: str | Path | None = None, title: str = "") -> Figure:
        """Draw the last frame with outlines, names and axes of the poses, and all from above.

        Args:
            path: file that it is written to, PNG, PDF or SVG; one of that name is replaced.
            title: of what is shown.

        Raises:
            SessionError: no frame was taken in yet.
            UsageError: the file is of another format.
            ResultsError: the path is a link or a folder, or cannot be written.
        """
        from nextview.scene.figure import draw_scene
        from nextview.session.episode_figure import save_figure

        if not self._tops:
            raise SessionError(
                "there is nothing to draw before the first frame: update with one"
            )
        target = None if self.done else self.target
        figure = draw_scene(self._tops, self.objects, target, title)
        if path is not None:
            save_figure(figure, Path(path))
        return figure

    def _refuse(self, frame: Frame) -> None:
        if not isinstance(frame, Frame):
            raise ObservationError(
                f"what a depth camera gave is a Frame, not {one_line(repr(frame))}"
            )
        if self._tops and (frame.pose is None or self._tops[0].frame.pose is None):
            raise ObservationError(
                "a second frame needs a pose, and the first one too: how else do they fit together?"
            )

    def _top_of(self, frame: Frame, ground: GroundPlane | None) -> TableTop:
        """What a frame shows on the ground, which is looked for if it is not known.

        Raises:
            ObservationError: no support plane is seen.
        """
        known = [_sphere(track) for track in self._tracks]
        return TableTop.of(frame, self.up, ground, known, self.region, self._widest)

    def _begin_anew(self, last: TableTop) -> Look:
        """Judge all frames anew, on the lower ground that a new one shows.

        Args:
            last: what the new frame shows.
        """
        anew = copy(self)
        anew._tops = []
        anew._tracks = []
        anew._touching = set()
        tops = [anew._top_of(frame, last.ground) for frame in self.frames]
        for top in (*tops, last):
            found = [agreement(track, top) for track in anew._tracks]
            if not contradicted(found):
                look = anew._take(top, found)
            elif top is last:
                return Look(False, warnings=(ViewWarning("pose", WRONG_POSE),))

        same = same_objects(anew._tracks, self._tracks)
        joined = parts_of(self._tracks, anew._tracks, same)
        known = {track.number for track in self._tracks}
        self._tops = anew._tops
        self._tracks = [
            replace(track, number=same.get(track.number, track.number))
            for track in anew._tracks
        ]
        pairs = [(same.get(a, a), same.get(b, b)) for a, b in anew._touching]
        self._touching = {(min(pair), max(pair)) for pair in pairs}
        self._next_number = anew._next_number
        self._target = None

        now = {track.number for track in self._tracks}
        return replace(
            look,
            appeared=tuple(sorted(now - known)),
            gone=tuple(sorted(known - now - {ended for ended, _ in joined})),
            moved=(),
            joined=joined,
            warnings=(*look.warnings, LOWER_GROUND),
        )

    def _take(self, top: TableTop, found: Sequence[SegmentAgreement]) -> Look:
        """Take in a frame that fits."""
        number = len(self._tops)
        segments = top.segments()
        bench = Bench(top, number, self._judged)
        there = [
            track
            for track, one in zip(self._tracks, found, strict=True)
            if not one.contradicts
        ]
        lost = [
            track
            for track, one in zip(self._tracks, found, strict=True)
            if one.contradicts
        ]

        own, new = assign(segments, there, top)
        shown = []
        hidden = []
        for row, track in enumerate(there):
            if row not in own:
                hidden.append(track)
                continue
            try:
                shown.append(self._seen_again(track, own[row], top, number))
            except ObservationError:  # too little of it shows to say anything
                hidden.append(track)
        for mask in new:
            with suppress(ObservationError):
                shown.append(new_track(mask, bench))

        before = {track.number: track for track in there}
        shown = part(self._judged_if_new(shown), bench, before)
        self._tops.append(top)
        self._target = None
        benches = [Bench(one, k, self._judged) for k, one in enumerate(self._tops)]
        every = merged(taken_over([*hidden, *shown], benches), benches)
        look = self._numbered(every, lost, top, number)
        if look.moved and not any(one.confirms for one in found):
            return replace(look, warnings=(*look.warnings, MOVED_OR_POSE))
        return look

    def _numbered(
        self,
        tracks: Sequence[Track],
        lost: Sequence[Track],
        top: TableTop,
        number: int,
    ) -> Look:
        """Give new objects their numbers: what is lost in one place may be found in another."""
        away = {
            track.result.answer: track for track in lost if track.result is not None
        }
        appeared = []
        moved = []
        kept = []
        joined = []
        for track in tracks:
            if track.number < 0:
                assert track.result is not None
                old = (
                    away.pop(track.result.answer, None) if track.result.answer else None
                )
                if old is not None:
                    track = replace(track, number=old.number)
                    moved.append(old.number)
                else:
                    track = replace(track, number=self._next_number)
                    self._next_number += 1
                    appeared.append(track.number)
            joined += [(ended, track.number) for ended in track.absorbed]
            kept.append(replace(track, absorbed=()))
        in_the_air = floating(kept, top.plane)
        self._tracks = [
            replace(track, floats=floats)
            for track, floats in zip(kept, in_the_air, strict=True)
        ]

        gone = tuple(track.number for track in lost if track.number not in moved)
        changed = {*gone, *moved, *(ended for ended, _ in joined)}
        self._touching = {pair for pair in self._touching if not set(pair) & changed}
        self._note_touching(top, number)
        small = fragments(self._tracks, self._touching)
        self._tracks = [
            replace(track, is_fragment=is_fragment)
            for track, is_fragment in zip(self._tracks, small, strict=True)
        ]
        warnings = tuple(check_frame(top.frame))
        if not kept:
            warnings += (EMPTY_WARNING,)
        return Look(True, tuple(appeared), tuple(moved), gone, tuple(joined), warnings)

    def _note_touching(self, top: TableTop, number: int) -> None:
        """Remember which objects touch in a frame."""
        here = [(track.number, track.mask_in(number)) for track in self._tracks]
        for (one, first), (other, second) in combinations(here, 2):
            if first is not None and second is not None and top.touching(first, second):
                self._touching.add((min(one, other), max(one, other)))

    def _seen_again(
        self,
        track: Track,
        mask: Mask,
        top: TableTop,
        number: int,
    ) -> Track:
        """An object with its pixels in another frame.

        What is sure by some frames already, and is seen where it should be, is not judged anew.

        Raises:
            ObservationError: too little is seen of it.
        """
        if is_sure(track) and len(track.frames) >= ENOUGH_FRAMES:
            rendered = render_track(track, top, number, track.posed)
            if rendered is not None:
                explained, every = rendered.fit(mask)
                if explained >= GOOD_FIT * every:
                    return replace(track, again=(*track.again, (number, mask)))
        return track.with_mask(number, mask, top)

    def _judged_if_new(self, tracks: Sequence[Track]) -> list[Track]:
        """The same objects with what each is; those of which that is known stay as they are."""
        asked = iter(self._judged([track for track in tracks if track.result is None]))
        return [next(asked) if track.result is None else track for track in tracks]

    def _judged(self, tracks: Sequence[Track]) -> list[Track]:
        """The same objects with what each is."""
        results = self._judge([track.thing for track in tracks])
        return [
            replace(track, result=result)
            for track, result in zip(tracks, results, strict=True)
        ]


def _sphere(track: Track) -> tuple[Float, float]:
    """Centre, (3,), and radius of an object, metres."""
    frame = track.thing.object_frame
    return frame.centre, frame.radius
