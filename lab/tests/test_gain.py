"""The gain policy: what it may know, what it costs, and that training finds the views that tell."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from lab_programs import refused
from pipeline import some_predictions
from scipy.special import log_softmax
from test_fits import SMALL, telling
from test_policies import SPHERE, state_of

torch = pytest.importorskip("torch")

from lab_programs import main

from nextview.policies.base import Evidence
from nextview.policies.baselines import Random, RandomAll
from nextview.policies.gain import Gain, features, mirrored, mirrored_features
from nextview.policies.policy_card import PolicyCard
from nextview.policies.registry import make_policy
from nextview.recognition.belief import Calibration
from nextview_lab.data.predictions import Predictions
from nextview_lab.training.gain_training import (
    Perceptrons,
    Score,
    best_epoch,
    train,
    write_gain,
)
from nextview_lab.training.recipes import GainRecipe
from nextview_lab.training.rollout import (
    OBJECTIVES,
    ReplayTable,
    candidate_values,
    fit_travel_weight,
    judge,
    rollout,
    value_after,
)

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


def test_in_the_objects_frame_it_does_not_matter_from_which_azimuth_the_object_is_seen():
    """The same views of it are visited, and the camera stands at one of them or another of the
    same ring.
    """
    # azimuth at which the object shows its azimuth bin 0, and the ring of the camera
    zero, ring = 3, 2
    states = []
    for azimuth in (1, 6):
        state = some_state(episodes=1)
        side = (azimuth - zero) % 8
        state.azimuth_bins[:] = 0.02
        state.azimuth_bins[:, :, side] = 0.86
        # of the sphere, by the object's own azimuth
        around = np.random.default_rng(1).random((1, 5, 8))
        state.evidence.maps["lem-sphere"] = around[:, :, (np.arange(8) + side) % 8]
        state.visited[:] = np.arange(40) % 3 == 0
        states.append(replace(state, current=np.array([ring * 8 + azimuth])))
    inputs = ("belief", "place", "lem-sphere")
    np.testing.assert_allclose(
        *(features(SPHERE, state, inputs, "object") for state in states)
    )
    assert not np.allclose(
        *(features(SPHERE, state, inputs, "camera") for state in states)
    )
    for state in states:  # and the networks are told on which side the camera is
        assert (
            features(SPHERE, state, ("azimuth_bin",), "object")[0, :8].argmax()
            == (state.current[0] % 8 - zero) % 8
        )


# What every choice leads to


def some_table(n=30, sphere=SMALL, seed=0, azimuth_bins=False) -> ReplayTable:
    rng = np.random.default_rng(seed)
    data = telling(sphere, [[0], [1], [2]], n, seed)
    noisy = data.logits + rng.normal(size=data.logits.shape)
    maps = {
        "lem-sphere": rng.random(
            (n, len(sphere), sphere.rings, sphere.azimuths), dtype=np.float32
        )
    }
    shape = (n, len(sphere), len(data.classes), sphere.azimuths)
    likely = (
        log_softmax(rng.normal(size=shape), axis=3).astype(np.float32)
        if azimuth_bins
        else None
    )
    calibration = Calibration(0.8, 0.5, bin_correlation=0.1 if azimuth_bins else None)
    known = {"logits": noisy.astype(np.float32), "azimuth_bins": likely}
    return ReplayTable(replace(data, **known, maps=maps, calibration=calibration))


@pytest.mark.parametrize("azimuth_bins", [False, True])
def test_what_a_choice_leads_to_is_what_is_there_after_it(azimuth_bins):
    table, seen = some_table(azimuth_bins=azimuth_bins), []
    for moment in rollout(table, RandomAll(SMALL), 4, np.random.default_rng(0)):
        state = moment.state
        if seen:
            before, log_evidence = seen[-1]
            moved = SMALL.travel[before.state.current, state.current]
            np.testing.assert_allclose(moment.travel - before.travel, moved)
            for kind in OBJECTIVES:
                reached = value_after(table, moment.total, state.step, kind)
                np.testing.assert_allclose(
                    reached, log_evidence[kind][np.arange(30), state.current], atol=1e-9
                )
        seen.append(
            (
                moment,
                {kind: candidate_values(table, moment, kind) for kind in OBJECTIVES},
            )
        )
    moment = seen[-1][0]
    logs = np.log(moment.state.belief)  # test_nothing_seen computes beliefs by hand
    assert (moment.state.visited.sum(1) == 4).all()
    of_truth = logs[np.arange(30), table.data.labels]
    np.testing.assert_allclose(
        value_after(table, moment.total, 4, "log-belief"), of_truth, atol=1e-9
    )
    right = (logs.argmax(1) == table.data.labels).astype(float)
    np.testing.assert_array_equal(value_after(table, moment.total, 4, "right"), right)


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
    state, policy = (
        some_state(episodes=300),
        some_gain(inputs=inputs, scope=scope, travel_weight=0.1),
    )
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


# Training


QUICK = GainRecipe(
    epochs=6, episodes=2, batch=128, networks_per_fold=2, max_views=3, lr=1e-2
)


def test_training_finds_the_views_that_tell_the_class_believed():
    """Every class is told on one ring alone, and each view hints at the class: go to the ring of
    the class believed.
    """
    learned = ReplayTable(telling(SMALL, [[0], [1], [2]], 240))
    fresh = ReplayTable(telling(SMALL, [[0], [1], [2]], 90, seed=1))
    recipe = replace(
        QUICK, inputs=("belief", "view", "place"), frame="camera", epochs=20
    )
    *_, ((policy,), value) = best_epoch([train(learned, recipe)], [fresh], recipe)
    first, second = (
        SMALL.ring[m.state.current]
        for m in rollout(fresh, policy, 2, np.random.default_rng(5))
    )
    not_told_yet = first != fresh.data.labels
    assert np.mean((second == fresh.data.labels)[not_told_yet]) > 0.9
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


@pytest.fixture
def unseen(tmp_path):
    path = tmp_path / "unseen.npz"
    p = some_predictions(90)
    sphere = (
        np.random.default_rng(0)
        .random((90, len(p.sphere), p.sphere.rings, p.sphere.azimuths))
        .astype(np.float32)
    )
    azimuth_bins = (
        np.random.default_rng(1)
        .normal(size=(90, len(p.sphere), 3, p.sphere.azimuths))
        .astype(np.float32)
    )
    maps = p.maps | {"lem-sphere": sphere}
    replace(
        p, splits=np.array(["train"] * 90), maps=maps, azimuth_bins=azimuth_bins
    ).save(path)
    return path


def test_validation_objects_are_left_out_of_the_training(unseen, tmp_path, capsys):
    p = Predictions.load(unseen)
    p.of_objects(np.arange(20)).save(tmp_path / "validation.npz")
    card = tmp_path / "mine.json"
    main(
        [
            "train",
            "gain",
            str(unseen),
            str(card),
            "--epochs",
            "1",
            "--validation",
            str(tmp_path / "validation.npz"),
        ]
    )
    assert "70 objects" in json.loads(card.read_text())["learned_from"]
    replace(p, azimuth_bins=None).save(tmp_path / "sideless.npz")
    new = tmp_path / "new.json"
    for arguments, sentence in [
        (
            [unseen, new, "--inputs", "beleif"],
            "no map 'beleif'; predict it, or choose --inputs among belief, ",
        ),
        ([tmp_path / "sideless.npz", new], "holds no azimuth bins"),
    ]:
        assert sentence in refused(capsys, "train", "gain", *arguments)
