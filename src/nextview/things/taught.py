"""A memory of taught things with their surfaces: from observations to names and poses."""

from collections.abc import Sequence
from copy import copy
from dataclasses import fields

import numpy as np

from nextview.errors import ModelError, ObservationError
from nextview.geometry.observation import Observation
from nextview.recognition.model_card import Verification
from nextview.recognition.protocol import log_evidence_of_views
from nextview.things.depth_view import MetricImage
from nextview.things.memory import TaughtRecogniser
from nextview.things.registration import RegistrationPrior
from nextview.things.surface import Surface
from nextview.things.unknown import KnownResiduals
from nextview.things.verifier import (
    FINE_SIDE,
    UNUSUAL,
    Verified,
    Verifier,
    images_of,
    rival_turns,
)
from nextview.things.weighing import EvidenceWeights
from nextview.types import Float, Floats, Mask

# Smallest object radius relative to that of the thing: a view may contain little of it.
SMALLEST_SHARE = 0.25
# largest extent of its pixels from their median, radii of the thing
LARGEST_SEEN_SHARE = 2.0
OF_ITS_PIXELS = (
    0.9  # quantile of the extent, without pixels that mix its depth with the background
)
TINY = 1e-300  # lower bound of a belief before its logarithm


class TaughtThings:
    """Recognises taught things and estimates their poses, by their geometry.

    Attributes:
        recogniser: memory of their views.
        verifier: verifier of their surfaces.
        names: names of the things, in the order of ``Verified.belief``.
        residuals: residuals of known things, in the same order; None if they were not fitted.
        symmetries: symmetries of each thing, in the same order.
        upright: whether each thing is known in its upright pose only, in the same order.
        any_orientation: whether all orientations are equally likely, not only resting poses.
        rows: resting poses in the memory that belong to these things, (R,) int64.
        owners: thing of each of these resting poses, (R,) int64.
        of_classes: whether a class of the memory has several things.
    """

    def __init__(
        self,
        recogniser: TaughtRecogniser,
        surfaces: Sequence[Surface],
        weights: EvidenceWeights = EvidenceWeights(),
        residuals: KnownResiduals | None = None,
    ) -> None:
        """Combine a memory and surfaces of its things, or of some of them.

        Args:
            recogniser: memory of the things.
            surfaces: surfaces of the things to be recognised, with their names in the memory.
            weights: weights of outlines, size and geometry.
            residuals: residuals of known things, in the order of the surfaces.

        Raises:
            ModelError: there is no surface, or one of a thing that is not in the memory.
        """
        about = recogniser.card.memory
        assert about is not None
        known = {thing.name: number for number, thing in enumerate(about.things)}
        self.names = tuple(surface.name for surface in surfaces)
        strange = sorted(set(self.names) - set(known))
        if strange or not surfaces:
            what = f"{strange[0]} is none of them" if strange else "no surface is given"
            raise ModelError(f"a memory of {len(known)} things: {what}")

        memory = recogniser.memory
        number = {known[name]: k for k, name in enumerate(self.names)}
        rows = [
            row for row, thing in enumerate(memory.thing.tolist()) if thing in number
        ]
        labels = np.array(recogniser.calibration.hypotheses)[
            np.unique(memory.thing, return_index=True)[1]
        ]
        self.of_classes = len(np.unique(labels)) < len(labels)
        self.rows = np.array(rows)
        self.owners = np.array([number[int(memory.thing[row])] for row in rows])
        self.recogniser = recogniser
        self.residuals = residuals
        self.symmetries = tuple(
            about.things[known[name]].symmetries for name in self.names
        )
        self.upright = tuple(about.things[known[name]].upright for name in self.names)
        self.verifier = Verifier(surfaces, weights)
        self.verifier.rivals = tuple(
            rival_turns(about.things[known[name]].near_symmetries)
            for name in self.names
        )
        self.any_orientation = False

    @classmethod
    def of(cls, recogniser: TaughtRecogniser) -> "TaughtThings | None":
        """Combine a memory and its own surfaces.

        Args:
            recogniser: memory of the things.

        Returns:
            All things of known geometry; None if the memory contains none.

        Raises:
            ModelError: this version does not support the fitted weights.
        """
        about = recogniser.card.memory
        assert about is not None
        stored = recogniser.memory.surfaces
        known = [k for k in range(len(stored)) if stored.counts[k, 0]]
        if not known:
            return None

        surfaces = [stored.surface(k, about.things[k].name) for k in known]
        some = [surface for surface in surfaces if surface is not None]
        if about.verification is None:
            return cls(recogniser, some)
        where = str(recogniser.card.card_path)
        weights = weights_of(about.verification, where)
        return cls(recogniser, some, weights, residuals_of(about.verification, known))

    def with_prior(self, prior: RegistrationPrior) -> "TaughtThings":
        """The same things for cameras with another prior.

        Args:
            prior: prior of the registration.

        Returns:
            A copy that shares the surfaces.
        """
        other = copy(self)
        other.verifier = copy(self.verifier)
        other.verifier.prior = prior
        return other

    def among(self, things: Mask) -> "TaughtThings":
        """The same things, of which an object can only be some.

        Args:
            things: those that it may be, (T,) bool.

        Returns:
            A copy that shares the surfaces.
        """
        other = copy(self)
        other.verifier = copy(self.verifier)
        other.verifier.among = things
        return other

    def in_any_orientation(self) -> "TaughtThings":
        """The same things in a gripper, leaning or in the air: they need not rest.

        Returns:
            A copy that shares the surfaces.
        """
        tilted = copy(self)
        tilted.any_orientation = True
        return tilted

    def __call__(self, observations: Sequence[Observation]) -> Verified:
        """Recognise the thing in some views.

        Args:
            observations: views of one thing in one object frame. Views that do not show it are
                ignored.

        Returns:
            The belief in each thing, and the poses.

        Raises:
            ObservationError: no view shows the thing, or its scale is not known.
        """
        seen = [observation for observation in observations if observation.seen]
        if not seen:
            raise ObservationError(
                "no view shows the thing, so nothing can be recognised"
            )
        if not self.of_classes:
            return self.judge(seen)
        calibration = self.recogniser.calibration
        classes = len(self.recogniser.classes)
        total = self.log_evidence(seen).sum(0)
        joint = calibration.joint(total, len(seen), classes, np.zeros(()))
        return self.judge(seen, self.of_things(joint.sum(1)))

    def of_things(self, of_hypotheses: Float) -> Float:
        """Sum the belief in resting poses over things.

        Args:
            of_hypotheses: belief in each resting pose of the memory, (H,).

        Returns:
            Belief in each thing, (T,).
        """
        belief = np.zeros(len(self.names))
        np.add.at(belief, self.owners, of_hypotheses[self.rows])
        return belief

    def judge(
        self,
        observations: Sequence[Observation],
        by_features: Float | None = None,
    ) -> Verified:
        """Recognise the thing in some views, given the belief by features.

        Features count if a class has several things: other members of the class differ from the
        taught ones, so that geometry alone does not recognise them.

        Args:
            observations: views that show one thing, in one object frame.
            by_features: belief in each thing by features and size, (T,); None without features.

        Returns:
            The belief in each thing, and the poses.

        Raises:
            ObservationError: no view shows enough of the thing, or its scale is not known.
        """
        prior = None
        if self.of_classes and by_features is not None:
            prior = np.log(by_features / by_features.sum() + TINY)
        return self.verifier(observations, self.any_orientation, prior)

    def standing(self, thing: int) -> Floats:
        """Rotation from the axes of a thing's file to its upright pose.

        Args:
            thing: number of the thing.

        Returns:
            Rotation matrix, (3, 3).
        """
        first = self.rows[self.owners == thing][0]
        return self.recogniser.memory.rotations[first]

    def log_evidence(self, observations: Sequence[Observation]) -> Floats:
        """Log-evidence of each view by features and size, which adds up over views.

        Args:
            observations: V views.

        Returns:
            Log-evidence, (V, D).
        """
        return log_evidence_of_views(self.recogniser, observations)

    def log_odds_of_stranger(
        self,
        observations: Sequence[Observation],
        found: Verified,
    ) -> float:
        """Log-odds of a stranger of the same shape against the likeliest thing.

        Args:
            observations: the views.
            found: their verification.

        Returns:
            Log-odds, nats: positive if a stranger is likelier.
        """
        seen = [observation for observation in observations if observation.seen]
        return self.verifier.log_odds_of_stranger(
            seen,
            found,
            not self.any_orientation,
        )

    def p_value(
        self,
        observations: Sequence[Observation],
        found: Verified,
    ) -> float | None:
        """p-value of the likeliest hypothesis among known things.

        An object of a different order of magnitude than the likeliest thing gets the smallest
        p-value, whatever the residual of its few pixels. A thing that does not stand on the visible
        ground has a lower p-value, because few do not.

        Args:
            observations: the views.
            found: their verification.

        Returns:
            Between 0 and 1, small for an object that was not taught; None if the residuals of known
            things were not fitted.
        """
        if self.residuals is None:
            return None

        likeliest = int(found.things[0])
        views = found.mean.shape[1]
        radius = float(self.verifier.caster.radii[likeliest])
        whole = max(observation.radius or 0.0 for observation in observations)

        seen = max(extent(image) for image in images_of(observations))
        if whole < SMALLEST_SHARE * radius or seen > LARGEST_SEEN_SHARE * radius:
            return self.residuals.p_value(np.inf, likeliest, views)

        explained = float(found.explained[0].mean())
        noise_share = float(found.noise_share[0].mean())
        p_value = self.residuals.of_real_camera(
            found.residual,
            likeliest,
            views,
            explained,
            noise_share,
        )
        return p_value if found.stands[0] else UNUSUAL * p_value


