"""One view of a session, with its evidence and the choice of the next view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from nextview.geometry.viewsphere import (
    Viewpoints,
    azimuth_of,
    direction_of,
    elevation_of,
)
from nextview.recognition.belief import log_evidence_of
from nextview.recognition.evidence import Evidence
from nextview.recognition.novelty import ViewScore, values_of
from nextview.recognition.protocol import JointBelief, Recogniser
from nextview.sensing.observation import Observation
from nextview.sensing.view_warning import ViewWarning
from nextview.types import Float, Floats


@dataclass(frozen=True)
class View:
    """One view of a session, with its evidence and the choice of the next view.

    Attributes:
        index: candidate viewpoint of the view, or the one nearest to the camera position.
        observation: image of the object.
        alone: belief from this view alone, (classes,), by size if views are judged jointly by
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

    @classmethod
    def of(
        cls,
        observation: Observation,
        evidence: Evidence | None,
        total: Floats | None,
        counted: float,
        sphere: Viewpoints,
        recogniser: Recogniser,
        joint: JointBelief | None = None,
    ) -> View:
        """Return a view of an object, without travel, warnings and a choice of the next view.

        Args:
            observation: of the object.
            evidence: of this view alone, one row; None if nothing is visible.
            total: sum of the log-evidence up to this view, (D,), see ``belief.log_evidence_of``;
                None before anything was visible.
            counted: number of views in the sum.
            sphere: the candidate views.
            recogniser: source of the evidence.
            joint: joint belief from all views up to this one; None if views are judged separately.
        """
        calibration = recogniser.calibration
        classes = len(recogniser.classes)
        direction = direction_of(observation.pose)
        nearest, there = sphere.nearest(direction)
        direction = sphere.directions[nearest] if there else direction
        azimuth = sphere.azimuth[[nearest]] if there else azimuth_of(direction[None])

        alone = belief = np.full(classes, 1 / classes)
        maps = {}
        if evidence is not None:
            own = log_evidence_of(evidence.logits, evidence.azimuth_bins, azimuth)
            alone = calibration.belief(own, 1, classes)[0]
            maps = {name: values[0] for name, values in evidence.maps.items()}
        bins = None
        if total is not None:
            views = np.array([max(counted, 1)])
            belief = calibration.belief(total[None], views, classes)[0]
            bins = calibration.azimuth_bins(total[None], views, classes, azimuth)
        return cls(
            nearest,
            observation,
            alone,
            belief if joint is None else joint.belief,
            maps,
            next_view=None,
            travel=0.0,
            arc=0.0,
            direction=direction,
            azimuth_bins=None if bins is None else bins[0],
            score=_score(observation, evidence, recogniser),
            joint=joint,
        )

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


def _score(
    observation: Observation,
    evidence: Evidence | None,
    recogniser: Recogniser,
) -> ViewScore | None:
    """Return the novelty score of a view; None if nothing is visible or without such a score."""
    if recogniser.novelty is None or evidence is None or not observation.seen:
        return None
    if evidence.seen is not None and not evidence.seen[0]:
        return None
    return None if evidence.novelty is None else evidence.novelty[0]


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
