"""A memory of taught things together with their surfaces: from observations to names and poses."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nextview.errors import ModelError, ObservationError
from nextview.geometry.observation import Observation
from nextview.geometry.viewsphere import direction_of
from nextview.recognition.belief import log_evidence_of
from nextview.things.memory import TaughtRecogniser
from nextview.things.surface import Surface
from nextview.things.verifier import Verified, Verifier
from nextview.things.weighing import EvidenceWeights

Float = NDArray[np.float64]


class TaughtThings:
    """Names taught things by features, size and geometry, and tells their poses.

    Attributes:
        recogniser: what is remembered of their views.
        verifier: their surfaces.
        names: of the things, in the order of ``Verified.belief``.
    """

    def __init__(
        self,
        recogniser: TaughtRecogniser,
        surfaces: Sequence[Surface],
        weights: EvidenceWeights = EvidenceWeights(),
    ) -> None:
        """Join a memory and the surfaces of its things, or of some of them.

        Args:
            recogniser: what is remembered of the things.
            surfaces: of the things that shall be recognised, by their names in the memory.
            weights: how much features, size and geometry count.

        Raises:
            ModelError: a surface of a thing that the memory does not know, or none.
        """
        about = recogniser.card.memory
        assert about is not None
        known = [thing.name for thing in about.things]
        self.names = tuple(surface.name for surface in surfaces)
        strange = sorted(set(self.names) - set(known))
        if strange or not surfaces:
            what = f"{strange[0]} is none of them" if strange else "no surface is given"
            raise ModelError(f"a memory of {len(known)} things: {what}")

        memory = recogniser.memory
        number = {known.index(name): k for k, name in enumerate(self.names)}
        rows = [row for row, thing in enumerate(memory.thing.tolist()) if thing in number]
        owners = np.array([number[int(memory.thing[row])] for row in rows])
        self._rows = np.array(rows)
        self.recogniser = recogniser
        self.verifier = Verifier(surfaces, owners, memory.rotations[self._rows], weights)

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
            raise ObservationError("no view shows the thing, so nothing can be recognised")
        return self.verify(seen, self.log_evidence(seen))

    def log_evidence(self, observations: Sequence[Observation]) -> NDArray[np.floating]:
        """What features and size say of each view, (V, D): it can be summed over views."""
        evidence = self.recogniser(observations)
        directions = np.stack([direction_of(observation.pose) for observation in observations])
        azimuths = np.arctan2(directions[:, 1], directions[:, 0])
        return log_evidence_of(evidence.logits, evidence.azimuth_bins, azimuths)

    def verify(
        self, observations: Sequence[Observation], log_evidence: NDArray[np.floating]
    ) -> Verified:
        """Recognise the thing that some views show, of which the features have been looked at.

        Args:
            observations: views that show one thing, all in one object frame.
            log_evidence: of each view, (V, D), see the method of this name.

        Returns:
            The belief in each thing, and the poses.
        """
        calibration = self.recogniser.calibration
        classes = len(self.recogniser.classes)
        total = log_evidence.sum(0)
        joint = calibration.joint(total, len(observations), classes, np.zeros(()))[self._rows]
        return self.verifier(observations, joint / joint.sum())
