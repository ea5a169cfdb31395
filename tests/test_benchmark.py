import json
import runpy
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from test_predictions import some_predictions

from nextview.belief import Calibration, RiskBounds
from nextview.benchmark import results
from nextview.benchmark.leaderboard import is_oracle, leaderboard, nothing_differs, promised_risks, too_few
from nextview.benchmark.published import ACCURACY, TRAVEL, published, read_table
from nextview.benchmark.replay import make_specs, replay, truncate
from nextview.benchmark.run import run_benchmark
from nextview.cli.benchmark import benchmark
from nextview.cli.report import report
from nextview.errors import EntryError, PredictionsError
from nextview.metrics import calibration_error
from nextview.policies.baselines import Random
from nextview.policies.registry import make_policy
from nextview.viewsphere import ViewSphere

TEN = tuple(read_table(ACCURACY[10]))


@pytest.fixture(scope="module")
def predictions():
    some = some_predictions(40, seed=2)
    conflicting = np.zeros(40, bool)
    conflicting[[3, 8]] = True
    return replace(some, conflicting=conflicting)


@pytest.fixture(scope="module")
def folder(predictions, tmp_path_factory):
    where = tmp_path_factory.mktemp("benchmark")
    predictions.save(where / "p.npz")
    benchmark(where / "p.npz", out=where / "out", thresholds=(0.7, 0.9), runs=3, samples=200)
    return where


def test_every_episode_is_a_row_and_is_what_it_says(folder, predictions):
    rows = pd.read_parquet(folder / "out" / "episodes.parquet")
    assert len(rows) == 3 * 40 * rows[["policy", "threshold"]].drop_duplicates().shape[0]
    row_of = {name: i for i, name in enumerate(predictions.names)}
    for row in rows.sample(200, random_state=0).itertuples():
        i, views = row_of[row.object], list(row.views)
        assert len(set(views)) == len(views) == row.n_views
        total = np.exp(predictions.logits[i, views].astype(float).sum(0))
        belief = total / total.sum()
        assert row.label == predictions.classes[predictions.labels[i]]
        assert row.answer == predictions.classes[belief.argmax()]
        assert row.confidence == pytest.approx(belief.max())
        legs = list(pairwise(views))
        assert row.travel == pytest.approx(sum(predictions.sphere.travel[leg] for leg in legs))
        assert row.arc == pytest.approx(sum(predictions.sphere.arc[leg] for leg in legs))
        if np.isnan(row.threshold):
            assert row.stop == "fixed views"
        else:
            assert row.stop == ("confident" if belief.max() >= row.threshold else "views ran out")
            before = [np.exp(predictions.logits[i, views[:k]].astype(float).sum(0)) for k in range(1, len(views))]
            assert all((b / b.sum()).max() < row.threshold for b in before)


def test_the_summary_is_what_pandas_makes_of_the_episodes(folder, predictions):
    rows = pd.read_parquet(folder / "out" / "episodes.parquet")
    rows["right"] = rows["answer"].astype(str) == rows["label"].astype(str)
    rows["clean"] = ~rows["object"].isin(np.array(predictions.names)[predictions.conflicting])
    summary = pd.read_csv(folder / "out" / "summary.csv").set_index(["policy", "threshold", "measure"])["value"]
    for (policy, threshold), cell in rows.groupby(["policy", "threshold"], observed=True):
        moved, sure = cell[cell.n_views > 1], cell[cell.stop == "confident"]
        by_class = cell.groupby("label", observed=True)
        wanted = {
            "accuracy": cell.right.mean(),
            "clean_accuracy": cell.right[cell.clean].mean(),
            "class_accuracy": by_class.right.mean().mean(),
            "class_accuracy_std": by_class.right.mean().std(ddof=0),
            "n_views": cell.n_views.mean(),
            "travel_all": cell.travel.mean(),
            "travel_moved": moved.travel.mean(),
            "class_travel_moved": moved.groupby("label", observed=True).travel.mean().mean(),
            "arc_all": cell.arc.mean(),
            "confident": len(sure) / len(cell),
            "confident_accuracy": sure.right.mean(),
            "calibration_error": calibration_error(cell.confidence.to_numpy(), cell.right.to_numpy()),
        }
        for measure, value in wanted.items():
            assert summary[policy, threshold, measure] == pytest.approx(value, nan_ok=True), (policy, measure)


def test_intervals_hold_their_values_and_tests_have_the_sign_of_the_difference(folder):
    summary = pd.read_csv(folder / "out" / "summary.csv").dropna(subset=["low"])
    assert ((summary.low <= summary.value + 1e-9) & (summary.value <= summary.high + 1e-9)).mean() > 0.98
    tests = pd.read_csv(folder / "out" / "tests.csv")
    assert "random" not in set(tests.policy)
    assert (tests.p_holm >= tests.p - 1e-12).all()
    gain = tests[(tests.policy == "oracle-gain") & (tests.measure == "accuracy")]
    assert (gain.low > 0).all()  # seeing the true logits helps beyond doubt
    assert (gain.mcnemar_holm < 0.001).all()


