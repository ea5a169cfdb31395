"""Policies of the benchmark of things, including blind rules and an upper bound."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nextview.errors import PolicyError, UsageError
from nextview.geometry.viewsphere import Viewpoints, ViewSphere
from nextview.policies.base import EpisodeState, Policy, best_view
from nextview.policies.baselines import Furthest, RandomAll, Spread
from nextview.policies.discriminate_geometry import DiscriminateGeometry
from nextview.policies.registry import make_policy
from nextview.types import Float, Float32, Index, Mask
from nextview.views.expected_images import HypothesisImages, rendered_images
from nextview.views.expected_likelihood import depth_variance
from nextview.views.expected_views import RENDERED_SIDE, Outlook
from nextview_lab.benchmark.thing_episodes import (
    EPISODE_SPHERE,
    KnownThings,
    ThingEpisode,
)

SAMPLES = 24  # simulated images of each view
# radians: views nearer to the current one count less
STEP_SCALE = np.radians(30.0)


# of an outlook, and of the hypotheses as each view would show them: the value of each view, (V,)
ViewValues = Callable[[Outlook, HypothesisImages, np.random.Generator], Float]


@dataclass(frozen=True, eq=False)
class LowestEntropy:
    """Chooses the view after which the entropy of the belief is expected to be lowest.

    Attributes:
        viewpoints: the candidates.
        values: returns the value of each view of one episode, nats.
        needs: required inputs, see ``Policy.needs``.
    """

    viewpoints: Viewpoints
    values: ViewValues
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


def sampled_information(
    outlook: Outlook, images: HypothesisImages, rng: np.random.Generator
) -> Float:
    """Return the mutual information of each view, (V,), estimated by sampling.

    Denzler and Brown, "Information theoretic sensor data selection for active object recognition
    and state estimation", IEEE TPAMI 24(2), 2002: a hypothesis is drawn from the belief, an image
    from the hypothesis, and the entropy of the updated belief is averaged over the draws.

    Args:
        outlook: with the belief so far.
        images: the hypotheses as each view would show them.
        rng: of samples.
    """
    belief = outlook.hypotheses.belief
    truths = rng.choice(len(belief), SAMPLES, p=belief)
    seen = _simulated(outlook, images, truths, rng)
    return -_entropies(outlook, images, seen).mean(1)


def predicted_entropy(
    outlook: Outlook, images: HypothesisImages, rng: np.random.Generator
) -> Float:
    """Return the expected reduction of entropy by predicted views, (V,), less near the last one.

    Borotschnig, Paletta, Prantl and Pinz, "Appearance-based active object recognition", Image and
    Vision Computing 18, 2000: each hypothesis predicts its own view without noise, the reductions
    of entropy are weighted by the belief, and small motions are discouraged.

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


THING_POLICIES = (
    "random",
    "spread",
    "furthest",
    "fixed",
    "ring",
    "geometry",
    "pose",
    "sampled",
    "predicted",
    "ceiling",
)
CEILINGS = ("ceiling",)  # upper bound with access to the ground truth
# rules that ignore the images
BLIND_RULES = ("random", "spread", "furthest", "fixed", "ring")
BEST_BLIND = "best-blind"  # the blind rule that is best on other episodes
# policies that use the hypotheses of a memory of taught things
OF_MEMORIES = ("geometry", "pose", "sampled", "predicted")
# azimuth steps of the fixed sequence, which reaches all 8 views of a ring
TURN_AHEAD = 3
# belief in the truth from which the upper bound accepts any view that keeps it
SETTLED_BELIEF = 0.97


