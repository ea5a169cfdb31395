"""Who takes part in the benchmark of things: policies, a fixed sequence, and two ceilings."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from nextview.benchmark.thing_episodes import EPISODE_SPHERE, ThingEpisode
from nextview.errors import UsageError
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.base import EpisodeState, Policy, best_view
from nextview.policies.baselines import Furthest, RandomAll, Spread
from nextview.policies.discriminate import Discriminate
from nextview.policies.discriminate_geometry import DiscriminateGeometry
from nextview.policies.registry import make_policy
from nextview.things.leading import Hypotheses
from nextview.things.taught import TaughtThings
from nextview.types import Index

THING_POLICIES = (
    "random",
    "spread",
    "furthest",
    "fixed",
    "picture",
    "geometry",
    "pose",
    "foresight",
    "ceiling",
)
CEILINGS = ("foresight", "ceiling")  # they know what no robot does
# azimuth steps of the fixed sequence, of 8 a turn: it comes to all of them
TURN_AHEAD = 3
TRUTH_BELIEF = 0.01  # in the true pose, beside the hypotheses, for the ceiling
SETTLED_BELIEF = 0.97  # in the truth, after which foresight looks for nothing better


@dataclass(frozen=True)
class RingSteps:
    """Goes round the ring of the first view by equal steps, whatever is believed.

    Attributes:
        sphere: of the views.
        needs: what it asks of the state of an episode, see ``Policy.needs``.
    """

    sphere: ViewSphere
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """The free view that comes next, of each episode.

        Args:
            state: of the episodes.
            rng: draws among equals.
        """
        azimuths = self.sphere.azimuths
        ring, azimuth = np.divmod(state.current, azimuths)
        steps = TURN_AHEAD * np.arange(1, azimuths)
        ahead = ring[:, None] * azimuths + (azimuth[:, None] + steps) % azimuths
        free = np.take_along_axis(state.free, ahead, 1)
        on_ring = ahead[np.arange(len(ring)), free.argmax(1)]
        return np.where(free.any(1), on_ring, state.free.argmax(1))


@dataclass(frozen=True, eq=False)
class FairCeiling:
    """Goes where a view is expected to tell most if the truth and its pose are known beforehand.

    It does not know the noise of the views to come: no policy that foresees by geometry can be
    expected to do better.

    Attributes:
        episode: whose truth it knows.
        needs: what it asks of the state of an episode, see ``Policy.needs``.
    """

    episode: ThingEpisode
    needs: tuple[str, ...] = ("outlook",)

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """The free view that is expected to raise the log-belief in the truth most.

        Args:
            state: of the episodes.
            rng: draws among equals.
        """
        assert state.outlook is not None
        outlook = state.outlook[0]
        assert outlook is not None
        others = outlook.hypotheses
        rivals = others.things != self.episode.thing
        belief = np.append(
            TRUTH_BELIEF + others.belief[~rivals].sum(),
            others.belief[rivals],
        )
        views = np.flatnonzero(state.visited[0]).tolist()
        hypotheses = Hypotheses(
            np.append(self.episode.thing, others.things[rivals]),
            np.concatenate(
                [self.episode.aligned_truth(views)[None], others.poses[rivals]]
            ),
            belief / belief.sum(),
        )
        cameras = outlook.cameras(EPISODE_SPHERE.directions)
        expected = replace(outlook, hypotheses=hypotheses).expect(cameras)
        value = expected.found * expected.gain(0)

        return best_view(
            EPISODE_SPHERE,
            state,
            value[None] + 1e-9 * rng.random((1, len(EPISODE_SPHERE))),
        )


@dataclass(frozen=True, eq=False)
class Foresight:
    """Goes where the truth really is believed most after the view, its noise included.

    Every candidate is verified. Once the truth is believed, it spreads.

    Attributes:
        episode: whose views it knows.
        needs: what it asks of the state of an episode, see ``Policy.needs``.
    """

    episode: ThingEpisode
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """The free view after which the belief in the truth is largest.

        Args:
            state: of the episodes.
            rng: draws among equals.
        """
        views = np.flatnonzero(state.visited[0]).tolist()
        if state.step > 1 and self.episode.belief_in_truth(views) >= SETTLED_BELIEF:
            return Spread(EPISODE_SPHERE).next_views(state, rng)
        values = np.full((1, len(EPISODE_SPHERE)), -np.inf)
        for view in np.flatnonzero(state.free[0]).tolist():
            values[0, view] = self.episode.belief_in_truth([*views, view])
        return best_view(EPISODE_SPHERE, state, values)


def policies_of(
    names: tuple[str, ...],
    things: TaughtThings,
) -> dict[str, Callable[[ThingEpisode], Policy]]:
    """Policies by name, each made for an episode.

    Args:
        names: of THING_POLICIES, or MODULE:CLASS for one of your own, which is made with the
            viewpoints.
        things: the things, for the one that goes by remembered pictures.

    Raises:
        UsageError: there is no policy of one of these names.
        PolicyError: one cannot be made.
    """
    geometry = DiscriminateGeometry(EPISODE_SPHERE)
    known: dict[str, Callable[[ThingEpisode], Policy]] = {
        "random": lambda _: RandomAll(EPISODE_SPHERE),
        "spread": lambda _: Spread(EPISODE_SPHERE),
        "furthest": lambda _: Furthest(EPISODE_SPHERE),
        "fixed": lambda _: RingSteps(EPISODE_SPHERE),
        "geometry": lambda _: geometry,
        "pose": lambda _: replace(geometry, goal="pose"),
        "foresight": Foresight,
        "ceiling": FairCeiling,
    }
    if "picture" in names:
        picture = Discriminate.from_card(
            things.recogniser.card.card_path,
            EPISODE_SPHERE,
        )
        known["picture"] = lambda _: picture
    for name in names:
        if name in known:
            continue
        if ":" not in name:
            raise UsageError(
                f"no policy is called {name}; there are {', '.join(THING_POLICIES)}"
            )
        known[name] = _always(make_policy(name, EPISODE_SPHERE))

    return {name: known[name] for name in names}


def _always(policy: Policy) -> Callable[[ThingEpisode], Policy]:
    """The same policy for all episodes."""
    return lambda _: policy
