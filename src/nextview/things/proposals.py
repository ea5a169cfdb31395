"""The hypotheses that are worth aligning: the likeliest ones by features and size."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.types import Float, Index, Mask

BASIN = 2  # azimuth bins to each side that registration reaches from a peak
FEWEST_PROPOSALS = 24
MOST_PROPOSALS = 96
ENOUGH_BELIEF = 0.99  # of the flattened belief that the proposals hold together
FLATTENING = 0.35  # exponent of the belief: features alone are too sure, above all of real frames
# likeliest hypotheses that are proposed at azimuths all around: features may be wrong there
ALL_AROUND = 3
MOST_PEAKS = 2  # azimuths of any other hypothesis


@dataclass(frozen=True, eq=False)
class Proposals:
    """Hypotheses that are worth aligning.

    Attributes:
        hypotheses: which thing in which resting pose, index of the memory's hypotheses, (M,) int64.
        azimuths: by how much each is turned about the vertical, radians, (M,) float64.
        log_belief: logarithm of the belief in the thing and resting pose by features and size, at
            any azimuth, (M,) float64.
    """

    hypotheses: Index
    azimuths: Float
    log_belief: Float

    def __len__(self) -> int:
        """Number of proposals."""
        return len(self.hypotheses)

    def select(self, rows: NDArray) -> "Proposals":
        """Some of the proposals, by index or mask."""
        return Proposals(
            self.hypotheses[rows],
            self.azimuths[rows],
            self.log_belief[rows],
        )


def propose(
    joint: Float,
    fewest: int = FEWEST_PROPOSALS,
    most: int = MOST_PROPOSALS,
    enough: float = ENOUGH_BELIEF,
) -> Proposals:
    """Choose the likeliest hypotheses: few where the belief is clear.

    Of the azimuths of a hypothesis only the peaks are proposed, as registration finds what lies
    between them. So a ball, which every azimuth suits, does not crowd out all else. The few
    likeliest hypotheses are also proposed at azimuths all around.

    Args:
        joint: belief in each hypothesis and azimuth bin, (hypotheses, bins), as
            ``Calibration.joint`` gives it for an azimuth of zero: bin b is the hypothesis turned by
            ``-2 pi b / bins``.
        fewest: number of proposals that are always made, if there are so many peaks.
        most: largest number of proposals.
        enough: belief at which no more are needed.

    Returns:
        The proposals.
    """
    bins = joint.shape[1]
    marginal = joint.sum(1)
    proposed = _peaks(joint)
    likeliest = np.argsort(-marginal, kind="stable")[:ALL_AROUND]
    around = (joint[likeliest].argmax(1)[:, None] + np.arange(0, bins, BASIN)) % bins
    proposed[likeliest] = False
    proposed[likeliest[:, None], around] = True

    rank = np.where(proposed, joint, 0)
    others = np.setdiff1d(np.arange(len(joint)), likeliest)
    rows = np.arange(len(others))[:, None]
    lower = np.argsort(-rank[others], axis=1, kind="stable")[:, MOST_PEAKS:]
    rank[others[rows], lower] = 0
    rank[likeliest[:, None], around] += 2  # first
    order = np.argsort(-rank, axis=None, kind="stable")
    hypotheses, bin_of = np.divmod(order[: min(most, np.count_nonzero(rank))], bins)

    flat = joint[hypotheses, bin_of] ** FLATTENING
    so_far = np.cumsum(flat) / flat.sum()
    needed = max(np.searchsorted(so_far, enough) + 1, around.size)
    count = int(np.clip(needed, fewest, most))
    azimuths = -2 * np.pi * bin_of[:count] / bins
    return Proposals(
        hypotheses[:count],
        azimuths,
        np.log(marginal[hypotheses[:count]] + 1e-300),
    )


def _peaks(joint: Float) -> Mask:
    """The azimuth bins of each hypothesis that are likelier than those around them."""
    peak = np.ones(joint.shape, bool)
    for shift in range(1, BASIN + 1):
        peak &= joint >= np.roll(joint, shift, 1)
        peak &= joint > np.roll(joint, -shift, 1)
    peak[np.arange(len(joint)), joint.argmax(1)] = True
    return peak
