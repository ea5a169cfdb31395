"""The leading hypotheses, things in poses, that the next view has to separate."""

from dataclasses import dataclass

import numpy as np

from nextview.things.verifier import Verified
from nextview.types import Float, Index

MOST_LEADING = 10  # most hypotheses that are rendered
FEW_THINGS = 5  # likeliest things that always contribute their best hypothesis
# smallest belief relative to the likeliest hypothesis
LEAST_LEADING_SHARE = 1e-4


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """The leading hypotheses: things in poses.

    Attributes:
        things: number of the surface of each, (H,) int64.
        poses: poses of the scan files' frames in the object frame, (H, 4, 4) float64, metres.
        belief: belief in each, (H,) float64, sums to 1.
    """

    things: Index
    poses: Float
    belief: Float

    @classmethod
    def leading(cls, verified: Verified, most: int = MOST_LEADING) -> "Hypotheses":
        """Choose the likeliest hypotheses, including the best one of each likely thing.

        Args:
            verified: result of the verifier.
            most: largest number of hypotheses.

        Returns:
            The hypotheses. The belief in a thing is divided among its hypotheses.
        """
        in_thing = np.bincount(
            verified.things,
            verified.probabilities,
            minlength=len(verified.belief),
        )
        share = verified.probabilities / np.maximum(in_thing[verified.things], 1e-300)
        belief = verified.belief[verified.things] * share

        # best hypothesis of each thing
        first = np.unique(verified.things, return_index=True)[1]
        first = first[
            np.argsort(-verified.belief[verified.things[first]], kind="stable")
        ]
        ahead = np.zeros(len(belief))
        ahead[first[:FEW_THINGS]] = 1
        rows = np.argsort(-(ahead + belief), kind="stable")[:most]
        rows = rows[belief[rows] >= LEAST_LEADING_SHARE * belief.max()]
        some = belief[rows]
        return cls(verified.things[rows], verified.poses[rows], some / some.sum())
