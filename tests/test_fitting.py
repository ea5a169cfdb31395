"""What is fitted to predictions, against generated evidence whose answer is known."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import log_softmax
from scipy.stats import binomtest
from test_predictions import some_predictions
from tiny_models import make_recogniser

from nextview.belief import PLAIN_SUM, Calibration
from nextview.calibration.fitting_set import FittingSet, blind_walks, fitting_set
from nextview.calibration.policy_tables import fit_class_table, fit_ring, fit_sequence
from nextview.calibration.temperature import error_bound, fit_risk, fit_temperature, loss
from nextview.cli.main import main
from nextview.data.predictions import Predictions
from nextview.data.splits import divide
from nextview.errors import PredictionsError
from nextview.models.inference import Recogniser
from nextview.policies.baselines import Random
from nextview.policies.learned_tables import ClassTable, cells_from, cells_to
from nextview.policies.registry import make_policy
from nextview.viewsphere import ViewSphere

SPHERE = ViewSphere.named("40")
SMALL = ViewSphere((0.0, 30.0, 60.0), 4)


def correlated(n: int, correlation: float, temperature: float, seed: int = 0) -> FittingSet:
    """Two classes at -1 and +1, seen through Gaussian noise that is shared in part by all views of an object."""
    rng, spread = np.random.default_rng(seed), 1.5
    labels = (rng.random(n) < 0.8).astype(np.int64)  # a mix that the even weights have to undo
    shared, own = rng.normal(size=(n, 1)), rng.normal(size=(n, len(SMALL)))
    seen = 2.0 * labels[:, None] - 1 + spread * (np.sqrt(correlation) * shared + np.sqrt(1 - correlation) * own)
    logits = np.stack([-((seen - m) ** 2) / (2 * spread**2) for m in (-1, 1)], -1)
    return FittingSet((temperature * logits).astype(np.float32), labels, SMALL, ("minus", "plus"))


@pytest.mark.parametrize(("correlation", "temperature"), [(0.0, 1.0), (0.4, 0.5), (0.8, 2.0)])
def test_the_correlation_and_temperature_of_generated_looks_are_found(correlation, temperature):
    data = correlated(4000, correlation, temperature)
    found = fit_temperature(data, np.random.default_rng(1), walks=1)
    assert found.temperature == pytest.approx(temperature, rel=0.08)
    assert found.correlation == pytest.approx(correlation, abs=0.06)
    losses = [loss(data, c, np.random.default_rng(2), walks=1) for c in (found, Calibration(temperature, correlation))]
    assert losses[0] == pytest.approx(losses[1], rel=0.01)
    if correlation:
        assert losses[0] < loss(data, PLAIN_SUM, np.random.default_rng(2), walks=1)


@pytest.mark.parametrize("right", [0.8, 0.5])
def test_sides_count_as_far_as_looks_are_right_about_them(right):
    """Both classes look alike; seen as the true one, a view claims to be right about the side 8 times in 10."""
    rng, n, v, s = np.random.default_rng(0), 2000, len(SMALL), SMALL.azimuths
    labels, zero = rng.integers(0, 2, n), rng.integers(0, s, n)
    claimed = rng.integers(0, s, (n, v, 2))  # seen as the other class: anything
    true = (SMALL.azimuth_index - zero[:, None]) % s
    wrong = (true + rng.integers(1, s, (n, v))) % s
    claimed[np.arange(n)[:, None], np.arange(v), labels[:, None]] = np.where(rng.random((n, v)) < right, true, wrong)
    azimuth_bins = np.log(np.where(np.arange(s) == claimed[..., None], 0.8, 0.2 / (s - 1))).astype(np.float32)
    data = FittingSet(rng.normal(size=(n, v, 2)).astype(np.float32) / 100, labels, SMALL, ("a", "b"), azimuth_bins)
    found = fit_temperature(data, np.random.default_rng(1), walks=1)
    if right == 0.8:  # as good as they claim, and each by itself
        assert found.bin_correlation == pytest.approx(0, abs=0.05)
    else:
        assert found.bin_correlation > 0.1
    blind = Calibration(found.temperature, found.correlation)
    of_found, of_blind = (loss(data, c, np.random.default_rng(2), walks=1) for c in (found, blind))
    assert of_found < of_blind


def test_the_bound_of_single_episodes_is_that_of_clopper_and_pearson():
    rng = np.random.default_rng(0)
    for n, wrong in [(50, 0), (50, 3), (300, 30), (7, 7)]:
        stopped = np.concatenate([np.ones(n), np.zeros(20)])
        failed = np.concatenate([np.ones(wrong), np.zeros(n - wrong), np.zeros(20)])
        order = rng.permutation(n + 20)
        bound = error_bound(failed[order], stopped[order], np.full(n + 20, 0.7), 0.05)
        exact = binomtest(wrong, n, alternative="less").proportion_ci(0.95, "exact").high
        assert bound == pytest.approx(exact, abs=1e-6)
    assert error_bound(np.zeros(5), np.zeros(5), np.ones(5), 0.1) == 1


def test_several_episodes_of_an_object_count_as_one():
    once = error_bound(np.eye(20)[0], np.ones(20), np.ones(20), 0.1)
    halves = error_bound(np.eye(20)[0] / 2, np.ones(20), np.ones(20), 0.1)
    assert once == pytest.approx(binomtest(1, 20, alternative="less").proportion_ci(0.9, "exact").high, abs=1e-6)
    # Half the failures, but no more objects than there are.
    assert halves >= binomtest(0, 20, alternative="less").proportion_ci(0.9, "exact").high


def test_promises_are_kept_as_often_as_promised():
    whole = correlated(40_000, 0.5, 1.0, seed=9)
    even = whole.weights
    calibration, risk, n_views, delta = Calibration(1.0, 0.5), 0.22, 3, 0.2
    walks = blind_walks(
        SMALL, Random(SMALL), np.random.default_rng(0).integers(12, size=len(whole)), n_views, np.random.default_rng(1)
    )
    total = np.cumsum(whole.logits[np.arange(len(whole))[:, None], walks], axis=1)
    sure = np.stack(
        [np.exp(log_softmax(total[:, k] / calibration.temperature_after(k + 1), 1)).max(1) for k in range(n_views)], 1
    )
    wrong = total.argmax(2) != whole.labels[:, None]

    def error_at(threshold: float) -> float:
        reached = sure >= threshold
        stopped, first = reached.any(1), reached.argmax(1)
        return np.average(wrong[np.arange(len(whole)), first][stopped], weights=even[stopped])

    promises, broken = 0, 0
    for seed in range(60):
        some = np.random.default_rng([5, seed]).choice(len(whole), 300, replace=False)
        part = replace(whole, logits=whole.logits[some], labels=whole.labels[some])
        bounds = fit_risk(part, calibration, np.random.default_rng(seed), delta, n_views, walks=1)
        if min(bounds.bounds[n_views - 1]) <= risk:  # else it promises nothing, and nothing is broken
            promises += 1
            broken += error_at(bounds.threshold(risk, n_views)) > risk
    assert promises > 30
    assert broken <= 60 * delta + 3 * np.sqrt(60 * delta * (1 - delta))


def test_bounds_fall_with_the_threshold_and_promise_nothing_where_few_stop():
    bounds = fit_risk(correlated(500, 0.5, 1.0), Calibration(1.0, 0.5), np.random.default_rng(0), n_views=4)
    assert len(bounds.bounds) == 4
    for row in np.array(bounds.bounds):
        reached = row < 1
        assert (np.diff(row[reached]) <= 0).all()
        assert not reached[-1]  # of these noisy views hardly any is that sure
        assert reached[0]


# What may be fitted to


def copied(p: Predictions, often: int) -> Predictions:
    """With the first object there so many times more, under other names and a little otherwise recognised."""
    rows = np.array([*range(len(p)), *[0] * often])
    arrays = {name: getattr(p, name)[rows] for name in ("labels", "splits", "conflicting", "depth_entropy")}
    logits = p.logits[rows]
    logits[len(p) :] += 1
    names = (*p.names, *(f"copy{i}" for i in range(often)))
    return replace(p, **arrays, logits=logits, maps={k: m[rows] for k, m in p.maps.items()}, names=names)


def test_a_shape_that_was_copied_counts_once():
    p = replace(some_predictions(60), splits=np.array(["train"] * 60))
    many = copied(p, 9)
    once = many.deduplicate()
    assert once.names == p.names
    np.testing.assert_array_equal(once.logits, p.logits)
    assert many.deduplicate().deduplicate().names == p.names
    relabelled = replace(many, labels=np.r_[many.labels[:-1], (many.labels[-1] + 1) % 3])
    assert relabelled.deduplicate().names == (*p.names, "copy8")  # which of two labels is right is not for us
    np.testing.assert_array_equal(fitting_set(many, 1.0, 0).logits, p.logits)
    drawn = [fitting_set(many, 0.1, seed) for seed in range(40)]
    assert any(p.logits[0] in data.logits for data in drawn)
    assert all(sum((row == p.logits[0]).all() for row in data.logits) < 2 for data in drawn)
    assert not any((row == p.logits[0] + 1).all() for data in drawn for row in data.logits)


def test_nothing_is_fitted_to_the_test_split():
    p = some_predictions(30)
    with pytest.raises(PredictionsError, match="test split"):
        fitting_set(p, 1.0, 0)
    with pytest.raises(PredictionsError, match="test split"):
        fitting_set(replace(p, splits=np.array(["train"] * 29 + ["test"])), 1.0, 0)


def test_it_is_fitted_to_the_objects_that_validate():
    p = replace(some_predictions(60), splits=np.array(["train"] * 60))
    _, validation = divide(p.labels, p.depth_entropy, 0.2, 3)
    data = fitting_set(p, 0.2, 3)
    np.testing.assert_array_equal(data.logits, p.logits[validation])
    assert np.bincount(data.labels).tolist() == [4, 4, 4]
    assert len(fitting_set(p, 1.0, 3)) == 60
    for share in (0.0, 1.1, np.nan):
        with pytest.raises(PredictionsError, match="between 0 and 1"):
            fitting_set(p, share, 0)
    with pytest.raises(PredictionsError, match="no object is left"):
        fitting_set(p, 0.001, 0)


def test_every_class_weighs_the_same():
    data = correlated(1000, 0.5, 1.0)
    sums = np.bincount(data.labels, data.weights)
    assert sums[0] == pytest.approx(sums[1])
    assert data.weights.sum() == pytest.approx(1000)


# Tables


def telling(sphere: ViewSphere, rings_of_class: list[list[int]], n: int = 40, seed: int = 0) -> FittingSet:
    """Every view says little of the class, but those on some rings, which depend on the class, say it loudly."""
    rng = np.random.default_rng(seed)
    c = len(rings_of_class)
    labels = np.arange(n) % c
    logits = rng.normal(size=(n, len(sphere), c)) * 0.1
    logits[np.arange(n), :, labels] += 0.3
    for i, label in enumerate(labels):
        loud = np.isin(sphere.ring, rings_of_class[label])
        logits[i, loud, label] += 3
    return FittingSet(logits.astype(np.float32), labels, sphere, tuple("abcdef"[:c]))


@pytest.mark.parametrize("scope", ["global", "local"])
def test_what_tells_most_is_found(scope):
    data = telling(SMALL, [[2], [2]])
    assert fit_ring(data, scope, 4, PLAIN_SUM)[0] == 2
    moves = fit_sequence(data, scope, 3, PLAIN_SUM)
    assert (SMALL.ring[moves] == 2).all()
    by_class = fit_class_table(telling(SMALL, [[0], [2]]), 4, 0.0, PLAIN_SUM, np.random.default_rng(0))
    assert (SMALL.ring[by_class[0].argmax(1)] == 0).all()
    assert (SMALL.ring[by_class[1].argmax(1)] == 2).all()
    duplicate_groups = fit_class_table(telling(SMALL, [[0], [2]]), 4, 1e9, PLAIN_SUM, np.random.default_rng(0))
    np.testing.assert_allclose(duplicate_groups[0], duplicate_groups[1], atol=1e-6)


@pytest.mark.parametrize("scope", ["global", "local"])
def test_each_move_of_a_sequence_is_the_best_there_is(scope):
    rng, calibration = np.random.default_rng(0), Calibration(0.8, 0.5)
    labels = np.array([0, 0, 0, 1, 2])
    data = FittingSet(rng.normal(size=(5, len(SMALL), 3)).astype(np.float32), labels, SMALL, ("a", "b", "c"))
    travel_weight = 0.05
    moves = fit_sequence(data, scope, 2, calibration, travel_weight)

    def turned(view: int, steps: int) -> int:
        ring, azimuth = divmod(view, 4)
        return ring * 4 + (azimuth + steps) % 4

    def value(path: list[int]) -> float:
        by_class = {0: [], 1: [], 2: []}
        for i, label in enumerate(labels):
            for steps in range(4):
                total = data.logits[i, [turned(v, steps) for v in path]].astype(float).sum(0)
                by_class[label].append(log_softmax(total / calibration.temperature_after(len(path)))[label])
        return np.mean([np.mean(values) for values in by_class.values()])

    for ring in range(3):
        path = [ring * 4]
        for move in moves[ring]:
            reachable = range(12) if scope == "global" else SMALL.window(path[-1]).ravel()
            values = {
                v: value([*path, v]) - travel_weight * SMALL.travel[path[-1], v] for v in reachable if v not in path
            }
            path.append(int(cells_from(SMALL)[path[-1], move]))
            assert values[path[-1]] == pytest.approx(max(values.values()), abs=1e-9)


# The commands


@pytest.fixture
def training_predictions(tmp_path):
    """A recogniser's card, and predictions of the training split that claim to be its own."""
    card = make_recogniser(tmp_path, ["ball", "box", "pillar"])
    p = some_predictions(90)
    logits = p.logits.copy()
    logits[np.arange(90), :, p.labels] += np.random.default_rng(0).normal(0.6, 0.8, (90, 1))
    recogniser = ("tiny", json.loads(card.read_text())["sha256"])
    models = {**p.models, "recogniser": recogniser}
    path = tmp_path / "training.npz"
    replace(p, logits=logits.astype(np.float32), splits=np.array(["train"] * 90), models=models).save(path)
    return card, path


