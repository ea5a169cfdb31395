"""The benchmark from predictions to a folder of results, against pandas, plain loops and the
thesis's own tables.
"""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from pipeline import benchmark, refused
from programs import main

from nextview.recognition.belief import Calibration, RiskBounds, Stopping
from nextview.recognition.own_stopping import own_stopping
from nextview_lab.benchmark import leaderboard
from nextview_lab.benchmark.classes import load
from nextview_lab.benchmark.leaderboard import promised_risks
from nextview_lab.benchmark.published import ACCURACY, published, read_table
from nextview_lab.benchmark.replay import make_specs, replay, truncate
from nextview_lab.benchmark.report import report
from nextview_lab.data.metrics import calibration_error
from nextview_lab.data.predictions import Predictions
from nextview_lab.thesis.reproduction import page

TEN = tuple(read_table(ACCURACY[10]))


@pytest.fixture(scope="module")
def predictions(results):
    return Predictions.load(results / "p.npz")


def test_every_episode_is_a_row_and_is_what_it_says(results, predictions):
    rows = pd.read_parquet(results / "out" / "episodes.parquet")
    assert (
        len(rows) == 3 * 40 * rows[["policy", "threshold"]].drop_duplicates().shape[0]
    )
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
        assert row.travel == pytest.approx(
            sum(predictions.sphere.travel[leg] for leg in legs)
        )
        assert row.arc == pytest.approx(
            sum(predictions.sphere.arc[leg] for leg in legs)
        )
        if np.isnan(row.threshold):
            assert row.stop == "fixed views"
        else:
            assert row.stop == (
                "confident" if belief.max() >= row.threshold else "views ran out"
            )
            before = [
                np.exp(predictions.logits[i, views[:k]].astype(float).sum(0))
                for k in range(1, len(views))
            ]
            assert all((b / b.sum()).max() < row.threshold for b in before)


def test_the_summary_is_what_pandas_makes_of_the_episodes(results, predictions):
    rows = pd.read_parquet(results / "out" / "episodes.parquet")
    rows["right"] = rows["answer"].astype(str) == rows["label"].astype(str)
    rows["clean"] = ~rows["object"].isin(
        np.array(predictions.names)[predictions.conflicting]
    )
    measures = pd.read_csv(results / "out" / "measures.csv").query("set == 'all'")
    summary = measures.set_index(["policy", "threshold", "measure"])["value"]
    for (policy, threshold), cell in rows.groupby(
        ["policy", "threshold"],
        observed=True,
    ):
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
            "class_travel_moved": moved.groupby("label", observed=True)
            .travel.mean()
            .mean(),
            "arc_all": cell.arc.mean(),
            "confident": len(sure) / len(cell),
            "confident_accuracy": sure.right.mean(),
            "calibration_error": calibration_error(
                cell.confidence.to_numpy(),
                cell.right.to_numpy(),
            ),
        }
        for measure, value in wanted.items():
            assert summary[policy, threshold, measure] == pytest.approx(
                value,
                nan_ok=True,
            ), (
                policy,
                measure,
            )


def test_python_and_the_command_give_the_same_numbers(predictions, tmp_path):
    """Replay cut by the rule of the recogniser's calibration is what the command writes, the
    threshold's decay too.
    """
    p = replace(predictions, calibration=Calibration(0.8, 0.5))
    p.save(tmp_path / "p.npz")
    main(
        [
            "benchmark",
            "classes",
            str(tmp_path / "p.npz"),
            str(tmp_path / "out"),
            "--policies",
            "lem",
            "spread",
            "--runs",
            "3",
            "--samples",
            "20",
            "--thresholds",
            "0.7",
        ]
    )
    found, specs = load(tmp_path / "out"), make_specs(p, runs=3, seed=0)
    stopping = Stopping.of(p.calibration, 0.7, max_views=5)
    assert stopping.threshold_decay == 0.5
    for name in ("random", "lem", "spread"):
        paths, rows = (
            replay(name, specs, stopping.max_views, seed=0),
            found.episodes(name, 0.7),
        )
        ends = truncate(paths, stopping)
        for column in ("n_views", "confidence", "travel", "arc"):
            np.testing.assert_array_equal(getattr(ends, column), rows[column])
        np.testing.assert_array_equal(
            np.array(p.classes)[ends.answer],
            rows["answer"].astype(str),
        )
        # a threshold that stays
        assert truncate(paths, Stopping(0.7)).n_views.mean() > ends.n_views.mean()