def test_areas_lie_between_the_first_look_and_the_best(folder, predictions):
    areas = pd.read_csv(folder / "out" / "areas.csv").set_index(["policy", "budget"])["value"]
    specs = make_specs(predictions, 3, 0)
    for name in ("random", "lem", "oracle-gain"):
        curve = [(truncate(replay(name, specs, 5, 0), t).answer == specs.labels).mean() for t in np.linspace(0, 1, 21)]
        for budget in ("n_views", "travel_all"):
            assert min(curve) <= areas[name, budget] <= max(curve)
    assert areas["oracle-gain", "n_views"] > areas["random", "n_views"]


def test_the_same_seed_gives_the_same_results_to_the_bit(folder):
    benchmark(folder / "p.npz", out=folder / "again", thresholds=(0.7, 0.9), runs=3, samples=200)
    for path in (folder / "out").iterdir():
        if path.suffix in (".csv", ".json", ".parquet"):
            assert path.read_bytes() == (folder / "again" / path.name).read_bytes(), path.name


def test_results_are_read_back_whole(folder, predictions):
    found = results.load(folder / "out")
    assert found.settings["thresholds"] == [0.7, 0.9]
    np.testing.assert_array_equal(found.predictions.logits, predictions.logits)
    assert len(found.episodes("lem", 0.9)) == 120
    assert len(found.episodes("best-5", None)) == 120


def test_a_policy_of_ones_own_runs_beside_the_reference_and_one_that_fails_takes_nothing_from_it(folder, capsys):
    names = ("test_replay:Asked", "test_replay:Raises", "lcm", "best-99")
    with pytest.raises(EntryError) as caught:
        benchmark(folder / "p.npz", out=folder / "own", policies=names, runs=1, samples=50)
    sentences = str(caught.value).splitlines()
    assert len(sentences) == 3
    assert "Raises" in sentences[0]
    assert "thing_11" in sentences[0]
    found = results.load(folder / "own")
    assert set(found.tables.summary.policy) == {"random", "test_replay:Asked"}
    assert set(found.settings["failures"]) == {"test_replay:Raises", "lcm", "best-99"}


def test_a_risk_is_run_at_its_threshold_and_the_calibration_can_be_left_out(folder, predictions):
    bounds = RiskBounds((0.6, 0.8), tuple((0.2, 0.1) for _ in range(5)), 0.1)
    calibrated = replace(predictions, calibration=Calibration(0.7, 0.5, bounds))
    calibrated.save(folder / "c.npz")
    settings = {"policies": ("random",), "thresholds": (0.9,), "runs": 2, "samples": 20}
    benchmark(folder / "c.npz", out=folder / "risk", risks=(0.15,), **settings)
    found = results.load(folder / "risk")
    assert found.settings["thresholds"] == [0.8, 0.9]
    assert found.settings["risks"] == {"0.15": 0.8}
    row = found.episodes("random", 0.9).iloc[0]
    i = predictions.names.index(row.object)
    total = predictions.logits[i, list(row.views)].astype(float).sum(0) / (0.7 * (1 + 0.5 * (row.n_views - 1)))
    assert row.confidence == pytest.approx((np.exp(total) / np.exp(total).sum()).max())

    benchmark(folder / "c.npz", out=folder / "plain", uncalibrated=True, **settings)
    benchmark(folder / "p.npz", out=folder / "as published", **settings)
    plain, published = (results.load(folder / name).episodes("random", 0.9) for name in ("plain", "as published"))
    pd.testing.assert_frame_equal(plain, published)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"thresholds": (1.5,)}, "between 0 and 1, not 1.5"),
        ({"thresholds": ()}, "at least one threshold"),
        ({"runs": 0}, "at least one run"),
        ({"max_views": 0}, "at least one view"),
        ({"valley_classes": ("sofa",)}, "no class 'sofa'"),
        ({"risks": (0.05,)}, "promises no error rate"),
        ({"risks": (0.05,), "threshold_decay": 0.5}, "without a threshold decay"),
        ({"threshold_decay": -1.0}, "threshold decay"),
    ],
)
def test_settings_that_make_no_sense_are_refused(folder, wrong, sentence):
    with pytest.raises(ValueError, match=sentence):
        benchmark(folder / "p.npz", out=folder / "none", **wrong)
    assert not (folder / "none").exists()


