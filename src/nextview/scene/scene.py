"""Recognise and locate all known things in the frames of a depth camera, and choose next views."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import ArrayLike

from nextview.checks import did_you_mean, number_of, one_line
from nextview.cores import one_blas_thread
from nextview.errors import ModelError, ObservationError, SessionError, UsageError
from nextview.geometry.axes import upright_axes
from nextview.scene.changes import changes, nothing_new
from nextview.scene.grasps import (
    GRASP_CLEARANCE,
    MOST_UNSEEN,
    FreeGrasp,
    Grasp,
    Gripper,
    free_grasps,
    within_reach,
)
from nextview.scene.next_view import Candidates, candidates
from nextview.scene.objects import SceneObject
from nextview.scene.open_points import OpenPoint, open_points
from nextview.scene.rule import SceneRule, ruled_out_by
from nextview.scene.state import SceneState
from nextview.scene.view_policies import (
    INFORMATION_POLICY,
    NamedPolicy,
    SceneChoice,
    ScenePolicy,
)
from nextview.segmentation.instances import Segmenter, instances_of
from nextview.sensing.frame import Frame, shown_before
from nextview.sensing.known_frames import REPEATED, KnownFrames, repeated
from nextview.sensing.masks import inside_box
from nextview.sensing.mistakes import check_mistakes
from nextview.sensing.object_frame import Box
from nextview.sensing.segmented_frame import segmented_frame
from nextview.sensing.tabletop import TableTop
from nextview.sensing.view import View
from nextview.sensing.view_warning import ViewWarning
from nextview.session.limits import Limits, checked_limits
from nextview.session.reach import (
    Reach,
    Reachable,
    TravelCost,
    as_distance,
    as_reachable,
    as_travel_cost,
)
from nextview.session.recogniser import ThingRecogniser
from nextview.session.several import SeveralRecognisers
from nextview.session.surroundings import Surroundings
from nextview.session.system import System, load
from nextview.things.library import Library
from nextview.things.world import Thing, World
from nextview.types import Float

if TYPE_CHECKING:
    from matplotlib.figure import Figure


NOT_WHERE_THEY_WERE = (
    "this frame does not fit the others and is left out: most objects are not where they"
    " were"
)
WRONG_POSE = ViewWarning(
    "pose",
    f"{NOT_WHERE_THEY_WERE}, so its pose or that of an earlier frame is likely to be wrong",
)
NOTHING_AGAIN = (
    "this frame shows neither the plane that things stand on nor any object where they were: its"
    " pose or that of an earlier frame is wrong, or the camera looks elsewhere"
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
        before: pose of its scan before the move, scan-to-world, (4, 4) float64, metres; None for an
            unknown object.
        after: the same after the move.
    """

    number: int
    before: Float | None
    after: Float | None


@dataclass(frozen=True)
class Look:
    """Changes that one frame made to a scene.

    Attributes:
        taken: whether the frame was used.
        appeared: numbers of new objects.
        moved: objects that have moved, each with its poses before and after.
        gone: numbers of objects that have disappeared.
        joined: pairs of numbers: an object that turned out to be a part of another one, and that
            other object. The first number is not used again.
        warnings: likely problems with the frame; usually empty.
    """

    taken: bool
    appeared: tuple[int, ...] = ()
    moved: tuple[Move, ...] = ()
    gone: tuple[int, ...] = ()
    joined: tuple[tuple[int, int], ...] = ()
    warnings: tuple[ViewWarning, ...] = ()