def test_a_stopping_rule_of_ones_own_decides_in_the_command(
    predictions,
    tmp_path,
    capsys,
):
    predictions.save(tmp_path / "p.npz")
    main(
        [
            "benchmark",
            "classes",
            str(tmp_path / "p.npz"),
            str(tmp_path / "out"),
            "--policies",
            "lem",
            "--runs",
            "2",
            "--samples",
            "20",
            "--thresholds",
            "0.6",
            "--stopping",
            "test_replay:uncertain",
        ]
    )
    specs, rule = (
        make_specs(predictions, runs=2, seed=0),
        own_stopping("test_replay:uncertain", 0.6, 5),
    )
    ends = truncate(replay("lem", specs, 5, 0, beliefs=True), rule)
    np.testing.assert_array_equal(
        ends.n_views,
        load(tmp_path / "out").episodes("lem", 0.6)["n_views"],
    )
    assert len(set(ends.n_views)) > 1
    wrong = (
        "benchmark",
        "classes",
        tmp_path / "p.npz",
        tmp_path / "no",
        "--stopping",
        "test_replay:nothing",
    )
    assert "stopping rule test_replay:nothing cannot be made" in refused(capsys, *wrong)


def test_a_policy_of_ones_own_runs_beside_the_reference_and_one_that_fails_takes_nothing_from_it(
    results,
    tmp_path,
    capsys,
):
    names = ("test_replay:Asked", "test_replay:Raises", "lcm", "best-99")
    sentences = refused(
        capsys,
        "benchmark",
        "classes",
        results / "p.npz",
        tmp_path / "own",
        "--policies",
        *names,
        "--runs",
        "1",
    )
    assert all(part in sentences for part in ("Raises", "thing_11", "lcm", "best-99"))
    found = load(tmp_path / "own")
    assert set(found.tables.measures.policy) == {"random", "test_replay:Asked"}
    assert set(found.settings["failures"]) == {"test_replay:Raises", "lcm", "best-99"}


def test_a_risk_is_run_at_its_threshold_and_the_calibration_can_be_left_out(
    results,
    predictions,
    tmp_path,
):
    bounds = RiskBounds((0.6, 0.8), tuple((0.2, 0.1) for _ in range(5)), 0.1)
    replace(predictions, calibration=Calibration(0.7, 0.5, bounds)).save(
        tmp_path / "c.npz"
    )
    settings = {"policies": ("random",), "thresholds": (0.9,), "runs": 2, "samples": 20}
    benchmark(tmp_path / "c.npz", tmp_path / "risk", risks=(0.15,), **settings)
    found = load(tmp_path / "risk")
    assert found.settings["thresholds"] == [0.8, 0.9]
    assert found.settings["risks"] == {"0.15": 0.8}
    row = found.episodes("random", 0.9).iloc[0]
    i = predictions.names.index(row.object)
    total = predictions.logits[i, list(row.views)].astype(float).sum(0) / (
        0.7 * (1 + 0.5 * (row.n_views - 1))
    )
    assert row.confidence == pytest.approx((np.exp(total) / np.exp(total).sum()).max())

    benchmark(tmp_path / "c.npz", tmp_path / "plain", uncalibrated=True, **settings)
    benchmark(results / "p.npz", tmp_path / "as published", **settings)
    plain, published = (
        load(tmp_path / name).episodes("random", 0.9)
        for name in ("plain", "as published")
    )
    pd.testing.assert_frame_equal(plain, published)


def test_training_objects_are_never_mixed_with_test_objects(predictions, tmp_path):
    both = replace(predictions, splits=np.array(["train", "test"] * 20))
    both.save(tmp_path / "both.npz")
    with pytest.raises(ValueError, match="choose one with --split"):
        benchmark(tmp_path / "both.npz", tmp_path / "mixed")
    half = benchmark(
        tmp_path / "both.npz",
        tmp_path / "half",
        split="test",
        policies=("random",),
        runs=1,
        samples=20,
    )
    assert half.predictions.names == both.names[1::2]


def test_the_page_of_the_reproduction_says_what_the_tables_say(results, tmp_path):
    text = page(results / "p.npz", samples=200)
    benchmark(results / "p.npz", tmp_path / "full", samples=200)
    measures = pd.read_csv(tmp_path / "full" / "measures.csv").query("set == 'all'")
    summary = measures.set_index(["policy", "threshold", "measure"])["value"]
    tests = pd.read_csv(tmp_path / "full" / "tests.csv").set_index(
        ["policy", "threshold", "measure"]
    )
    for name in ("lem", "oracle-gain"):
        row = next(
            line
            for line in text.split("## Every policy")[1].splitlines()
            if line.startswith(f"| {name} |")
        )
        for cell, measure in zip(
            row.split("|")[2:],
            ["accuracy", "clean_accuracy", "n_views"],
            strict=False,
        ):
            assert float(cell.split()[0]) == pytest.approx(
                summary[name, 0.97, measure],
                abs=0.0051,
            )
        test = tests.loc[(name, 0.97, "accuracy")]
        assert (
            f"{100 * test.difference:+.1f} ({100 * test.low:+.1f} to {100 * test.high:+.1f}"
            in text
        )
    assert "LCM from a predicted map; no such network" in text


