"""All objects in the frames of a depth camera: which of the known things are where, and where to
look next.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from nextview.checks import number
from nextview.errors import ObservationError, SessionError
from nextview.geometry.axes import upright_axes
from nextview.scene.changes import Change, changes, wrong_pose
from nextview.scene.following import SAME_OBJECT_SHARE, assign
from nextview.scene.judging import Judge
from nextview.scene.next_view import best, candidates, is_sure, values
from nextview.scene.objects import SceneObject
from nextview.scene.parting import GOOD_FIT, Bench, merged, new_track, part, taken_over
from nextview.scene.state import MOST_VERIFIED, SceneState
from nextview.scene.tracks import Track, render_track
from nextview.segmentation.instances import Instances, Segmenter, instances_of
from nextview.sensing.frame import Frame
from nextview.sensing.known_frames import KnownFrames
from nextview.sensing.object_frame import Box
from nextview.sensing.tabletop import TableTop
from nextview.sensing.view_warning import ViewWarning
from nextview.session.repeated import REPEATED
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
NOTHING_AGAIN = (
    "this frame shows neither the plane that things stand on nor any object where they were: check"
    " its pose, or aim the camera at them"
)
MOVED_OR_POSE = ViewWarning(
    "pose",
    "what was known is not where it was, and nothing else stands where it was: it is taken to have"
    " moved, but the frame's pose may be wrong",
)


@dataclass(frozen=True, eq=False)
class Move:
    """An object that stands elsewhere than before.

    Attributes:
        number: of the object.
        before: pose of its scan file in the world until this frame, (4, 4) float64, metres; None
            where it was not known.
        after: the same by this frame.
    """

    number: int
    before: Float | None
    after: Float | None


@dataclass(frozen=True)
class Look:
    """What one frame changed.

    Attributes:
        taken: whether the frame was taken in.
        appeared: numbers of objects that were not known before.
        moved: the objects that stand elsewhere now, each with its number and both poses.
        gone: numbers of objects that are no longer there.
        joined: number of each object that turned out to be a part of another one, and the number of
            that one: the first is used no more.
        warnings: what is likely to be wrong with the frame; usually nothing.
    """

    taken: bool
    appeared: tuple[int, ...] = ()
    moved: tuple[Move, ...] = ()
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
        segmentation: a segmentation of your own: from a frame to the pixels of each thing,
            (N, H, W) bool, to labels, (H, W) int, 0 for none, or to a ``Segmentation``. None for
            the bundled network, which also tells the surfaces where another one does not. What
            stands on no surface is left out.
    """

    def __init__(
        self,
        models: System | str | Path | Sequence[str | Path] = "ycb",
        up: ArrayLike | None = (0.0, 0.0, 1.0),
        region: Box | None = None,
        distance: float | None = None,
        reachable: Callable[[Float], bool] | None = None,
        segmentation: Segmenter | None = None,
    ) -> None:
        self.distance = (
            None if distance is None else number(distance, "the distance", above=0)
        )

        self.reachable = reachable
        self.segmentation = segmentation
        self.system = models if isinstance(models, System) else load(models)
        self.up = None if up is None else upright_axes(up)[2]
        self.region = region
        self._judge = Judge(self.system, CORES)
        self._widest = self._judge.widest
        self._state = SceneState(region=region)
        self._target: Float | None = None
        self._lock = RLock()

    def __getstate__(self) -> dict[str, Any]:
        """All but the lock: a scene can be copied and pickled."""
        return {name: value for name, value in vars(self).items() if name != "_lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _lock=RLock())

    @property
    def objects(self) -> tuple[SceneObject, ...]:
        """What is on the table, in the order in which it was found."""
        state = self._state
        tracks = sorted(state.tracks, key=lambda track: track.number)
        return tuple(SceneObject.of(track, state.touching) for track in tracks)

    @property
    def remarks(self) -> tuple[ViewWarning, ...]:
        """What is left open: small objects that were not verified, what is no object, no ground."""
        return self._state.remarks

    @property
    def tops(self) -> tuple[TableTop, ...]:
        """What each frame that was taken in shows on the plane."""
        return self._state.tops

    @property
    def frames(self) -> tuple[Frame, ...]:
        """The frames that were taken in."""
        return tuple(top.frame for top in self._state.tops)

    @property
    def done(self) -> bool:
        """Whether more views would tell little, or as many were taken as the system may take.

        They would where an object is not sure; where much of what stands in ``region``, or on the
        ground that is seen, is no object yet; and where something hides much of the ground.
        """
        state = self._state
        if len(state.tops) >= self.system.stopping.max_views:
            return True
        return bool(state.tops) and state.settled

    @property
    def target(self) -> Float | None:
        """Where to look next so that all objects are sure soonest, camera-to-world, (4, 4).

        The sum of what a view is expected to tell of each object that is not sure, and of the part
        of the table that is hidden in all frames, less a little for the way. None before the first
        frame, where nothing was found, or no view is left.
        """
        with self._lock:
            state = self._state
            around = state.around
            if not len(around):
                return None
            if self._target is None:
                views = candidates(self.system, state.tops, around, self.distance)
                if self.reachable is not None:
                    can = [bool(self.reachable(pose)) for pose in views.poses]
                    views = replace(views, free=views.free & np.array(can))
                worth = values(self.system, state.tops, state.tracks, views)
                row = best(views, worth, state.tops[-1].frame.camera_to_world[:3, 3])
                self._target = None if row is None else views.poses[row]
            return self._target

    def update(self, frame: Frame) -> Look:
        """Take in what the camera sees.

        Where this raises, nothing is taken in: the scene is as it was.

        Args:
            frame: of a depth camera; all frames but a single one need a pose. Its mask, if it has
                one, limits where is looked.

        Returns:
            What the frame changed. A frame whose pose does not fit, and one that was handed in
            before, is left out with a warning.

        Raises:
            ObservationError: no support plane is seen, this is no frame, or has no pose, or it
                cannot be of the same world as what is known; or ``segmentation`` returned no masks.
        """
        with self._lock:
            known = self._known_frames
            known.refuse(frame)
            if known.repeats(frame):
                return Look(False, warnings=(REPEATED,))

            before = self._state
            instances = instances_of(self.segmentation, frame, self.up)
            top = self._top_of(frame, instances, before.tops)
            shown = top.plane if top.shows_ground else None
            top = replace(top, warnings=tuple(known.check(frame, shown)))
            state, look = self._after(before, top)
            self._state = state
            self._target = None
            return look

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

        if not self._state.tops:
            raise SessionError(
                "there is nothing to draw before the first frame: update with one"
            )
        target = None if self.done else self.target
        figure = draw_scene(self._state.tops, self.objects, target, title)
        if path is not None:
            save_figure(figure, Path(path))
        return figure

    @property
    def _known_frames(self) -> KnownFrames:
        """What is known before another frame."""
        tops = self._state.tops
        box = None if self.region is None else self.region.object_frame
        return KnownFrames(
            tuple(top.frame for top in tops),
            tuple(top.plane if top.shows_ground else None for top in tops),
            self.up,
            None if box is None else box.centre,
            0.0 if box is None else box.radius,
        )

    def _top_of(
        self,
        frame: Frame,
        instances: Instances,
        before: Sequence[TableTop],
    ) -> TableTop:
        """What a frame shows on its surfaces.

        Raises:
            ObservationError: it shows none.
        """
        earlier = before[-1] if before else None
        return TableTop.of(
            frame, instances, self.up, earlier, self.region, self._widest
        )

    def _after(self, before: SceneState, top: TableTop) -> tuple[SceneState, Look]:
        """The scene after a frame, which is left out where it does not fit.

        Raises:
            ObservationError: it shows nothing where it was.
        """
        found, camera = changes(
            before.tracks,
            top,
            top.segments(),
            before.tops,
            before.cameras,
        )
        if wrong_pose(found, camera):
            return before, Look(False, warnings=(ViewWarning("pose", WRONG_POSE),))
        seen_again = any(one.confirms for one in found)
        if before.tops and not (top.shows_ground or seen_again):
            raise ObservationError(NOTHING_AGAIN)

        state, look = self._taken(before, top, found)
        state = replace(state, cameras=(*before.cameras, camera))
        if look.moved and not seen_again:
            look = replace(look, warnings=(*look.warnings, MOVED_OR_POSE))
        return state, look

    def _taken(
        self,
        before: SceneState,
        top: TableTop,
        found: Sequence[Change],
    ) -> tuple[SceneState, Look]:
        """The scene after a frame that fits."""
        number = len(before.tops)
        bench = Bench(top, number, self._judged)
        pairs = list(zip(before.tracks, found, strict=True))
        there = [track for track, one in pairs if not one.contradicts]
        lost = [(track, one.pose) for track, one in pairs if one.contradicts]

        own, new = assign(top.segments(), there, top)
        hidden = [track for row, track in enumerate(there) if row not in own]
        seen = {row: self._explained(there[row], own[row], top, number) for row in own}
        shown = [track for track in seen.values() if track is not None]
        doubtful = {row: own[row] for row, track in seen.items() if track is None}
        verified = _most_pixels([*doubtful.values(), *new])
        for (row, mask), chosen in zip(doubtful.items(), verified, strict=False):
            track = there[row]
            if not chosen:
                hidden.append(replace(track, again=(*track.again, (number, mask))))
                continue
            try:
                shown.append(track.with_mask(number, mask, top))
            except ObservationError:  # too little of it shows to say anything
                hidden.append(track)
        of_new = verified[len(doubtful) :]
        for mask, chosen in zip(new, of_new, strict=True):
            if chosen:
                with suppress(ObservationError):
                    shown.append(new_track(mask, bench))

        known = {track.number: track for track in there}
        shown = part(self._judged_if_new(shown), bench, known)
        tops = (*before.tops, top)
        benches = [Bench(one, k, self._judged) for k, one in enumerate(tops)]
        every = merged(taken_over([*hidden, *shown], benches), benches)
        state = replace(before, tops=tops, left_unknown=of_new.count(False))
        return _numbered(state, [_with_past(one, known, number) for one in every], lost)

    def _explained(
        self,
        track: Track,
        mask: Mask,
        top: TableTop,
        number: int,
    ) -> Track | None:
        """An object with its pixels in another frame, if these change nothing.

        What is sure by some frames already, and is seen where it should be, is not judged anew.
        """
        if is_sure(track) and len(track.frames) >= ENOUGH_FRAMES:
            rendered = render_track(track, top, number, track.posed)
            if rendered is not None:
                explained, every = rendered.fit(mask)
                if explained >= GOOD_FIT * every:
                    return replace(track, again=(*track.again, (number, mask)))
        return None

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


def _most_pixels(masks: Sequence[Mask]) -> list[bool]:
    """Whether each mask, (H, W) bool, is one of the largest, which are verified in a frame."""
    order = sorted(range(len(masks)), key=lambda row: -np.count_nonzero(masks[row]))
    largest = set(order[:MOST_VERIFIED])
    return [row in largest for row in range(len(masks))]


def _with_past(track: Track, known: Mapping[int, Track], number: int) -> Track:
    """An object that remembers whether it had a name before a frame that shows it."""
    if track.number not in known or track.mask_in(number) is None:
        return track
    before = known[track.number].result
    named = before is not None and before.answer is not None
    return replace(track, lately_named=named)


def _numbered(
    state: SceneState,
    tracks: Sequence[Track],
    lost: Sequence[tuple[Track, Float | None]],
) -> tuple[SceneState, Look]:
    """Give new objects their numbers: what is lost in one place may be found in another.

    Args:
        state: with the last frame, and the objects as they were before it.
        tracks: the objects.
        lost: those that are not where they were, with the poses in which they stand now, (4, 4), as
            far as these are known.
    """
    found_again = _found_again(tracks, lost, state.tops[-1])
    number = state.next_number
    appeared = []
    moved = []
    kept = []
    joined = []
    for row, track in enumerate(tracks):
        if track.number < 0:
            old = found_again.get(row)
            if old is not None:
                track = replace(track, number=old.number)
                moved.append(Move(old.number, _pose_of(old), _pose_of(track)))
            else:
                track = replace(track, number=number)
                appeared.append(number)
                number += 1
        joined += [(ended, track.number) for ended in track.absorbed]
        kept.append(replace(track, absorbed=()))

    elsewhere = {move.number for move in moved}
    ended = {track.number for track, _ in lost}
    gone = tuple(sorted(ended - elsewhere))
    changed = {*ended, *(ended for ended, _ in joined)}
    touching = {pair for pair in state.touching if not set(pair) & changed}
    touching |= _touching(kept, state.tops[-1], len(state.tops) - 1)
    after = replace(
        state,
        tracks=tuple(kept),
        touching=frozenset(touching),
        next_number=number,
    )
    look = Look(True, tuple(appeared), tuple(moved), gone, tuple(joined))
    warnings = (*state.tops[-1].warnings, *after.remarks)
    return after, replace(look, warnings=warnings)


def _found_again(
    tracks: Sequence[Track],
    lost: Sequence[tuple[Track, Float | None]],
    top: TableTop,
) -> dict[int, Track]:
    """Which new objects are lost ones, by their rows: those that stand where these were found, and
    those that have the same names.
    """
    new = {row: track for row, track in enumerate(tracks) if track.number < 0}
    found: dict[int, Track] = {}
    for old, pose in lost:
        if pose is None or old.posed is None:
            continue
        rendered = render_track(old, top, -1, replace(old.posed, pose=pose))
        if rendered is None:
            continue
        for row in new.keys() - found.keys():
            mask = new[row].thing.sightings[-1].mask
            explained, _ = rendered.fit(mask)
            if explained >= SAME_OBJECT_SHARE * np.count_nonzero(mask):
                found[row] = old
                break

    for old, _ in lost:
        name = None if old.result is None else old.result.answer
        if name is None or old in found.values():
            continue
        for row in new.keys() - found.keys():
            result = new[row].result
            if result is not None and result.answer == name:
                found[row] = old
                break
    return found


def _pose_of(track: Track) -> Float | None:
    """Pose of an object's scan file in the world, (4, 4), metres; None for an unknown one."""
    return None if track.result is None else track.result.pose


def _touching(
    tracks: Sequence[Track],
    top: TableTop,
    number: int,
) -> set[tuple[int, int]]:
    """Numbers of all pairs of objects that touch in a frame, the smaller number first."""
    masks = [track.mask_in(number) for track in tracks]
    found = set()
    for row, beside in top.neighbours(masks):
        one, other = masks[row], masks[beside]
        assert one is not None
        assert other is not None
        if top.touching(one, other):
            pair = tracks[row].number, tracks[beside].number
            found.add((min(pair), max(pair)))
    return found
