"""One view of a session, and what followed from it."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from nextview.geometry.observation import Observation
from nextview.geometry.viewsphere import azimuth_of, elevation_of
from nextview.recognition.novelty import ViewScore, values_of
from nextview.recognition.protocol import JointBelief
from nextview.sensing.view_warning import ViewWarning
from nextview.types import Float, Floats


@dataclass(frozen=True)
class View:
    """One view and what followed from it.

    Attributes:
        index: candidate viewpoint that it was taken from, or the nearest one to where the camera
            stood.
        observation: what was seen.
        alone: belief by this view alone, (classes,), by features where the geometry of all views is
            judged together; even if nothing is seen in it.
        belief: fused over all views so far, (classes,).
        maps: predicted local maps by name, each (rings, 3).
        next_view: where to look next; None where the episode ends.
        travel: so far, grid cells.
        arc: so far, radians.
        direction: unit vector from the object to where the camera stood, (3,).
        azimuth_bins: Belief, over all views, in the azimuth from which the object is seen here, for
            each class, in even steps, (classes, azimuth bins); None if the recogniser does not
            tell.
        values: What the policy valued each candidate view at, (V,), NaN if not considered; None at
            the end, and for policies that value nothing.
        score: how novel it is; None if nothing is seen in it, or the recogniser has no score.
        warnings: what is likely to be wrong with the view; usually nothing.
        degrees_off: between the view that was asked for and where the camera stood; 0 for a first
            frame.
        joint: What all views up to this one say together, its poses in the object frame as it was
            known then; None where the recogniser judges views one by one, or nothing was seen.

    Example:
        >>> view = nextview.recognise(sample_mesh("chair"), start=3).views[0]
        >>> view.index, view.belief.shape
        (3, (10,))
    """

    index: int
    observation: Observation = field(repr=False)
    alone: Float = field(repr=False)
    belief: Float = field(repr=False)
    maps: dict[str, Floats] = field(repr=False)
    next_view: int | None
    travel: float
    arc: float
    direction: Float
    azimuth_bins: Float | None = field(default=None, repr=False)
    values: Float | None = field(default=None, repr=False)
    score: ViewScore | None = field(default=None, repr=False)
    warnings: tuple[ViewWarning, ...] = ()
    degrees_off: float = 0.0
    joint: JointBelief | None = field(default=None, repr=False)

    @property
    def novelty(self) -> float | None:
        """Novelty score of this view, computed when it is first used; None without a score."""
        return None if self.score is None else values_of([self.score])[0]

    @property
    def angles(self) -> tuple[float, float]:
        """(elevation, azimuth) of where the camera stood, degrees."""
        return float(np.degrees(elevation_of(self.direction))), float(
            np.degrees(azimuth_of(self.direction))
        )


def is_doubtful(warned: Sequence[Sequence[ViewWarning]]) -> bool:
    """Whether no answer is confident by some views, whatever they show.

    Args:
        warned: the warnings of each view, in order.

    Returns:
        Whether a warning of the last one holds, or half of the views contradict others.
    """
    contradicting = sum(
        any(warning.name == "contradiction" for warning in warnings)
        for warnings in warned
    )
    last = warned[-1] if warned else ()
    return (
        any(warning.holds for warning in last) or 2 * contradicting >= len(warned) > 0
    )
