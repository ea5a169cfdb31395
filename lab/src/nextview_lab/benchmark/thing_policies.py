"""Policies of the benchmark of things, including blind rules and an upper bound."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nextview.errors import UsageError
from nextview.geometry.viewsphere import Viewpoints, ViewSphere
from nextview.policies.base import EpisodeState, Policy, best_view
from nextview.policies.baselines import Furthest, RandomAll, Spread
from nextview.policies.discriminate_geometry import DiscriminateGeometry
from nextview.policies.registry import make_policy
from nextview.types import Index
from nextview_lab.benchmark.known_things import KnownThings
from nextview_lab.benchmark.published_policies import (
    PredictedEntropy,
    SampledInformation,
)
from nextview_lab.benchmark.thing_episodes import EPISODE_SPHERE, ThingEpisode

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
        "sampled": lambda: SampledInformation(sphere),
        "predicted": lambda: PredictedEntropy(sphere),
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
    if {"joint", "outlook"} & set(needs) and things.memory is None:
        raise UsageError(
            f"the policy {name} goes by the hypotheses of a memory of taught things, which"
            f" recogniser {things.recogniser.name} does not have; leave it out"
        )
    if "joint" in needs:
        raise UsageError(
            f"the policy {name} goes by features of views, and the memory holds none: its things"
            " are recognised by their geometry"
        )


def _always(policy: Policy) -> Callable[[ThingEpisode], Policy]:
    """Use the same policy for all episodes."""
    return lambda _: policy
