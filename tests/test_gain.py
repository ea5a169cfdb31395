"""The gain policy: what it may know, what it costs, and that training finds the views that tell."""

import json
import time
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.special import log_softmax
from test_fitting import SMALL, telling
from test_policies import SPHERE, state_of
from test_predictions import some_predictions

from nextview.cli.main import main
from nextview.fitting.choices import OUTCOMES, ReplayTable, choices, follow, judge, outcome, travel_price
from nextview.policies.base import Evidence
from nextview.policies.baselines import Random, RandomAll
from nextview.policies.gain import INPUTS, Gain, mirrored, told, told_mirrored
from nextview.policies.registry import make_policy
from nextview.recognition import PLAIN_SUM, Calibration
from nextview.training.recipes import GainRecipe

CLASSES = 4


def some_gain(sphere=SPHERE, inputs=INPUTS, networks=2, seed=0, **rest) -> Gain:
    """With weights at random: whatever it was trained to, these promises hold."""
    rng = np.random.default_rng(seed)
    widths = [len(told_mirrored(sphere, CLASSES, inputs)), 8, 8, len(sphere)]
    layers = [
        tuple((rng.normal(size=(a, b)), rng.normal(size=b)) for a, b in pairwise(widths)) for _ in range(networks)
    ]
    return Gain(sphere, CLASSES, tuple(layers), inputs, **rest)


def some_state(sphere=SPHERE, episodes=60, seed=0):
    rng = np.random.default_rng(seed)
    state = state_of(sphere, rng.integers(len(sphere), size=episodes), belief=rng.dirichlet([1] * CLASSES, episodes))
    state.visited[:] |= rng.random(state.visited.shape) < rng.random((episodes, 1))
    maps = {"lem": rng.random((episodes, sphere.rings, 3))}
    return replace(state, evidence=Evidence(rng.normal(size=(episodes, CLASSES)), maps))


# The contract


@pytest.mark.parametrize("anywhere", [True, False])
@pytest.mark.parametrize("inputs", [INPUTS, ("belief",), ("look", "place")])
def test_an_unvisited_view_is_chosen_in_each_episode_by_itself(anywhere, inputs):
    state, policy = some_state(), some_gain(inputs=inputs, anywhere=anywhere)
    chosen = policy.next_views(state, np.random.default_rng(0))
    free = ~state.visited.all(1)
    assert free.sum() > 40
    assert not state.visited[np.arange(60), chosen][free].any()
    for i in range(0, 60, 7):
        alone = replace(
            state,
            current=state.current[[i]],
            visited=state.visited[[i]],
            belief=state.belief[[i]],
            evidence=Evidence(state.evidence.logits[[i]], {"lem": state.evidence.maps["lem"][[i]]}),
        )
        assert policy.next_views(alone, np.random.default_rng(1)) == chosen[i]


def turned(state, sphere, steps: int):
    """The same episodes with the world's azimuth counted from elsewhere."""
    views = sphere.ring * sphere.azimuths + (sphere.azimuth_index + steps) % sphere.azimuths
    visited = np.zeros_like(state.visited)
    visited[:, views] = state.visited
    return replace(state, current=views[state.current], visited=visited), views


@pytest.mark.parametrize("price", [0.0, 0.3])
def test_absolute_azimuth_means_nothing(price):
    state, policy = some_state(), some_gain(price=price)
    gains, chosen = policy.gains(state), policy.next_views(state, np.random.default_rng(0))
    for steps in (1, 3, 4):
        other, views = turned(state, SPHERE, steps)
        np.testing.assert_allclose(policy.gains(other)[:, views], gains, atol=1e-9)
        going = ~state.visited.all(1)
        np.testing.assert_array_equal(policy.next_views(other, np.random.default_rng(0))[going], views[chosen][going])


def test_an_object_and_its_mirror_image_are_alike():
    state, policy = some_state(), some_gain()
    flip = mirrored(SPHERE)  # also the reflection of the world, azimuth to minus azimuth
    evidence = Evidence(state.evidence.logits, {"lem": state.evidence.maps["lem"][:, :, ::-1]})
    other = replace(state, current=flip[state.current], visited=state.visited[:, flip], evidence=evidence)
    np.testing.assert_allclose(policy.gains(other)[:, flip], policy.gains(state), atol=1e-7)
    np.testing.assert_array_equal(
        told(SPHERE, other, INPUTS), told(SPHERE, state, INPUTS)[:, told_mirrored(SPHERE, CLASSES, INPUTS)]
    )


