"""Recogniser of taught things by features alone, or verified by their geometry."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from copy import copy
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from nextview.errors import ModelError, ObservationError
from nextview.geometry.observation import Observation
from nextview.recognition.inference import NetworkRecogniser
from nextview.recognition.model_card import find_card
from nextview.recognition.protocol import JointBelief
from nextview.things.doubt import doubt_of
from nextview.things.expected_views import Outlook
from nextview.things.memory import TaughtRecogniser, open_memory
from nextview.things.pose_candidates import candidates_of
from nextview.things.registration import RegistrationPrior
from nextview.things.taught import TaughtThings
from nextview.things.verifier import Verified
from nextview.types import Float, Floats, Index

# derived attributes that refer back to the recogniser
MADE = ("things", "in_any_orientation")
NO_SCALE = "the scale of the views is not known in metres"
NO_NAME = "every name is ruled out"
SOME_BELIEF = 1e-12  # of a class that is not ruled out, so that some belief is left


class VerifiedRecogniser(TaughtRecogniser):
    """Recognises taught things in all views jointly, by their geometry.

    The evidence of single views, which policies use, comes from the features and sizes of the
    memory.
    """

    def __init__(self, model: str | Path, threads: int = 0) -> None:
        """Open a memory with surfaces.

        Args:
            model: name of a bundled memory, or the path of its card.
            threads: number of threads of ONNX Runtime, 0 for one on each core.

        Raises:
            ModelError: see ``open_memory``, or the memory contains no geometry.
        """
        super().__init__(model, threads)
        self.prior = RegistrationPrior()
        self.ruled_out = np.zeros(len(self.classes), bool)
        # prepared now: errors appear when the memory is opened, and the first frame is not delayed
        self.things.verifier.prepare(threads)

    def __getstate__(self) -> dict[str, Any]:
        """The attributes without those that are derived and refer back to the recogniser."""
        return {name: value for name, value in vars(self).items() if name not in MADE}

    @cached_property
    def things(self) -> TaughtThings:
        """The things of known geometry, ready for verification.

        Raises:
            ModelError: the memory contains no geometry.
        """
        found = TaughtThings.of(self)
        if found is None:
            raise ModelError(f"{self.card.card_path}: knows no geometry of its things")
        found.verifier.prior = self.prior
        return found.among(~self.ruled_out[self._labels_of(found)])

    def for_cameras(self, place: float, aim: float) -> VerifiedRecogniser:
        """The same recogniser for cameras with another pose accuracy.

        Args:
            place: standard deviation of the position of a camera along each axis, metres.
            aim: standard deviation of its viewing direction, radians.

        Returns:
            A copy that shares the memory.
        """
        other = copy(self)
        vars(other).pop("in_any_orientation", None)
        other.prior = self.prior.for_cameras(place, aim)
        other.things = self.things.with_prior(other.prior)
        return other

    @cached_property
    def in_any_orientation(self) -> VerifiedRecogniser:
        """The same recogniser for things in a gripper or in the air: the ground is ignored."""
        tilted = copy(self)
        tilted.things = self.things.in_any_orientation()
        return tilted

    def without(self, names: Collection[str]) -> VerifiedRecogniser:
        """The same recogniser for an object that is none of some classes.

        Args:
            names: of the classes.

        Returns:
            A copy that shares the memory.
        """
        other = copy(self)
        vars(other).pop("in_any_orientation", None)
        named = np.array([name in names for name in self.classes])
        other.ruled_out = self.ruled_out | named
        other.things = self.things.among(~other.ruled_out[self.labels])
        return other

    @cached_property
    def labels(self) -> Index:
        """Class of each thing of known geometry, (T,) int64."""
        return self._labels_of(self.things)

    @property
    def least_p_value(self) -> float:
        """Smallest p-value of a thing that stands as it should; 0 if residuals were not fitted."""
        residuals = self.things.residuals
        return 0.0 if residuals is None else residuals.least_p_value

    def _labels_of(self, things: TaughtThings) -> Index:
        """Class of each of some things, (T,) int64."""
        of_hypotheses = np.array(self.calibration.hypotheses)[things.rows]
        labels = np.zeros(len(things.names), np.int64)
        labels[things.owners] = of_hypotheses
        return labels

    def together(
        self,
        observations: Sequence[Observation],
        total: Floats,
        counted: int,
    ) -> JointBelief:
        """Belief about an object, given all its views.

        Args:
            observations: the views, in one object frame; each shows the object.
            total: sum of their log-evidence, (D,).
            counted: number of views.

        Returns:
            The belief in each class and the candidate poses. If the scale is not known, or no
            likely thing has known geometry, the belief by features alone and the reason.
        """
        classes = len(self.classes)
        if self.ruled_out.all():
            belief = np.full(classes, 1 / classes)
            return JointBelief(belief, p_value=0.0, why_no_pose=NO_NAME, doubt=NO_NAME)
        alone = self._allowed(self.calibration.belief(total, counted, classes))
        if any(observation.radius is None for observation in observations):
            return self._unexplained(alone, NO_SCALE)

        of_things = None  # belief by features and size
        others = np.zeros(classes)
        if self.memory.has_features:
            joint = self.calibration.joint(total, counted, classes, np.zeros(()))
            of_hypotheses = joint.sum(1)
            of_hypotheses[self.ruled_out[list(self.calibration.hypotheses)]] = 0
            of_things = self.things.of_things(of_hypotheses)
            of_hypotheses[self.things.rows] = 0
            np.add.at(others, list(self.calibration.hypotheses), of_hypotheses)
            if of_things.sum() <= 0:
                return self._unexplained(alone, self._no_geometry(alone))

        try:
            found = self.things.judge(observations, of_things)
        except ObservationError as error:
            return self._unexplained(alone, str(error))
        return self._believed(observations, found, others)

    def _allowed(self, belief: Float) -> Float:
        """A belief, (classes,), without the classes that are ruled out."""
        left = np.where(self.ruled_out, 0, np.maximum(belief, SOME_BELIEF))
        return left / left.sum() if self.ruled_out.any() else belief

    def _unexplained(self, belief: Float, why: str) -> JointBelief:
        """A belief by features and size; it is not confident if the memory has no features."""
        doubt = "" if self.memory.has_features else why
        return JointBelief(belief, why_no_pose=why, doubt=doubt)

    def _believed(
        self,
        observations: Sequence[Observation],
        found: Verified,
        others: Float,
    ) -> JointBelief:
        """Convert the belief in things to a belief in classes.

        Geometry decides among the things with known surfaces. The belief by features and size in
        all others, (classes,), stays.
        """
        belief = others.copy()
        np.add.at(belief, self.labels, (1 - others.sum()) * found.belief)
        belief /= belief.sum()

        best = int(belief.argmax())
        if best not in self.labels:
            return JointBelief(
                belief,
                why_no_pose=self._no_geometry(belief),
                found=found,
            )
        poses, camera_error = candidates_of(
            self.things,
            found,
            observations,
            self.labels,
        )

        doubt = doubt_of(
            found,
            poses,
            most_pixels(observations),
            partial(self.things.log_odds_of_stranger, observations, found),
        )
        return JointBelief(
            belief,
            poses=poses,
            camera_error=camera_error,
            p_value=self.things.p_value(observations, found),
            doubt=doubt,
            found=found,
        )

    def outlook(
        self,
        observations: Sequence[Observation],
        joint: JointBelief,
    ) -> Outlook | None:
        """The state from which the next view is chosen.

        Args:
            observations: the views, in one object frame; each shows the object.
            joint: result of ``together`` for them.

        Returns:
            The leading hypotheses and their surroundings; None without a verification by geometry.
        """
        if not isinstance(joint.found, Verified):
            return None
        return Outlook.of(self.things.verifier, joint.found, observations)

    def _no_geometry(self, belief: Float) -> str:
        """Explain why the likeliest class has no pose."""
        return f"the geometry of {self.classes[int(belief.argmax())]} is not known in metres"


def most_pixels(observations: Sequence[Observation]) -> int:
    """Number of pixels of the object in the frame that shows most of it.

    Args:
        observations: views of one object.
    """
    counts = [
        int(one.depth.astype(bool).sum()) for one in observations if one.scene is None
    ]
    for one in observations:
        if one.scene is not None:
            counts.append(int(one.scene.target.sum()) * one.scene.step**2)
    return max(counts)


def open_recogniser(model: str | Path, threads: int = 0) -> NetworkRecogniser:
    """Open a recogniser, or a memory of taught things.

    Args:
        model: name of a bundled model, or the path of its card.
        threads: number of threads; 0 for one on each core.

    Returns:
        The recogniser that the card describes.

    Raises:
        ModelError: the model is missing or damaged.
    """
    if find_card(model).memory is None:
        return NetworkRecogniser(model, threads)
    _, memory = open_memory(model)
    if memory.surfaces.counts.any():
        return VerifiedRecogniser(model, threads)
    return TaughtRecogniser(model, threads)