class Scene:
    """All objects on a table or floor, updated with the frames of a depth camera.

    >>> scene = nextview.Scene("ycb")                                           # doctest: +SKIP
    >>> scene.update(Frame(depth, intrinsics, pose))  # of nextview.sensing     # doctest: +SKIP
    >>> for thing in scene.objects:                                             # doctest: +SKIP
    ...     print(thing.name, thing.confidence, thing.pose)

    A scene can be shared between threads; calls wait for each other.

    Args:
        models: a system returned by ``nextview.load``, or its argument ``models``.
        up: direction against gravity in the world, (3,); z by default. With None, and always for
            frames without a pose, the normal of the support plane is used.
        region: upright box in the world; everything outside is ignored.
        distance: of the camera from the centre of the scene in ``target``, metres; by default that
            of the last frame.
        reachable: function that returns True if the camera can reach a pose, camera-to-world,
            (4, 4); or a mask of the candidate views, (V,) bool.
        segmentation: your own segmentation: a function from a frame to masks of the objects,
            (N, H, W) bool, to labels, (H, W) int, 0 for none, or to a ``Segmentation``. With None
            the bundled network is used; it also provides the support surfaces if your own
            segmentation does not. Objects that stand on no surface are ignored.
        policy: chooses ``target``: "target" by expected information, "random", "fixed" for a
            quarter turn ahead, or your own: a function of a ``SceneChoice`` and a random generator,
            or MODULE:NAME of one; see ``scene.view_policies``.
        rng: source of the random numbers of the policy; seed 0 by default.
        travel_cost: function that returns the cost of moving the camera from one pose to another,
            such as the seconds of a motion planner; infinity if there is no path. Metres of a
            straight line by default.
        background: frame or frames of the empty place, before anything was put there, such as a
            cell or a bin: what they show, too, is no object.
        rule: rules out names of objects, given all objects, see ``scene.rule.SceneRule``.

    Raises:
        ModelError: the models cannot be used, or have no things of known geometry.
        PolicyError: there is no such policy, or it cannot be made.
        UsageError: ``up``, ``distance``, ``reachable`` or ``travel_cost`` is not valid.
    """

    def __init__(
        self,
        models: System | str | Path | Sequence[str | Path] = "ycb",
        up: ArrayLike | None = (0.0, 0.0, 1.0),
        region: Box | None = None,
        distance: float | None = None,
        reachable: ArrayLike | Callable[[Float], bool] | None = None,
        segmentation: Segmenter | None = None,
        policy: str | ScenePolicy | type = INFORMATION_POLICY,
        rng: np.random.Generator | None = None,
        travel_cost: ArrayLike | Callable[[Float, Float], float] | None = None,
        rule: SceneRule | None = None,
        background: Frame | Sequence[Frame] = (),
    ) -> None:
        self._policy = NamedPolicy.of(policy)
        self._rng = rng or np.random.default_rng(0)
        self._views: Candidates | None = None
        self._open: tuple[OpenPoint, ...] | None = None
        self._targets: Float | None = None
        self._target_rows: list[int] = []
        self._surroundings: tuple[Surroundings, ...] = ()
        self._limits = Limits()
        self._lock = RLock()

        self.system = models if isinstance(models, System) else load(models)
        self._reach = Reach(np.zeros(len(self.system.sphere), bool))
        self.distance = distance
        self.reachable = reachable
        self.travel_cost = travel_cost
        self.segmentation = segmentation
        self.rule = rule
        if isinstance(background, Frame):
            background = (background,)
        self.background = tuple(background)
        self.up = None if up is None else upright_axes(up)[2]
        self.region = region

        library = _library_of(self.system)
        self._widest = 2 * float(library.radii.max())
        self._state = SceneState(World(library), region)

    def __repr__(self) -> str:
        counts = (len(self.frames), "frame"), (len(self.objects), "object")
        return f"Scene({', '.join(number_of(*one) for one in counts)})"

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the lock, so that a scene can be copied and pickled."""
        return {name: value for name, value in vars(self).items() if name != "_lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _lock=RLock())

    @property
    def objects(self) -> tuple[SceneObject, ...]:
        """Objects on the table, in the order in which they were found."""
        return self._state.objects

    @property
    def library(self) -> Library:
        """The things that the scene knows."""
        return self._state.world.library

    @property
    def remarks(self) -> tuple[ViewWarning, ...]:
        """Open issues: parts left out, unexplained points, no visible ground, a doubtful unit."""
        return self._state.remarks

    @property
    def tops(self) -> tuple[TableTop, ...]:
        """Support surfaces of each frame that was used."""
        return self._state.tops

    @property
    def frames(self) -> tuple[Frame, ...]:
        """Frames that were used: at most ``things.world.MOST_VIEWS``, from different places."""
        return tuple(top.frame for top in self._state.tops)

    @property
    def done(self) -> bool:
        """True if further views would add little, or the largest number of views is reached.

        Further views help if the recognition of an object is uncertain, if many points in
        ``region`` or on the visible ground belong to no object, or if a large part of the ground is
        occluded; and if a view that is left would show it.
        """
        tops = self._state.tops
        if len(tops) >= self.system.stopping.max_views:
            return True
        return bool(tops) and not any(point.in_sight for point in self.open)

    @property
    def open(self) -> tuple[OpenPoint, ...]:
        """What is not settled yet, and why: objects first, then parts of the table.

        Empty before the first frame, and when further views would add little.
        """
        with self._lock:
            if self._open is None:
                views = self._candidates
                if views is None:
                    return ()

                state = self._state
                left = views.poses[views.free]
                self._open = open_points(
                    state.objects,
                    state.unexplained,
                    state.ground,
                    state.ground_seen,
                    left[:, :3, 3],
                )
            return self._open

    @property
    def distance(self) -> float | None:
        """Distance of the camera from the centre of the scene in ``target``, metres.

        None for that of the last frame. A change takes effect immediately.
        """
        return self._distance

    @distance.setter
    def distance(self, given: float | None) -> None:
        self._distance = as_distance(given)
        self._changed()

    @property
    def reachable(self) -> Reachable | None:
        """Views that the camera can reach, see ``session.reach.Reachable``; None for all.

        A function is asked once after each frame, for all candidates. A change takes effect
        immediately.
        """
        return self._reach.reachable

    @reachable.setter
    def reachable(self, given: ArrayLike | Callable[[Float], bool] | None) -> None:
        checked = as_reachable(given, len(self.system.sphere))
        self._reach = replace(self._reach, reachable=checked)
        self._changed()

    @property
    def travel_cost(self) -> TravelCost | None:
        """Cost of moving the camera, see ``session.reach.TravelCost``; None for metres.

        A function is asked once after each frame, for all candidates that can be reached. The unit
        is arbitrary. A change takes effect immediately.
        """
        return self._reach.cost

    @travel_cost.setter
    def travel_cost(
        self, given: ArrayLike | Callable[[Float, Float], float] | None
    ) -> None:
        checked = as_travel_cost(given, len(self.system.sphere))
        self._reach = replace(self._reach, cost=checked)
        self._changed()

    @property
    def limits(self) -> Limits:
        """Limits on the positions of the camera, see ``session.limits.Limits``.

        A change takes effect immediately.
        """
        return self._limits

    @limits.setter
    def limits(self, given: Limits) -> None:
        self._limits = checked_limits(given)
        self._changed()

    @property
    def target(self) -> Float | None:
        """Next view that is expected to settle all objects soonest, camera-to-world, (4, 4).

        It maximises the expected information about uncertain objects and about the part of the
        table that is hidden in all frames, minus a small cost of travel; or it is the choice of
        another ``policy``, which is asked once after each frame. Where nothing is found, views are
        of the region or of the ground. None before the first frame, and if no view is left.

        Raises:
            PolicyError: a policy of your own failed.
        """
        targets = self.targets
        return targets[0] if len(targets) else None

    @property
    def targets(self) -> Float:
        """Candidate views, the best first, camera-to-world, (V, 4, 4); the first is ``target``.

        Only views within ``limits`` and reach, and away from the earlier ones. One view at most if
        the ``policy`` chooses one instead of valuing all.

        Raises:
            PolicyError: a policy of your own failed.
        """
        with self._lock:
            if self._targets is None:
                with one_blas_thread():
                    self._target_rows, self._targets = self._ranked()
            return self._targets

    def _ranked(self) -> tuple[list[int], Float]:
        """Ask the policy; return the rows of the views, the best first, and their poses."""
        views = self._candidates
        if views is None or not views.free.any():
            return [], np.zeros((0, 4, 4))
        choice = SceneChoice(views, self._state, self.system)
        rows = self._policy.ranked(choice, self._rng)
        return rows, views.poses[rows]

    @property
    def _candidates(self) -> Candidates | None:
        """Candidate views; those that failed or are out of reach are not free.

        None before the first frame.
        """
        around = self._state.around
        if self._views is None and around is not None:
            tops = self._state.tops
            self._surroundings = Surroundings.in_frames(
                tops, around, self._surroundings
            )

            self._views = candidates(
                self.system,
                tops,
                around,
                self.distance,
                self.limits,
                self._surroundings,
                self._reach,
            )
        return self._views

    def _changed(self) -> None:
        """Forget the candidate views, and what depends on them."""
        self._views = None
        self._targets = None
        self._open = None

    def failed(self) -> None:
        """Report that the camera could not reach ``target``.

        No view from its direction is a target again.

        Raises:
            SessionError: there is no target.
        """
        with self._lock:
            if self.target is None:
                raise SessionError("no view was asked for, so none has failed")
            rows = np.arange(len(self._reach.failed))
            failed = self._reach.failed | (rows == self._target_rows[0])
            self._reach = replace(self._reach, failed=failed)
            self._changed()

    @overload
    def update(self, frame: Frame) -> Look: ...

    @overload
    def update(self, frame: Sequence[Frame]) -> tuple[Look, ...]: ...

    def update(self, frame: Frame | Sequence[Frame]) -> Look | tuple[Look, ...]:
        """Update the scene with a frame, or with frames of several cameras.

        If an error is raised, the scene is unchanged.

        Args:
            frame: of a depth camera, or frames that several cameras took together. A pose is needed
                unless it is the only frame. Its mask, if it has one, limits the search.

        Returns:
            The changes; a tuple of those of each frame, if there were several. A frame with an
            inconsistent pose, and a repeated frame, is left out with a warning.

        Raises:
            ObservationError: the frame is invalid or has no pose, it shows no support plane, it
                does not fit the known world, or ``segmentation`` returned no masks.
            UsageError: ``segmentation`` or ``rule`` raises, or the rule returns no names.
        """
        with self._lock, one_blas_thread():
            if not isinstance(frame, Sequence):
                return self._update(frame)
            before = self._state
            try:
                return tuple([self._update(one) for one in frame])
            except BaseException:
                self._state = before
                self._changed()
                raise

    def _update(self, frame: Frame) -> Look:
        """Update the scene with one frame."""
        known = self._known_frames
        known.refuse(frame)
        if repeated(frame, known.frames) is not None:
            return Look(False, warnings=(REPEATED,))

        before = self._state
        if nothing_new(before.world, frame):
            again = (*before.tops[-1].warnings, *before.remarks)
            return Look(True, warnings=again)
        self._state, look = self._after(before, frame)
        self._changed()
        return look

    def grasps(
        self,
        grasps: Mapping[str, Sequence[Grasp]],
        gripper: Gripper,
        reachable: Callable[[Float], bool] | None = None,
        most: int | None = None,
        clearance: float = GRASP_CLEARANCE,
        most_unseen: float = MOST_UNSEEN,
    ) -> list[FreeGrasp]:
        """Find the grasps of confident objects that nothing known is in the way of.

        The open gripper comes along its z axis in a straight line. It must not meet measured points
        of other objects, walls or the support, nor the scans of other confident objects, and the
        space between its fingers must not hold a part of another object. An object that reaches out
        of ``region`` offers none: where that is the inside of a bin, it is a wall.

        Args:
            grasps: of each thing, by its name; see ``scene.grasps``.
            gripper: that grasps.
            reachable: function that returns True if the arm can bring the gripper to a pose,
                gripper-to-world, (4, 4). The best grasps are asked first, each as it is and with
                the fingers exchanged.
            most: largest number of grasps; with ``reachable`` no more than these are searched for.
            clearance: distance that fingers and palm keep from everything else, metres.
            most_unseen: largest share of the fingers' space that no frame has shown to be empty.

        Returns:
            The grasps, the best first; [] before the first frame.

        Raises:
            UsageError: a number is out of range, the scene knows no thing of a name, a grasp is far
                from its thing, or ``reachable`` raises.
        """
        known = self.system.models.classes
        for name in grasps:
            if name not in known:
                what = f"grasps of {one_line(name)}, which is none of the taught things"
                raise UsageError(f"{what}{did_you_mean(name, known)}")

        with self._lock:
            found = free_grasps(
                self.objects,
                self.tops,
                grasps,
                gripper,
                clearance,
                most_unseen,
                self.region,
            )
            if reachable is not None:
                return within_reach(found, reachable, most)
            return found[:most]

    def plot(self, path: str | Path | None = None, title: str = "") -> Figure:
        """Draw the last frame with outlines, names and axes of the poses, and a top view.

        Args:
            path: output file, PNG, PDF or SVG; an existing file is replaced.
            title: of the figure.

        Returns:
            The figure.

        Raises:
            SessionError: there is no frame yet.
            UsageError: the file has another format.
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
        """Frames, planes and region against which a new frame is checked."""
        tops = self._state.tops
        box = None if self.region is None else self.region.object_frame
        return KnownFrames(
            tuple(top.frame for top in tops),
            tuple(top.plane if top.shows_ground else None for top in tops),
            self.up,
            None if box is None else box.centre,
            0.0 if box is None else box.radius,
        )

    def _seen(self, frame: Frame, before: Sequence[TableTop]) -> tuple[TableTop, View]:
        """Segment a frame, and find its surfaces and its ground.

        Raises:
            ObservationError: there is no ground, or the frame was read with a mistake.
        """
        instances = instances_of(self.segmentation, frame, self.up)
        inside = frame.depth > 0 if frame.mask is None else frame.mask
        if self.region is not None:
            inside = inside & inside_box(frame, self.region)
        known = np.zeros(frame.shape, bool)
        for empty in self.background:
            known |= shown_before(frame, empty)
        masks = tuple(mask & inside & ~known for mask in instances.masks)
        background = instances.background | known

        earlier = before[-1] if before else None
        up = None if frame.pose is None else self.up
        if up is None and earlier is not None:
            up = earlier.plane.normal
        seen = segmented_frame(
            frame,
            replace(instances, masks=masks, background=background),
            up,
            () if earlier is None else earlier.seen.levels,
        )
        carried = seen.with_carried()
        if self.background:
            # what is not of the empty place is a thing, whatever carries it
            seen = carried
        else:
            masks = carried.masks
        known_frames = self._known_frames
        warnings = tuple(check_mistakes(seen, known_frames))
        ground = None if earlier is None else earlier.plane
        top = TableTop.of(seen, self.up, ground, inside, self._widest, warnings)
        shown = top.plane if top.shows_ground else None
        warnings += tuple(known_frames.check(frame, shown))
        view = View.of(
            frame,
            replace(instances, masks=masks),
            inside,
            top.height,
            top.up,
            self._widest,
            known,
        )
        return replace(top, warnings=warnings), view

    def _after(self, before: SceneState, frame: Frame) -> tuple[SceneState, Look]:
        """Return the scene after a frame; a frame that does not fit is left out.

        Raises:
            ObservationError: neither the ground nor any known object is visible, or the frame was
                read with a mistake.
        """
        top, view = self._seen(frame, before.tops)
        # the pose of a camera that has not moved is as right as before
        stands = self._known_frames.stands(frame)
        kept = before.with_room()
        told = changes(kept.world, view, stands)
        if before.tops and not (top.shows_ground or told.stand):
            raise ObservationError(NOTHING_AGAIN)
        if told.wrong_pose:
            camera = [
                replace(one, message=f"{NOT_WHERE_THEY_WERE}: {one.message}")
                for one in top.warnings
                if one.name == "intrinsics"
            ]
            return before, Look(False, warnings=(*camera, WRONG_POSE)[:1])

        world = told.world.with_view(told.view, told.held)
        among = ~np.isin(world.library.names, self.system.ruled_out)
        world = world.searched(among).numbered()
        gone = {one.number: one for one in told.gone}
        world, moved = _found_again(world, kept.world, gone)
        state = replace(kept, world=world, tops=(*kept.tops, top))
        state = self._ruled(state.with_objects({}))
        look = _look(kept, state, (*told.moved, *moved), gone)
        if look.moved and not (told.stand or stands):
            look = replace(look, warnings=(*look.warnings, MOVED_OR_POSE))
        return state, look

    def _ruled(self, state: SceneState) -> SceneState:
        """Return a scene without the names that the rule rules out."""
        if self.rule is None:
            return state
        while True:
            new = ruled_out_by(self.rule, state.objects)
            if not new:
                return state

            known = state.world.library.names
            for name in {name for names in new.values() for name in names}:
                if name not in known:
                    what = f"{one_line(name)} is none of the taught things"
                    raise UsageError(f"{what}{did_you_mean(name, known)}")

            ruled_out = {
                number: {**state.ruled_out.get(number, {}), **new.get(number, {})}
                for number in {*state.ruled_out, *new}
            }
            state = state.with_objects(ruled_out)


