"""The gain policy: what it may know, what it costs, and that training finds the views that tell."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from factories import make_map_network, make_recogniser
from lab_programs import refused
from pipeline import some_predictions, train_predictions
from scipy.special import log_softmax
from test_fits import SMALL, telling
from test_policies import SPHERE, state_of

torch = pytest.importorskip("torch")

from lab_programs import main

import nextview
from nextview.data.samples import sample_mesh
from nextview.errors import ModelError, SessionError
from nextview.policies.base import Evidence
from nextview.policies.baselines import Random, RandomAll
from nextview.policies.gain import Gain, features, mirrored, mirrored_features
from nextview.policies.maps import SpherePeak
from nextview.policies.policy_card import PolicyCard
from nextview.policies.registry import make_policy
from nextview.recognition.belief import Calibration
from nextview.session.session import Session
from nextview_lab.benchmark.classes import load as load_results
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
    sphere=SPHERE,
    inputs=INPUTS,
    networks=2,
    seed=0,
    frame="camera",
    **rest,
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


def turned(state, sphere, steps: int):
    """The same episodes with the world's azimuth counted from elsewhere."""
    views = (
        sphere.ring * sphere.azimuths + (sphere.azimuth_index + steps) % sphere.azimuths
    )
    visited = np.zeros_like(state.visited)
    visited[:, views] = state.visited
    return replace(state, current=views[state.current], visited=visited), views