def test_a_folder_with_something_else_in_it_is_left_alone(folder):
    (folder / "mine").mkdir()
    (folder / "mine" / "thesis.txt").write_text("years of work")
    with pytest.raises(results.ResultsError, match="holds no benchmark results"):
        benchmark(folder / "p.npz", out=folder / "mine")
    assert (folder / "mine" / "thesis.txt").read_text() == "years of work"
    with pytest.raises(results.ResultsError, match="holds no benchmark results"):
        results.load(folder / "mine")
    with pytest.raises(PredictionsError, match="there is no such file"):
        benchmark(folder / "q.npz", out=folder / "none")


def test_a_benchmark_of_one_view_has_no_travel(folder):
    benchmark(folder / "p.npz", out=folder / "one", policies=("random", "furthest"), max_views=1, runs=2, samples=50)
    summary = results.load(folder / "one").tables.summary
    assert (summary[summary.measure == "n_views"].value == 1).all()
    assert (summary[summary.measure == "travel_all"].value == 0).all()
    assert summary[summary.measure == "travel_moved"].value.isna().all()


def test_training_objects_are_never_mixed_with_test_objects(folder, predictions):
    both = replace(predictions, splits=np.array(["train", "test"] * 20))
    both.save(folder / "both.npz")
    with pytest.raises(ValueError, match="choose with --split"):
        benchmark(folder / "both.npz", out=folder / "mixed")
    benchmark(folder / "both.npz", out=folder / "half", split="test", policies=("random",), runs=1, samples=20)
    assert results.load(folder / "half").predictions.names == both.names[1::2]


def test_settings_tell_how_to_run_it_again(folder):
    settings = json.loads((folder / "out" / "benchmark.json").read_text())
    assert settings["seed"] == 0
    assert settings["models"]["recogniser"] == ["r", "0" * 64]
    assert settings["valley_classes"] == ["box"]


def test_the_page_of_the_reproduction_says_what_the_tables_say(folder):
    page = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "reproduction.py"))["page"]
    text = page(folder / "p.npz", samples=200)
    benchmark(folder / "p.npz", out=folder / "full", samples=200)
    summary = pd.read_csv(folder / "full" / "summary.csv").set_index(["policy", "threshold", "measure"])["value"]
    tests = pd.read_csv(folder / "full" / "tests.csv").set_index(["policy", "threshold", "measure"])
    for name in ("lem", "oracle-gain"):
        row = next(line for line in text.split("## Every policy")[1].splitlines() if line.startswith(f"| {name} |"))
        for cell, measure in zip(row.split("|")[2:], ["accuracy", "clean_accuracy", "n_views"], strict=False):
            assert float(cell.split()[0]) == pytest.approx(summary[name, 0.97, measure], abs=0.0051)
        test = tests.loc[(name, 0.97, "accuracy")]
        assert f"{100 * test.difference:+.1f} ({100 * test.low:+.1f} to {100 * test.high:+.1f}" in text
    assert "LCM from a predicted map; no such network" in text


@pytest.mark.parametrize(("policy", "column"), [("oracle-valley", "LEM10"), ("furthest", "furthest")])
def test_the_published_tables_agree_with_each_other(policy, column):
    # Table 5 prints the class averages of tables 8 and 9.
    table5 = read_table("table5_nbv_modelnet10")
    assert published(policy, 0.99, "class_accuracy", TEN) == pytest.approx(table5["class_accuracy"][column], abs=2e-4)
    assert published(policy, 0.99, "class_travel_moved", TEN) == pytest.approx(table5["class_travel"][column], abs=2e-4)
    assert published(policy, 0.99, "accuracy", TEN) == table5["instance_accuracy"][column]


def test_published_values_stand_only_beside_the_cells_they_were_published_for():
    assert published("random", 0.97, "accuracy", TEN) == 0.8988
    assert published("random", 0.99, "accuracy", TEN) is None
    assert published("lem", 0.99, "accuracy", TEN) is None
    assert published("random", 0.97, "accuracy", ("cat", "dog")) is None
    assert published("random", 0.97, "travel_moved", TEN, "desk") == read_table(TRAVEL[10])["desk"]["random"]
    assert published("best-5", None, "accuracy", TEN, "table") == 1.0
    forty = tuple(read_table(ACCURACY[40]))
    assert published("furthest", 0.99, "accuracy", forty, "sink") == 0.89


def test_all_policies_and_thresholds_stand_in_one_comparison_with_the_reference(folder):
    tests = pd.read_csv(folder / "out" / "tests.csv")
    for measure, rows in tests.groupby("measure"):
        policies = set(pd.read_csv(folder / "out" / "sweep.csv").policy) - {"random"}
        assert set(rows.policy) == policies  # the published ones, the learned ones and the oracles
        assert len(rows) == 2 * len(policies)
        ranks = rows.p.rank(method="first").astype(int)
        by_hand = [  # Holm: the k-th smallest of m by m - k + 1, never below a smaller one's
            min(1, max(q * (len(rows) - rank + 1) for q, rank in zip(rows.p, ranks, strict=True) if rank <= mine))
            for mine in ranks
        ]
        assert rows.p_holm.to_numpy() == pytest.approx(by_hand), measure


