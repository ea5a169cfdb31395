"""The comparison at fixed numbers of views against the benchmark itself, one number of views at a time."""

import runpy
from pathlib import Path

import pandas as pd
import pytest
from pipeline import some_predictions

from nextview.benchmark.run import BenchmarkSettings, run_benchmark

VIEWS = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "views.py"))
NAMES = ("lem", "furthest", "spread", "orbit-4", "best-4")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("n_views")
    some_predictions(24, seed=2).save(folder / "p.npz")
    VIEWS["main"](folder / "p.npz", folder / "out", NAMES, (4, 2), runs=3, samples=200)
    return folder


@pytest.mark.parametrize("n_views", [2, 4])
def test_the_numbers_are_those_of_a_benchmark_with_so_many_views(made, n_views):
    names = ("random", "random-all", "lem", "furthest", "spread", "oracle-gain")
    out = made / f"benchmark{n_views}"
    settings = BenchmarkSettings(policies=names, thresholds=(1.0,), runs=3, max_views=n_views, samples=200)
    tables = run_benchmark(made / "p.npz", out, settings).tables
    found = pd.read_csv(made / "out" / "views.csv").set_index(["policy", "n_views", "measure"]).sort_index()
    for ours, theirs in (("accuracy", "accuracy"), ("travel", "travel_all")):
        summary = tables.summary[tables.summary["measure"] == theirs].set_index("policy")
        for name in names:
            for column in ("value", "low", "high"):
                assert found.loc[name, n_views, ours][column] == pytest.approx(summary.loc[name, column], abs=1e-9)
    tests = tables.tests.query("measure == 'accuracy'").set_index("policy")
    for name in names[1:]:
        for ours, theirs in (("value", "difference"), ("low", "low"), ("high", "high"), ("p", "mcnemar")):
            assert found.loc[name, n_views, "to_random"][ours] == pytest.approx(tests.loc[name, theirs], abs=1e-9)


def test_the_gap_is_that_between_random_and_one_step_of_foresight(made):
    found = pd.read_csv(made / "out" / "views.csv").set_index(["measure", "n_views", "policy"])["value"].sort_index()
    for n_views in (2, 4):
        accuracy, share = found["accuracy", n_views], found["share_of_gap", n_views]
        assert (share["random"], share["oracle-gain"]) == (0, pytest.approx(1))
        floor, top = accuracy["random"], accuracy["oracle-gain"]
        assert share["spread"] == pytest.approx((accuracy["spread"] - floor) / (top - floor))