@pytest.mark.parametrize("frame", ["camera", "object"])
@pytest.mark.parametrize("travel_weight", [0.0, 0.3])
def test_absolute_azimuth_means_nothing(travel_weight, frame):
    state, policy = some_state(), some_gain(travel_weight=travel_weight, frame=frame)
    gains, chosen = (
        policy.gains(state),
        policy.next_views(state, np.random.default_rng(0)),
    )
    for steps in (1, 3, 4):
        other, views = turned(state, SPHERE, steps)
        np.testing.assert_allclose(policy.gains(other)[:, views], gains, atol=1e-9)
        going = ~state.visited.all(1)
        np.testing.assert_array_equal(
            policy.next_views(other, np.random.default_rng(0))[going],
            views[chosen][going],
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


def reflected(state):
    """The same episodes in the mirror, azimuth to minus azimuth, and where each view is then."""
    flip = mirrored(SPHERE)
    # Columns are azimuths from here: -1, 0, 1 of a window, 0, 1, ... once round.
    maps = {
        name: (
            np.concatenate([m[:, :, :1], m[:, :, :0:-1]], 2)
            if name.endswith("-sphere")
            else m[:, :, ::-1]
        )
        for name, m in state.evidence.maps.items()
    }
    evidence = Evidence(state.evidence.logits, maps)
    azimuth_bins = state.azimuth_bins[..., -np.arange(8) % 8]
    moved = {"current": flip[state.current], "visited": state.visited[:, flip]}
    return replace(state, **moved, evidence=evidence, azimuth_bins=azimuth_bins), flip


# What every choice leads to


def some_table(n=30, sphere=SMALL, seed=0, azimuth_bins=False) -> ReplayTable:
    rng = np.random.default_rng(seed)
    data = telling(sphere, [[0], [1], [2]], n, seed)
    noisy = data.logits + rng.normal(size=data.logits.shape)
    maps = {
        "lem-sphere": rng.random(
            (n, len(sphere), sphere.rings, sphere.azimuths),
            dtype=np.float32,
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
                    reached,
                    log_evidence[kind][np.arange(30), state.current],
                    atol=1e-9,
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
        value_after(table, moment.total, 4, "log-belief"),
        of_truth,
        atol=1e-9,
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


@pytest.mark.parametrize(("frame", "travel_weight"), [("camera", 0.3), ("object", 0.0)])
def test_a_mirrored_object_gets_the_mirrored_choice(travel_weight, frame, tmp_path):
    policy = shipped(tmp_path, some_gain(travel_weight=travel_weight, frame=frame))
    state = some_state(episodes=300)
    other, flip = reflected(state)
    seen, mirror = (
        features(SPHERE, each, INPUTS, frame).astype(np.float32)
        for each in (state, other)
    )
    np.testing.assert_array_equal(
        mirror,
        seen[:, mirrored_features(SPHERE, CLASSES, INPUTS, frame)],
    )
    np.testing.assert_array_equal(policy.score(mirror)[:, flip], policy.score(seen))
    chosen, mirror = (
        policy.next_views(each, np.random.default_rng(0)) for each in (state, other)
    )
    going = ~state.visited.all(1)
    assert len(np.unique(chosen[going])) > 10
    np.testing.assert_array_equal(mirror[going], flip[chosen][going])


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
        other.score(seen.astype(np.float32)),
        policy.score(seen),
        atol=1e-5,
    )
    random = np.random.default_rng(0)
    np.testing.assert_array_equal(
        other.next_views(state, random),
        policy.next_views(state, random),
    )


def test_a_map_of_another_measure_is_predicted_live_where_a_network_of_the_folder_predicts_it(
    tmp_path,
):
    make_recogniser(tmp_path, ["a", "b", "c", "d"])
    make_map_network(tmp_path, "view_area")
    write_card(tmp_path / "mine.json", some_gain(inputs=("place", "view_area")))
    system = nextview.load(tmp_path, policy="mine", threshold=1.0, max_views=3)
    assert system.policy.needs == ("view_area",)
    views = system.recognise(sample_mesh("chair"), start=9).views
    assert [len(view.maps["view_area"]) for view in views] == [5, 5, 5]
    # the network knows no whole sphere
    for inputs in (["place", "view_area-sphere"], ["place", "mine:clutter"]):
        write_card(tmp_path / "mine.json", some_gain(inputs=tuple(inputs)))
        said = (
            f"no network predicts the map '{inputs[1]}'; there are lem, lem-sphere, lcm,"
            " lcm-sphere, view_area$"
        )
        with pytest.raises(ModelError, match=said):
            nextview.load(tmp_path, policy="mine")
    system = nextview.load(tmp_path, policy="view_area")
    with pytest.raises(SessionError, match="needs the map 'view_area-sphere'"):
        Session(system.models, SpherePeak(SPHERE, "view_area-sphere"), SPHERE)


# Training


QUICK = GainRecipe(
    epochs=6,
    episodes=2,
    batch=128,
    networks_per_fold=2,
    max_views=3,
    lr=1e-2,
)


def test_training_finds_the_views_that_tell_the_class_believed():
    """Every class is told on one ring alone, and each view hints at the class: go to the ring of
    the class believed.
    """
    learned = ReplayTable(telling(SMALL, [[0], [1], [2]], 240))
    fresh = ReplayTable(telling(SMALL, [[0], [1], [2]], 90, seed=1))
    recipe = replace(
        QUICK,
        inputs=("belief", "view", "place"),
        frame="camera",
        epochs=20,
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
        policy,
        travel_weight=fit_travel_weight([(fresh, policy)], 3, "log-belief", 0),
    )
    assert (travel(fitted) <= travel(Random(SMALL))).all()


def test_the_same_seed_gives_the_same_policy():
    table = some_table(azimuth_bins=True)
    recipe = replace(QUICK, epochs=2)

    def weights(seed):
        *_, policy = train(table, replace(recipe, seed=seed))
        return np.concatenate(
            [
                part.detach().numpy().ravel()
                for part in policy.score.networks.parameters()
            ]
        )

    np.testing.assert_array_equal(weights(0), weights(0))
    assert np.abs(weights(0) - weights(1)).max() > 0.01


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
        p,
        splits=np.array(["train"] * 90),
        maps=maps,
        azimuth_bins=azimuth_bins,
    ).save(path)
    return path


@pytest.mark.long
def test_the_command_writes_a_card_that_runs_at_any_price(unseen, tmp_path, capsys):
    card = tmp_path / "mine.json"
    main(
        [
            "train",
            "gain",
            str(unseen),
            str(card),
            "--epochs",
            "1",
            "--inputs",
            "belief",
            "place",
            "--frame",
            "camera",
        ]
    )
    values = json.loads(card.read_text())
    assert "90 objects" in values["learned_from"]
    assert "each judged by networks of 19 other folds" in values["learned_from"]
    policy = make_policy(str(card), SPHERE, classes=("ball", "box", "pillar"))
    assert isinstance(policy, Gain)
    assert policy.travel_weight == values["table"]["travel_weight"]
    assert make_policy(f"{card}@0.5", SPHERE).travel_weight == 0.5
    assert policy.needs == ()
    with pytest.raises(ValueError, match="a travel weight is a number of at least 0"):
        make_policy(f"{card}@much", SPHERE)
    with pytest.raises(ValueError, match="does not weigh travel"):
        make_policy("class-table@1", SPHERE)
    with pytest.raises(ValueError, match="other classes"):
        make_policy(str(card), SPHERE, classes=("ball", "box"))
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "mine.json",
        "mine.onnx",
        "unseen.npz",
    ]
    assert "its answers differ from the networks' by" in " ".join(
        capsys.readouterr().err.split()
    )
    main(
        [
            "train",
            "gain",
            str(unseen),
            str(card),
            "--epochs",
            "1",
            "--local",
            "--travel-weight",
            "0.2",
            "--overwrite",
        ]
    )
    policy = make_policy(str(card), SPHERE)
    assert (policy.scope, policy.travel_weight, policy.needs) == (
        "local",
        0.2,
        ("lem-sphere", "azimuth_bins"),
    )
    assert policy.frame == "object"