def test_the_leaderboard_has_the_best_first_and_oracles_last(folder):
    tables = results.load(folder / "out").tables
    board = leaderboard(tables, 0.9)
    of = tables.summary.query("threshold == 0.9").set_index(["policy", "measure"])["value"]
    robots = [s for s in board if not is_oracle(s.policy)]
    assert board[: len(robots)] == robots
    assert {s.policy for s in board} == set(tables.sweep.policy)
    for group in (robots, board[len(robots) :]):
        assert [s.accuracy for s in group] == sorted((of[s.policy, "accuracy"] for s in group), reverse=True)
    for s in board:
        assert (s.class_accuracy, s.n_views, s.travel) == tuple(
            of[s.policy, measure] for measure in ("class_accuracy", "n_views", "travel_all")
        )
        assert np.isnan(s.difference) == (s.policy == "random")


def test_it_is_printed_with_a_sentence_where_nothing_differs_and_a_warning_where_objects_are_few(folder, capsys):
    benchmark(folder / "p.npz", out=folder / "board", policies=("lem", "oracle-gain"), runs=3, samples=200)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    shown = " ".join(" ".join(lines).split())
    of = results.load(folder / "board").tables.summary.query("threshold == 0.97").set_index(["policy", "measure"])
    lem = of.loc["lem", "accuracy"]
    assert f"lem {lem.value:.3f} ({lem.low:.3f}-{lem.high:.3f})" in shown
    assert "< 0.001 *" in next(line for line in lines if "oracle-gain" in line)
    assert "No policy that a robot could follow differs significantly from random" in shown
    assert "Too few objects to tell: there are 40" in shown


def some_tests(half, p=0.5):
    """Tables of two policies whose differences of accuracy are known to plus or minus ``half``."""
    rows = [(name, 0.97, "accuracy", -half, half, p, p) for name in ("lem", "gain")]
    rows.append(("oracle-gain", 0.97, "accuracy", 0.0, 2.0, 0.0, 0.0))  # no oracle counts
    tests = pd.DataFrame(rows, columns=["policy", "threshold", "measure", "low", "high", "p", "p_holm"])
    return SimpleNamespace(tests=tests)


def test_when_objects_are_too_few_to_tell():
    assert too_few(some_tests(0.029), 0.97, 200) is None
    assert "there are 199 and differences in accuracy are known to ±2.9" in too_few(some_tests(0.029), 0.97, 199)
    assert "±3.1 points" in too_few(some_tests(0.031), 0.97, 1000)
    assert nothing_differs(some_tests(0.01), 0.97, "random").startswith("No policy that a robot could follow")
    assert nothing_differs(some_tests(0.01, p=0.04), 0.97, "random") is None


def test_measured_error_rates_stand_beside_the_promised_ones(folder, predictions, capsys):
    bounds = RiskBounds((0.7, 0.8), ((0.2, 0.1),) * 5, 0.1)
    replace(predictions, calibration=Calibration(1.0, 0.0, bounds)).save(folder / "r.npz")
    found = run_benchmark(
        folder / "r.npz", folder / "rates", ("random", "lem", "oracle-gain"), risks=(0.1, 0.2), runs=4, samples=50
    )
    rows = pd.read_parquet(folder / "rates" / "episodes.parquet")
    risks = found.tables.risks
    assert set(zip(risks.policy, risks.risk, risks.threshold, strict=True)) == {
        (name, *promise) for name in ("random", "lem") for promise in ((0.1, 0.8), (0.2, 0.7))
    }
    for row in risks.itertuples():
        cell = rows[(rows.policy == row.policy) & (rows.threshold == row.threshold)]
        stopped = cell[cell.confidence >= row.threshold]
        assert row.error == pytest.approx((stopped.answer.astype(str) != stopped.label.astype(str)).mean())
        assert row.confident == pytest.approx(len(stopped) / len(cell))
        assert row.low <= row.error <= row.high
    assert any(promise.broken for promise in promised_risks(found.tables))  # the logits are noise
    assert capsys.readouterr().out == ""  # the library prints nothing
    report(folder / "rates")
    assert "Promised error rates" in (folder / "rates" / "report.html").read_text()


def test_a_policy_in_the_working_folder_is_found(folder, tmp_path, monkeypatch):
    (tmp_path / "mine_alone.py").write_text("from nextview.policies.baselines import Random\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [entry for entry in sys.path if entry not in ("", str(tmp_path))])
    assert isinstance(make_policy("mine_alone:Random", ViewSphere.named("40")), Random)
