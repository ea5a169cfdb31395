"""All objects in the frames of a depth camera: which of the known things are where, and where to
look next.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from threading import RLock

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nextview.checks import one_line
from nextview.errors import ObservationError
from nextview.scene.following import Agreement, agreement, assign, contradicted
from nextview.scene.judging import Judge
from nextview.scene.objects import SceneObject
from nextview.scene.parting import Bench, new_track, part
from nextview.scene.tracks import Track
from nextview.sensing.frame import Frame
from nextview.sensing.object_frame import Box, upright_axes
from nextview.sensing.plausibility import ViewWarning, check_frame
from nextview.sensing.tabletop import TableTop
from nextview.session.system import System, load

Float = NDArray[np.float64]

CORES = 2  # objects that are judged at the same time
WRONG_POSE = (
    "this frame does not fit the others and is left out: most objects are not where they were, so"
    " its pose is likely to be wrong"
)
NOTHING = ViewWarning("empty", "nothing stands on the plane in this frame")


@dataclass(frozen=True)
class Look:
    """What one frame changed.

    Attributes:
        taken: whether the frame was taken in.
        appeared: numbers of objects that were not known before.
        moved: numbers of objects that stand elsewhere now.
        gone: numbers of objects that are no longer there.
        warnings: what is likely to be wrong with the frame; usually nothing.
    """

    taken: bool
    appeared: tuple[int, ...] = ()
    moved: tuple[int, ...] = ()
    gone: tuple[int, ...] = ()
    warnings: tuple[ViewWarning, ...] = ()


class Scene:
    """All objects on a table, or a floor, as a depth camera sees them in one or more frames.

    >>> scene = nextview.Scene("ycb")                                           # doctest: +SKIP
    >>> scene.update(nextview.Frame(depth, intrinsics, pose))                   # doctest: +SKIP
    >>> for thing in scene.objects:                                             # doctest: +SKIP
    ...     print(thing.name, thing.confidence, thing.pose)

    Threads that share one wait for each other.

    Args:
        models: a system of ``nextview.load``, or what it takes as models.
        up: direction against gravity in the world, (3,); z by default. None: the normal of the
            support plane, as always for frames without a pose.
        region: upright box in the world; what is outside is left out.
    """

    def __init__(
        self,
        models: System | str | Path | Sequence[str | Path] = "ycb",
        up: ArrayLike | None = (0.0, 0.0, 1.0),
        region: Box | None = None,
    ) -> None:
        self.system = models if isinstance(models, System) else load(models)
        self.up = None if up is None else upright_axes(up)[2]
        self.region = region
        self._judge = Judge(self.system, CORES)
        self._tops: list[TableTop] = []
        self._tracks: list[Track] = []
        self._touching: set[tuple[int, int]] = set()
        self._next_number = 1
        self._lock = RLock()

    @property
    def objects(self) -> tuple[SceneObject, ...]:
        """What is on the table, in the order in which it was found."""
        tracks = sorted(self._tracks, key=lambda track: track.number)
        return tuple(SceneObject.of(track, self._touching) for track in tracks)

    @property
    def frames(self) -> tuple[Frame, ...]:
        """The frames that were taken in."""
        return tuple(top.frame for top in self._tops)

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
            known = [_sphere(track) for track in self._tracks]
            plane = self._tops[0].plane if self._tops else None
            top = TableTop.of(frame, self.up, plane, known, self.region)
            found = [agreement(track, top) for track in self._tracks]
            if contradicted(found):
                return Look(False, warnings=(ViewWarning("pose", WRONG_POSE),))
            return self._take(top, found)

    def _refuse(self, frame: Frame) -> None:
        if not isinstance(frame, Frame):
            raise ObservationError(
                f"what a depth camera gave is a Frame, not {one_line(repr(frame))}"
            )
        if self._tops and (frame.pose is None or self._tops[0].frame.pose is None):
            raise ObservationError(
                "a second frame needs a pose, and the first one too: how else do they fit together?"
            )

    def _take(self, top: TableTop, found: Sequence[Agreement]) -> Look:
        """Take in a frame that fits."""
        number = len(self._tops)
        bench = Bench(top, number, self._judged)
        there = [
            track for track, one in zip(self._tracks, found, strict=True) if not one.contradicts
        ]
        lost = [track for track, one in zip(self._tracks, found, strict=True) if one.contradicts]

        own, new = assign(top.segments(), there, top)
        shown = []
        hidden = []
        for row, track in enumerate(there):
            if row not in own:
                hidden.append(track)
                continue
            try:
                shown.append(track.with_mask(number, own[row], top))
            except ObservationError:  # too little of it shows to say anything
                hidden.append(track)
        for mask in new:
            with suppress(ObservationError):
                shown.append(new_track(mask, bench))

        shown = part(self._judged(shown), bench)
        self._tops.append(top)
        return self._numbered(shown, hidden, lost, top, number)

    def _numbered(
        self,
        shown: Sequence[Track],
        hidden: Sequence[Track],
        lost: Sequence[Track],
        top: TableTop,
        number: int,
    ) -> Look:
        """Give new objects their numbers: what is lost in one place may be found in another."""
        away = {track.result.answer: track for track in lost if track.result is not None}
        appeared = []
        moved = []
        kept = list(hidden)
        for track in shown:
            if track.number < 0:
                assert track.result is not None
                old = away.pop(track.result.answer, None) if track.result.answer else None
                if old is not None:
                    track = replace(track, number=old.number)
                    moved.append(old.number)
                else:
                    track = replace(track, number=self._next_number)
                    self._next_number += 1
                    appeared.append(track.number)
            kept.append(track)
        self._tracks = kept

        gone = tuple(track.number for track in lost if track.number not in moved)
        self._touching = {pair for pair in self._touching if not set(pair) & {*gone, *moved}}
        self._note_touching(top, number)
        warnings = tuple(check_frame(top.frame))
        if not kept:
            warnings += (NOTHING,)
        return Look(True, tuple(appeared), tuple(moved), gone, warnings)

    def _note_touching(self, top: TableTop, number: int) -> None:
        """Remember which objects touch in a frame."""
        here = [(track.number, track.mask_in(number)) for track in self._tracks]
        for (one, first), (other, second) in combinations(here, 2):
            if first is not None and second is not None and top.touching(first, second):
                self._touching.add((min(one, other), max(one, other)))

    def _judged(self, tracks: Sequence[Track]) -> list[Track]:
        """The same objects with what each is."""
        results = self._judge([track.thing for track in tracks])
        return [
            replace(track, result=result) for track, result in zip(tracks, results, strict=True)
        ]


def _sphere(track: Track) -> tuple[Float, float]:
    """Centre, (3,), and radius of an object, metres."""
    frame = track.thing.object_frame
    return frame.centre, frame.radius