def test_few_objects_have_a_fold_each(unseen, tmp_path, capsys):
    Predictions.load(unseen).of_objects(np.arange(4)).save(tmp_path / "few.npz")
    command = [
        "train",
        "gain",
        str(tmp_path / "few.npz"),
        str(tmp_path / "few.json"),
        "--epochs",
        "1",
    ]
    main([*command, "--inputs", "belief", "place", "--frame", "camera"])
    assert (
        "judged by networks of 3 other folds"
        in json.loads((tmp_path / "few.json").read_text())["learned_from"]
    )
    Predictions.load(unseen).of_objects(np.arange(1)).save(tmp_path / "one.npz")
    words = refused(
        capsys,
        "train",
        "gain",
        tmp_path / "one.npz",
        tmp_path / "one.json",
    )
    assert (
        "1 objects cannot be divided into 1 folds: two folds and as many objects are needed at"
        " least" in words
    )


def test_it_learns_from_what_sensors_made_of_the_same_objects(unseen, tmp_path, capsys):
    p = Predictions.load(unseen)
    replace(p, logits=p.logits[:, ::-1]).of_objects(np.arange(90)[::-1]).save(
        tmp_path / "sensed.npz"
    )
    sensed = Predictions.load(tmp_path / "sensed.npz").of_objects(np.arange(90)[::-1])
    kept = np.array([3, 50, 7])
    table = ReplayTable.select(p, kept, np.random.default_rng(0), [sensed])
    np.testing.assert_array_equal(table.data.logits[3:], p.logits[kept][:, ::-1])
    np.testing.assert_array_equal(table.data.labels, np.tile(p.labels[kept], 2))
    np.testing.assert_array_equal(
        table.data.maps["lem-sphere"],
        np.tile(p.maps["lem-sphere"][kept], (2, 1, 1, 1)),
    )
    card = tmp_path / "mine.json"
    more = ["--sensed", str(tmp_path / "sensed.npz"), "--epochs", "1", "--folds", "2"]
    start = ["train", "gain", str(unseen), str(card), *more]
    main(start)
    assert (
        "90 objects of the training split, clean and through sensors"
        in json.loads(card.read_text())["learned_from"]
    )
    assert isinstance(
        make_policy(str(card), SPHERE, classes=("ball", "box", "pillar")),
        Gain,
    )
    assert "no --validation" in refused(
        capsys,
        *start,
        "--overwrite",
        "--validation",
        unseen,
    )


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


