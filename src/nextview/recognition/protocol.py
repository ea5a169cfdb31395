"""What a recogniser is: observations in, what is believed of each class out."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from nextview.checks import number
from nextview.errors import UsageError
from nextview.recognition.belief import MUCH, Calibration
from nextview.recognition.evidence import Evidence
from nextview.recognition.novelty import Quantiles
from nextview.recognition.poses import PoseCandidate
from nextview.sensing.observation import Observation
from nextview.types import Float, Floats

# factor by which an object is larger or smaller than a taught thing of which half may be hidden,
# from which it is not that thing
THING_SIZE = 1.3


@runtime_checkable
class Recogniser(Protocol):
    """Says of single views which class they speak for. What it says of several can be summed.

    The ONNX recogniser, the memory of taught things, and ``own_recogniser.OwnRecogniser`` around an
    object of yours are of this kind.

    Attributes:
        name: what to call it in messages.
        classes: names of the classes, unique.
        azimuth_bins: how many azimuths it tells apart; 0 if it tells none.
        calibration: how far the sum of what it says is to be trusted.
        novelty: how novel objects of known classes are to it; None if it does not tell.
    """

    classes: tuple[str, ...]
    azimuth_bins: int
    calibration: Calibration
    novelty: Quantiles | None

    @property
    def name(self) -> str:
        """What to call it in messages."""

    def __call__(self, observations: Sequence[Observation]) -> Evidence:
        """What each of B views speaks for.

        Args:
            observations: the views; they need not be of one object.

        Returns:
            Logits of the classes, (B, classes), and what else it knows.
        """


@dataclass(frozen=True, eq=False)
class JointBelief:
    """What all views of one object say together.

    Attributes:
        belief: in each class, (classes,) float64, sums to 1.
        poses: that the object may have, the likeliest first, in the object frame; () if none is
            known.
        camera_error: by how much errors of the cameras' places displace these poses, millimetres,
            one standard deviation.
        p_value: below the rate of the test for unknown objects the object is unknown, 0 to 1: the
            share of known objects that are explained as badly as this one, or the probability that
            the likeliest name is right; None if it is not known.
        why_no_pose: why there is no pose, in words; "" if there is one, or none was to be expected.
        doubt: why no answer is confident however high the belief, in words; "" for no such reason.
        found: what the recogniser goes by if it is asked for more; None if that is nothing.
    """

    belief: Float
    poses: tuple[PoseCandidate, ...] = ()
    camera_error: float = 0.0
    p_value: float | None = None
    why_no_pose: str = ""
    doubt: str = ""
    found: Any = None


@runtime_checkable
class JudgesTogether(Protocol):
    """A recogniser that judges all views of an object together, where a sum would not do.

    Policies still see what it says of single views.
    """

    def together(
        self,
        observations: Sequence[Observation],
        total: Floats,
        counted: int,
    ) -> JointBelief:
        """What is believed of an object.

        Args:
            observations: all views so far in which anything was seen, in one object frame; at
                least one.
            total: sum of the log-evidence of these views, (D,), see ``belief.log_evidence_of``.
            counted: number of these views.
        """


@runtime_checkable
class LooksAhead(Protocol):
    """A recogniser that judges views together, and knows what other views would show."""

    def outlook(self, observations: Sequence[Observation], joint: JointBelief) -> Any:
        """What policies that need an "outlook" are shown.

        Args:
            observations: all views so far in which anything was seen.
            joint: what they say together.

        Returns:
            A ``views.expected_views.Outlook``; None where nothing can be foreseen.
        """


@runtime_checkable
class RulesOut(Protocol):
    """A recogniser that can leave out classes: an object is none of them."""

    def without(self, names: Collection[str]) -> Recogniser:
        """The same for an object that is none of some classes; ``classes`` stay as they are.

        Args:
            names: of the classes.
        """


def tells_unknown(recogniser: Recogniser) -> bool:
    """Whether a recogniser may say that an object is of none of its classes."""
    return recogniser.novelty is not None or isinstance(recogniser, JudgesTogether)


def least_p_value(recogniser: Recogniser) -> float:
    """Smallest p-value of a recogniser's test for unknown objects; 0 if no bound is known.

    A p-value is the rank of an object among known ones, so that their number bounds it.

    Args:
        recogniser: any; one of your own that judges views together has no known bound.
    """
    if isinstance(recogniser, JudgesTogether):
        return float(getattr(recogniser, "least_p_value", 0.0))
    return 0.0 if recogniser.novelty is None else recogniser.novelty.least_p_value


def check_unknown(rate: float, recogniser: Recogniser) -> None:
    """Check the significance level of the test for unknown objects.

    Args:
        rate: p-value below which an object is called unknown; 0 disables the test.
        recogniser: whose test it is.

    Raises:
        UsageError: it is no number from 0 to below 1, or no p-value of the recogniser is as small.
    """
    what = "the share of known objects called unknown"
    if number(rate, what, 0) >= 1:
        raise UsageError(f"{what} is below 1, not {rate}")
    least = least_p_value(recogniser)
    if 0 < rate <= least:
        raise UsageError(
            f"{recogniser.name}: the share of known objects called unknown is 0 or above"
            f" {least:.4g}, the smallest p-value of these models, not {rate:g}"
        )


def classes_of_other_size(
    recogniser: Recogniser,
    radius: float | None,
) -> tuple[str, ...]:
    """Return the classes whose objects are far larger or far smaller than an object.

    The bounds of a taught thing are narrower than those of a class, whose objects differ in size.

    Args:
        recogniser: knows the sizes, or not: one of your own does not.
        radius: of the object, metres; None if it is not known.

    Returns:
        The names; none where a size is not known.
    """
    card = getattr(recogniser, "card", None)
    if card is None or card.size is None or radius is None:
        return ()
    things = bool(recogniser.calibration.hypotheses)
    wrong = card.size.impossible(radius, THING_SIZE if things else MUCH)
    return tuple(
        name for name, off in zip(recogniser.classes, wrong, strict=True) if off
    )
