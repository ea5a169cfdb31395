"""A recogniser of your own: an object, checked at the door and whenever it answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.checks import one_line, plugin, plugin_errors, whole
from nextview.errors import ModelError, NextviewError, UsageError
from nextview.recognition.belief import PLAIN_SUM, Calibration
from nextview.recognition.evidence import Evidence
from nextview.recognition.inference import NetworkRecogniser
from nextview.recognition.novelty import Quantiles
from nextview.recognition.poses import check_candidate
from nextview.recognition.protocol import JointBelief, Recogniser
from nextview.sensing.observation import Observation
from nextview.types import Floats

LEAST_CLASS_BELIEF = 1e-12  # in a class, where the logarithm of a belief is taken
SUM_ERROR = 1e-3  # by how much the sum of a belief may be off


class OwnRecogniser:
    """A recogniser of your own, which says what single views speak for.

    Attributes:
        given: the object that was handed in.
        name: the name of its class.
        classes: names of the classes.
        azimuth_bins: how many azimuths it tells apart; 0 if it tells none.
        calibration: how far the sum of what it says is to be trusted.
        novelty: how novel objects of known classes are to it; None if it does not tell.
    """

    def __init__(self, given: Any, name: str) -> None:
        """Check what is known of it before it is asked.

        Args:
            given: an object with ``classes``, that can be called with observations or has a method
                ``belief``.
            name: what to call it in messages.

        Raises:
            ModelError: an attribute that cannot be right.
        """
        self.given = given
        self.name = name
        self.classes = _names_of(given, name)
        bins = getattr(given, "azimuth_bins", 0)
        self.azimuth_bins = whole(
            bins,
            f"the number of azimuth bins of recogniser {name}",
        )
        self.calibration: Calibration = _attribute(
            given,
            name,
            "calibration",
            PLAIN_SUM,
        )

        self.novelty: Quantiles | None = _attribute(
            given,
            name,
            "novelty",
            None,
            Quantiles,
        )

    def __call__(self, observations: Sequence[Observation]) -> Evidence:
        """What each of some views speaks for.

        Raises:
            ModelError: it failed, or what it says is not of the right shape, or not finite.
        """
        with plugin_errors(self._failed):
            said = self.given(observations)
        evidence = said if isinstance(said, Evidence) else Evidence(_numbers(said))
        wanted = (len(observations), len(self.classes))
        self._check("logits", evidence.logits, wanted)
        if self.azimuth_bins:
            bins = (*wanted, self.azimuth_bins)
            self._check("azimuth bins", evidence.azimuth_bins, bins)
        if evidence.seen is not None:
            return evidence
        return replace(evidence, seen=np.array([seen.seen for seen in observations]))

    def _failed(self, said: str) -> NextviewError:
        return ModelError(f"recogniser {self.name} raised {said}")

    def _check(self, what: str, values: Any, shape: tuple[int, ...]) -> None:
        """Refuse an answer that is no array of finite numbers of this shape; ModelError."""
        array = _numbers(values)
        if array.dtype.kind not in "fiu" or array.shape != shape:
            there = f"{array.dtype} of the shape {array.shape}"
            raise ModelError(
                f"recogniser {self.name} gives {what} of {shape} numbers, not {there}"
            )
        if not np.isfinite(array).all():
            raise ModelError(
                f"recogniser {self.name} gives {what} that are not finite numbers"
            )


class OwnJointRecogniser(OwnRecogniser):
    """A recogniser of your own that judges all views of an object together."""

    def __call__(self, observations: Sequence[Observation]) -> Evidence:
        """What each of some views speaks for; by default the logarithm of the belief by it alone.

        Raises:
            ModelError: it failed, or what it says is not of the right shape, or not finite.
        """
        if callable(self.given):
            return super().__call__(observations)
        logits = np.zeros((len(observations), len(self.classes)))
        for row, observation in enumerate(observations):
            if observation.seen:
                belief = self.together([observation], logits[row], 1).belief
                logits[row] = np.log(np.maximum(belief, LEAST_CLASS_BELIEF))
        return Evidence(logits, seen=np.array([seen.seen for seen in observations]))

    def together(
        self,
        observations: Sequence[Observation],
        total: Floats,
        counted: int,
    ) -> JointBelief:
        """What all views say together.

        Args:
            observations: of one object, in one object frame; something is seen in all of them.
            total: is not used.
            counted: is not used.

        Raises:
            ModelError: it failed, or what it says is no belief in its classes.
        """
        with plugin_errors(self._failed):
            said = self.given.belief(observations)
        joint = said if isinstance(said, JointBelief) else JointBelief(_numbers(said))
        self._check("a belief", joint.belief, (len(self.classes),))
        belief = np.asarray(joint.belief, np.float64)
        if (belief < 0).any() or abs(belief.sum() - 1) > SUM_ERROR:
            what = "a belief is probabilities of the classes, which sum to 1"
            raise ModelError(
                f"recogniser {self.name}: {what}, not to {belief.sum():.4g}"
            )
        if not isinstance(joint.doubt, str):
            raise ModelError(
                f'recogniser {self.name}: a doubt is a reason in words, or "", not'
                f" {one_line(repr(joint.doubt))}"
            )
        if joint.p_value is not None and not 0 <= joint.p_value <= 1:
            raise ModelError(
                f"recogniser {self.name}: a p-value is 0 to 1, not {joint.p_value}"
            )

        try:
            poses = tuple(
                check_candidate(pose, len(self.classes)) for pose in joint.poses
            )
        except ModelError as error:
            raise ModelError(f"recogniser {self.name}: {error}") from None
        return replace(joint, belief=belief / belief.sum(), poses=poses)


def own_recogniser(given: Any) -> Recogniser:
    """Accept a recogniser of your own.

    Args:
        given: an object with ``classes``, which can be called with observations, or has a method
            ``belief``; or MODULE:NAME of one, or of a class that makes one. The package's own kinds
            are taken as they are.

    Raises:
        UsageError: a name that is not MODULE:NAME, or what it names cannot be made.
        ModelError: an object that is no recogniser.
    """
    name = type(given).__name__
    if isinstance(given, str):
        name = given
        given = _named(given)

    if isinstance(given, NetworkRecogniser | OwnRecogniser):
        return given
    if isinstance(given, type):
        raise ModelError(
            f"a recogniser is an object, not the class {given.__name__}: call it first"
        )

    if callable(getattr(given, "belief", None)):
        return OwnJointRecogniser(given, name)
    if not callable(given):
        what = "can be called with observations, or has a method belief"
        raise ModelError(f"a recogniser {what}, which {one_line(repr(given))} is not")
    return OwnRecogniser(given, name)


def _named(path: str) -> Any:
    """What MODULE:NAME names; of a class, an object of it."""
    if ":" not in path:
        raise UsageError(
            f"a recogniser of your own is named MODULE:NAME, not {one_line(repr(path))}"
        )
    with plugin_errors(
        lambda said: UsageError(f"the recogniser {path} cannot be made ({said})")
    ):
        found = plugin(path)
        return found() if isinstance(found, type) else found


def _names_of(given: Any, name: str) -> tuple[str, ...]:
    """The classes of a recogniser; ModelError if they are no names, or two are the same."""
    with plugin_errors(
        lambda said: ModelError(f"recogniser {name} has no classes ({said})")
    ):
        classes = given.classes
        names = () if isinstance(classes, str) else tuple(classes)
    if not names or not all(isinstance(each, str) and each for each in names):
        shown = one_line(repr(classes))
        raise ModelError(
            f"the classes of recogniser {name} are a tuple of names, not {shown}"
        )
    if len(set(names)) < len(names):
        raise ModelError(f"two classes of recogniser {name} have the same name")
    return names


def _attribute(
    given: Any,
    name: str,
    what: str,
    default: Any,
    kind: type | None = None,
) -> Any:
    """An attribute that need not be there; ModelError if it is not of the default's kind."""
    value = getattr(given, what, default)
    kind = kind or type(default)
    if value is not default and not isinstance(value, kind):
        shown = one_line(repr(value))
        raise ModelError(
            f"{what} of recogniser {name} is a {kind.__name__}, not {shown}"
        )
    return value


def _numbers(values: Any) -> NDArray[Any]:
    """An array; of objects where it cannot become one of numbers."""
    try:
        return np.asarray(values)
    except (ValueError, TypeError):  # rows of different lengths
        return np.asarray(None)
