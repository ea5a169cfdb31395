"""Published policies for known objects, as opponents in the benchmark of things.

Both predict what a camera would see of each leading hypothesis, and choose the view after which the
entropy of the belief is expected to be lowest. They follow the method of the papers, not the code
of their authors, with depth images in place of the features there: every pixel is independent, with
the noise of the sensor and a share of outliers, and the weights of pixels against the prior are
those of the verifier. Poses are not refined with the new view, and space that no view has shown is
free.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from nextview.errors import PolicyError
from nextview.geometry.viewsphere import Viewpoints
from nextview.policies.base import EpisodeState, best_view
from nextview.things.expected_images import HypothesisImages, rendered_images
from nextview.things.expected_likelihood import depth_variance
from nextview.things.expected_views import RENDERED_SIDE, Outlook
from nextview.types import Float, Float32, Index, Mask

SAMPLES = 24  # simulated images of each view
# radians: views nearer to the current one count less
STEP_SCALE = np.radians(30.0)


@dataclass(frozen=True, eq=False)
class LowestEntropy(ABC):
    """Chooses the view after which the entropy of the belief is expected to be lowest.

    Attributes:
        viewpoints: the candidates.
        needs: required inputs, see ``Policy.needs``.
    """

    viewpoints: Viewpoints
    needs: tuple[str, ...] = ("outlook",)

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Return the free view with the highest value.

        Args:
            state: of the episodes.
            rng: of samples, and for ties.

        Raises:
            PolicyError: the state has no outlook.
        """
        if state.outlook is None:
            raise PolicyError(
                "this policy needs things of known geometry: a memory that was taught from scans"
            )

        values = np.full(state.free.shape, -np.inf)
        for row, outlook in enumerate(state.outlook):
            some = np.flatnonzero(state.free[row])
            values[row, some] = 1e-9 * rng.random(len(some))
            if outlook is None or not len(some):
                continue
            images = rendered_images(
                outlook.caster,
                outlook.hypotheses,
                outlook.cameras(self.viewpoints.directions[some]),
                outlook.surroundings,
                RENDERED_SIDE,
            )
            values[row, some] += self.values(outlook, images, rng)
        return best_view(self.viewpoints, state, values)

    @abstractmethod
    def values(
        self,
        outlook: Outlook,
        images: HypothesisImages,
        rng: np.random.Generator,
    ) -> Float:
        """Return the value of each view of one episode, (V,), nats.

        Args:
            outlook: with the belief so far.
            images: the hypotheses as each view would show them.
            rng: of samples.
        """


class SampledInformation(LowestEntropy):
    """Chooses the view with the most mutual information, estimated by sampling.

    Denzler and Brown, "Information theoretic sensor data selection for active object recognition
    and state estimation", IEEE TPAMI 24(2), 2002: a hypothesis is drawn from the belief, an image
    from the hypothesis, and the entropy of the updated belief is averaged over the draws.
    """

    def values(
        self,
        outlook: Outlook,
        images: HypothesisImages,
        rng: np.random.Generator,
    ) -> Float:
        """Return the negative mean entropy over sampled images; see ``LowestEntropy.values``.

        Args:
            outlook: with the belief so far.
            images: the hypotheses as each view would show them.
            rng: of samples.
        """
        belief = outlook.hypotheses.belief
        truths = rng.choice(len(belief), SAMPLES, p=belief)
        seen = _simulated(outlook, images, truths, rng)
        return -_entropies(outlook, images, seen).mean(1)


