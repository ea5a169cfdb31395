"""Weights of outline, size and geometry, and the belief that follows from them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from nextview.errors import ModelError
from nextview.types import Float, Index

NEVER = -1e9  # log-likelihood of a thing without a registered hypothesis
# lower bound of the belief in the truth before its logarithm
LEAST_TRUE_BELIEF = 1e-9

GEOMETRY_WEIGHTS = (5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0)
OUTLINE_WEIGHTS = (0.2, 0.4, 0.6, 0.8, 1.0)
CAMERA_WEIGHTS = (0.1, 0.5)
VIEW_CORRELATIONS = (0.0, 0.2, 0.5, 1.0)
DOUBTS = (0.001, 0.003, 0.01, 0.03)
"""Candidate values of ``fit_weights``."""


@dataclass(frozen=True)
class EvidenceWeights:
    """Weights of the kinds of evidence.

    The pixels of a view are correlated, and so are the views of a thing, so they are not
    independent pieces of evidence. The factors of their sums are fitted to views of known things.

    Attributes:
        geometry: of the mean log-likelihood of a view's pixels.
        outlines: of the log-belief by outline and size.
        cameras: of the log-likelihood of the camera position errors.
        correlation: of two views, 0 to 1: the sum over k views is divided by ``1 + correlation * (k
            - 1)``.
        doubt: share of the belief that depends on outline and size alone.
    """

    geometry: float = 40.0
    outlines: float = 0.6
    cameras: float = 0.1
    correlation: float = 0.5
    doubt: float = 0.001

    def scores(self, mean: Float, camera_costs: Float, log_belief: Float) -> Float:
        """Log-likelihood of hypotheses by all evidence, up to a constant.

        Args:
            mean: mean log-likelihood of the pixels of each view, (M, V).
            camera_costs: half the squared normalised errors of each camera's position, (M, V).
            log_belief: log-belief in the thing of each hypothesis by outline and size, (M,).

        Returns:
            Scores, (M,) float64.
        """
        of_views = self.geometry * mean - self.cameras * camera_costs
        together = 1 + self.correlation * (mean.shape[1] - 1)
        return of_views.sum(1) / together + self.outlines * log_belief

    def belief(self, scores: Float, things: Index, by_outline: Float) -> Float:
        """Belief in each thing, from its likeliest hypothesis.

        Args:
            scores: scores of M hypotheses, (M,).
            things: thing of each, (M,) int.
            by_outline: belief in each thing by outline and size alone, (T,), sums to 1.

        Returns:
            Belief, (T,) float64, sums to 1.
        """
        best = np.full(len(by_outline), NEVER)
        np.maximum.at(best, things, scores)
        belief = np.exp(best - best.max())
        belief /= belief.sum()
        return (1 - self.doubt) * belief + self.doubt * by_outline


@dataclass(frozen=True, eq=False)
class JudgedEpisode:
    """Evidence about the hypotheses of one object after some views, and the true thing.

    Attributes:
        truth: number of the true thing.
        things: thing of each hypothesis, (M,) int64.
        mean: mean log-likelihood of the pixels of each view, (M, V) float64.
        camera_costs: half the squared normalised errors of each camera's position, (M, V) float64.
        log_belief: log-belief in the thing of each hypothesis by outline and size, (M,) float64.
        by_outline: belief in each thing by outline and size alone, (T,) float64.
    """

    truth: int
    things: Index
    mean: Float
    camera_costs: Float
    log_belief: Float
    by_outline: Float

    def belief(self, weights: EvidenceWeights) -> Float:
        """Belief in each thing.

        Args:
            weights: weights of the evidence.

        Returns:
            Belief, (T,) float64, sums to 1.
        """
        scores = weights.scores(self.mean, self.camera_costs, self.log_belief)
        return weights.belief(scores, self.things, self.by_outline)


def fit_weights(episodes: Sequence[JudgedEpisode]) -> EvidenceWeights:
    """Choose the weights with the smallest mean negative log-belief in the truth.

    The search covers a grid of values; the doubt is fitted after the other weights.

    Args:
        episodes: episodes of known things, after one or more views.

    Returns:
        The best weights.

    Raises:
        ModelError: there is no episode.
    """
    if not episodes:
        raise ModelError("weights are fitted to episodes, and there is none")

    tried = []
    for values in product(
        GEOMETRY_WEIGHTS,
        OUTLINE_WEIGHTS,
        CAMERA_WEIGHTS,
        VIEW_CORRELATIONS,
    ):
        weights = EvidenceWeights(*values)
        tried.append((_loss(weights, episodes), weights))
    best = min(tried, key=lambda pair: pair[0])[1]

    doubting = [replace(best, doubt=doubt) for doubt in DOUBTS]
    return min(doubting, key=lambda weights: _loss(weights, episodes))


def _loss(weights: EvidenceWeights, episodes: Sequence[JudgedEpisode]) -> float:
    """Mean negative logarithm of the belief in the truth."""
    believed = np.array(
        [episode.belief(weights)[episode.truth] for episode in episodes]
    )
    return float(-np.log(np.maximum(believed, LEAST_TRUE_BELIEF)).mean())
