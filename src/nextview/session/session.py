"""Recognise one object live: pass in frames and get the belief and the next view."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import replace
from itertools import pairwise
from threading import RLock
from typing import Any, Protocol, get_args, overload, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nextview.checks import one_line, plugin_errors, whole
from nextview.cores import one_blas_thread
from nextview.errors import (
    NoViewLeftError,
    ObservationError,
    PolicyError,
    SessionError,
    UsageError,
)
from nextview.geometry.viewsphere import (
    Viewpoints,
    angle_between,
    direction_of,
)
from nextview.policies.base import EpisodeState, Policy, SeeksPose, ValuesViews
from nextview.policies.off_grid import anywhere
from nextview.recognition.belief import Stopping
from nextview.recognition.evidence import Evidence
from nextview.recognition.inference import Models
from nextview.recognition.map_names import maps_among
from nextview.recognition.poses import share_of_likeliest
from nextview.recognition.protocol import (
    JudgesTogether,
    LooksAhead,
    check_unknown,
)
from nextview.segmentation.instances import Segmenter
from nextview.sensing.frame import Frame
from nextview.sensing.known_frames import REPEATED, repeated
from nextview.sensing.observation import Camera, Observation
from nextview.sensing.observed_object import ObservedObject
from nextview.sensing.plausibility import (
    check_last_view,
    check_observation,
    repeated_observation,
)
from nextview.sensing.view_warning import ViewWarning
from nextview.session.episode import Episodes, Step
from nextview.session.limits import Limits, checked_limits, in_words
from nextview.session.ranked import RankedView, camera_poses, rank_views
from nextview.session.reach import (
    Reach,
    Reachable,
    TravelCost,
    as_distance,
    as_reachable,
    as_travel_cost,
)
from nextview.session.result import Recognition
from nextview.session.surroundings import Surroundings
from nextview.session.view import View
from nextview.types import Float, Mask
from nextview.views.expected_views import Goal, Outlook

FARTHEST_TARGET = 60.0
"""Object radii: such as 0.6 m from a thing with a radius of 0.01 m. A distance in millimetres
would be a thousand times as large.
"""


@runtime_checkable
class FrameCamera(Protocol):
    """A camera in the world that delivers frames of one object.

    If it has a true attribute ``knows_reach``, it alone decides which poses it can reach, and is
    also asked for candidates that ``Session.limits`` would exclude, such as views captured earlier.
    """

    @property
    def object(self) -> ObservedObject:
        """Object to recognise."""
        ...

    def observe(self, pose: Float) -> Frame:
        """Capture a frame from a pose in the object frame, object radii, or from near it.

        It raises ``NoViewLeftError`` if that is not possible.
        """
        ...

    def refused(self, error: ObservationError) -> None:
        """Report that the object was not found in the last frame.

        Returns if there may be another frame; otherwise raises the error.
        """
        ...


class Session:
    """Recognition of one object, view by view; the caller moves the camera.

    A session can be shared between threads; calls wait for each other. With a camera that reaches
    every requested pose, in the object frame and object radii:

    >>> session = nextview.load().session()                                     # doctest: +SKIP
    >>> while not session.done:                                                 # doctest: +SKIP
    ...     view = session.update(my_camera.observe(session.pose))
    >>> session.result                                                          # doctest: +SKIP

    With a depth camera on a robot, in the world frame and metres, from any first pose:

    >>> session = nextview.load().session(distance=0.6)                         # doctest: +SKIP
    >>> session.update(look())                                                  # doctest: +SKIP
    >>> while not session.done:                                                 # doctest: +SKIP
    ...     if go_to(session.target):
    ...         session.update(look())  # a Frame, with the pose that was reached
    ...     else:
    ...         session.failed()

    Args:
        models: recogniser and map networks.
        policy: chooses the next view; it may use other viewpoints, see ``policies.off_grid``.
        sphere: the candidate viewpoints.
        start: suggested first view; the camera may start elsewhere.
        stopping: stopping rule; by default that of the recogniser, see ``Stopping.of``.
        rng: for random policies; seed 0 by default.
        object: the object to find in frames; by default the one at which the first camera is aimed.
        distance: of the camera from the object's centre, metres; ``sphere.distance`` object radii
            by default.
        unknown: significance level of the test for unknown objects; 0 disables it.
        segmentation: segments the objects in frames, see ``Scene``; None for the bundled network. A
            given object has its own segmentation.

    Raises:
        UsageError: both an object and a segmentation are given.
        SessionError: the models lack an output that the policy needs.
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
        check_unknown(unknown, models.recogniser)

        self.models = models
        self.policy = policy
        self.sphere = sphere
        self._distance = as_distance(distance)
        self.object = (
            ObservedObject(segmentation=segmentation)
            if object is None and distance is not None
            else object
        )
        self.stopping = stopping or Stopping.of(models.recogniser.calibration)
        self.unknown = unknown
        self.segmentation = segmentation
        self.views: list[View] = []
        self._goal: Goal = "thing"
        self.observers: list[Callable[[Session], None]] = []
        """Functions that are called in order after each view, and when the next view changes."""

        self._before = 0 if object is None else len(object.sightings)
        self._chooser = anywhere(policy, sphere)
        self._rng = rng or np.random.default_rng(0)
        self._reach = Reach(np.zeros(len(sphere), bool))
        self._limits = Limits()
        self._surroundings: tuple[Surroundings, ...] = ()
        self._lock = RLock()
        self._episodes = self._begin(whole(start, "the first view", 0, len(sphere) - 1))

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the lock, so that a session can be copied and pickled.

        Networks are opened again.
        """
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

    # The next view

    @property
    def done(self) -> bool:
        """True if the episode has ended."""
        return len(self._episodes.running) == 0

    @property
    def view(self) -> int:
        """Index of the next view."""
        return int(self._episodes.current[0])

    @property
    def pose(self) -> Float:
        """Next camera-to-world pose, (4, 4), OpenCV axes, object frame, object radii."""
        return self.sphere.poses[self.view]

    @property
    def poses(self) -> Float:
        """Candidate poses in the world: camera-to-world, (V, 4, 4), OpenCV axes, metres.

        They are level, at ``distance`` from the object, and aimed at its centre. They are updated
        when a frame improves the estimate of the object's position. Without frames they are those
        of ``sphere``, in object radii.
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
        """Next camera pose, one of ``poses``, (4, 4); None if the episode has ended."""
        return None if self.done else self.poses[self.view]

    def ranked(
        self,
        poses: ArrayLike | None = None,
        goal: Goal = "thing",
    ) -> tuple[RankedView, ...]:
        """Rank candidate views by their expected information about the identity of the object.

        Among views of similar value, nearer ones come first. Occluders seen in the frames so far
        are taken into account; reachability is left to the caller.

        Args:
            poses: candidate camera poses of your robot, camera-to-world, (V, 4, 4), OpenCV axes, in
                the world frame and metres; without frames, in the object frame and object radii. By
                default the remaining ``poses``: not visited, within ``limits`` and ``reachable``.
            goal: "thing" ranks by information about the identity, "pose" by information about
                identity and pose.

        Raises:
            SessionError: nothing can be predicted, as there is no view yet or the geometry of the
                object is not known.
            UsageError: the poses are invalid.
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
        if self.object is not None:
            cameras = self.object.object_frame.pose_in_metres(given)
        else:
            radius = self.views[-1].observation.radius
            assert radius is not None  # an outlook implies a radius
            cameras = given.copy()
            cameras[:, :3, 3] *= radius
        return rank_views(outlook, cameras, given, left, goal)

    @property
    def outlook(self) -> Outlook | None:
        """Prediction of further views from the leading hypotheses with known geometry.

        None before the first view, and if no taught thing with known geometry explains the views.
        """
        with self._lock:
            if not self.views:
                return None
            found = self._episodes.outlooks(self._episodes.steps[-1], np.ones(1, bool))[
                0
            ]
            named = isinstance(found, Outlook) and found.unknown < 1
            return found if named else None

    def _left(self) -> Mask:
        """Return which candidates may still be chosen, (V,) bool."""
        state = self._episodes.steps[-1].state
        if state is not None:
            return state.free[0]
        left = np.ones(len(self.sphere), bool)
        left[[view.index for view in self.views]] = False
        return left & ~self._reach.failed & (self._reasons(self.object) == "")

    @property
    def distance(self) -> float | None:
        """Camera distance from the object's centre, metres; None for ``sphere.distance`` radii.

        A change takes effect with the next pose.
        """
        return self._distance

    @distance.setter
    def distance(self, given: float | None) -> None:
        with self._lock:
            checked = as_distance(given)
            before = self._distance
            self._distance = checked
            if self.object is not None and self.object.sightings:
                try:
                    self._check_distance(self.object)
                except UsageError:
                    self._distance = before
                    raise

    # Constraints of the robot

    @property
    def goal(self) -> Goal:
        """Goal of the session: "thing" for the identity, "pose" for identity and pose.

        With "pose", views are valued by their information about identity and pose, and the session
        continues until the belief in the likeliest pose, up to symmetry, reaches the threshold too.
        If the object has no known pose, the session ends as with "thing". Set the goal before the
        first view. A policy that does not support it raises ``UsageError``.
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
        """Return True if the goal is the pose and its belief is below the threshold."""
        joint = step.joint[0] if len(step.joint) else None
        if self._goal == "thing" or joint is None or not joint.poses:
            return False
        threshold = float(self.stopping.threshold_at(int(step.seen[0])))
        return share_of_likeliest(joint.poses) < threshold

    @property
    def reachable(self) -> Reachable | None:
        """Views that the camera can reach, see ``session.reach.Reachable``; None for all.

        Policies choose only among these. A change takes effect immediately: if the current target
        is not reachable, another view is chosen. A callable is called again for each choice after
        the first view, with the unvisited views.
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

        It replaces the travel distance from the next choice on, for instance by the duration from
        your motion planner. The unit is arbitrary: costs are scaled so that their mean over the
        free views equals the mean travel in cells.
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
        """Limits on the camera positions, see ``session.limits.Limits``.

        A change takes effect immediately, as for ``reachable``. Limits have no effect in sessions
        without frames.
        """
        return self._limits

    @limits.setter
    def limits(self, given: Limits) -> None:
        checked = checked_limits(given)
        with self._lock:
            before = self._limits
            self._limits = checked
            try:
                self._set_reach(self._reach)
            except BaseException:
                self._limits = before
                raise

    @property
    def left_out(self) -> tuple[str, ...]:
        """Reason why each candidate is excluded or has failed, (V,); "" if allowed."""
        with self._lock:
            reasons = self._reasons(self.object)
            return tuple(
                "failed" if gone else str(why)
                for gone, why in zip(self._reach.failed, reasons, strict=True)
            )

    def _reasons(self, object: ObservedObject | None) -> NDArray[np.str_]:
        """Return ``Limits.reasons``; all "" without frames and before the first one."""
        if object is None or not object.sightings:
            return np.full(len(self.sphere), "", "<U1")
        self._surroundings = Surroundings.in_frames(
            object.sightings, object.object_frame, self._surroundings
        )
        return self._limits.reasons(
            self._poses_around(object),
            object.object_frame,
            self._surroundings,
            object.support,
        )

    def failed(self, view: int | None = None) -> None:
        """Report that the camera could not reach a view, by default the requested one.

        The view is not offered again. If no reachable view is left, the session ends and is not
        confident: ``Recognition.stranded``.
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
        """Update the reachability, and choose another view if the target is no longer reachable."""
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
        else:  # with frames the episode starts at the current camera pose
            episodes = (
                self._begin_nearest(reach) if self.object is None else self._episodes
            )
            self._reach = reach
            self._episodes = episodes

    def _can_go(self, view: int, reach: Reach) -> bool:
        """Return True if a view is allowed and reachable."""
        if self._reasons(self.object)[view]:
            return False
        return bool(reach.can_reach(np.array([view]), lambda: self.poses)[0])

    def _begin_nearest(self, reach: Reach) -> Episodes:
        """Start a session without views at the nearest reachable view.

        A callable is not called yet.
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
        """Add the reachable views and the travel cost to a state.

        Costs are measured from the camera of the last view by default.
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

    # Views

    @overload
    def update(self, seen: Observation | Frame) -> View: ...

    @overload
    def update(self, seen: Sequence[Frame]) -> tuple[View, ...]: ...

    def update(
        self, seen: Observation | Frame | Sequence[Frame]
    ) -> View | tuple[View, ...]:
        """Process a view, taken from ``pose``, ``target`` or anywhere else.

        If an error is raised, the session is unchanged and continues with the next view. Of several
        frames, those after the one that ends the session are not used.

        Args:
            seen: an observation in the object frame, or a frame of a depth camera in the world
                frame, or frames that several cameras took together. If a frame improves the
                estimate of the object's position, the earlier ``views`` are recomputed in the new
                object frame, except for their choices and warnings.

        Returns:
            The view; a tuple of those of the used frames, if there were several.

        Raises:
            SessionError: the episode has ended, or the session mixes frames and observations.
            ObservationError: the object is not found in the frame, the frames are inconsistent, or
                the image does not suit the networks.
            UsageError: the session's ``distance`` is inside the object, or more than 60 object
                radii.
            PolicyError: the policy failed.
        """
        with self._lock:
            if self.done:
                raise SessionError("this session has ended; begin another one")
            before = copy(self._episodes), list(self.views), self.object
            state = None if self.object is None else self.object.state
            found = []
            try:
                for one in seen if isinstance(seen, Sequence) else (seen,):
                    if not self.done:
                        found.append(self._update(one))
            except BaseException:
                self._episodes, self.views, self.object = before
                if self.object is not None and state is not None:
                    self.object.state = state
                raise
        return tuple(found) if isinstance(seen, Sequence) else found[0]

    def _update(self, seen: Observation | Frame) -> View:
        """Process one view."""
        with one_blas_thread():
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
        if repeated_observation(seen, earlier):
            warnings = [REPEATED]
        else:
            warnings = check_observation(seen) or check_last_view([*earlier, seen])
        return self._take([*earlier, seen], warnings, seen.pose, None)

    def _add_frame(self, frame: Frame) -> View:
        if self.object is None and self.views:
            raise SessionError(
                "this session has taken observations; begin another one for frames"
            )
        object = self.object or ObservedObject(segmentation=self.segmentation)
        if len(object.sightings) != self._before + len(self.views):
            raise SessionError(
                "frames were added to this object outside of the session; begin another one"
            )

        known = [one.frame for one in object.sightings[self._before :]]
        number = repeated(frame, known, any_mask=True)
        if number is None:
            self._find(object, frame)
        else:
            object.add_again(frame, self._before + number)
        self._refuse_disagreement(object)
        self._check_distance(object)
        return self._take(
            object.observations[self._before :],
            object.warnings,
            frame.camera_to_world,
            object,
        )

    def _find(self, object: ObservedObject, frame: Frame) -> None:
        """Find an object in a frame, with what touches it if that is more like a known class.

        No scan tells where an object of a class ends.
        """
        before = object.state
        object.add(frame)
        recogniser = self.models.recogniser
        if isinstance(recogniser, JudgesTogether) or recogniser.novelty is None:
            return
        if frame.mask is not None or object.known is not None:
            return
        alone = self._judged(object)
        if alone.familiarity >= 1:
            return
        whole = copy(object)
        whole.state = before
        whole.alone = True
        with suppress(ObservationError):
            whole.add(frame)
            result = self._judged(whole)
            if not result.unknown and result.familiarity > alone.familiarity:
                object.state = whole.state

    def _judged(self, object: ObservedObject) -> Recognition:
        """Return what all frames say of an object of which the last view is not taken yet."""
        observations = object.observations[self._before :]
        every = range(len(observations))
        evidence = self._evidence(observations, every, object.warnings)
        directions = [self._snapped(direction_of(seen.pose)) for seen in observations]
        episodes = self._begin(self.view)
        for k in every:
            episodes.take(evidence[k], directions[k][None])
        views = self._views(episodes.steps, observations, every)
        return self._recognition([views[k] for k in every], object)

    def _refuse_disagreement(self, object: ObservedObject) -> None:
        """Reject frames whose object is as large as the camera distance only in combination.

        A wrong distance or depth scale is visible in a single frame. If the object is much smaller
        in each frame than in all together, the frames are inconsistent.
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
            # much larger than in any single frame
            or together < 1.5 * alone
        ):
            return

        raise ObservationError(
            f"the frames do not fit together: the object has a radius of {together:.2g} m in all of"
            f" them, and of {alone:.2g} m at most in a single one: are the poses wrong (inverse, or"
            " in another unit), or has the object moved?"
        )

    def _check_distance(self, object: ObservedObject) -> None:
        """Reject targets inside the object or far away, as soon as its radius is known."""
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
        """Process the last of some observations, and any earlier ones that have changed."""
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

        def viewed(step: Step) -> list[View]:
            """Return all views, with a step for the last of them."""
            anew = self._views([*episodes.steps, step], observations, [*changed, last])
            views = list(self.views)
            for k in changed:
                views[k] = _seen_anew(views[k], anew[k])
            return [*views, replace(anew[last], warnings=tuple(warnings))]

        taken = episodes.next_step(
            evidence[last],
            directions[last][None],
            constrain=lambda state: self._constrained(state, reach, object, here),
            hold=lambda step: (
                self._recognition(viewed(step), object).refused
                or self._pose_in_doubt(step)
            ),
        )
        *views, view = viewed(taken.step)
        asked_for = bool(self.views) or object is None or object.known is not None
        view = replace(
            view,
            next_view=_next_of(taken.step),
            values=self._values(taken.step),
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
        """Return the evidence of some observations; a repeated image counts as not visible.

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
        """Replay the episode with new evidence for some of its views."""
        episodes = self._begin(self.view)
        for k, step in enumerate(self._episodes.steps):
            # The joint beliefs of earlier steps are reused, as they are slow to compute.
            episodes.take(
                evidence.get(k, step.evidence),
                directions[k][None],
                step.joint,
            )
        return episodes

    def _degrees_off(self, direction: Float) -> float:
        """Return the angle between the requested view and the actual camera position."""
        off = angle_between(self.sphere.directions[self.view], direction)
        return float(np.degrees(off))

    def _snapped(self, towards: Float) -> Float:
        """Return a direction, (3,), snapped to a candidate view that it coincides with."""
        view, there = self.sphere.nearest(towards)
        return self.sphere.directions[view] if there else towards

    def _views(
        self,
        steps: Sequence[Step],
        observations: Sequence[Observation],
        which: Iterable[int],
    ) -> dict[int, View]:
        """Return the views of some steps, without their choices of the next view."""
        directions = [self._snapped(direction_of(seen.pose)) for seen in observations]
        travel = self._travelled([int(step.views[0]) for step in steps], directions)

        found = {}
        for k in which:
            step = steps[k]
            view = View.of(
                observations[k],
                step.evidence,
                step.total[0],
                float(step.seen[0]),
                self.sphere,
                self.models.recogniser,
                step.joint[0] if step.joint else None,
            )
            found[k] = replace(view, travel=travel[k][0], arc=travel[k][1])
        return found

    def _travelled(
        self,
        views: Sequence[int],
        directions: Sequence[Float],
    ) -> list[tuple[float, float]]:
        """Return the travel to each view from the camera positions, in cells and radians."""
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
        """Run the session with a camera until it ends or the camera has no view left."""
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
        """Result of the session; while it is running, the current belief, not confident."""
        with self._lock:
            enough = self.done and bool(self._episodes.outcome.confident[0])
            all_taken = len(self.views) >= min(
                self.stopping.max_views,
                len(self.sphere),
            )
            stranded = self.done and not enough and not all_taken
            result = self._recognition(self.views, self.object)
            return replace(
                result,
                confident=enough and not result.unknown,
                stranded=stranded,
                why_stranded=self._why_stranded() if stranded else "",
            )

    def _recognition(
        self, views: Sequence[View], object: ObservedObject | None
    ) -> Recognition:
        """Return what some views of the object say, not confident yet."""
        return Recognition.of(
            views, self.models, self.sphere, self.stopping, self.unknown, object
        )

    def _why_stranded(self) -> str:
        """Describe why the remaining candidates were not taken."""
        taken = {view.index for view in self.views}
        left = [
            why or "out of reach"
            for k, why in enumerate(self.left_out)
            if k not in taken
        ]
        return in_words(left)


def _seen_anew(before: View, seen: View) -> View:
    """Update a view for an improved object frame; its choice and warnings are kept."""
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
    """Return half the diagonal of the bounding box of points, (N, 3), metres; 0 for no points."""
    if not len(points):
        return 0.0
    return float(np.linalg.norm(np.ptp(points, axis=0)) / 2)


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