class PredictedEntropy(LowestEntropy):
    """Chooses the view with the largest expected reduction of entropy, from predicted views.

    Borotschnig, Paletta, Prantl and Pinz, "Appearance-based active object recognition", Image and
    Vision Computing 18, 2000: each hypothesis predicts its own view without noise, the reductions
    of entropy are weighted by the belief, and small motions are discouraged.
    """

    def values(
        self,
        outlook: Outlook,
        images: HypothesisImages,
        rng: np.random.Generator,
    ) -> Float:
        """Return the expected reduction, less near the current view; see ``LowestEntropy.values``.

        Args:
            outlook: with the belief so far.
            images: the hypotheses as each view would show them.
            rng: not used.
        """
        belief = outlook.hypotheses.belief
        seen = _simulated(outlook, images, np.arange(len(belief)), None)
        before = _entropy(belief[None], outlook.hypotheses.things)[0]
        gained = before - _entropies(outlook, images, seen) @ belief

        lengths = np.linalg.norm(images.origins, axis=1, keepdims=True)
        arc = np.arccos(np.clip(images.origins / lengths @ outlook.towards, -1, 1))
        return gained * (1 - np.exp(-((arc / STEP_SCALE) ** 2)))


def _simulated(
    outlook: Outlook,
    images: HypothesisImages,
    truths: Index,
    rng: np.random.Generator | None,
) -> Float32:
    """Depth that is measured if some hypotheses are true, (V, S, P) float32, metres.

    Infinity where the thing does not show. Noise is added if there is a generator.
    """
    depth = images.depth[:, truths]
    if rng is None:
        return depth
    deviation = np.sqrt(depth_variance(images, outlook.sensor, outlook.model))
    noise = rng.standard_normal(depth.shape, np.float32)
    return depth + noise * deviation[:, truths]


def _entropies(outlook: Outlook, images: HypothesisImages, seen: Float32) -> Float:
    """Entropy of the belief in the things after each simulated image, (V, S) float64, nats.

    Args:
        outlook: with the belief so far.
        images: the hypotheses as each view would show them.
        seen: simulated images, see ``_simulated``.
    """
    model = outlook.model
    weight = model.geometry / (1 + model.correlation * outlook.taken)
    variance = depth_variance(images, outlook.sensor, outlook.model)
    log_belief = np.log(outlook.hypotheses.belief)

    scores = np.empty((*seen.shape[:2], len(log_belief)))
    for row in range(len(log_belief)):
        mean = _mean_log_likelihood(
            seen,
            images.depth[:, row, None],
            variance[:, row, None],
            images.behind[:, None],
            outlook.model.outlier,
        )
        scores[..., row] = log_belief[row] + weight * mean

    belief = np.exp(scores - scores.max(2, keepdims=True))
    return _entropy(belief / belief.sum(2, keepdims=True), outlook.hypotheses.things)


def _mean_log_likelihood(
    seen: Float32,
    depth: Float32,
    variance: Float32,
    behind: Mask,
    outlier: float,
) -> Float:
    """Mean over the pixels that show the thing or the hypothesis, (V, S).

    Args:
        seen: measured depth, (V, S, P), metres; infinity where the thing does not show.
        depth: of the hypothesis, (V, 1, P).
        variance: of its depth, (V, 1, P), square metres.
        behind: whether something is measured where nothing of the thing shows, (V, 1, P).
        outlier: log-likelihood of a pixel that the hypothesis does not explain.
    """
    measured = np.isfinite(seen)
    shows = np.isfinite(depth)
    off = np.where(measured & shows, seen - np.where(shows, depth, 0), 0)
    match = np.log(np.exp(-(off**2) / (2 * variance)) + np.exp(outlier))
    match -= np.log1p(np.exp(outlier))

    judged = np.where(measured & shows, match, 0)
    counted = measured | (shows & behind)
    judged = np.where(counted & (measured != shows), outlier, judged)
    return np.asarray(judged.sum(2) / np.maximum(counted.sum(2), 1), np.float64)


def _entropy(belief: Float, things: Index) -> Float:
    """Entropy of the belief in things, (...,), nats, from that in hypotheses, (..., H)."""
    each = np.unique(things)
    of_things = np.stack([belief[..., things == one].sum(-1) for one in each], -1)
    logarithms = np.log(np.maximum(of_things, 1e-300))
    return np.asarray(-(of_things * logarithms).sum(-1))
