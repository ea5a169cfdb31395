"""Who takes part in the benchmark of things: policies, blind rules, and a ceiling."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from nextview.benchmark.own_things import OwnThings
from nextview.benchmark.thing_episodes import EPISODE_SPHERE, ThingEpisode
from nextview.errors import UsageError
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.base import EpisodeState, Policy, best_view
from nextview.policies.baselines import Furthest, RandomAll, Spread
from nextview.policies.discriminate import Discriminate
from nextview.policies.discriminate_geometry import DiscriminateGeometry
from nextview.policies.registry import make_policy
from nextview.things.taught import TaughtThings
from nextview.types import Index

THING_POLICIES = (
    "random",
    "spread",
    "furthest",
    "fixed",
    "ring",
    "picture",
    "geometry",
    "pose",
    "ceiling",
)
CEILINGS = ("ceiling",)  # it knows what no robot does
# they ignore the images
BLIND_RULES = ("random", "spread", "furthest", "fixed", "ring")
BEST_BLIND = "best-blind"  # the one of them that is best on other episodes
# they go by the hypotheses of a memory of taught things
OF_MEMORIES = ("picture", "geometry", "pose")
# azimuth steps of the fixed sequence, of 8 a turn: it comes to all of them
TURN_AHEAD = 3
# belief in the truth: where it is reached, a view that keeps it is good enough for the ceiling
SETTLED_BELIEF = 0.97


@dataclass(frozen=True)
class RingSteps:
    """Goes round the ring of the first view by equal steps, whatever is believed.

    Attributes:
        sphere: of the views.
        ahead: azimuth steps to the next view.
        needs: what it asks of the state of an episode, see ``Policy.needs``.
    """

    sphere: ViewSphere
    ahead: int = TURN_AHEAD
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """The free view that comes next, of each episode.

        Args:
            state: of the episodes.
            rng: draws among equals.
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
    """Goes where the truth comes out best, by the very views that are to come, noise included.

    Every free view is judged: one after which the thing is named right comes before one after which
    it is not, then the belief in the truth decides. No choice of one view names more things right,
    so that nothing is above it after two views. It looks one view ahead: of several views there may
    be a better sequence.

    Attributes:
        episode: whose views it knows.
        needs: what it asks of the state of an episode, see ``Policy.needs``.
    """

    episode: ThingEpisode
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """The free view after which the truth is named and believed most.

        Args:
            state: of the episodes.
            rng: draws among equals.
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
        """Belief in the truth after some views; 1 more where it is the answer."""
        right = self.episode.named_right(views)
        return float(right) + self.episode.belief_in_truth(views)


def policies_of(
    names: tuple[str, ...],
    things: TaughtThings | OwnThings,
) -> dict[str, Callable[[ThingEpisode], Policy]]:
    """Policies by name, each made for an episode.

    Args:
        names: of THING_POLICIES, or MODULE:CLASS for one of your own, which is made with the
            viewpoints.
        things: the things, for the one that goes by remembered pictures.

    Raises:
        UsageError: there is no policy of one of these names, or it goes by the hypotheses of a
            memory where there is none.
        PolicyError: one cannot be made.
    """
    geometry = DiscriminateGeometry(EPISODE_SPHERE)
    known: dict[str, Callable[[ThingEpisode], Policy]] = {
        "random": lambda _: RandomAll(EPISODE_SPHERE),
        "spread": lambda _: Spread(EPISODE_SPHERE),
        "furthest": lambda _: Furthest(EPISODE_SPHERE),
        "fixed": lambda _: RingSteps(EPISODE_SPHERE),
        "ring": lambda _: RingSteps(EPISODE_SPHERE, 1),
        "geometry": lambda _: geometry,
        "pose": lambda _: replace(geometry, goal="pose"),
        "ceiling": TruthCeiling,
    }
    if "picture" in names and isinstance(things, TaughtThings):
        picture = Discriminate.from_card(
            things.recogniser.card.card_path,
            EPISODE_SPHERE,
        )
        known["picture"] = lambda _: picture
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
    things: TaughtThings | OwnThings,
) -> None:
    """Say that a policy goes by the hypotheses of a memory, where there are none; UsageError."""
    lacking = sorted({"joint", "outlook"} & set(needs))
    if lacking and isinstance(things, OwnThings):
        raise UsageError(
            f"the policy {name} goes by the hypotheses of a memory of taught things, which"
            f" recogniser {things.recogniser.name} does not have; leave it out"
        )


def _always(policy: Policy) -> Callable[[ThingEpisode], Policy]:
    """The same policy for all episodes."""
    return lambda _: policy