def test_a_calibration_goes_into_the_card_and_is_used(training_predictions):
    card, path = training_predictions
    before = json.loads(card.read_text())
    main(["fit", "calibration", str(path), str(card), "--validation", "0.5"])
    after = json.loads(card.read_text())
    assert {name: after[name] for name in before} == before | {"schema": 2}  # written anew
    assert [line.split()[:3] for line in after["training"]["commands"]] == [["nextview", "fit", "calibration"]]
    calibration = Recogniser(card).calibration
    assert calibration.correlation > 0.1
    assert calibration.risk is not None
    assert "45 objects" in after["fitted_to"]["calibration"]


def test_a_calibration_is_fitted_to_what_the_card_calls_held_out_whatever_the_sizes(training_predictions, capsys):
    card, path = training_predictions
    with pytest.raises(SystemExit):
        main(["fit", "calibration", str(path), str(card)])
    assert "holds no object that" in capsys.readouterr().err
    p, card_before = Predictions.load(path), json.loads(card.read_text())
    card.write_text(json.dumps(card_before | {"held_out": [*p.names[:30], "elsewhere"]}))
    main(["fit", "calibration", str(path), str(card)])
    fitted = json.loads(card.read_text())
    by_shape = fitted["calibration"]
    assert "30 objects" in fitted["fitted_to"]["calibration"]
    of_size = np.random.default_rng(0).normal(0, 3, (90, 3)).astype(np.float32)
    replace(p, logits=p.logits + of_size[:, None], of_size=of_size).save(path)
    main(["fit", "calibration", str(path), str(card)])
    sized = json.loads(card.read_text())["calibration"]
    assert sized["temperature"] == pytest.approx(by_shape["temperature"], abs=1e-3)


