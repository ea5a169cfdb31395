"""A memory of taught things together with their surfaces: from observations to names and poses."""

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
from nextview.types import Float, Floats

# The radius of an object that a thing may have, of that of the thing: little may be taken in of it.
SMALLEST_SHARE = 0.25
# how far from their middle its pixels may lie, of the radius of the thing
LARGEST_SEEN_SHARE = 2.0
OF_ITS_PIXELS = (
    0.9  # share of its pixels, without those that mix its depth with that behind it
)
TINY = 1e-300  # belief that has a logarithm


class TaughtThings:
    """Names taught things by their geometry, and tells their poses.

    Attributes:
        recogniser: what is remembered of their views.
        verifier: their surfaces.
        names: of the things, in the order of ``Verified.belief``.
        residuals: how badly known things are explained, in the same order; None if that was not
            fitted.
        symmetries: of each thing, in the same order.
        upright: whether each thing is known only as it stands, in the same order.
        any_orientation: whether they need not rest: all orientations are equally likely.
        rows: resting poses of the memory that are of these things, (R,) int64.
        owners: which of the things each of these is of, (R,) int64.
        of_classes: whether some class of the memory has several things.
    """

    def __init__(
        self,
        recogniser: TaughtRecogniser,
        surfaces: Sequence[Surface],
        weights: EvidenceWeights = EvidenceWeights(),
        residuals: KnownResiduals | None = None,
    ) -> None:
        """Join a memory and the surfaces of its things, or of some of them.

        Args:
            recogniser: what is remembered of the things.
            surfaces: of the things that shall be recognised, by their names in the memory.
            weights: how much outlines, size and geometry count.
            residuals: how badly known things are explained, in the order of the surfaces.

        Raises:
            ModelError: a surface of a thing that the memory does not know, or none.
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
        """Join a memory and its own surfaces.

        Args:
            recogniser: what is remembered of the things.

        Returns:
            A recogniser of all things of known geometry; None if the memory holds none.

        Raises:
            ModelError: what was fitted to the surfaces is not what this version fits.
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
        """The same things, looked at by cameras whose errors have another prior."""
        other = copy(self)
        other.verifier = copy(self.verifier)
        other.verifier.prior = prior
        return other

    def in_any_orientation(self) -> "TaughtThings":
        """The same things, which may be held, lean or fly: they need not rest."""
        tilted = copy(self)
        tilted.any_orientation = True
        return tilted

    def __call__(self, observations: Sequence[Observation]) -> Verified:
        """Recognise the thing that some views show.

        Args:
            observations: views of one thing, all in one object frame. Views that do not show it are
                left out.

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
        """The belief in each thing, (T,), from that in each resting pose of the memory, (H,)."""
        belief = np.zeros(len(self.names))
        np.add.at(belief, self.owners, of_hypotheses[self.rows])
        return belief

    def judge(
        self,
        observations: Sequence[Observation],
        by_features: Float | None = None,
    ) -> Verified:
        """Recognise the thing that some views show, of which the features have been looked at.

        Features count where a class has several things: others of it differ from those that were
        taught, and geometry alone cannot tell them.

        Args:
            observations: views that show one thing, all in one object frame.
            by_features: belief in each thing by features and size, (T,); None if there are none.

        Returns:
            The belief in each thing, and the poses.
        """
        prior = None
        if self.of_classes and by_features is not None:
            prior = np.log(by_features / by_features.sum() + TINY)
        return self.verifier(observations, self.any_orientation, prior)

    def standing(self, thing: int) -> Floats:
        """Rotation of a thing from the axes of its file to how it stands there, (3, 3)."""
        first = self.rows[self.owners == thing][0]
        return self.recogniser.memory.rotations[first]

    def log_evidence(self, observations: Sequence[Observation]) -> Floats:
        """What features and size say of each view, (V, D): it can be summed over views."""
        return log_evidence_of_views(self.recogniser, observations)

    def log_odds_of_stranger(
        self,
        observations: Sequence[Observation],
        found: Verified,
    ) -> float:
        """How much likelier a stranger of its shape is than the likeliest thing.

        Args:
            observations: the views.
            found: what was found of them.

        Returns:
            Log-odds, nats: positive where another thing is likelier.
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
        """Share of known things that are explained as badly by the likeliest hypothesis.

        What is of another order of size than the likeliest thing is none of them, whatever its
        few pixels say: it gets the least p-value that there is. Few things do not stand on the
        ground that is seen below them.

        Args:
            observations: the views.
            found: what was found of them.

        Returns:
            Between 0 and 1, small for a thing that was not taught; None if it was not fitted how
            badly known things are explained.
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
    """How far from their middle the pixels of a thing lie, metres."""
    points = image.view(FINE_SIDE).thing_points
    away = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return float(np.quantile(away, OF_ITS_PIXELS))


def weights_of(verification: Verification, where: str) -> EvidenceWeights:
    """The weights that a card holds; those that it does not name have their defaults.

    Args:
        verification: what the card says.
        where: path of the card, for the sentence of an error.

    Raises:
        ModelError: it names a weight that this version does not know, or one is out of its range.
    """
    strange = sorted(
        set(verification.weights) - {field.name for field in fields(EvidenceWeights)}
    )
    if strange:
        raise ModelError(
            f"{where}: weighs {strange[0]}, which this version does not know"
        )
    for share in ("correlation", "doubt"):
        value = verification.weights.get(share, 0)
        if value > 1:
            raise ModelError(f"{where}: its {share} is {value:g}, and it is a share")
    return EvidenceWeights(**verification.weights)


def residuals_of(
    verification: Verification,
    things: Sequence[int],
) -> KnownResiduals | None:
    """The residuals that a card holds, of some of its things; None if it holds none.

    Args:
        verification: of the card.
        things: rows of the things that are meant.
    """
    if not verification.usual:
        return None
    usual = np.array(verification.usual)[list(things)]
    return KnownResiduals(usual, tuple(np.array(row) for row in verification.excess))