@dataclass(frozen=True)
class RingSteps:
    """Moves around the ring of the first view in equal steps, whatever the belief.

    Attributes:
        sphere: of the views.
        ahead: azimuth steps to the next view.
        needs: required inputs, see ``Policy.needs``.
    """

    sphere: ViewSphere
    ahead: int = TURN_AHEAD
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Return the next free view of each episode.

        Args:
            state: of the episodes.
            rng: for ties.
        """
        azimuths = self.sphere.azimuths
        ring, azimuth = np.divmod(state.current, azimuths)
        steps = self.ahead * np.arange(1, azimuths)
        ahead = ring[:, None] * azimuths + (azimuth[:, None] + steps) % azimuths
        free = np.take_along_axis(state.free, ahead, 1)
        on_ring = ahead[np.arange(len(ring)), free.argmax(1)]
        return np.where(free.any(1), on_ring, state.free.argmax(1))


@dataclass(frozen=True, eq=False)
class TruthCeiling:
    """Chooses the view with the best true outcome, simulated with its actual noise.

    Every free view is evaluated: views after which the thing is named correctly come first, then
    the belief in the truth decides. No choice of a single view names more things correctly, so this
    is an upper bound after two views. It looks one view ahead; there may be better sequences of
    several views.

    Attributes:
        episode: with the true views.
        needs: required inputs, see ``Policy.needs``.
    """

    episode: ThingEpisode
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Return the free view with the best true outcome.

        Args:
            state: of the episodes.
            rng: for ties.
        """
        views = np.flatnonzero(state.visited[0]).tolist()
        if state.step > 1 and self._worth(views) >= 1 + SETTLED_BELIEF:
            far = Spread(EPISODE_SPHERE).next_views(state, rng)
            if self._worth([*views, int(far[0])]) >= 1 + SETTLED_BELIEF:
                return far
        values = np.full((1, len(EPISODE_SPHERE)), -np.inf)
        for view in np.flatnonzero(state.free[0]).tolist():
            values[0, view] = self._worth([*views, view])
        return best_view(EPISODE_SPHERE, state, values)

    def _worth(self, views: list[int]) -> float:
        """Return the belief in the truth after some views, plus 1 if it is the answer."""
        right = self.episode.named_right(views)
        return float(right) + self.episode.belief_in_truth(views)


def rules_of(sphere: Viewpoints, grid: ViewSphere) -> dict[str, Callable[[], Policy]]:
    """Return functions that create the policies that know nothing of an episode, by name.

    Args:
        sphere: candidate views.
        grid: the same views as a grid, for those that move on its rings.
    """
    return {
        "random": lambda: RandomAll(sphere),
        "spread": lambda: Spread(sphere),
        "furthest": lambda: Furthest(grid),
        "fixed": lambda: RingSteps(grid),
        "ring": lambda: RingSteps(grid, 1),
        "geometry": lambda: DiscriminateGeometry(sphere),
        "sampled": lambda: LowestEntropy(sphere, sampled_information),
        "predicted": lambda: LowestEntropy(sphere, predicted_entropy),
    }


def policies_of(
    names: tuple[str, ...],
    things: KnownThings,
) -> dict[str, Callable[[ThingEpisode], Policy]]:
    """Return functions that create the named policies for an episode.

    Args:
        names: of THING_POLICIES, or MODULE:CLASS for your own, which is created with the
            viewpoints.
        things: what the policies go by.

    Raises:
        UsageError: there is no policy with one of these names, or it needs the hypotheses of a
            memory and there is none.
        PolicyError: a policy cannot be created.
    """
    rules = rules_of(EPISODE_SPHERE, EPISODE_SPHERE)
    known: dict[str, Callable[[ThingEpisode], Policy]] = {
        **{name: _always(rule()) for name, rule in rules.items()},
        "pose": _always(DiscriminateGeometry(EPISODE_SPHERE, goal="pose")),
        "ceiling": TruthCeiling,
    }
    for name in names:
        if name in OF_MEMORIES:
            _refuse_needs(name, ("outlook",), things)
        if name in known:
            continue
        if ":" not in name:
            raise UsageError(
                f"no policy is called {name}; there are {', '.join(THING_POLICIES)}"
            )
        own = make_policy(name, EPISODE_SPHERE)
        _refuse_needs(name, own.needs, things)
        known[name] = _always(own)

    return {name: known[name] for name in names}


def _refuse_needs(
    name: str,
    needs: tuple[str, ...],
    things: KnownThings,
) -> None:
    """Reject a policy that needs the hypotheses of a memory if there is none; UsageError."""
    if "outlook" in needs and things.memory is None:
        raise UsageError(
            f"the policy {name} goes by the hypotheses of a memory of taught things, which"
            f" recogniser {things.recogniser.name} does not have; leave it out"
        )


def _always(policy: Policy) -> Callable[[ThingEpisode], Policy]:
    """Use the same policy for all episodes."""
    return lambda _: policy