def test_a_calibration_that_knows_a_bad_sensor_trusts_views_less(training_predictions, tmp_path, capsys):
    card, path = training_predictions
    p = Predictions.load(path)
    card.write_text(json.dumps(json.loads(card.read_text()) | {"held_out": list(p.names[:60])}))
    main(["fit", "calibration", str(path), str(card)])
    clean = Recogniser(card).calibration
    order = np.random.default_rng(1).permutation(90)  # the same objects, in another order
    noise = np.random.default_rng(2).normal(0, 4, p.logits.shape)
    sensed = replace(p, logits=(p.logits + noise).astype(np.float32)).of_objects(order)
    sensed.save(tmp_path / "sensed.npz")
    main(["fit", "calibration", str(path), str(card), "--sensed", str(tmp_path / "sensed.npz")])
    assert Recogniser(card).calibration.temperature > 1.5 * clean.temperature
    assert "60 objects" in json.loads(card.read_text())["fitted_to"]["calibration"]
    assert "through sensors" in json.loads(card.read_text())["fitted_to"]["calibration"]
    sensed.of_objects(np.arange(50)).save(tmp_path / "few.npz")
    replace(sensed, models={**p.models, "lem": ("other", "f" * 64)}).save(tmp_path / "other.npz")
    capsys.readouterr()
    for arguments, sentence in [
        (["--sensed", str(tmp_path / "few.npz")], "lacks"),
        (["--sensed", str(tmp_path / "other.npz")], "of other models"),
        (["--sensed", str(tmp_path / "sensed.npz"), "--validation", "0.5"], "no --validation"),
    ]:
        with pytest.raises(SystemExit) as end:
            main(["fit", "calibration", str(path), str(card), *arguments])
        assert end.value.code == 2
        assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        ({"splits": np.array(["test"] * 90)}, "test split"),
        ({"models": {"recogniser": ("other", "f" * 64)}}, "another recogniser"),
    ],
)
def test_a_calibration_from_the_wrong_predictions_leaves_the_card_alone(training_predictions, spoil, sentence, capsys):
    card, path = training_predictions
    before = card.read_bytes()
    replace(Predictions.load(path), **spoil).save(path)
    with pytest.raises(SystemExit) as end:
        main(["fit", "calibration", str(path), str(card)])
    assert end.value.code == 2
    assert sentence in capsys.readouterr().err
    assert card.read_bytes() == before