def _library_of(system: System) -> Library:
    """Return the things of known geometry of a system.

    Raises:
        ModelError: it has none.
    """
    recogniser = system.models.recogniser
    if not isinstance(recogniser, ThingRecogniser | SeveralRecognisers):
        raise ModelError(
            f"{recogniser.name}: a scene needs things of known geometry, and these models have"
            " none; a session recognises one object by its class"
        )
    return recogniser.library


def _found_again(
    world: World, before: World, gone: dict[int, Thing]
) -> tuple[World, list[int]]:
    """Return the world with the old numbers of things that are new in another place, and these.

    Args:
        world: after a frame.
        before: before it.
        gone: things that are not where they were, by their numbers; those that are found again are
            removed.
    """
    moved = []
    renamed = {}
    for one in world.things:
        if one.number < before.next_number or one.row < 0:
            continue
        thing = world.hypotheses.things[one.row]
        for number, old in list(gone.items()):
            if old.row >= 0 and before.hypotheses.things[old.row] == thing:
                del gone[number]
                renamed[one.number] = number
                moved.append(number)
                break
    return world.with_numbers(renamed), moved


def _look(
    before: SceneState,
    state: SceneState,
    moved: Sequence[int],
    gone: Mapping[int, Thing],
) -> Look:
    """Return what a frame has changed."""
    old = {one.number: one for one in before.objects}
    new = {one.number: one for one in state.objects}
    lost = [number for number in old if number not in new]

    # what is neither gone nor an object any more became a part of another one
    joined = []
    for number in lost:
        into = state.world.holder(before.world, number)
        if number not in gone and into:
            joined.append((number, into))
    ended = {number for number, _ in joined}

    return Look(
        True,
        tuple(number for number in new if number not in old),
        tuple(
            Move(number, old[number].pose, new[number].pose)
            for number in moved
            if number in new and number in old
        ),
        tuple(number for number in lost if number not in ended),
        tuple(joined),
        (*state.tops[-1].warnings, *state.remarks),
    )
