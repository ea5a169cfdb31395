"""How an episode ended: the answer, how sure it is, and its picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from nextview.geometry.viewsphere import Viewpoints
from nextview.recognition.belief import Stopping
from nextview.recognition.novelty import Quantiles
from nextview.session.view import View

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Recognition:
    """The end of an episode, or how it stands; before the first view nothing is seen."""

    views: tuple[View, ...]  # in order
    classes: tuple[str, ...]  # their names
    confident: bool  # whether the threshold was reached (else the views ran out); never if nothing was seen
    sphere: Viewpoints  # the candidates
    stopping: Stopping  # the rule that ended it
    stranded: bool = False  # whether it ended because no view that was left could be reached; then it is not confident
    score: Quantiles | None = None  # gives the novelty of views; None if the recogniser has none
    unknown_rate: float = 0.0  # share of objects of known classes that may be called unknown; 0: none

    @property
    def seen(self) -> bool:
        """Whether the object was seen from any of the views."""
        return any(view.observation.seen for view in self.views)

    @property
    def novelty(self) -> float | None:
        """Share of known objects that are at least as novel (a p-value); None if the recogniser has no score.

        It holds for objects seen as the known ones were, see ``nextview.recognition.novelty``.
        """
        if self.score is None or not self.seen:
            return None
        return self.score.of_views([view.novelty for view in self.views if view.novelty is not None])

    @property
    def unknown(self) -> bool:
        """Whether the object is called one of no known class."""
        return self.novelty is not None and self.novelty < self.unknown_rate

    @property
    def most_like(self) -> str | None:
        """The class believed most, also of an unknown object; None if nothing was seen."""
        return self.classes[int(self.views[-1].belief.argmax())] if self.seen else None

    @property
    def answer(self) -> str | None:
        """The class believed most; None if nothing was seen, or the object is unknown."""
        return None if self.unknown else self.most_like

    @property
    def confidence(self) -> float:
        """The belief in the answer; 0 if there is none."""
        return 0.0 if self.answer is None else float(self.views[-1].belief.max())

    @property
    def beliefs(self) -> dict[str, float]:
        """The belief in each class by its name, over all views; empty if nothing was seen."""
        return dict(zip(self.classes, self.views[-1].belief.tolist(), strict=True)) if self.seen else {}

    @property
    def radius(self) -> float | None:
        """The object radius, metres, as it is known by now; None if the camera does not know its scale."""
        return self.views[-1].observation.radius if self.views else None

    @property
    def travel(self) -> float:
        """Of the whole episode, grid cells."""
        return self.views[-1].travel if self.views else 0.0

    def __repr__(self) -> str:
        """One line: ``chair (belief 0.998, 2 views, 1.41 cells of travel, confident)``."""
        views = f"{len(self.views)} view{'s' * (len(self.views) != 1)}, {self.travel:.2f} cells of travel"
        if not self.seen:
            return f"nothing is seen ({views})"
        if self.unknown:
            belief = self.views[-1].belief.max()
            return f"unknown (most like {self.most_like}, {belief:.2f}; novelty p {self.novelty:.3f}, {views})"
        sure = "confident" if self.confident else "not confident" + ", no other view in reach" * self.stranded
        names = dict.fromkeys(warning.name for view in self.views for warning in view.warnings)
        warnings = f", warnings: {', '.join(names)}" if names else ""
        return f"{self.answer} (belief {self.confidence:.3f}, {views}, {sure}{warnings})"

    def plot(self, path: str | Path | None = None, title: str = "") -> Figure:
        """Draw the episode: images, what the policy valued the views at, beliefs and the path on the sphere.

        With a path it is written to that file too, PNG, PDF or SVG; UsageError if it cannot be.
        """
        from nextview.session.episode_figure import draw_episode, save_figure

        heading = f"{title}: {self!r}" if title else repr(self)
        figure = draw_episode(self.views, self.classes, self.sphere, self.stopping, heading)
        if path is not None:
            save_figure(figure, Path(path))
        return figure
