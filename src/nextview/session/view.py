"""One view of a session, with its evidence and the choice of the next view."""

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
    """One view of a session, with its evidence and the choice of the next view.

    Attributes:
        index: candidate viewpoint of the view, or the one nearest to the camera position.
        observation: image of the object.
        alone: belief from this view alone, (classes,), by features if views are judged jointly by
            geometry; defined even if nothing is visible.
        belief: fused belief over all views so far, (classes,).
        maps: predicted local maps by name, each (rings, 3).
        next_view: index of the next view; None if the episode ends.
        travel: so far, grid cells.
        arc: so far, radians.
        direction: unit vector from the object to the camera, (3,).
        azimuth_bins: belief, over all views, in the azimuth of this view, for each class in even
            steps, (classes, azimuth bins); None if the recogniser has no azimuth output.
        values: value of each candidate view according to the policy, (V,), NaN if not considered;
            None at the end, and for policies without values.
        score: novelty; None if nothing is visible or the recogniser has no novelty score.
        warnings: likely problems of the view; usually empty.
        degrees_off: angle between the requested view and the actual camera position; 0 for a first
            frame.
        joint: joint belief from all views up to this one, with poses in the object frame as
            estimated then; None if views are judged separately, or nothing was visible.

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
        """Elevation and azimuth of the camera, degrees."""
        return float(np.degrees(elevation_of(self.direction))), float(
            np.degrees(azimuth_of(self.direction))
        )


def is_doubtful(warned: Sequence[Sequence[ViewWarning]]) -> bool:
    """Return True if the warnings of some views rule out a confident answer.

    Args:
        warned: the warnings of each view, in order.

    Returns:
        True if a warning of the last view is blocking, or half of the views contradict others.
    """
    contradicting = sum(
        any(warning.name == "contradiction" for warning in warnings)
        for warnings in warned
    )
    last = warned[-1] if warned else ()
    return (
        any(warning.holds for warning in last) or 2 * contradicting >= len(warned) > 0
    )
