"""How an episode ended: the answer, how sure it is, and its picture."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from nextview.geometry.viewsphere import Viewpoints
from nextview.recognition.belief import Stopping
from nextview.recognition.novelty import Quantiles, values_of
from nextview.session.view import View

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SUSPICIOUS = 5.0  # an object as novel as so many times the share that may be called unknown gets no confident answer


@dataclass(frozen=True)
class Recognition:
    """The end of an episode, or how it stands; before the first view nothing is seen.

    It is confident where the threshold was reached in a view without warnings, by an object that is not suspiciously
    novel (see ``SUSPICIOUS``) and may be of the class by its size, and fewer than half of the views contradict others.
    """

    views: tuple[View, ...]  # in order
    classes: tuple[str, ...]  # their names
    confident: bool  # else the views ran out
    sphere: Viewpoints  # the candidates
    stopping: Stopping  # the rule that ended it
    stranded: bool = False  # whether it ended because no view that was left could be reached; then it is not confident
    why_stranded: str = ""  # what became of the views that were left, as "30 too low, 9 failed"; "" if not stranded
    score: Quantiles | None = None  # gives the novelty of views; None if the recogniser has none
    unknown_rate: float = 0.0  # share of objects of known classes that may be called unknown; 0: none
    impossible: tuple[str, ...] = ()  # classes whose objects have not such a size

    @property
    def seen(self) -> bool:
        """Whether the object was seen from any of the views."""
        return any(view.observation.seen for view in self.views)

    @property
    def novelty(self) -> float | None:
        """Share of known objects that are at least as novel (a p-value); None if the recogniser has no score.

        It holds for objects seen as the known ones were; what is hidden of one is allowed for, see ``values_of``.
        """
        if self.score is None or not self.seen:
            return None
        views = [view.score for view in self.views if view.score is not None]
        return self.score.of_views(values_of(views, whole=not self.score.joint))

    @property
    def unknown(self) -> bool:
        """Whether the object is called one of no known class: too novel, or of another size than the class believed."""
        if not self.unknown_rate or not self.seen:
            return False
        return (self.novelty is not None and self.novelty < self.unknown_rate) or self.most_like in self.impossible

    @property
    def none_of_them(self) -> str:
        """The answer for an unknown object: ``none of the 10 classes it knows (most like a toilet)``."""
        a = "an" if str(self.most_like)[:1].lower() in "aeiou" else "a"
        return f"none of the {len(self.classes)} classes it knows (most like {a} {self.most_like})"

    @property
    def why_unknown(self) -> str:
        """What an object is called unknown for, in words."""
        if self.most_like in self.impossible:
            return f"a radius of {self.radius:.2g} m is that of no {self.most_like}"
        return f"{100 * (self.novelty or 0):.2g} % of known objects are as novel"

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
            return f"{self.none_of_them}: {self.why_unknown} ({views})"
        sure = "confident" if self.confident else "not confident"
        if self.stranded:
            sure += ", no other view in reach"
            if self.why_stranded:
                sure += f": {self.why_stranded}"
        names = dict.fromkeys(warning.name for view in self.views for warning in view.warnings)
        warnings = f", warnings: {', '.join(names)}" if names else ""
        return f"{self.answer} (belief {self.confidence:.3f}, {views}, {sure}{warnings})"

    def plot(self, path: str | Path | None = None, title: str = "") -> "Figure":
        """Draw the episode: images, what the policy valued the views at, beliefs and the path on the sphere.

        With a path it is written to that file too, PNG, PDF or SVG; UsageError if it cannot be.
        """
        from nextview.session.episode_figure import draw_episode, save_figure

        heading = f"{title}: {self!r}" if title else repr(self)
        figure = draw_episode(self.views, self.classes, self.sphere, self.stopping, heading)
        if path is not None:
            save_figure(figure, Path(path))
        return figure
