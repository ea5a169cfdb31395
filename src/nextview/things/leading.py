"""The leading hypotheses: the things, in poses, that a next view has to tell apart."""

from dataclasses import dataclass

import numpy as np

from nextview.things.verifier import Verified
from nextview.types import Float, Index

MOST_LEADING = 10  # hypotheses that are rendered
FEW_THINGS = 5  # likeliest things whose best hypothesis is always among them
# of the likeliest hypothesis' belief, below which one does not count
LEAST_LEADING_SHARE = 1e-4


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """The leading hypotheses: things in poses.

    Attributes:
        things: number of the surface of each, (H,) int64.
        poses: of the scan files' frames in the object frame, (H, 4, 4) float64, metres.
        belief: in each, (H,) float64, sums to 1.
    """

    things: Index
    poses: Float
    belief: Float

    @classmethod
    def leading(cls, verified: Verified, most: int = MOST_LEADING) -> "Hypotheses":
        """Choose the likeliest hypotheses, among them the best one of each likely thing.

        Args:
            verified: what the verifier found.
            most: how many at most.

        Returns:
            The hypotheses. The belief in a thing is shared among its hypotheses.
        """
        in_thing = np.bincount(
            verified.things,
            verified.probabilities,
            minlength=len(verified.belief),
        )
        share = verified.probabilities / np.maximum(in_thing[verified.things], 1e-300)
        belief = verified.belief[verified.things] * share

        # the best hypothesis of each
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