def test_learned_policies_can_be_run_from_their_cards(training_predictions, tmp_path):
    _, path = training_predictions
    main(["fit", "policies", str(path), str(tmp_path / "learned"), "--length", "3"])
    cards = sorted((tmp_path / "learned").iterdir(), key=lambda path: path.stem)
    assert [c.stem for c in cards] == [
        "class-table", "class-table-local", "class-table-near", "fixed-ring", "fixed-ring-local",
        "fixed-sequence", "fixed-sequence-local", "fixed-sequence-near",
    ]  # fmt: skip
    for card in cards:
        policy = make_policy(str(card), SPHERE, classes=("ball", "box", "pillar"))
        if isinstance(policy, ClassTable):
            data = fitting_set(Predictions.load(path), 0.1, 0)
            calibration = fit_temperature(data, np.random.default_rng([0, 0]), walks=1 + 8000 // 9)
            values = fit_class_table(data, 5, 20.0, calibration, np.random.default_rng(0))
            travel_weight = 0.01 if card.stem.endswith("near") else 0.0
            for ring, azimuth in [(0, 0), (2, 5)]:
                view = 8 * ring + azimuth
                paid = values[:, ring, cells_to(SPHERE)[view]] - travel_weight * SPHERE.travel[view]
                here = policy.values[:, ring, cells_to(SPHERE)[view]]
                np.testing.assert_allclose(here, paid, atol=1e-5)
        with pytest.raises(ValueError, match="other classes"):
            make_policy(str(card), SPHERE, classes=("ball", "box"))
        with pytest.raises(ValueError, match="not for this sphere"):
            make_policy(str(card), ViewSphere((0.0, 18.0, 36.0, 54.0, 71.0), 8))


@pytest.mark.parametrize(
    "spoil",
    [
        lambda card: "no JSON",
        lambda card: json.dumps({**card, "kind": "magic"}),
        lambda card: json.dumps({**card, "table": {"moves": [[99]] * 5}}),
        lambda card: json.dumps({**card, "table": {}}),
        lambda card: json.dumps({**card, "schema": 2}),
        lambda card: json.dumps({**card, "surprise": 1}),
        lambda card: json.dumps({**card, "classes": ["a", "a"]}),
        lambda card: json.dumps({**card, "azimuths": "many"}),
        lambda card: json.dumps([]),
    ],
)
def test_a_damaged_policy_card_is_refused_in_one_sentence(training_predictions, tmp_path, spoil):
    _, path = training_predictions
    main(["fit", "policies", str(path), str(tmp_path), "--length", "2"])
    card = tmp_path / "fixed-sequence.json"
    card.write_text(spoil(json.loads(card.read_text())))
    with pytest.raises(ValueError, match=r"^[^\n]*fixed-sequence\.json: not a policy card[^\n]*$"):
        make_policy(str(card), SPHERE)
    with pytest.raises(ValueError, match="no such policy card"):
        make_policy(str(tmp_path / "none.json"), SPHERE)
