"""Live use: hand in what the camera sees, get told what it is or where to look next."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import ThreadpoolController

from nextview.arguments import as_line, number, of_kind, takes_paths, whole
from nextview.belief import Stopping, fuse
from nextview.episode import Episodes, Step
from nextview.errors import NoViewLeftError, ObservationError, PolicyError, SessionError, UsageError
from nextview.models.inference import Models
from nextview.novelty import Novelty
from nextview.observation import Camera, Observation
from nextview.own_code import own_code
from nextview.policies.base import EpisodeState, Evidence, Policy, ValuesViews, maps_among, travel_from
from nextview.policies.off_grid import anywhere
from nextview.sensing.frame import Frame
from nextview.sensing.plausibility import Doubt, check_observation, check_views
from nextview.viewsphere import Viewpoints, angle_between, direction_of, elevation_of, turn_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from nextview.sensing.observed_object import ObservedObject

Float = NDArray[np.float64]
Reachable = NDArray[np.bool_] | Callable[[Float], bool]
"""Which candidate views the camera can be brought to: (V,) bool; or what says so of a pose of ``Session.poses``."""
TravelCost = Float | Callable[[Float, Float], float]
"""What it costs to go from one view to another, in any unit: (V, V), row from, column to; or what says so of two poses
in the frame of ``Session.poses``, the first that where the camera stands. Infinity where there is no way."""
CONTRADICTABLE = 3
"""Views before the last with whose geometry it is compared."""


@runtime_checkable
class FrameCamera(Protocol):
    """A camera in the world, with what it is to look at: it gives frames, and need not be where it was asked to be."""

    @property
    def object(self) -> ObservedObject:
        """The object that it is to look at."""
        ...

    def observe(self, pose: Float) -> Frame:
        """Look from a pose in the object frame, object radii, or from near it.

        Raises:
            NoViewLeftError: there is no view left to offer.
        """
        ...

    def refused(self, error: ObservationError) -> None:
        """The object is not found in the last frame. Returns if there may be another one; else raises the error."""
        ...


@dataclass(frozen=True)
class View:
    """One view and what followed from it.

    Attributes:
        index: the candidate viewpoint it was taken from, or the one nearest to where the camera stood.
        observation: what was seen.
        alone: belief by this view alone, (classes,) float64; the same for all classes if nothing is seen in it.
        belief: fused over all views so far, (classes,) float64.
        maps: predicted local maps by name, each (rings, 3).
        next_view: where to look next; None where the episode ends.
        travel: so far, in grid cells.
        arc: so far, in radians.
        direction: unit vector from the object to where the camera stood, (3,) float64.
        azimuth_bins: belief, over all views, in the azimuth from which the object is seen here, for each class,
            (classes, azimuth bins), in even steps; None if the recogniser was not taught them.
        values: what the policy valued each candidate view at, (V,) float64, NaN for those that it did not consider;
            None where the episode ends, and for policies that value nothing.
        doubts: what is likely to be wrong with the view though it was taken in; usually nothing.
        degrees_off: angle at the object between the view that was asked for and where the camera stood; 0 for the first
            frame of a camera in the world, which begins where it stands.
        novelty: how strange this view is, see ``nextview.novelty``; None if nothing is seen in it, or the recogniser
            cannot tell.
    """

    index: int
    observation: Observation
    alone: NDArray[np.float64]
    belief: NDArray[np.float64]
    maps: dict[str, NDArray[np.floating]]
    next_view: int | None
    travel: float
    arc: float
    direction: NDArray[np.float64]
    azimuth_bins: NDArray[np.float64] | None = None
    values: NDArray[np.float64] | None = None
    novelty: float | None = None
    doubts: tuple[Doubt, ...] = ()
    degrees_off: float = 0.0

    @property
    def angles(self) -> tuple[float, float]:
        """(elevation, azimuth) of where the camera stood, degrees."""
        return float(np.degrees(elevation_of(self.direction))), 360 * float(turn_of(self.direction))


@dataclass(frozen=True)
class Recognition:
    """The end of an episode.

    Attributes:
        views: in order.
        classes: their names.
        confident: whether the threshold was reached (else the views ran out); never if nothing was seen.
        sphere: the candidate viewpoints.
        stopping: the rule that ended it.
        stranded: whether it ended because no view that was left could be reached; then it is not confident.
        score: tells how strange views are; None if the recogniser cannot.
        unknown_rate: the share of objects of known classes that may be taken for unknown ones; 0 to take none.
    """

    views: tuple[View, ...]
    classes: tuple[str, ...]
    confident: bool
    sphere: Viewpoints
    stopping: Stopping
    stranded: bool = False
    score: Novelty | None = None
    unknown_rate: float = 0.0

    @property
    def seen(self) -> bool:
        """Whether the object was seen from any of the views."""
        return any(view.observation.seen for view in self.views)

    @property
    def novelty(self) -> float | None:
        """The share of known objects that look at least as strange (a p-value); None if the recogniser cannot tell.

        It holds for objects that are seen as the known ones were, without noise say; see ``nextview.novelty``.
        """
        if self.score is None or not self.seen:
            return None
        return self.score.of_views([view.novelty for view in self.views if view.novelty is not None])

    @property
    def unknown(self) -> bool:
        """Whether the object is taken to be of no class that the recogniser knows."""
        return self.novelty is not None and self.novelty < self.unknown_rate

    @property
    def most_like(self) -> str | None:
        """The class believed most, also of an unknown object; None if too little was seen."""
        return self.classes[int(self.views[-1].belief.argmax())] if self.seen else None

    @property
    def answer(self) -> str | None:
        """The class believed most; None if too little was seen, or the object is of none of them."""
        return None if self.unknown else self.most_like

    @property
    def confidence(self) -> float:
        """The belief in the answer; 0 if there is none."""
        return 0.0 if self.answer is None else float(self.views[-1].belief.max())

    @property
    def travel(self) -> float:
        """Of the whole episode, in grid cells."""
        return self.views[-1].travel

    def __repr__(self) -> str:
        """One line: ``chair (belief 0.998, 2 views, 1.41 cells of travel, confident)``."""
        views = f"{len(self.views)} view{'s' * (len(self.views) > 1)}, {self.travel:.2f} cells of travel"
        if not self.seen:
            return f"nothing is seen ({views})"
        if self.unknown:
            belief = self.views[-1].belief.max()
            return f"unknown (most like {self.most_like}, {belief:.2f}; novelty p {self.novelty:.3f}, {views})"
        sure = "confident" if self.confident else "not confident" + ", no other view in reach" * self.stranded
        names = dict.fromkeys(doubt.name for view in self.views for doubt in view.doubts)
        doubts = f", doubtful: {', '.join(names)}" if names else ""
        return f"{self.answer} (belief {self.confidence:.3f}, {views}, {sure}{doubts})"

    @takes_paths("path")
    def plot(self, path: str | Path | None = None, title: str = "") -> Figure:
        """Draw the episode: images, what the policy valued the views at, beliefs and the path on the sphere.

        Args:
            path: write it to this file too (PNG, PDF or SVG).
            title: of the picture.

        Raises:
            UsageError: the file cannot be written, or its suffix is not a picture's.
        """
        from nextview.report.episode_figure import draw_episode, save_figure

        figure = draw_episode(self, title)
        if path is not None:
            save_figure(figure, Path(path))
        return figure


def _array(given: ArrayLike, what: str) -> NDArray:
    try:
        return np.asarray(given)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{what} is an array or a callable ({error})") from None


def _seconds(cost: Any) -> float:
    """What a callable says that a way costs; infinity is a cost, too."""
    found = number(cost, "a travel cost")
    if not found >= 0:
        raise UsageError(f"a travel cost is a number from 0 on, not {found}")
    return found


def _truth(said: Any) -> bool:
    """What a callable says of a pose. Nothing is no answer: it is what a function gives that forgets to."""
    of_kind(said, bool | np.bool_ | int, "whether a view can be reached is true or false")
    return bool(said)


@lru_cache(maxsize=1)
def _blas() -> ThreadpoolController:
    """The libraries below NumPy. Their threads wait for more work in a loop, and take the cores from the networks."""
    return ThreadpoolController().select(user_api="blas")


class Session:
    """One object under way; the caller moves the camera.

    A camera that goes where it is told, in the object frame and object radii:

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
        policy: chooses the next view; one for other viewpoints than these is asked as ``policies.off_grid`` says.
        sphere: the viewpoints.
        start: where to look first; a camera that stands elsewhere is as welcome.
        stopping: when to stop; by default the rule that goes with the recogniser, see ``Stopping.of``.
        rng: for policies that draw; seed 0 by default.
        object: which object to find in frames; the largest on the support plane by default.
        distance: how far from the object's centre the camera shall stand, metres; as ``sphere.distance`` says, in
            object radii, by default.
        unknown: the share of objects of known classes that may be taken for unknown ones; 0 to take none.

    Raises:
        SessionError: the models lack what the policy needs.
        UsageError: there is no such first view or distance.
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
    ) -> None:
        of_kind(models, Models, "the models are Models")
        of_kind(sphere, Viewpoints, "the viewpoints are a ViewSphere or Directions")
        of_kind(stopping, Stopping | None, "when to stop is told by a Stopping")
        of_kind(rng, np.random.Generator | None, "rng is a numpy.random.Generator")
        if not (hasattr(policy, "needs") and hasattr(policy, "next_views")):
            raise UsageError(f"a policy has needs and next_views, see nextview.Policy, not {as_line(policy)}")
        if not 0 <= number(unknown, "the rate of known objects taken for unknown ones") < 1:
            raise UsageError(f"the rate of known objects taken for unknown ones lies from 0 to below 1, not {unknown}")
        if "azimuth_bins" in policy.needs and not models.recogniser.azimuth_bins:
            raise SessionError(
                "this policy wants to know the azimuth bin that is seen, and the recogniser was not taught it"
            )
        missing = [name for name in maps_among(policy.needs) if name not in models.map_names]
        if missing:
            raise SessionError(f"this policy needs the map {missing[0]!r}; load it with the models")
        if distance is not None and not 0 < number(distance, "the distance") < np.inf:
            raise UsageError(f"the distance is a positive number of metres, not {distance}")
        self.models, self.policy, self.sphere, self.distance = models, policy, sphere, distance
        self.views: list[View] = []
        if object is None and distance is not None:
            from nextview.sensing.observed_object import ObservedObject

            object = ObservedObject()
        if object is not None and not hasattr(object, "sightings"):
            raise UsageError(f"an object to find in frames is an ObservedObject, not {as_line(object)}")
        self.object = object
        self.stopping = stopping or Stopping.of(models.recogniser.calibration)
        self.unknown = unknown
        self._evidence: list[Evidence] = []
        self._before = 0 if object is None else len(object.sightings)
        self._chooser = anywhere(policy, sphere)
        self._rng = rng or np.random.default_rng(0)
        self._failed = np.zeros(len(sphere), bool)
        self._reachable: Reachable | None = None
        self._travel_cost: TravelCost | None = None
        self._here = np.eye(4)
        self.observers: list[Callable[[Session], None]] = []
        """Called, in order, after each view that was taken in, and when another next view was chosen."""
        self._episodes = self._begin(start)

    def _begin(self, start: int) -> Episodes:
        start = whole(start, "the first view", 0, len(self.sphere) - 1)
        starts, calibration = np.array([start]), self.models.recogniser.calibration
        return Episodes(self.sphere, self._chooser, starts, self.stopping, self._rng, calibration)

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
        """Where to look now, as a camera-to-world pose (4, 4), OpenCV axes, object frame, object radii."""
        return self.sphere.poses[self.view]

    @property
    def poses(self) -> Float:
        """Where the candidate views are in your world: camera-to-world, (V, 4, 4), OpenCV axes, metres.

        At ``distance`` from the object, looking at its centre, the horizon level. They move when a frame shows better
        where the object is. Without frames there is no world: the poses are those of ``sphere``, in object radii.

        Raises:
            SessionError: it is a session for frames, and the object was not seen yet.
        """
        if self.object is None:
            return self.sphere.poses
        if not self.object.sightings and self.object.known is None:
            raise SessionError("where the object is in the world is not known before the first frame: update with one")
        return self.object.object_frame.pose_in_world(self.sphere.poses, self.distance)

    @property
    def target(self) -> Float:
        """Where to look now, one of ``poses``, (4, 4)."""
        return self.poses[self.view]

    # What the robot can do

    @property
    def reachable(self) -> Reachable | None:
        """Which views the camera can be brought to, see ``Reachable``; None for all.

        No policy chooses another one. What is set here counts from now on: if the view that was chosen is not
        reachable, another one is. A callable is asked anew for each choice, of unvisited views, after the first view.

        Raises:
            UsageError: neither a mask of the candidate views nor callable.
        """
        return self._reachable

    @reachable.setter
    def reachable(self, given: ArrayLike | Callable[[Float], bool] | None) -> None:
        if given is not None and not callable(given):
            given = _array(given, "reachable")
            if given.shape != (len(self.sphere),) or given.dtype != bool:
                raise UsageError(
                    f"reachable is a mask, ({len(self.sphere)},) bool, or a callable on poses, not {given.dtype} "
                    f"{given.shape}"
                )
        before, self._reachable = self._reachable, given
        try:
            self._choose_again()
        except SessionError:
            self._reachable = before
            raise

    @property
    def travel_cost(self) -> TravelCost | None:
        """What it costs to go from view to view, see ``TravelCost``, seconds of your planner for instance; None for the
        travel in grid cells.

        Policies that weigh travel weigh this instead from the next choice on. Its unit does not matter: on the average
        over the free views it is taken to be as much as their travel in cells.

        Raises:
            UsageError: neither a matrix of the candidate views, without NaN and negative costs, nor callable.
        """
        return self._travel_cost

    @travel_cost.setter
    def travel_cost(self, given: ArrayLike | Callable[[Float, Float], float] | None) -> None:
        if given is not None and not callable(given):
            given, v = _array(given, "a travel cost"), len(self.sphere)
            if given.dtype.kind not in "fiu" or given.shape != (v, v) or not (given >= 0).all():
                raise UsageError(f"a travel cost is a matrix, ({v}, {v}) of numbers from 0 on, or a callable on poses")
            given = given.astype(np.float64)
        self._travel_cost = given

    def failed(self, view: int | None = None) -> None:
        """The camera could not be brought to a view, by default the one that was asked for: it is offered no more.

        Where no reachable view is left the session ends, not confident: ``Recognition.stranded``.

        Raises:
            SessionError: the session has ended; or, before the first view, no other one can be reached.
            UsageError: there is no such view.
        """
        if self.done:
            raise SessionError("this session has ended; begin another one")
        view = self.view if view is None else view
        view = whole(view, "a view", 0, len(self.sphere) - 1)
        self._failed[view] = True
        self._choose_again()

    def _choose_again(self) -> None:
        """Choose another view if the one that was chosen can no longer be reached."""
        if self.done:
            return
        if self.views:
            if not self._can_reach(np.array([self.view]))[0]:
                drawn = self._rng.bit_generator.state
                try:
                    step = self._episodes.choose_again(self._constrain)
                except BaseException:
                    self._rng.bit_generator.state = drawn
                    raise
                to = int(step.next_views[0])
                self.views[-1] = replace(
                    self.views[-1], next_view=None if to < 0 else to, values=self._values(step, to < 0)
                )
                self._tell_observers()
        elif self.object is None:  # with frames it begins where the camera is
            order = np.argsort(self.sphere.arc[self.view], kind="stable")
            there = ~self._failed[order]
            if self._reachable is not None and not callable(self._reachable):
                there &= self._reachable[order]
            if not there.any():
                raise SessionError("none of the candidate views can be reached")
            self._episodes = self._begin(int(order[there.argmax()]))

    def _can_reach(self, views: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of some views have not failed and can be reached."""
        there = ~self._failed[views]
        if callable(self._reachable):
            poses = self.poses
            for k in np.flatnonzero(there):
                there[k] = _truth(self._reachable(poses[views[k]]))
        elif self._reachable is not None:
            there &= self._reachable[views]
        return there

    def _constrain(self, state: EpisodeState) -> EpisodeState:
        """The state with where the robot can go, and what that costs."""
        views = np.flatnonzero(state.free[0])
        views = views[self._can_reach(views)]
        cost, cells = None, travel_from(self.sphere, state)[0]
        if self._travel_cost is not None:
            if callable(self._travel_cost):
                poses = self.poses
                cost = np.array([_seconds(self._travel_cost(self._here, poses[view])) for view in views], np.float64)
            else:
                cost = self._travel_cost[state.current[0], views]
            views, cost = views[cost < np.inf], cost[cost < np.inf]
        reachable = np.zeros(len(self.sphere), bool)
        reachable[views] = True
        if reachable[state.free[0]].all() and cost is None:
            return state
        if cost is not None:
            unit = cells[views].mean() / cost.mean() if len(cost) and cost.mean() > 0 else 0.0
            cells = np.full(len(self.sphere), np.nan)
            cells[views] = unit * cost
            state = replace(state, travel=cells[None])
        return replace(state, reachable=reachable[None])

    # What is seen

    def update(self, seen: Observation | Frame) -> View:
        """Take in what was seen, from ``pose``, from ``target`` or from anywhere else: its own pose counts.

        Where this raises, nothing is taken in: the session is as it was, and goes on with the next view.

        Args:
            seen: an observation in the object frame; or a frame of a depth camera in the world. If a frame shows better
                where the object is, the earlier ones are expressed anew, and ``views`` with them: all but what was
                chosen after them, and what they were doubted for.

        Raises:
            SessionError: the episode has ended, or a session mixes frames and observations.
            ObservationError: the object is not found in the frame, or the image does not suit the networks.
            PolicyError: the policy failed.
        """
        if self.done:
            raise SessionError("this session has ended; begin another one")
        of_kind(seen, Observation | Frame, "what a camera gave is an Observation, or a Frame", ObservationError)
        with _blas().limit(limits=1):
            view = self._update(seen)
        self._tell_observers()
        return view

    def _tell_observers(self) -> None:
        for observer in self.observers:
            observer(self)

    def _update(self, seen: Observation | Frame) -> View:
        if isinstance(seen, Frame):
            if self.object is None:
                if self.views:
                    raise SessionError("this session has taken observations; begin another one for frames")
                from nextview.sensing.observed_object import ObservedObject

                with self._undone_by_errors():
                    self.object = ObservedObject()
                    return self._add(seen)
            if len(self.object.sightings) != self._before + len(self.views):
                raise SessionError("frames were added to this object outside of the session; begin another one")
            with self._undone_by_errors(), self.object.undone_by_errors():
                return self._add(seen)
        if self.object is not None:
            raise SessionError("this session takes frames: it has an observed object")
        doubts = check_observation(seen)
        for view in self.views[-CONTRADICTABLE:]:
            doubts = doubts or check_views(view.observation, seen)
        with self._undone_by_errors():
            return self._take([*(view.observation for view in self.views), seen], doubts, seen.pose)

    def _add(self, frame: Frame) -> View:
        assert self.object is not None
        self.object.add(frame)
        return self._take(self.object.observations[self._before :], self.object.doubts, frame.camera_to_world)

    def _take(self, observations: Sequence[Observation], doubts: Sequence[Doubt], here: Float) -> View:
        """Take in the last of some observations, and whichever of the others has changed."""
        last, self._here = len(observations) - 1, here
        asked = self.sphere.directions[self.view] if self.views or self.object is None or self.object.known else None
        changed = [k for k in range(last) if observations[k] is not self.views[k].observation] + [last]
        evidence, new = (
            [*self._evidence, Evidence(np.zeros((1, 1)))],
            self.models.evidence([observations[k] for k in changed]),
        )
        for row, k in enumerate(changed):
            evidence[k] = new.of([row])
        directions = [self._snapped(direction_of(observation.pose)) for observation in observations]
        episodes = self._episodes
        if changed != [last]:
            episodes = self._begin(self.view)
            for each, direction in zip(evidence[:-1], directions, strict=False):
                episodes.take(each, direction[None])
        step = episodes.update(evidence[-1], directions[-1][None], self._constrain)
        to = int(step.next_views[0])
        travel = self._travelled([int(step.views[0]) for step in episodes.steps], directions)
        views = list(self.views)
        for k in changed:
            seen = self._view(episodes.steps[k], observations[k], directions[k], travel[k])
            if k < last:
                was = views[k]
                views[k] = replace(
                    seen, next_view=was.next_view, values=was.values, doubts=was.doubts, degrees_off=was.degrees_off
                )
            else:
                views.append(
                    replace(
                        seen,
                        next_view=None if to < 0 else to,
                        values=self._values(step, to < 0),
                        doubts=tuple(doubts),
                        degrees_off=0.0 if asked is None else float(np.degrees(angle_between(asked, directions[k]))),
                    )
                )
        self._episodes, self._evidence, self.views = episodes, evidence, views
        return views[-1]

    def _view(self, step: Step, observation: Observation, direction: Float, travel: tuple[float, float]) -> View:
        """What a step says of its view, but for what was chosen after it."""
        calibration, (view, there) = self._episodes.calibration, self.sphere.nearest(direction)
        azimuth = self.sphere.turn[[view]] if there else turn_of(direction[None])
        azimuth_bins = calibration.azimuth_bins(step.total, np.maximum(step.seen, 1), len(self.models.classes), azimuth)
        return View(
            int(step.views[0]),
            observation,
            fuse(step.evidence.logits[:, None], calibration.temperature_after(1))[0],
            step.belief[0],
            {name: values[0] for name, values in step.evidence.maps.items()},
            None,
            *travel,
            direction,
            None if azimuth_bins is None else azimuth_bins[0],
            None,
            float(step.evidence.novelty[0]) if step.evidence.novelty is not None and observation.seen else None,
        )

    def _snapped(self, direction: Float) -> Float:
        view, there = self.sphere.nearest(direction)
        return self.sphere.directions[view] if there else direction

    def _travelled(self, views: Sequence[int], directions: Sequence[Float]) -> list[tuple[float, float]]:
        """Cells and radians on the way to each view, from the places where the camera stood."""
        at = [np.array_equal(d, self.sphere.directions[view]) for view, d in zip(views, directions, strict=True)]
        found = [(0.0, 0.0)]
        for k in range(1, len(views)):
            travel, arc = found[-1]
            if at[k - 1] and at[k]:
                travel += float(self.sphere.travel[views[k - 1], views[k]])
                arc += float(self.sphere.arc[views[k - 1], views[k]])
            else:
                travel += float(self.sphere.travel_between(directions[k - 1], directions[k]))
                arc += float(angle_between(directions[k - 1], directions[k]))
            found.append((travel, arc))
        return found

    @contextmanager
    def _undone_by_errors(self) -> Iterator[None]:
        """Whatever changes within the block is as if it had not, to the last random number, if the block raises."""
        before, drawn = dict(vars(self)), self._rng.bit_generator.state
        try:
            yield
        except BaseException:
            vars(self).update(before)
            self._rng.bit_generator.state = drawn
            raise

    def run(self, camera: Camera | FrameCamera, lap: Callable[[str], None] = lambda done: None) -> Recognition:
        """Go on to the end with a camera that goes where it is told, or to where the camera has no view left to offer.

        Args:
            camera: looks.
            lap: is told what was done, "looking" or "thinking", whenever it is: to time it.

        Raises:
            ObservationError: the camera gives what cannot be used, or has not a single view (``NoViewLeftError``).
            UsageError: it is no camera.
        """
        if not hasattr(camera, "observe"):
            raise UsageError(f"a camera has observe(pose), and {as_line(camera)} has not")
        while not self.done:
            try:
                seen = camera.observe(self.pose)
            except NoViewLeftError:
                if not self.views:
                    raise
                self.reachable = np.zeros(len(self.sphere), bool)
                break
            lap("looking")
            try:
                self.update(seen)
            except ObservationError as error:
                if not isinstance(camera, FrameCamera):
                    raise
                camera.refused(error)
            lap("thinking")
        return self.result

    def _values(self, step: Step, ended: bool) -> Float | None:
        """What the policy valued the views at when it chose."""
        if ended or step.state is None or not isinstance(self.policy, ValuesViews):
            return None
        assert isinstance(self._chooser, ValuesViews)
        name = type(self.policy).__name__
        with own_code(lambda said: PolicyError(f"policy {name}, asked what it values views at, raised {said}")):
            values = np.asarray(self._chooser.view_values(step.state), np.float64)
        if values.shape != (1, len(self.sphere)):
            raise PolicyError(f"policy {name} values views by (B, V) numbers, here (1, {len(self.sphere)})")
        return values[0]

    @property
    def result(self) -> Recognition:
        """How it ended.

        Raises:
            SessionError: it has not.
        """
        confident = bool(self._episodes.outcome.confident[0])
        all_taken = len(self.views) >= min(self.stopping.max_views, len(self.sphere))
        return Recognition(
            tuple(self.views),
            self.models.classes,
            confident,
            self.sphere,
            self.stopping,
            stranded=not confident and not all_taken,
            score=self.models.recogniser.novelty,
            unknown_rate=self.unknown,
        )
