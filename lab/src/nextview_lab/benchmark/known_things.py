"""The recogniser of the benchmark of things: a memory of taught things, or one of your own."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from nextview.errors import UsageError
from nextview.geometry.observation import Observation
from nextview.recognition.model_card import find_models
from nextview.recognition.own_recogniser import own_recogniser
from nextview.recognition.protocol import (
    JointBelief,
    JudgesTogether,
    LooksAhead,
    Recogniser,
    log_evidence_of_views,
)
from nextview.things.expected_views import Outlook
from nextview.things.recogniser import VerifiedRecogniser, open_recogniser
from nextview.things.surface import Surface
from nextview.types import Float, Index


@dataclass(frozen=True, eq=False)
class Answer:
    """What a recogniser says of some views.

    Attributes:
        belief: in each thing, (T,) float64.
        things: thing of each pose, the likeliest first, (M,) int64; empty without poses.
        poses: from the frames of the scan files to the object frame, (M, 4, 4) float64, metres.
        p_value: value of the test for unknown things, () float64; NaN if it is not known.
    """

    belief: Float
    things: Index
    poses: Float
    p_value: Float


class KnownThings:
    """The things that a recogniser knows.

    Attributes:
        recogniser: the recogniser.
        names: its classes in alphabetical order, so that things with the same names have the same
            episodes.
        memory: the same recogniser, of taught things; None for one of your own.
    """

    def __init__(self, recogniser: Recogniser) -> None:
        """Use a recogniser.

        Args:
            recogniser: a memory of taught things of known geometry, or one of your own.
        """
        self.recogniser = recogniser
        self._order = np.argsort(recogniser.classes, kind="stable")
        self.names = tuple(recogniser.classes[k] for k in self._order)
        self.memory = recogniser if isinstance(recogniser, VerifiedRecogniser) else None

    def surface(self, thing: int) -> Surface | None:
        """Return the taught surface of a thing; None for a recogniser of your own."""
        if self.memory is None:
            return None
        library = self.memory.library
        return library.caster.surfaces[library.names.index(self.names[thing])]

    def __call__(self, observations: Sequence[Observation]) -> Answer:
        """What it says of views of one thing: together if it can, else by the sum of all.

        Args:
            observations: views that show the thing, in one object frame.

        Raises:
            ModelError: its answer is invalid.
        """
        joint = self._together(observations)
        poses = [each for each in joint.poses if each.thing in self.names]
        return Answer(
            belief=np.asarray(joint.belief, np.float64)[self._order],
            things=np.array([self.names.index(each.thing) for each in poses], np.int64),
            poses=np.array([each.pose for each in poses]).reshape(-1, 4, 4),
            p_value=np.array(np.nan if joint.p_value is None else joint.p_value),
        )

    def _together(self, observations: Sequence[Observation]) -> JointBelief:
        """What it says of views of one thing: together if it can, else by the sum of all."""
        total = log_evidence_of_views(self.recogniser, observations).sum(0)
        count = len(observations)
        if isinstance(self.recogniser, JudgesTogether):
            return self.recogniser.together(observations, total, count)
        calibration = self.recogniser.calibration
        return JointBelief(calibration.belief(total, count, len(self.names)))

    def outlook(self, observations: Sequence[Observation]) -> Outlook | None:
        """Return the prediction of further views; None where nothing can be foreseen.

        Args:
            observations: views that show the thing, in one object frame.
        """
        if not isinstance(self.recogniser, LooksAhead):
            return None
        found = self.recogniser.outlook(observations, self._together(observations))
        assert found is None or isinstance(found, Outlook)
        return found


@lru_cache(maxsize=1)
def things_of(models: str, given: str | None) -> KnownThings:
    """Open the things of a memory, or of your own recogniser, once per process.

    Args:
        models: folder or name of the memory.
        given: MODULE:NAME of your own recogniser; None for the memory.

    Raises:
        UsageError: the memory knows no geometry, or there is no such recogniser.
        ModelError: the memory or the recogniser cannot be opened.
    """
    if given is not None:
        return KnownThings(own_recogniser(given))
    recogniser = open_recogniser(find_models(models).recogniser, threads=1)
    if not isinstance(recogniser, VerifiedRecogniser):
        raise UsageError(
            f"{models}: knows the geometry of no thing; teach it with --unit"
        )
    return KnownThings(recogniser)
