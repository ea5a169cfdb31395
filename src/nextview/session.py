"""Live use: hand in what the camera sees, get told what it is or where to look next."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nextview.belief import Stopping, fuse
from nextview.episode import Episodes, Step
from nextview.errors import SessionError
from nextview.models.inference import Models
from nextview.observation import Camera, Observation
from nextview.policies.base import Policy, ValuesViews, maps_among
from nextview.viewsphere import ViewSphere, degrees_between

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
        azimuth_bins: belief, over all views, in the azimuth from which the object is seen here, for each class,
            (classes, azimuth bins), in even steps; None if the recogniser was not taught them.
        values: what the policy valued each candidate view at, (V,) float64, NaN for those that it did not consider;
            None where the episode ends, and for policies that value nothing.
        degrees_off: angle at the object between the candidate viewpoint and where the observation was taken from.
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
    values: NDArray[np.float64] | None = None
    degrees_off: float = 0.0


@dataclass(frozen=True)
class Recognition:
    """The end of an episode.

    Attributes:
        views: in order.
        classes: their names.
        confident: whether the threshold was reached (else the views ran out); never if nothing was seen.
        sphere: the candidate viewpoints.
        stopping: the rule that ended it.
    """

    views: tuple[View, ...]
    classes: tuple[str, ...]
    confident: bool
    sphere: ViewSphere
    stopping: Stopping

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

    def __repr__(self) -> str:
        """One line: ``chair (belief 0.998, 2 views, 1.41 cells of travel, confident)``."""
        views = f"{len(self.views)} view{'s' * (len(self.views) > 1)}, {self.travel:.2f} cells of travel"
        if self.answer is None:
            return f"nothing is seen ({views})"
        sure = "confident" if self.confident else "not confident"
        return f"{self.answer} (belief {self.confidence:.3f}, {views}, {sure})"

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


class Session:
    """One object under way; the caller moves the camera.

    >>> session = nextview.load().session()                                     # doctest: +SKIP
    >>> while not session.done:                                                 # doctest: +SKIP
    ...     view = session.update(my_camera.observe(session.pose))
    >>> session.result                                                          # doctest: +SKIP

    Args:
        models: recogniser and map networks.
        policy: chooses the next view.
        sphere: the viewpoints.
        start: the first view.
        stopping: when to stop; by default the rule that goes with the recogniser, see ``Stopping.of``.
        rng: for policies that draw; seed 0 by default.
    """

    def __init__(
        self,
        models: Models,
        policy: Policy,
        sphere: ViewSphere,
        start: int = 0,
        stopping: Stopping | None = None,
        rng: np.random.Generator | None = None,
    ) -> None:
        if "azimuth_bins" in policy.needs and not models.recogniser.azimuth_bins:
            raise SessionError(
                "this policy wants to know the azimuth bin that is seen, and the recogniser was not taught it"
            )
        missing = [name for name in maps_among(policy.needs) if name.removesuffix("-sphere") not in models.maps]
        if missing:
            raise SessionError(f"this policy needs the map {missing[0]!r}; load it with the models")
        self.models, self.policy, self.sphere = models, policy, sphere
        self.views: list[View] = []
        rng = rng or np.random.default_rng(0)
        calibration = models.recogniser.calibration
        self.stopping = stopping or Stopping.of(calibration)
        self._episodes = Episodes(sphere, policy, np.array([start]), self.stopping, rng, calibration)

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
            self._values(step),
            degrees_between(self.sphere.directions[here], observation.pose[:3, 3]),
        )
        self.views.append(view)
        return view

    def run(self, camera: Camera) -> Recognition:
        """Go on to the end with a camera that goes where it is told."""
        while not self.done:
            self.update(camera.observe(self.pose))
        return self.result

    def _values(self, step: Step) -> NDArray[np.float64] | None:
        """What the policy valued the views at when it chose."""
        if step.state is None or not isinstance(self.policy, ValuesViews):
            return None
        return self.policy.view_values(step.state)[0]

    @property
    def result(self) -> Recognition:
        """How it ended.

        Raises:
            SessionError: it has not.
        """
        return Recognition(
            tuple(self.views),
            self.models.classes,
            bool(self._episodes.outcome.confident[0]),
            self.sphere,
            self.stopping,
        )