@pytest.mark.parametrize(
    ("policy", "column"),
    [("oracle-valley", "LEM10"), ("furthest", "furthest")],
)
def test_the_published_tables_agree_with_each_other(policy, column):
    # Table 5 prints the class averages of tables 8 and 9.
    table5 = read_table("table5_nbv_modelnet10")
    assert published(policy, 0.99, "class_accuracy", TEN) == pytest.approx(
        table5["class_accuracy"][column],
        abs=2e-4,
    )
    assert published(policy, 0.99, "class_travel_moved", TEN) == pytest.approx(
        table5["class_travel"][column],
        abs=2e-4,
    )
    assert (
        published(policy, 0.99, "accuracy", TEN) == table5["instance_accuracy"][column]
    )


def test_it_is_printed_with_a_sentence_where_nothing_differs_and_a_warning_where_objects_are_few(
    results,
    tmp_path,
    capsys,
):
    run = ["--policies", "lem", "oracle-gain", "--runs", "3", "--samples", "200"]
    main(
        ["benchmark", "classes", str(results / "p.npz"), str(tmp_path / "board"), *run]
    )
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    shown = " ".join(" ".join(lines).split())
    of = (
        load(tmp_path / "board")
        .tables.measures.query("set == 'all' and threshold == 0.97")
        .set_index(["policy", "measure"])
    )
    lem = of.loc["lem", "accuracy"]
    assert f"lem {lem.value:.3f} ({lem.low:.3f}-{lem.high:.3f})" in shown
    assert "< 0.001 *" in next(line for line in lines if "oracle-gain" in line)
    assert (
        "No policy that a robot could follow differs significantly from random" in shown
    )
    assert "Too few objects to tell: there are 40" in shown


def test_measured_error_rates_stand_beside_the_promised_ones(
    predictions,
    tmp_path,
    capsys,
):
    bounds = RiskBounds((0.7, 0.8), ((0.2, 0.1),) * 5, 0.1)
    replace(predictions, calibration=Calibration(1.0, 0.0, bounds)).save(
        tmp_path / "r.npz"
    )
    policies, rates = ("random", "lem", "oracle-gain"), tmp_path / "rates"
    found = benchmark(
        tmp_path / "r.npz",
        rates,
        policies=policies,
        risks=(0.1, 0.2),
        runs=4,
        samples=50,
    )
    rows = pd.read_parquet(rates / "episodes.parquet")
    risks = promised_risks(found.tables, found.settings["risks"])
    assert {(row.policy, row.risk, row.threshold) for row in risks} == {
        (name, *promise)
        for name in ("random", "lem")
        for promise in ((0.1, 0.8), (0.2, 0.7))
    }
    for row in risks:
        cell = rows[(rows.policy == row.policy) & (rows.threshold == row.threshold)]
        stopped = cell[cell.confidence >= row.threshold]
        assert row.error == pytest.approx(
            (stopped.answer.astype(str) != stopped.label.astype(str)).mean()
        )
        assert row.confident == pytest.approx(len(stopped) / len(cell))
        assert row.low <= row.error <= row.high
    assert any(promise.broken for promise in risks)  # the logits are noise
    assert capsys.readouterr().out == ""  # the library prints nothing
    report(rates)
    assert "Promised error rates" in (rates / "report.html").read_text()


def test_so_few_objects_that_nothing_can_be_significant_are_warned_of():
    tests = pd.DataFrame(
        {"set": ["all"] * 4, "policy": ["spread"] * 4, "views": [0] * 4}
    )
    ends = {"threshold": 0.9, "p": 0.5, "low": -0.1, "high": 0.1}
    tests = tests.assign(measure="accuracy", **ends)
    # Of six objects no choice of signs is rarer than 2 of 64, and four tests are corrected.
    few = SimpleNamespace(tests=tests.assign(families=6))
    said = leaderboard.too_few_objects(few, 0.9, 6)
    assert "no p-value of 6 is below 0.031, and 4 tests" in said
    more = SimpleNamespace(tests=tests.assign(families=16))
    assert "Too few objects" in leaderboard.too_few_objects(more, 0.9, 16)
