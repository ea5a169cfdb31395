"""Live use: hand in what the camera sees, get told what it is or where to look next."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nextview.belief import Stopping, fuse
from nextview.episode import Episodes, Step
from nextview.errors import SessionError, UsageError
from nextview.models.inference import Models
from nextview.novelty import Novelty
from nextview.observation import Camera, Observation
from nextview.policies.base import Policy, ValuesViews, maps_among
from nextview.viewsphere import ViewSphere

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
    azimuth_bins: NDArray[np.float64] | None = None
    values: NDArray[np.float64] | None = None
    novelty: float | None = None


@dataclass(frozen=True)
class Recognition:
    """The end of an episode.

    Attributes:
        views: in order.
        classes: their names.
        confident: whether the threshold was reached (else the views ran out); never if nothing was seen.
        sphere: the candidate viewpoints.
        stopping: the rule that ended it.
        score: tells how strange views are; None if the recogniser cannot.
        unknown_rate: the share of objects of known classes that may be taken for unknown ones; 0 to take none.
    """

    views: tuple[View, ...]
    classes: tuple[str, ...]
    confident: bool
    sphere: ViewSphere
    stopping: Stopping
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
        unknown: the share of objects of known classes that may be taken for unknown ones; 0 to take none.
    """

    def __init__(
        self,
        models: Models,
        policy: Policy,
        sphere: ViewSphere,
        start: int = 0,
        stopping: Stopping | None = None,
        rng: np.random.Generator | None = None,
        unknown: float = 0.0,
    ) -> None:
        if not 0 <= unknown < 1:
            raise UsageError(f"the rate of known objects taken for unknown ones lies from 0 to below 1, not {unknown}")
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
        self.unknown = unknown
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
            float(step.evidence.novelty[0]) if step.evidence.novelty is not None and observation.seen else None,
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
            self.models.recogniser.novelty,
            self.unknown,
        )
