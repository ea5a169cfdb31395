"""Use your own recogniser instead of a memory in the benchmark of things."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from nextview.geometry.observation import Observation
from nextview.recognition.own_recogniser import own_recogniser
from nextview.recognition.protocol import (
    JointBelief,
    JudgesTogether,
    log_evidence_of_views,
)
from nextview.types import Float, Index


@dataclass(frozen=True, eq=False)
class OwnAnswer:
    """Answer of your own recogniser, with the attributes of ``Verified`` that the benchmark uses.

    Attributes:
        belief: in each thing, (T,) float64.
        things: thing of each pose, the likeliest first, (M,) int64; empty without poses.
        poses: from the frames of the scan files to the object frame, (M, 4, 4) float64, metres.
        cameras: displacement of each pose in each view, (M, V, 3) float64, metres.
        p_value: share of known things that are explained as badly, () float64; NaN if it is not
            known.
    """

    belief: Float
    things: Index
    poses: Float
    cameras: Float
    p_value: Float


class OwnThings:
    """The classes of your own recogniser as the things of the benchmark.

    Attributes:
        recogniser: your recogniser.
        names: its classes in alphabetical order, like those of a memory, so that things with the
            same names have the same episodes.
    """

    def __init__(self, given: str) -> None:
        """Create the recogniser.

        Args:
            given: MODULE:NAME of a recogniser, or of a class or function that creates one.

        Raises:
            UsageError, ModelError: see ``own_recogniser``.
        """
        self.recogniser = own_recogniser(given)
        self._order = np.argsort(self.recogniser.classes, kind="stable")
        self.names = tuple(self.recogniser.classes[k] for k in self._order)

    def __call__(self, observations: Sequence[Observation]) -> OwnAnswer:
        """What it says of views of one thing: together if it can, else by the sum of all.

        Args:
            observations: views that show the thing, in one object frame.

        Raises:
            ModelError: its answer is invalid.
        """
        total = log_evidence_of_views(self.recogniser, observations).sum(0)
        count = len(observations)
        if isinstance(self.recogniser, JudgesTogether):
            joint = self.recogniser.together(observations, total, count)
        else:
            classes = len(self.names)
            calibration = self.recogniser.calibration
            joint = JointBelief(calibration.belief(total, count, classes))

        poses = [each for each in joint.poses if each.thing in self.names]
        moved = np.zeros((len(poses), count, 3))
        for row, each in enumerate(poses):
            if len(each.displacements) == count:
                moved[row] = each.displacements
        return OwnAnswer(
            belief=np.asarray(joint.belief, np.float64)[self._order],
            things=np.array([self.names.index(each.thing) for each in poses], np.int64),
            poses=np.array([each.pose for each in poses]).reshape(-1, 4, 4),
            cameras=moved,
            p_value=np.array(np.nan if joint.p_value is None else joint.p_value),
        )

    def p_value(
        self,
        observations: Sequence[Observation],
        found: OwnAnswer,
    ) -> float | None:
        """Return the share of known things that are explained as badly; None if not known.

        Args:
            observations: the views.
            found: its answer.
        """
        return None if np.isnan(found.p_value) else float(found.p_value)


@lru_cache(maxsize=1)
def own_things(given: str) -> OwnThings:
    """Create your own recogniser once per process; see ``OwnThings``."""
    return OwnThings(given)