def ring_that_tells(n: int, seed: int, split: str) -> Predictions:
    """Objects that only one ring tells, another one for each, and a map of one's own measure
    that shows which.
    """
    rng = np.random.default_rng(seed)
    labels, ring = np.arange(n) % 3, rng.integers(SMALL.rings, size=n)
    logits = 0.1 * rng.normal(size=(n, len(SMALL), 3))
    tells = SMALL.ring == ring[:, None]
    logits[np.arange(n), :, labels] += 4 * tells
    window = tells[:, SMALL.windows].astype(np.float32)
    whole = np.broadcast_to(
        tells.reshape(n, 1, SMALL.rings, SMALL.azimuths),
        (n, len(SMALL), 3, 4),
    ).astype(np.float32)
    maps = {"mine:clutter": window, "mine:clutter-sphere": whole}
    known = {
        "maps": maps,
        "depth_entropy": rng.random((n, len(SMALL))).astype(np.float32),
    }
    known |= {
        "names": tuple(f"{split}_{i}" for i in range(n)),
        "splits": np.array([split] * n),
    }
    return train_predictions(
        logits.astype(np.float32),
        labels,
        SMALL,
        ("a", "b", "c"),
        **known,
    )


@pytest.mark.parametrize("given", ["mine:clutter", "mine:clutter-sphere"])
def test_a_map_of_a_measure_of_ones_own_leads_a_policy_to_the_views_that_it_shows(
    given,
    tmp_path,
    capsys,
):
    """Trained from the command, and followed in the benchmark on objects that were not learned
    from.
    """
    learned, fresh, card = (
        tmp_path / "learn.npz",
        tmp_path / "test.npz",
        tmp_path / "mine.json",
    )
    ring_that_tells(120, 0, "train").save(learned)
    p = ring_that_tells(60, 1, "test")
    p.save(fresh)
    quick = ["--epochs", "12", "--folds", "2", "--lr", "0.01", "--batch", "128"]
    how = [
        "--inputs",
        given,
        "place",
        "--frame",
        "camera",
        "--max-views",
        "2",
        "--travel-weight",
        "0",
    ]
    main(["train", "gain", str(learned), str(card), *how, *quick])
    assert json.loads(card.read_text())["table"]["inputs"] == [given, "place"]
    run = [
        "--runs",
        "4",
        "--samples",
        "20",
        "--max-views",
        "2",
        "--thresholds",
        "0.999",
    ]
    main(
        [
            "benchmark",
            "classes",
            str(fresh),
            str(tmp_path / "out"),
            *run,
            "--policies",
            str(card),
        ]
    )
    episodes = load_results(tmp_path / "out").episodes(str(card), 0.999)
    rows = [p.names.index(name) for name in episodes["object"].astype(str)]
    tells = p.maps["mine:clutter-sphere"][rows, 0].argmax(1)[:, 0]
    first, second = (
        np.array([views[min(k, len(views) - 1)] for views in episodes["views"]])
        for k in (0, 1)
    )
    going = SMALL.ring[first] != tells
    assert 100 < going.sum() < 240
    assert (SMALL.ring[second] == tells)[going].mean() > 0.95
    replace(p, maps={}).save(fresh, overwrite=True)
    said = refused(
        capsys,
        "benchmark",
        "classes",
        fresh,
        tmp_path / "none",
        *run,
        "--policies",
        card,
        "--reference",
        card,
    )
    assert f"needs the map '{given}', which these predictions lack" in said
