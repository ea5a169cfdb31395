"""The gain policy: what it may know, what it costs, and that training finds the views that tell."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from pipeline import train_predictions
from test_policies import SPHERE, state_of

torch = pytest.importorskip("torch")


from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.base import Evidence
from nextview.policies.baselines import Random, RandomAll
from nextview.policies.gain import Gain, features, mirrored, mirrored_features
from nextview.policies.policy_card import PolicyCard
from nextview.policies.registry import make_policy
from nextview_lab.data.predictions import Predictions
from nextview_lab.training.gain_training import (
    Perceptrons,
    Score,
    best_epoch,
    train,
    write_gain,
)
from nextview_lab.training.recipes import GainRecipe
from nextview_lab.training.rollout import fit_travel_weight, judge, rollout

SMALL = ViewSphere((0.0, 30.0, 60.0), 4)
CLASSES = 4
MAPS = (
    "lem",
    "lcm",
    "mine:clutter",
    "view_area",
    "lem-sphere",
    "lcm-sphere",
    "view_area-sphere",
)
INPUTS = ("belief", "view", "place", *MAPS, "azimuth_bin")
"""All that a network may take, of measures of all kinds; in the order that its weights are for."""


def some_gain(
    sphere=SPHERE, inputs=INPUTS, networks=2, seed=0, frame="camera", **rest
) -> Gain:
    """With weights at random: whatever it was trained to, these promises hold."""
    rng = np.random.default_rng(seed)
    widths = list(
        pairwise(
            [len(mirrored_features(sphere, CLASSES, inputs, frame)), 8, 8, len(sphere)]
        )
    )
    weights = [
        torch.from_numpy(rng.normal(size=(networks, a, b)) / a**0.5).float()
        for a, b in widths
    ]
    biases = [
        torch.from_numpy(rng.normal(size=(networks, 1, b))).float() for _, b in widths
    ]
    flips = mirrored_features(sphere, CLASSES, inputs, frame), mirrored(sphere)
    return Gain(
        sphere,
        CLASSES,
        Score(Perceptrons(weights, biases, *flips)),
        inputs,
        frame=frame,
        **rest,
    )


def some_state(sphere=SPHERE, episodes=60, seed=0):
    rng = np.random.default_rng(seed)
    state = state_of(
        sphere,
        rng.integers(len(sphere), size=episodes),
        belief=rng.dirichlet([1] * CLASSES, episodes),
    )
    state.visited[:] |= rng.random(state.visited.shape) < rng.random((episodes, 1))
    columns = {
        name: sphere.azimuths if name.endswith("-sphere") else 3 for name in MAPS
    }
    maps = {
        name: rng.random((episodes, sphere.rings, wide))
        for name, wide in columns.items()
    }
    azimuth_bins = rng.dirichlet([1] * sphere.azimuths, (episodes, CLASSES))
    return replace(
        state,
        evidence=Evidence(rng.normal(size=(episodes, CLASSES)), maps),
        azimuth_bins=azimuth_bins,
    )


# The contract


@pytest.mark.parametrize("scope", ["global", "local"])
@pytest.mark.parametrize(
    ("inputs", "frame"),
    [
        (INPUTS, "camera"),
        (INPUTS, "object"),
        (("belief",), "camera"),
        (("view", "place"), "object"),
    ],
)
def test_an_unvisited_view_is_chosen_in_each_episode_by_itself(scope, inputs, frame):
    state, policy = some_state(), some_gain(inputs=inputs, frame=frame, scope=scope)
    chosen = policy.next_views(state, np.random.default_rng(0))
    free = ~state.visited.all(1)
    assert free.sum() > 40
    assert not state.visited[np.arange(60), chosen][free].any()
    for i in range(0, 60, 7):
        assert (
            policy.next_views(state.select([i]), np.random.default_rng(1)) == chosen[i]
        )


# The file that ships


def write_card(card, policy, state=None):
    """The card of a policy, and the ONNX file beside it."""
    seen = features(SPHERE, state or some_state(), policy.inputs, policy.frame)
    about = PolicyCard(
        "gain",
        policy.scope,
        SPHERE.elevations,
        SPHERE.azimuths,
        ("a", "b", "c", "d"),
        {},
    )
    return write_gain(card, policy, about, seen.astype(np.float32))


def shipped(folder, policy) -> Gain:
    """The policy as it comes from its files."""
    write_card(folder / "mine.json", policy)
    return make_policy(str(folder / "mine.json"), SPHERE)


@pytest.mark.parametrize(
    ("scope", "inputs"), [("global", INPUTS), ("local", ("view", "place"))]
)
def test_the_file_chooses_as_the_networks_do(scope, inputs, tmp_path):
    state = some_state(episodes=300)
    policy = some_gain(inputs=inputs, scope=scope, travel_weight=0.1)
    other = shipped(tmp_path, policy)
    assert (other.inputs, other.scope, other.travel_weight) == (inputs, scope, 0.1)
    seen = features(SPHERE, state, inputs)
    np.testing.assert_allclose(
        other.score(seen.astype(np.float32)), policy.score(seen), atol=1e-5
    )
    random = np.random.default_rng(0)
    np.testing.assert_array_equal(
        other.next_views(state, random), policy.next_views(state, random)
    )


def telling(
    sphere: ViewSphere, rings_of_class: list[list[int]], n: int = 40, seed: int = 0
) -> Predictions:
    """Every view says little of the class, but those on some rings, which depend on the class,
    say it loudly.
    """
    rng = np.random.default_rng(seed)
    c = len(rings_of_class)
    labels = np.arange(n) % c
    logits = rng.normal(size=(n, len(sphere), c)) * 0.1
    logits[np.arange(n), :, labels] += 0.3
    for i, label in enumerate(labels):
        loud = np.isin(sphere.ring, rings_of_class[label])
        logits[i, loud, label] += 3
    return train_predictions(
        logits.astype(np.float32), labels, sphere, tuple("abcdef"[:c])
    )


# Training


QUICK = GainRecipe(
    epochs=6, episodes=2, batch=128, networks_per_fold=2, max_views=3, lr=1e-2
)


def test_training_finds_the_views_that_tell_the_class_believed():
    """Every class is told on one ring alone, and each view hints at the class: go to the ring of
    the class believed.
    """
    learned = telling(SMALL, [[0], [1], [2]], 240)
    fresh = telling(SMALL, [[0], [1], [2]], 90, seed=1)
    recipe = replace(
        QUICK, inputs=("belief", "view", "place"), frame="camera", epochs=20
    )
    *_, ((policy,), value) = best_epoch([train(learned, recipe)], [fresh], recipe)
    first, second = (
        SMALL.ring[m.state.current]
        for m in rollout(fresh, policy, 2, np.random.default_rng(5))
    )
    not_told_yet = first != fresh.labels
    assert np.mean((second == fresh.labels)[not_told_yet]) > 0.9
    blind = judge(fresh, RandomAll(SMALL), 3, "log-belief", np.random.default_rng(0))
    assert (value.mean > blind.mean + 0.05).all()

    def travel(policy):
        return judge(fresh, policy, 3, "log-belief", np.random.default_rng(0)).travel

    # The dearer the way, the shorter; and it can be made as short as that of random views.
    free, cheap, dear = (
        travel(replace(policy, travel_weight=weight))[-1]
        for weight in (0.0, 0.05, 10.0)
    )
    assert free > cheap > dear
    fitted = replace(
        policy, travel_weight=fit_travel_weight([(fresh, policy)], 3, "log-belief", 0)
    )
    assert (travel(fitted) <= travel(Random(SMALL))).all()
