"""Live use: hand in what the camera sees, get told what it is or where to look next."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from threading import RLock
from typing import TYPE_CHECKING, Any, Protocol, get_args, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import ThreadpoolController

from nextview.checks import number, one_line, plugin_errors, whole
from nextview.errors import (
    NoViewLeftError,
    ObservationError,
    PolicyError,
    SessionError,
    UsageError,
)
from nextview.geometry.observation import Camera, Observation
from nextview.geometry.viewsphere import (
    Viewpoints,
    angle_between,
    azimuth_of,
    direction_of,
)
from nextview.policies.base import EpisodeState, Policy, SeeksPose, ValuesViews
from nextview.policies.off_grid import anywhere
from nextview.recognition.belief import Stopping, log_evidence_of
from nextview.recognition.evidence import Evidence
from nextview.recognition.inference import Models
from nextview.recognition.map_names import maps_among
from nextview.recognition.novelty import ViewScore, values_of
from nextview.recognition.poses import share_of_likeliest
from nextview.recognition.protocol import (
    JudgesTogether,
    LooksAhead,
    classes_of_other_size,
)
from nextview.sensing.frame import Frame
from nextview.sensing.plausibility import (
    check_last_view,
    check_observation,
)
from nextview.sensing.view_warning import ViewWarning
from nextview.session.episode import Episodes, Step
from nextview.session.limits import Limits, in_words
from nextview.session.pose_frame import PoseFrame
from nextview.session.ranked import RankedView, camera_poses, rank_views
from nextview.session.reach import (
    Reach,
    Reachable,
    TravelCost,
    as_reachable,
    as_travel_cost,
)
from nextview.session.repeated import REPEATED, after_repeated, is_repeated
from nextview.session.result import SUSPICIOUS, Recognition
from nextview.session.surroundings import Surroundings
from nextview.session.view import View, is_doubtful
from nextview.things.expected_views import Goal, Outlook
from nextview.types import Float, Mask

if TYPE_CHECKING:
    from nextview.segmentation.instances import Segmenter
    from nextview.sensing.observed_object import ObservedObject

FARTHEST_TARGET = 60.0
"""Object radii: a camera looks at a thing of 0.01 m radius from 0.6 m; in millimetres it would
be a thousand times.
"""
# times as large as in any single frame: from there an object of several frames is none
MUCH_LARGER = 1.5


@runtime_checkable
class FrameCamera(Protocol):
    """A camera in the world that delivers frames, with the object that it is to look at.

    Where it has an attribute ``knows_reach`` that is true, it decides alone where it can stand, and
    is asked for candidates too that ``Session.limits`` would leave out: views that were captured
    before, for instance.
    """

    @property
    def object(self) -> ObservedObject:
        """The object that it is to look at."""
        ...

    def observe(self, pose: Float) -> Frame:
        """Look from a pose in the object frame, object radii, or from near it.

        It raises ``NoViewLeftError`` if that is not possible.
        """
        ...

    def refused(self, error: ObservationError) -> None:
        """The object is not found in the last frame.

        Returns if there may be another one; else raises the error.
        """
        ...


@lru_cache(maxsize=1)
def _blas() -> ThreadpoolController:
    """The libraries below NumPy.

    Their threads wait for more work in a loop, and take the cores from the networks.
    """
    return ThreadpoolController().select(user_api="blas")


class Session:
    """One object under way; the caller moves the camera.

    Threads that share one wait for each other. A camera that goes where it is told, in the object
    frame and object radii:

    >>> session = nextview.load().session()                                     # doctest: +SKIP
    >>> while not session.done:                                                 # doctest: +SKIP
    ...     view = session.update(my_camera.observe(session.pose))
    >>> session.result                                                          # doctest: +SKIP

    A depth camera on a robot, in the world and metres, beginning wherever it stands:

    >>> session = nextview.load().session(distance=0.6)                         # doctest: +SKIP
    >>> session.update(look())                                                  # doctest: +SKIP
    >>> while not session.done:                                                 # doctest: +SKIP
    ...     if go_to(session.target):
    ...         session.update(look())  # a Frame, with the pose that was reached
    ...     else:
    ...         session.failed()

    Args:
        models: recogniser and map networks.
        policy: chooses the next view; it may know other viewpoints, see ``policies.off_grid``.
        sphere: the viewpoints.
        start: where to look first; a camera that stands elsewhere is as welcome.
        stopping: when to stop; by default the rule that goes with the recogniser, see
            ``Stopping.of``.
        rng: for policies that draw; seed 0 by default.
        object: which object to find in frames; by default the one at which the first camera is
            aimed.
        distance: of the camera from the object's centre, metres; ``sphere.distance`` object radii
            by default.
        unknown: share of objects of known classes that may be called unknown; 0: none.
        segmentation: that tells the things in frames, see ``Scene``; None for the bundled network.
            An object has its own.

    Raises:
        UsageError: an object and a segmentation are given.
        SessionError: the models lack what the policy needs.
    """

    def __init__(
        self,
        models: Models,
        policy: Policy,
        sphere: Viewpoints,
        start: int = 0,
        stopping: Stopping | None = None,
        rng: np.random.Generator | None = None,
        object: ObservedObject | None = None,
        distance: float | None = None,
        unknown: float = 0.0,
        segmentation: Segmenter | None = None,
    ) -> None:
        _check_needs(policy, models)
        if object is not None and not hasattr(object, "sightings"):
            wanted = "what to find in frames is a nextview.sensing.ObservedObject"
            raise UsageError(f"{wanted}, not {one_line(repr(object))}")
        if object is not None and segmentation is not None:
            raise UsageError(
                "an object has its own segmentation: ObservedObject(segmentation=...)"
            )
        if number(unknown, "the share of known objects called unknown", 0) >= 1:
            raise UsageError(
                f"the share of known objects called unknown is below 1, not {unknown}"
            )

        self.models = models
        self.policy = policy
        self.sphere = sphere
        self._distance = _checked_distance(distance)
        self.object = (
            _new_object(segmentation)
            if object is None and distance is not None
            else object
        )
        self.stopping = stopping or Stopping.of(models.recogniser.calibration)
        self.unknown = unknown
        self.segmentation = segmentation
        self.views: list[View] = []
        self._goal: Goal = "thing"
        self.observers: list[Callable[[Session], None]] = []
        """Called, in order, after each view that was taken in, and when another next view was
        chosen.
        """

        self._before = 0 if object is None else len(object.sightings)
        self._chooser = anywhere(policy, sphere)
        self._rng = rng or np.random.default_rng(0)
        self._reach = Reach(np.zeros(len(sphere), bool))
        self._limits = Limits()
        self._surroundings: list[Surroundings] = []
        self._lock = RLock()
        self._episodes = self._begin(whole(start, "the first view", 0, len(sphere) - 1))

    def __getstate__(self) -> dict[str, Any]:
        """All but the lock: a session can be copied and pickled, its networks are opened again."""
        return {name: value for name, value in vars(self).items() if name != "_lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _lock=RLock())

    def _begin(self, start: int) -> Episodes:
        recogniser = self.models.recogniser
        return Episodes(
            self.sphere,
            self._chooser,
            np.array([start]),
            self.stopping,
            self._rng,
            recogniser.calibration,
            together=recogniser.together
            if isinstance(recogniser, JudgesTogether)
            else None,
            outlook=recogniser.outlook if isinstance(recogniser, LooksAhead) else None,
        )

    # Where to look

    @property
    def done(self) -> bool:
        """Whether the episode has ended."""
        return len(self._episodes.running) == 0

    @property
    def view(self) -> int:
        """Where to look now."""
        return int(self._episodes.current[0])

    @property
    def pose(self) -> Float:
        """Next camera-to-world pose, (4, 4), OpenCV axes, object frame, object radii."""
        return self.sphere.poses[self.view]

    @property
    def poses(self) -> Float:
        """Candidate poses in your world: camera-to-world, (V, 4, 4), OpenCV axes, metres.

        At ``distance`` from the object, looking at its centre, the horizon level. They move when a
        frame shows better where the object is. Without frames they are those of ``sphere``, in
        object radii.
        """
        return self._poses_around(self.object)

    def _poses_around(self, object: ObservedObject | None) -> Float:
        if object is None:
            return self.sphere.poses
        if not object.sightings and object.known is None:
            raise SessionError(
                "where the object is in the world is not known before the first frame: update"
                " with one"
            )
        return object.object_frame.pose_in_world(self.sphere.poses, self.distance)

    @property
    def target(self) -> Float | None:
        """Where to look now, one of ``poses``, (4, 4); None where the episode has ended."""
        return None if self.done else self.poses[self.view]

    def ranked(
        self,
        poses: ArrayLike | None = None,
        goal: Goal = "thing",
    ) -> tuple[RankedView, ...]:
        """Candidate views, those first that are expected to tell most of which taught thing it is.

        Of the views that are worth nearly the same the nearer ones come first. What stands in the
        way by the frames so far is allowed for; whether the camera can be brought there is yours to
        know.

        Args:
            poses: of the camera, as your robot can take them, camera-to-world, (V, 4, 4), OpenCV
                axes, in the world and metres; without frames in the object frame and object radii.
                By default those of ``poses`` that are left: not visited, within ``limits`` and
                ``reachable``.
            goal: "thing" ranks by what is told of which thing it is, "pose" by what is told of its
                pose too.

        Raises:
            SessionError: nothing can be foreseen: no view was taken, or the geometry of what is
                seen is not known.
            UsageError: these are no poses.
        """
        with self._lock:
            return self._ranked(poses, goal)

    def _ranked(self, poses: ArrayLike | None, goal: Goal) -> tuple[RankedView, ...]:
        if not self.views:
            raise SessionError(
                "what views would tell is not known before the first one"
            )
        outlook = self.outlook
        if outlook is None:
            raise SessionError(
                "what views would tell is not known: no taught thing of known geometry explains"
                " them"
            )

        if poses is None:
            left = np.flatnonzero(self._left())
            given = self.poses[left]
        else:
            given = camera_poses(poses)
            left = np.arange(len(given))
        inside = (
            given
            if self.object is None
            else self.object.object_frame.pose_in_object(given)
        )
        radius = self.views[-1].observation.radius
        assert radius is not None  # else nothing was foreseen
        return rank_views(outlook, inside, radius, given, left, goal)

    @property
    def outlook(self) -> Outlook | None:
        """What can be foreseen of other views: the leading hypotheses of known geometry.

        None before the first view, and where no taught thing of known geometry explains the views.
        """
        with self._lock:
            if not self.views:
                return None
            found = self._episodes.outlooks(self._episodes.steps[-1], np.ones(1, bool))[
                0
            ]
            return found if isinstance(found, Outlook) else None

    def _left(self) -> Mask:
        """Which candidates may still be chosen, (V,) bool."""
        state = self._episodes.steps[-1].state
        if state is not None:
            return state.free[0]
        left = np.ones(len(self.sphere), bool)
        left[[view.index for view in self.views]] = False
        return left & ~self._reach.failed & (self._reasons(self.object) == "")

    @property
    def distance(self) -> float | None:
        """Camera distance from the object's centre, metres; None for ``sphere.distance`` radii.

        What is set here counts from the next pose on.
        """
        return self._distance

    @distance.setter
    def distance(self, given: float | None) -> None:
        with self._lock:
            checked = _checked_distance(given)
            before = self._distance
            self._distance = checked
            if self.object is not None and self.object.sightings:
                try:
                    self._check_distance(self.object)
                except UsageError:
                    self._distance = before
                    raise

    # What the robot can do

    @property
    def goal(self) -> Goal:
        """What is to be found out: which "thing" it is, or its "pose" too.

        For the pose, views are valued by what they tell of thing and pose, and the session goes on
        until the likeliest pose is as sure as the thing has to be: turns of a symmetry make no
        difference. Where no pose can be known it ends as for the thing. Set it before the first
        view. ``UsageError``: the policy looks for no pose.
        """
        return self._goal

    @goal.setter
    def goal(self, given: Goal) -> None:
        if given not in get_args(Goal):
            raise UsageError(
                f"the goal is {' or '.join(get_args(Goal))}, not {one_line(str(given))}"
            )

        with self._lock:
            if given == self._goal:
                return
            if self.views:
                raise SessionError("the goal is set before the first view")
            if not isinstance(self.policy, SeeksPose):
                raise UsageError(
                    "this policy looks for no pose; discriminate does, for taught things of known"
                    " geometry"
                )

            self.policy = self.policy.seeking(given)
            self._goal = given
            self._chooser = anywhere(self.policy, self.sphere)
            self._episodes = self._begin(self.view)

    def _pose_in_doubt(self, step: Step) -> bool:
        """Whether the pose is wanted, and not as sure yet as the thing has to be."""
        joint = step.joint[0] if len(step.joint) else None
        if self._goal == "thing" or joint is None or not joint.poses:
            return False
        threshold = float(self.stopping.threshold_at(int(step.seen[0])))
        return share_of_likeliest(joint.poses) < threshold

    @property
    def reachable(self) -> Reachable | None:
        """Which views the camera can be brought to, see ``session.reach.Reachable``; None for all.

        No policy chooses another one. What is set here counts from now on: if the view that was
        chosen is not reachable, another one is. A callable is asked anew for each choice, of
        unvisited views, after the first view.
        """
        return self._reach.reachable

    @reachable.setter
    def reachable(self, given: ArrayLike | Callable[[Float], bool] | None) -> None:
        with self._lock:
            self._set_reach(
                replace(self._reach, reachable=as_reachable(given, len(self.sphere)))
            )

    @property
    def travel_cost(self) -> TravelCost | None:
        """Cost from view to view, see ``session.reach.TravelCost``; None for grid cells.

        Policies that weigh travel weigh this instead from the next choice on: seconds of your
        planner for instance. Its unit does not matter: its mean over the free views counts as much
        as their mean travel in cells.
        """
        return self._reach.cost

    @travel_cost.setter
    def travel_cost(
        self,
        given: ArrayLike | Callable[[Float, Float], float] | None,
    ) -> None:
        with self._lock:
            self._reach = replace(
                self._reach,
                cost=as_travel_cost(given, len(self.sphere)),
            )

    @property
    def limits(self) -> Limits:
        """Limits by which candidates are left out, see ``session.limits.Limits``.

        What is set here counts from now on, as for ``reachable``. Sessions without frames know no
        place to keep off.
        """
        return self._limits

    @limits.setter
    def limits(self, given: Limits) -> None:
        if not isinstance(given, Limits):
            raise UsageError(
                f"limits are a nextview.session.limits.Limits, not {one_line(repr(given))}"
            )
        with self._lock:
            before = self._limits
            self._limits = given
            try:
                self._set_reach(self._reach)
            except BaseException:
                self._limits = before
                raise

    @property
    def left_out(self) -> tuple[str, ...]:
        """Why each candidate is left out by ``limits`` or has failed, (V,); else ""."""
        with self._lock:
            reasons = self._reasons(self.object)
            return tuple(
                "failed" if gone else str(why)
                for gone, why in zip(self._reach.failed, reasons, strict=True)
            )

    def _reasons(self, object: ObservedObject | None) -> NDArray[np.str_]:
        """See ``Limits.reasons``; all "" before the first frame, and without frames."""
        if object is None or not object.sightings:
            return np.full(len(self.sphere), "", "<U1")
        known = {id(shown.frame): shown for shown in self._surroundings}
        self._surroundings = [
            known.get(id(sighting.frame))
            or Surroundings.of(sighting, object.object_frame)
            for sighting in object.sightings
        ]
        return self._limits.reasons(
            self._poses_around(object),
            object,
            self._surroundings,
        )

    def failed(self, view: int | None = None) -> None:
        """Report that the camera could not reach a view, by default the requested one.

        It is offered no more.

        Where no reachable view is left the session ends, not confident: ``Recognition.stranded``.
        """
        with self._lock:
            if self.done:
                raise SessionError("this session has ended; begin another one")

            known = (
                self.object is None
                or self.object.sightings
                or self.object.known is not None
            )
            if view is None and not known:
                what = "no view was asked for yet, so none has failed"
                raise SessionError(
                    f"{what}: the first frame comes from wherever the camera stands"
                )

            view = (
                self.view
                if view is None
                else whole(view, "a view", 0, len(self.sphere) - 1)
            )
            self._set_reach(
                replace(
                    self._reach,
                    failed=self._reach.failed | (np.arange(len(self.sphere)) == view),
                )
            )

    def _set_reach(self, reach: Reach) -> None:
        """Choose another view if the one that was chosen can no longer be reached."""
        if self.done or (self.views and self._can_go(self.view, reach)):
            self._reach = reach
        elif self.views:
            step = self._episodes.next_choice(
                lambda state: self._constrained(state, reach, self.object)
            )
            view = replace(
                self.views[-1],
                next_view=_next_of(step),
                values=self._values(step),
            )
            self._episodes.keep_choice(step)
            self._reach = reach
            self.views[-1] = view
            for observer in self.observers:
                observer(self)
        else:  # with frames it begins where the camera is
            episodes = (
                self._begin_nearest(reach) if self.object is None else self._episodes
            )
            self._reach = reach
            self._episodes = episodes

    def _can_go(self, view: int, reach: Reach) -> bool:
        """Whether the camera may be sent to a view, and can be brought there."""
        if self._reasons(self.object)[view]:
            return False
        return bool(reach.can_reach(np.array([view]), lambda: self.poses)[0])

    def _begin_nearest(self, reach: Reach) -> Episodes:
        """Before the first view: begin at the nearest view that can be reached.

        A callable is not asked yet.
        """
        there = ~reach.failed & (
            reach.reachable if isinstance(reach.reachable, np.ndarray) else True
        )
        if not there.any():
            raise SessionError("none of the candidate views can be reached")
        return self._begin(
            int(np.where(there, self.sphere.arc[self.view], np.inf).argmin())
        )

    def _constrained(
        self,
        state: EpisodeState,
        reach: Reach,
        object: ObservedObject | None,
        here: Float | None = None,
    ) -> EpisodeState:
        """Return the state with the reachable views and the travel cost.

        They are counted from the camera of the last view by default.
        """
        if here is None:
            here = (
                self.views[-1].observation.pose
                if object is None
                else object.sightings[-1].frame.camera_to_world
            )
        barred = self._reasons(object) != ""
        reach = replace(reach, failed=reach.failed | barred)
        return reach.constrain(
            state, self.sphere, here, lambda: self._poses_around(object)
        )

    # What is seen

    def update(self, seen: Observation | Frame) -> View:
        """Take in what was seen, from ``pose``, ``target`` or anywhere else.

        Where this raises, nothing is taken in: the session is as it was, and goes on with the next
        view.

        Args:
            seen: an observation in the object frame; or a frame of a depth camera in the world. If
                a frame shows better where the object is, the earlier ones are expressed anew, and
                ``views`` with them: all but what was chosen after them, and what they were warned
                of.

        Raises:
            SessionError: the episode has ended, or a session mixes frames and observations.
            ObservationError: the object is not found in the frame, the frames do not fit together,
                or the image does not suit the networks.
            UsageError: the session's ``distance`` is inside the object, or more than 60 object
                radii.
            PolicyError: the policy failed.
        """
        with self._lock:
            if self.done:
                raise SessionError("this session has ended; begin another one")
            with _blas().limit(limits=1):
                view = (
                    self._add_frame(seen)
                    if isinstance(seen, Frame)
                    else self._add_observation(seen)
                )
            for observer in self.observers:
                observer(self)
        return view

    def _add_observation(self, seen: Observation) -> View:
        if not isinstance(seen, Observation):
            raise ObservationError(
                f"what a camera gave is an Observation, or a Frame, not {one_line(repr(seen))}"
            )
        if self.object is not None:
            raise SessionError("this session takes frames: it has an observed object")
        earlier = [view.observation for view in self.views]
        if is_repeated(seen, earlier):
            warnings = [REPEATED]
        else:
            warnings = check_observation(seen) or check_last_view([*earlier, seen])
        return self._take([*earlier, seen], warnings, seen.pose, None)

    def _add_frame(self, frame: Frame) -> View:
        if self.object is None and self.views:
            raise SessionError(
                "this session has taken observations; begin another one for frames"
            )
        object = self.object or _new_object(self.segmentation)
        if len(object.sightings) != self._before + len(self.views):
            raise SessionError(
                "frames were added to this object outside of the session; begin another one"
            )

        before = object.state
        try:
            if (repeated := after_repeated(before, frame, self._before)) is not None:
                object.state = repeated
            else:
                object.add(frame)
                if self.unknown and object.state.partings:
                    self._part(object)

            self._refuse_disagreement(object)
            self._check_distance(object)
            return self._take(
                object.observations[self._before :],
                object.warnings,
                frame.camera_to_world,
                object,
            )
        except BaseException:
            object.state = before
            raise

    def _part(self, object: ObservedObject) -> None:
        """Look for another parting of what is suspiciously novel."""
        if self._p_value(object.observations) < SUSPICIOUS * self.unknown:
            object.part_otherwise(self._p_value)

    def _p_value(self, observations: Sequence[Observation]) -> float:
        """The p-value of some views as views of a known thing; 1 where nothing tells it."""
        seen = [one for one in observations if one.seen]
        if not seen:
            return 1.0
        found = self.models.evidence(seen)
        recogniser = self.models.recogniser
        if isinstance(recogniser, JudgesTogether):
            azimuths = azimuth_of(np.stack([direction_of(one.pose) for one in seen]))
            total = log_evidence_of(found.logits, found.azimuth_bins, azimuths).sum(0)
            p_value = recogniser.together(seen, total, len(seen)).p_value
            return 1.0 if p_value is None else p_value
        if recogniser.novelty is None or found.novelty is None:
            return 1.0
        return recogniser.novelty.of_views(values_of(found.novelty))

    def _refuse_disagreement(self, object: ObservedObject) -> None:
        """Refuse frames that only together make the object reach as far as the camera's distance.

        A wrong distance or depth scale shows in a single frame. Where each frame alone shows a much
        smaller object, the frames do not fit together.
        """
        together = object.object_frame.radius
        if (
            self.distance is None
            or together < self.distance
            or object.known is not None
        ):
            return

        alone = max(_half_diagonal(sighting.hull) for sighting in object.sightings)

        if (
            len(object.sightings) == 1
            or alone >= self.distance
            or together < MUCH_LARGER * alone
        ):
            return

        raise ObservationError(
            f"the frames do not fit together: the object has a radius of {together:.2g} m in all of"
            f" them, and of {alone:.2g} m at most in a single one: are the poses wrong (inverse, or"
            " in another unit), or has the object moved?"
        )

    def _check_distance(self, object: ObservedObject) -> None:
        """Refuse targets inside the object or far from it, as soon as its radius is known."""
        radius = object.object_frame.radius
        if self.distance is None or radius < self.distance <= FARTHEST_TARGET * radius:
            return

        if self.distance > radius:
            why = f"within {FARTHEST_TARGET:g} radii: is it in millimetres?"
        else:
            why = (
                "outside of it: ask for a larger one, unless what was found is not the object, and"
                " is to be named by a point, a box or a mask"
            )
            if object.sightings[-1].frame.counted:
                why += "; or the steps of the uint16 depth are no millimetres"

        raise UsageError(
            f"the distance of {self.distance:g} m from the centre of an object of {radius:.2g} m"
            f" radius has to be {why}"
        )

    def _take(
        self,
        observations: Sequence[Observation],
        warnings: Sequence[ViewWarning],
        here: Float,
        object: ObservedObject | None,
    ) -> View:
        """Take in the last of some observations, and whichever of the others has changed."""
        last = len(observations) - 1
        changed = [
            k
            for k, view in enumerate(self.views)
            if observations[k] is not view.observation
        ]
        evidence = self._evidence(observations, [*changed, last], warnings)
        directions = [self._snapped(direction_of(seen.pose)) for seen in observations]
        episodes = self._replayed(evidence, directions) if changed else self._episodes

        reach = self._reach
        doubtful = is_doubtful([*(view.warnings for view in self.views), warnings])
        taken = episodes.next_step(
            evidence[last],
            directions[last][None],
            constrain=lambda state: self._constrained(state, reach, object, here),
            hold=lambda step: (
                doubtful
                or _in_doubt(step)
                or self._suspicious([*episodes.steps, step], observations)
                or self._pose_in_doubt(step)
            ),
        )

        steps = [*episodes.steps, taken.step]
        travel = self._travelled([int(step.views[0]) for step in steps], directions)
        seen = {
            k: self._view(steps[k], observations[k], directions[k], travel[k])
            for k in (*changed, last)
        }
        views = list(self.views)
        for k in changed:
            views[k] = _seen_anew(views[k], seen[k])
        asked_for = bool(self.views) or object is None or object.known is not None
        view = replace(
            seen[last],
            next_view=_next_of(taken.step),
            values=self._values(taken.step),
            warnings=tuple(warnings),
            degrees_off=self._degrees_off(directions[last]) if asked_for else 0.0,
        )

        episodes.keep(taken)
        self._episodes = episodes
        self.views = [*views, view]
        self.object = object
        return view

    def _evidence(
        self,
        observations: Sequence[Observation],
        which: Sequence[int],
        warnings: Sequence[ViewWarning],
    ) -> dict[int, Evidence]:
        """The evidence of some of the observations; a repeated picture counts as unseen.

        ``warnings`` are those of the last observation.
        """
        found = self.models.evidence([observations[k] for k in which])
        warned = [*(view.warnings for view in self.views), warnings]
        once = np.array([REPEATED not in warned[k] for k in which])
        found = replace(found, seen=once if found.seen is None else found.seen & once)
        return {k: found.select([row]) for row, k in enumerate(which)}

    def _replayed(
        self,
        evidence: dict[int, Evidence],
        directions: Sequence[Float],
    ) -> Episodes:
        """The episode so far once more, with new evidence of some of its views."""
        episodes = self._begin(self.view)
        for k, step in enumerate(self._episodes.steps):
            # What all views said together then is not asked again: it takes time.
            episodes.take(
                evidence.get(k, step.evidence),
                directions[k][None],
                step.joint,
            )
        return episodes

    def _degrees_off(self, direction: Float) -> float:
        """Between the view that was asked for and where the camera stood."""
        off = angle_between(self.sphere.directions[self.view], direction)
        return float(np.degrees(off))

    def _snapped(self, towards: Float) -> Float:
        """A direction, (3,), or that of the candidate view at which it is."""
        view, there = self.sphere.nearest(towards)
        return self.sphere.directions[view] if there else towards

    def _view(
        self,
        step: Step,
        observation: Observation,
        direction: Float,
        travel: tuple[float, float],
    ) -> View:
        """What a step says of its view, but for what was chosen after it."""
        calibration = self._episodes.calibration
        nearest, there = self.sphere.nearest(direction)
        azimuth = (
            self.sphere.azimuth[[nearest]] if there else azimuth_of(direction[None])
        )
        classes = len(self.models.classes)
        evidence = step.evidence
        bins = calibration.azimuth_bins(
            step.total,
            np.maximum(step.seen, 1),
            classes,
            azimuth,
        )

        return View(
            int(step.views[0]),
            observation,
            alone=calibration.belief(
                log_evidence_of(evidence.logits, evidence.azimuth_bins, azimuth),
                1,
                classes,
            )[0],
            belief=step.belief[0],
            maps={name: values[0] for name, values in step.evidence.maps.items()},
            next_view=None,
            travel=travel[0],
            arc=travel[1],
            direction=direction,
            azimuth_bins=None if bins is None else bins[0],
            score=self._score(step, observation),
            joint=step.joint[0] if step.joint else None,
        )

    def _score(self, step: Step, observation: Observation) -> ViewScore | None:
        """Return the novelty score of a view; None without a score."""
        score = self.models.recogniser.novelty
        evidence = step.evidence
        if not observation.seen or (evidence.seen is not None and not evidence.seen[0]):
            return None
        if (
            score is not None and score.joint
        ):  # how badly all views are explained by what is known
            calibration = self.models.recogniser.calibration
            classes = len(self.models.classes)
            seen = np.maximum(step.seen, 1)
            value = score.of_belief(
                calibration.log_belief(step.total, seen, classes)[0],
                int(seen[0]),
            )
            return ViewScore(observation, None, value)
        return None if evidence.novelty is None else evidence.novelty[0]

    def _suspicious(
        self,
        steps: Sequence[Step],
        observations: Sequence[Observation],
    ) -> bool:
        """Return whether an object is too novel for a confident answer."""
        if not self.unknown:
            return False
        joint = steps[-1].joint[0] if steps[-1].joint else None
        if joint is not None and joint.p_value is not None:
            return joint.p_value < SUSPICIOUS * self.unknown
        score = self.models.recogniser.novelty
        if score is None:
            return False
        found = [
            self._score(step, seen)
            for step, seen in zip(steps, observations, strict=True)
        ]

        return (
            score.of_views(values_of([s for s in found if s is not None]))
            < SUSPICIOUS * self.unknown
        )

    def _travelled(
        self,
        views: Sequence[int],
        directions: Sequence[Float],
    ) -> list[tuple[float, float]]:
        """Cells and radians on the way to each view, from the places where the camera stood."""
        sphere = self.sphere
        found = [(0.0, 0.0)]
        at = [
            np.array_equal(d, sphere.directions[view])
            for view, d in zip(views, directions, strict=True)
        ]

        for a, b in pairwise(range(len(views))):
            if at[a] and at[b]:
                leg = sphere.travel[views[a], views[b]], sphere.arc[views[a], views[b]]
            else:
                leg = (
                    sphere.travel_between(directions[a], directions[b]),
                    angle_between(directions[a], directions[b]),
                )
            found.append((found[-1][0] + float(leg[0]), found[-1][1] + float(leg[1])))
        return found

    def _values(self, step: Step) -> Float | None:
        chooser = self._chooser
        if (
            step.stopped[0]
            or step.state is None
            or not isinstance(self.policy, ValuesViews)
        ):
            return None

        assert isinstance(chooser, ValuesViews)
        name = type(self.policy).__name__

        with plugin_errors(
            lambda said: PolicyError(
                f"policy {name}, asked what it values views at, raised {said}"
            )
        ):
            values = np.asarray(chooser.view_values(step.state), np.float64)

        if values.shape != (1, len(self.sphere)):
            raise PolicyError(
                f"policy {name} values views by (B, V) numbers, here (1, {len(self.sphere)})"
            )

        return values[0]

    def run(self, camera: Camera | FrameCamera) -> Recognition:
        """Continue to the end with a camera, or until it has no view left."""
        while not self.done:
            try:
                seen = camera.observe(self.pose)
            except NoViewLeftError:
                if not self.views:
                    raise
                self.reachable = np.zeros(len(self.sphere), bool)
                break

            try:
                self.update(seen)
            except ObservationError as error:
                if not isinstance(camera, FrameCamera):
                    raise
                camera.refused(error)
        return self.result

    @property
    def result(self) -> Recognition:
        """How it ended; or what is believed so far, not confident, while it goes on."""
        with self._lock:
            enough = self.done and bool(self._episodes.outcome.confident[0])
            all_taken = len(self.views) >= min(
                self.stopping.max_views,
                len(self.sphere),
            )
            radius = self.views[-1].observation.radius if self.views else None
            result = Recognition(
                tuple(self.views),
                self.models.classes,
                enough,
                self.sphere,
                self.stopping,
                stranded=(stranded := self.done and not enough and not all_taken),
                why_stranded=self._why_stranded() if stranded else "",
                score=self.models.recogniser.novelty,
                unknown_rate=self.unknown,
                impossible=classes_of_other_size(self.models.recogniser, radius),
                poses_in=PoseFrame.of(self.object),
            )

            return replace(result, confident=enough and not result.unknown)

    def _why_stranded(self) -> str:
        """What became of the candidates that were not taken, in words."""
        taken = {view.index for view in self.views}
        left = [
            why or "out of reach"
            for k, why in enumerate(self.left_out)
            if k not in taken
        ]
        return in_words(left)


def _in_doubt(step: Step) -> bool:
    """Whether what all views say together is not to be acted on, however it is believed."""
    joint = step.joint[0] if step.joint else None
    return joint is not None and bool(joint.doubt)


def _seen_anew(before: View, seen: View) -> View:
    """A view that is seen in a better object frame: what was chosen and noticed then stays."""
    return replace(
        seen,
        next_view=before.next_view,
        values=before.values,
        warnings=before.warnings,
        degrees_off=before.degrees_off,
    )


def _next_of(step: Step) -> int | None:
    return None if step.stopped[0] else int(step.next_views[0])


def _half_diagonal(points: Float) -> float:
    """Half the diagonal of the box around points, (N, 3), metres; 0 around none."""
    if not len(points):
        return 0.0
    return float(np.linalg.norm(np.ptp(points, axis=0)) / 2)


def _checked_distance(given: float | None) -> float | None:
    """A distance of the camera, metres, above 0; or None."""
    return None if given is None else number(given, "the distance, in metres,", above=0)


def _new_object(segmentation: Segmenter | None) -> ObservedObject:
    from nextview.sensing.observed_object import ObservedObject

    return ObservedObject(segmentation=segmentation)


def _check_needs(policy: Policy, models: Models) -> None:
    if not (hasattr(policy, "needs") and hasattr(policy, "next_views")):
        raise UsageError(
            f"a policy has needs and next_views, see nextview.Policy, not {one_line(repr(policy))}"
        )

    if "azimuth_bins" in policy.needs and not models.recogniser.azimuth_bins:
        raise SessionError(
            "this policy needs the azimuth bin that is seen, and the recogniser was not taught it"
        )

    if "outlook" in policy.needs and not isinstance(models.recogniser, LooksAhead):
        raise SessionError(
            "this policy needs things of known geometry: a memory that was taught from scans"
        )

    missing = [
        name for name in maps_among(policy.needs) if name not in models.map_names
    ]
    if missing:
        raise SessionError(
            f"this policy needs the map {missing[0]!r}; load it with the models"
        )
