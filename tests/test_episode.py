"""Episodes against a plain loop over one object, and policies that misbehave."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import softmax

from nextview.errors import PolicyError
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.base import EpisodeState, Evidence
from nextview.policies.baselines import Unidirectional
from nextview.policies.maps import MapPeak
from nextview.recognition.belief import PLAIN_SUM, Calibration, Stopping
from nextview.session.episode import Episodes, run_episodes

SPHERE = ViewSphere.named("40")
CLASSES = 4


@dataclass(frozen=True)
class Table:
    """What the models would say of every view of some objects; episode e looks at object e."""

    logits: np.ndarray
    lem: np.ndarray

    @classmethod
    def random(
        cls, objects: int, sphere: ViewSphere = SPHERE, seed: int = 0
    ) -> "Table":
        rng = np.random.default_rng(seed)
        logits = rng.normal(size=(objects, len(sphere), CLASSES)) * 1.5
        logits[np.arange(objects), :, rng.integers(0, CLASSES, objects)] += 1
        return cls(logits, rng.random((objects, len(sphere), sphere.rings, 3)))

    def observe(self, episodes: np.ndarray, views: np.ndarray) -> Evidence:
        return Evidence(
            self.logits[episodes, views], {"lem": self.lem[episodes, views]}
        )


def walk(
    table: Table,
    policy,
    episode: int,
    start: int,
    stopping: Stopping,
    calibration,
    sphere=SPHERE,
):
    """One episode as one would write it for one object: views, beliefs."""
    views, beliefs = [start], []
    while True:
        beliefs.append(
            softmax(
                table.logits[episode, views].sum(0)
                / calibration.temperature_after(len(views))
            )
        )
        if beliefs[-1].max() >= stopping.threshold or len(views) in (
            stopping.max_views,
            len(sphere),
        ):
            return views, beliefs
        visited = np.zeros((1, len(sphere)), bool)
        visited[0, views] = True
        here = np.array([views[-1]])
        evidence = table.observe(np.array([episode]), here)
        state = EpisodeState(
            here, visited, beliefs[-1][None], evidence, len(views), np.array([episode])
        )
        views.append(int(policy.next_views(state, np.random.default_rng(0))[0]))


def run(
    table, policy, starts, stopping, sphere=SPHERE, seed=0, calibration=PLAIN_SUM
) -> Episodes:
    return run_episodes(
        table.observe,
        sphere,
        policy,
        starts,
        stopping,
        np.random.default_rng(seed),
        calibration,
    )


@settings(deadline=None, max_examples=25)
@given(
    st.integers(0, 1000),
    st.sampled_from([0.0, 0.5, 0.8, 0.97, 1.0]),
    st.integers(1, 7),
    st.sampled_from(
        [
            Unidirectional(SPHERE),
            MapPeak(SPHERE, "lem"),
            MapPeak(SPHERE, "lem", valley_classes=(0, 2)),
        ]
    ),
    st.sampled_from([PLAIN_SUM, Calibration(0.7, 0.4)]),
)
def test_many_episodes_at_once_are_each_episode_alone(
    seed, threshold, max_views, policy, calibration
):
    table, stopping = Table.random(20, seed=seed), Stopping(threshold, max_views)
    starts = np.random.default_rng(seed).integers(0, 40, 20)
    episodes = run(table, policy, starts, stopping, calibration=calibration)
    end = episodes.outcome
    for e, start in enumerate(starts):
        views, beliefs = walk(table, policy, e, int(start), stopping, calibration)
        assert end.views[e, : len(views)].tolist() == views
        assert (end.views[e, len(views) :] == -1).all()
        assert end.n_views[e] == len(views)
        assert end.answer[e] == beliefs[-1].argmax()
        assert end.confidence[e] == pytest.approx(beliefs[-1].max(), abs=1e-12)
        assert end.confident[e] == (beliefs[-1].max() >= threshold)
        legs = list(pairwise(views))
        assert end.travel[e] == pytest.approx(
            sum(SPHERE.travel[leg] for leg in legs), abs=1e-12
        )
        assert end.arc[e] == pytest.approx(
            sum(SPHERE.arc[leg] for leg in legs), abs=1e-12
        )


# Refusing


@dataclass(frozen=True)
class Broken:
    """A policy with a fault, in episode 7 only where it can be told apart."""

    fault: str
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator):
        good, seven = Unidirectional(SPHERE).next_views(state, rng), state.episodes == 7
        if self.fault == "raises" and seven.any():
            raise KeyError("no such map")
        return {
            "raises": good,
            "stays": np.where(seven, state.current, good),
            "too high": np.where(seven, 40, good),
            "fractions": good + 0.5,
        }[self.fault]


@pytest.mark.parametrize(
    ("fault", "part", "episode"),
    [
        ("raises", "raised KeyError: 'no such map'", 7),
        ("stays", "which was visited before", 7),
        ("too high", "chose view 40, which is not on the sphere", 7),
        ("fractions", "has to return 20 integers", None),
    ],
)
def test_a_policy_that_misbehaves_is_named(fault, part, episode):
    with pytest.raises(PolicyError, match=f"^policy Broken .*{part}") as refusal:
        run(Table.random(20), Broken(fault), np.arange(20), Stopping(1.0, 5))
    assert refusal.value.episode == episode
