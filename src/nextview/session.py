"""Live use: hand in what the camera sees, get told what it is or where to look next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.belief import Stopping, fuse
from nextview.episode import Episodes
from nextview.errors import SessionError
from nextview.models.inference import Models
from nextview.observation import Camera, Observation
from nextview.policies.base import Policy, maps_among
from nextview.viewsphere import ViewSphere


@dataclass(frozen=True)
class View:
    """One view and what followed from it.

    Attributes:
        index: the candidate viewpoint it was taken from.
        observation: what was seen.
        alone: belief by this view alone, (classes,) float64; the same for all classes if nothing is seen in it.
        belief: fused over all views so far, (classes,) float64.
        maps: predicted local maps by name, each (rings, 3).
        next_view: where to look next; None where the episode ends.
        travel: so far, in grid cells.
        arc: so far, in radians.
        azimuth_bins: belief, over all views, in the side of the object that is seen from here, for each class,
            (classes, azimuth bins), in even steps of azimuth; None if the recogniser was not taught them.
    """

    index: int
    observation: Observation
    alone: NDArray[np.float64]
    belief: NDArray[np.float64]
    maps: dict[str, NDArray[np.floating]]
    next_view: int | None
    travel: float
    arc: float
    azimuth_bins: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Recognition:
    """The end of an episode.

    Attributes:
        views: in order.
        classes: their names.
        confident: whether the threshold was reached (else the views ran out); never if nothing was seen.
    """

    views: tuple[View, ...]
    classes: tuple[str, ...]
    confident: bool

    @property
    def seen(self) -> bool:
        """Whether the object was seen from any of the views."""
        return any(view.observation.seen for view in self.views)

    @property
    def answer(self) -> str | None:
        """The class believed most; None if nothing was seen."""
        if not self.seen:
            return None
        return self.classes[int(self.views[-1].belief.argmax())]

    @property
    def confidence(self) -> float:
        """The belief in the answer; 0 if there is none."""
        return float(self.views[-1].belief.max()) if self.seen else 0.0

    @property
    def travel(self) -> float:
        """Of the whole episode, in grid cells."""
        return self.views[-1].travel


class Session:
    """One object under way; the caller moves the camera.

    >>> session = Session(models, policy, sphere, start=0)                      # doctest: +SKIP
    >>> while not session.done:                                                 # doctest: +SKIP
    ...     view = session.update(my_camera.observe(session.pose))

    Args:
        models: recogniser and map networks.
        policy: chooses the next view.
        sphere: the viewpoints.
        start: the first view.
        stopping: when to stop.
        rng: for policies that draw; seed 0 by default.
    """

    def __init__(
        self,
        models: Models,
        policy: Policy,
        sphere: ViewSphere,
        start: int = 0,
        stopping: Stopping = Stopping(),
        rng: np.random.Generator | None = None,
    ) -> None:
        if "azimuth_bins" in policy.needs and not models.recogniser.azimuth_bins:
            raise SessionError(
                "this policy wants to know the azimuth bin that is seen, and the recogniser was not taught it"
            )
        missing = [name for name in maps_among(policy.needs) if name.removesuffix("-sphere") not in models.maps]
        if missing:
            raise SessionError(f"this policy needs the map {missing[0]!r}; load it with the models")
        self.models, self.sphere = models, sphere
        self.views: list[View] = []
        rng = rng or np.random.default_rng(0)
        calibration = models.recogniser.calibration
        self._episodes = Episodes(sphere, policy, np.array([start]), stopping, rng, calibration)

    @property
    def done(self) -> bool:
        """Whether the episode has ended."""
        return len(self._episodes.running) == 0

    @property
    def view(self) -> int:
        """Where to look now."""
        return int(self._episodes.current[0])

    @property
    def pose(self) -> NDArray[np.float64]:
        """Where to look now, as a camera-to-world pose (4, 4), OpenCV axes, object radii."""
        return self.sphere.poses[self.view]

    def update(self, observation: Observation) -> View:
        """Take in what was seen from ``pose``. Where this raises, nothing is taken in: the same view can be told again.

        Raises:
            SessionError: the episode has ended.
            ObservationError: the image does not suit the networks.
        """
        if self.done:
            raise SessionError("this session has ended; begin another one")
        step = self._episodes.update(self.models.evidence([observation]))
        here, to = int(step.views[0]), int(step.next_views[0])
        travel, arc = (self.views[-1].travel, self.views[-1].arc) if self.views else (0.0, 0.0)
        if self.views:
            travel += float(self.sphere.travel[self.views[-1].index, here])
            arc += float(self.sphere.arc[self.views[-1].index, here])
        calibration, azimuth = self._episodes.calibration, self.sphere.turn[step.views]
        azimuth_bins = calibration.azimuth_bins(step.total, np.maximum(step.seen, 1), len(self.models.classes), azimuth)
        view = View(
            here,
            observation,
            fuse(step.evidence.logits[:, None], self._episodes.calibration.temperature_after(1))[0],
            step.belief[0],
            {name: values[0] for name, values in step.evidence.maps.items()},
            None if to < 0 else to,
            travel,
            arc,
            None if azimuth_bins is None else azimuth_bins[0],
        )
        self.views.append(view)
        return view

    @property
    def result(self) -> Recognition:
        """How it ended.

        Raises:
            SessionError: it has not.
        """
        return Recognition(tuple(self.views), self.models.classes, bool(self._episodes.outcome.confident[0]))


def recognise(
    camera: Camera,
    models: Models,
    policy: Policy,
    sphere: ViewSphere,
    start: int = 0,
    stopping: Stopping = Stopping(),
    rng: np.random.Generator | None = None,
) -> Recognition:
    """Look at an object until its class is believed or the views run out. Arguments as for ``Session``."""
    session = Session(models, policy, sphere, start, stopping, rng)
    while not session.done:
        session.update(camera.observe(session.pose))
    return session.result