def test_a_high_price_buys_the_nearest_view():
    state, policy = some_state(), some_gain(price=1e6)
    chosen = policy.next_views(state, np.random.default_rng(0))
    going = ~state.visited.all(1)
    distance = np.where(state.visited, np.inf, SPHERE.travel[state.current])
    np.testing.assert_allclose(distance[np.arange(60), chosen][going], distance.min(1)[going])


def test_a_decision_takes_less_than_three_milliseconds():
    state, policy = some_state(episodes=1), some_gain(networks=5)
    taken = []
    for _ in range(20):
        began = time.perf_counter()
        policy.next_views(state, np.random.default_rng(0))
        taken.append(time.perf_counter() - began)
    assert min(taken) < 3e-3


# What every choice leads to


def some_table(n=30, sphere=SMALL, seed=0) -> ReplayTable:
    rng = np.random.default_rng(seed)
    data = telling(sphere, [[0], [1], [2]], n, seed)
    noisy = data.logits + rng.normal(size=data.logits.shape)
    maps = {"lem": rng.random((n, len(sphere), sphere.rings, 3), dtype=np.float32)}
    return ReplayTable(replace(data, logits=noisy.astype(np.float32)), maps, Calibration(0.8, 0.5))


def test_what_a_choice_leads_to_is_what_is_there_after_it():
    table, seen = some_table(), []
    for moment in follow(table, RandomAll(SMALL), 4, np.random.default_rng(0)):
        state = moment.state
        if seen:
            before, said = seen[-1]
            moved = SMALL.travel[before.state.current, state.current]
            np.testing.assert_allclose(moment.travel - before.travel, moved)
            for kind in OUTCOMES:
                reached = outcome(moment.total, table.data.labels, table.calibration.temperature(state.step), kind)
                np.testing.assert_allclose(reached, said[kind][np.arange(30), state.current], atol=1e-9)
        seen.append((moment, {kind: choices(table, moment, kind) for kind in OUTCOMES}))
    moment = seen[-1][0]
    logits = np.stack([table.data.logits[np.arange(30), m.state.current] for m, _ in seen], 1).astype(float)
    logs = log_softmax(logits.sum(1) / (0.8 * 2.5), axis=1)
    np.testing.assert_allclose(np.log(moment.state.belief), logs, atol=1e-9)
    assert (moment.state.visited.sum(1) == 4).all()
    of_truth = logs[np.arange(30), table.data.labels]
    np.testing.assert_allclose(outcome(moment.total, table.data.labels, 2.0, "log-belief"), of_truth, atol=1e-9)
    right = (logits.sum(1).argmax(1) == table.data.labels).astype(float)
    np.testing.assert_array_equal(outcome(moment.total, table.data.labels, 2.0, "right"), right)


def test_objects_that_the_recogniser_knows_or_of_the_test_split_are_refused():
    p = some_predictions(20)
    with pytest.raises(ValueError, match="test split"):
        ReplayTable.of(p, np.arange(20), np.random.default_rng(0))
    with pytest.raises(ValueError, match="no object is left"):
        ReplayTable.of(p, np.arange(0), np.random.default_rng(0))


def test_the_calibration_is_the_predictions_own_or_fitted_to_what_is_learned_from():
    p = replace(some_predictions(60), splits=np.array(["train"] * 60))
    own = Calibration(0.7, 0.4)
    assert ReplayTable.of(replace(p, calibration=own), np.arange(60), np.random.default_rng(0)).calibration == own
    assert ReplayTable.of(p, np.arange(60), np.random.default_rng(0)).calibration != PLAIN_SUM


# Training

torch = pytest.importorskip("torch")

from nextview.training.gain import best_epoch, train  # noqa: E402

QUICK = GainRecipe(epochs=6, walks=2, batch=128, networks=2, looks=3, rate=1e-2)