def extent(image: MetricImage) -> float:
    """Extent of the pixels of a thing around their median.

    Args:
        image: a view of the thing.

    Returns:
        Radius, metres.
    """
    points = image.view(FINE_SIDE).thing_points
    away = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return float(np.quantile(away, OF_ITS_PIXELS))


def weights_of(verification: Verification, where: str) -> EvidenceWeights:
    """The weights on a card; missing ones have their defaults.

    Args:
        verification: fits on the card.
        where: path of the card, for error messages.

    Returns:
        The weights.

    Raises:
        ModelError: this version does not support one of the weights, or one is out of range.
    """
    strange = sorted(
        set(verification.weights) - {field.name for field in fields(EvidenceWeights)}
    )
    if strange:
        raise ModelError(
            f"{where}: has a weight {strange[0]}, which this version does not support"
        )
    for share in ("correlation", "doubt"):
        value = verification.weights.get(share, 0)
        if value > 1:
            raise ModelError(
                f"{where}: its {share} is {value:g}, and a share is at most 1"
            )
    return EvidenceWeights(**verification.weights)


def residuals_of(
    verification: Verification,
    things: Sequence[int],
) -> KnownResiduals | None:
    """The residuals of known things on a card, for some of its things.

    Args:
        verification: fits on the card.
        things: indices of the things.

    Returns:
        The residuals; None if the card contains none.
    """
    if not verification.usual:
        return None
    usual = np.array(verification.usual)[list(things)]
    return KnownResiduals(usual, tuple(np.array(row) for row in verification.excess))
