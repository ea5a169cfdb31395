"""The comparison at fixed numbers of views against the benchmark itself, one number of views at
a time.
"""

import numpy as np
import pandas as pd
import pytest
from lab_programs import main, refused
from pipeline import benchmark, some_predictions

from benchmarks.views import main as compare

NAMES = ("lem", "furthest", "spread", "orbit-4", "best-4")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("n_views")
    some_predictions(24, seed=2).save(folder / "p.npz")
    compare(folder / "p.npz", folder / "out", NAMES, (4, 2), runs=3, samples=200)
    return folder


@pytest.mark.parametrize("n_views", [2, 4])
def test_the_numbers_are_those_of_a_benchmark_with_so_many_views(made, n_views):
    names = ("random", "random-all", "lem", "furthest", "spread", "oracle-gain")
    out = made / f"benchmark{n_views}"
    settings = {
        "policies": names,
        "thresholds": (1.0,),
        "runs": 3,
        "max_views": n_views,
        "samples": 200,
    }
    tables = benchmark(made / "p.npz", out, **settings).tables
    keys = ["policy", "views", "measure"]
    found = pd.read_csv(made / "out" / "measures.csv").set_index(keys).sort_index()
    apart = pd.read_csv(made / "out" / "tests.csv").query("reference == 'random'")
    for ours, theirs in (("accuracy", "accuracy"), ("travel", "travel_all")):
        of_all = tables.measures.query("set == 'all'").set_index(["measure", "policy"])
        summary = of_all.loc[theirs]
        for name in names:
            for column in ("value", "low", "high"):
                assert found.loc[name, n_views, ours][column] == pytest.approx(
                    summary.loc[name, column],
                    abs=1e-9,
                )
    tests = tables.tests.query("measure == 'accuracy'").set_index("policy")
    after = apart[apart["views"] == n_views].set_index("policy")
    for name in names[1:]:
        for column in ("difference", "low", "high"):
            assert after.loc[name, column] == pytest.approx(
                tests.loc[name, column],
                abs=1e-9,
            )
        if name == "oracle-gain":  # it is no rival
            assert np.isnan(after.loc[name, "p"])
        else:
            assert after.loc[name, "p"] == pytest.approx(tests.loc[name, "p"], abs=1e-9)


def test_the_gap_is_that_between_random_and_one_step_of_foresight(made):
    keys = ["measure", "views", "policy"]
    measures = pd.read_csv(made / "out" / "measures.csv")
    found = measures.set_index(keys)["value"].sort_index()
    for n_views in (2, 4):
        accuracy, share = found["accuracy", n_views], found["share_of_gap", n_views]
        assert (share["random"], share["oracle-gain"]) == (0, pytest.approx(1))
        floor, top = accuracy["random"], accuracy["oracle-gain"]
        assert share["spread"] == pytest.approx(
            (accuracy["spread"] - floor) / (top - floor)
        )


def test_the_command_writes_the_same_table_beside_its_own(made, capsys):
    """``nextview-lab benchmark classes --views``, from the same first views; then figures
    and tables for papers.
    """
    out = made / "command"
    main(
        [
            "benchmark",
            "classes",
            str(made / "p.npz"),
            str(out),
            "--policies",
            "lem",
            "spread",
            "oracle-gain",
            "--views",
            "4",
            "2",
            "--runs",
            "3",
            "--samples",
            "200",
            "--thresholds",
            "0.9",
        ]
    )
    assert "| policy | 2 views | 4 views |" in capsys.readouterr().out
    keys = ["policy", "views", "measure"]
    for name, columns in (
        ("measures", ["value", "low", "high"]),
        ("tests", ["difference", "low", "high", "p"]),
    ):
        ours, script = (
            pd.read_csv(folder / f"{name}.csv").query("set == 'all' and views > 0")
            for folder in (out, made / "out")
        )
        if name == "tests":
            script = script[script["reference"] == "random"]
        ours, script = (each.set_index(keys).sort_index() for each in (ours, script))
        shared = ours.index[ours.index.get_level_values("policy") != "random-all"]
        assert len(shared) > 3
        np.testing.assert_allclose(
            ours.loc[shared, columns],
            script.loc[shared, columns],
            atol=1e-9,
        )
    assert (out / "views.md").read_text().startswith("| policy | 2 views")
    main(["report", str(out), "--figures", str(made / "figures")])
    written = {path.name for path in (made / "figures").iterdir()}
    for name in ("accuracy", "n_views", "reliability"):
        assert (made / "figures" / f"{name}.pdf").read_bytes().startswith(b"%PDF")
        assert "<svg" in (made / "figures" / f"{name}.svg").read_text()
    for name in ("leaderboard", "tests", "views"):
        assert {f"{name}.csv", f"{name}.tex"} <= written
        assert (made / "figures" / f"{name}.tex").read_text().count("oracle-gain") >= 1


def test_more_views_than_are_taken_are_refused(made, capsys):
    words = refused(
        capsys,
        "benchmark",
        "classes",
        made / "p.npz",
        made / "no",
        "--views",
        "3",
        "7",
    )
    assert "policies take 1 to 5 views (--max-views), and --views asks for 3 7" in words