def test_training_finds_the_views_that_tell_the_class_believed():
    """Every class is told on one ring alone, and each look hints at the class: go to the ring of the class believed."""
    learned = ReplayTable(telling(SMALL, [[0], [1], [2]], 240), {}, PLAIN_SUM)
    fresh = ReplayTable(telling(SMALL, [[0], [1], [2]], 90, seed=1), {}, PLAIN_SUM)
    recipe = replace(QUICK, inputs=("belief", "look", "place"), epochs=20)
    *_, (policy, worth) = best_epoch(train(learned, recipe), fresh, recipe)
    first, second = (SMALL.ring[m.state.current] for m in follow(fresh, policy, 2, np.random.default_rng(5)))
    not_told_yet = first != fresh.data.labels
    assert np.mean((second == fresh.data.labels)[not_told_yet]) > 0.9
    blind = judge(fresh, RandomAll(SMALL), 3, "log-belief", np.random.default_rng(0))
    assert (worth.outcome > blind.outcome + 0.05).all()
    # What may be bought for little travel depends on where one stands: dearer ways are shorter.
    travel = [
        judge(fresh, replace(policy, price=p), 3, "log-belief", np.random.default_rng(0)).travel[-1]
        for p in (0.0, 0.05, 10.0)
    ]
    assert travel[0] > travel[1] > travel[2]
    price = travel_price(fresh, policy, 3, "log-belief", 0)
    limit = judge(fresh, Random(SMALL), 3, "log-belief", np.random.default_rng(0)).travel
    assert (judge(fresh, replace(policy, price=price), 3, "log-belief", np.random.default_rng(0)).travel <= limit).all()


def test_the_same_seed_gives_the_same_policy():
    table = some_table()
    recipe = replace(QUICK, epochs=2)

    def weights(seed):
        *_, policy = train(table, replace(recipe, seed=seed))
        return np.concatenate([np.ravel(part) for net in policy.networks for layer in net for part in layer])

    np.testing.assert_array_equal(weights(0), weights(0))
    assert np.abs(weights(0) - weights(1)).max() > 0.01


@pytest.fixture
def unseen(tmp_path):
    path = tmp_path / "unseen.npz"
    p = some_predictions(90)
    replace(p, splits=np.array(["train"] * 90)).save(path)
    return path


def test_the_command_writes_a_card_that_runs_at_any_price(unseen, tmp_path, capsys):
    card = tmp_path / "mine.json"
    main(["train", "gain", str(unseen), str(card), "--epochs", "2", "--inputs", "belief", "place"])
    facts = json.loads(card.read_text())
    assert "72 objects" in facts["learned_from"]
    policy = make_policy(str(card), SPHERE, classes=("ball", "box", "pillar"))
    assert isinstance(policy, Gain)
    assert policy.price == facts["table"]["price"]
    assert make_policy(f"{card}@0.5", SPHERE).price == 0.5
    assert policy.needs == ()
    for wrong in ("-1", "much", "nan", ""):
        with pytest.raises(ValueError, match="a price is a number of at least 0"):
            make_policy(f"{card}@{wrong}", SPHERE)
    with pytest.raises(ValueError, match="pays no price"):
        make_policy("class-table@1", SPHERE)
    with pytest.raises(ValueError, match="other classes"):
        make_policy(str(card), SPHERE, classes=("ball", "box"))
    facts["table"]["networks"][0].pop()
    card.write_text(json.dumps(facts))
    with pytest.raises(ValueError, match="do not lead from"):
        make_policy(str(card), SPHERE)
    main(["train", "gain", str(unseen), str(card), "--epochs", "1", "--local", "--price", "0.2"])
    policy = make_policy(str(card), SPHERE)
    assert (policy.anywhere, policy.price, policy.needs) == (False, 0.2, ("lem",))


def test_validation_objects_are_left_out_of_the_training(unseen, tmp_path, capsys):
    from nextview.data.predictions import Predictions

    p = Predictions.load(unseen)
    some = replace(
        p, logits=p.logits[:20], maps={n: m[:20] for n, m in p.maps.items()}, depth_entropy=p.depth_entropy[:20],
        names=p.names[:20], labels=p.labels[:20], splits=p.splits[:20], conflicting=p.conflicting[:20],
    )  # fmt: skip
    some.save(tmp_path / "validation.npz")
    card = tmp_path / "mine.json"
    main(["train", "gain", str(unseen), str(card), "--epochs", "1", "--validation", str(tmp_path / "validation.npz")])
    assert "70 objects" in json.loads(card.read_text())["learned_from"]
    for arguments, sentence in [
        ([str(unseen), str(tmp_path / "mine")], "NAME.json"),
        ([str(tmp_path / "none.npz"), str(card)], "no such file"),
    ]:
        with pytest.raises(SystemExit) as end:
            main(["train", "gain", *arguments])
        assert end.value.code == 2
        assert sentence in capsys.readouterr().err
