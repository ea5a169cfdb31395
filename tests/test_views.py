"""The comparison at fixed numbers of views against the benchmark itself, one number of views at a time."""

import runpy
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from matplotlib.text import Text
from test_predictions import some_predictions

from nextview.benchmark import results
from nextview.cli.benchmark import benchmark

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
    benchmark(made / "p.npz", out=out, policies=names, thresholds=(1.0,), runs=3, max_views=n_views, samples=200)
    tables = results.load(out).tables
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


def test_the_table_has_a_row_for_every_policy_and_a_column_for_every_number_of_views(made):
    text = (made / "out" / "views.md").read_text().splitlines()
    assert [line.split(" | ")[0] for line in text[2:]] == [f"| {name}" for name in ("random", "random-all", *NAMES,
                                                                                  "oracle-gain")]  # fmt: skip
    assert text[0].startswith("| policy | 2 views | 4 views | travel at 2, 4 |")
    assert {line.count("|") for line in text} == {text[0].count("|")}


def test_policies_may_be_compared_with_others_than_the_random_ones(made):
    VIEWS["main"](made / "p.npz", made / "against", ("furthest",), (2,), runs=3, samples=50, against=("lem",))
    found = pd.read_csv(made / "against" / "views.csv").set_index(["policy", "measure"]).sort_index()
    for reference in ("random", "lem"):
        difference = found.loc[("furthest", "accuracy"), "value"] - found.loc[(reference, "accuracy"), "value"]
        assert found.loc[("furthest", f"to_{reference}"), "value"] == pytest.approx(difference)
    assert np.isnan(found.loc[("lem", "to_lem"), "p"])
    head = (made / "against" / "views.md").read_text().splitlines()[0]
    assert "points over random at 2 | points over lem at 2 |" in head
    with pytest.raises(ValueError, match="not all"):
        VIEWS["main"](made / "p.npz", made / "against", (), (2,), runs=1, samples=20, against=("lcm",))


def test_views_that_end_before_the_last_look_are_left_out_with_a_sentence(made):
    with pytest.raises(ValueError, match="not all"):
        VIEWS["main"](made / "p.npz", made / "short", ("orbit-3", "lem"), (2, 4), runs=1, samples=20)
    text = (made / "short" / "views.md").read_text()
    assert "Left out: orbit-3 is over before view 4" in text
    assert "| orbit-3" not in text
    assert "| lem |" in text


@pytest.mark.parametrize("n_views", [(), (0, 2), (41,)])
def test_a_number_of_views_that_nobody_can_take_is_refused(made, n_views):
    with pytest.raises(ValueError, match="1 to 40 views"):
        VIEWS["main"](made / "p.npz", made / "bad", n_views=n_views)


def test_no_name_in_the_figure_covers_another_and_only_robots_have_a_dot():
    rng = np.random.default_rng(0)
    family = [(0.0, "gain@0"), (0.01, "gain"), (0.05, "gain@0.05")]
    names = ["random", "random-all", "lem", "furthest", "spread", "class-table", *(name for _, name in family)]
    rows = []
    for name in (*names, "oracle-gain"):
        x, y = (2, 0.97) if name == "oracle-gain" else (rng.uniform(2, 2.6), rng.uniform(0.91, 0.914))
        rows += [(name, 2, "accuracy", y, y, y, np.nan), (name, 2, "travel", x, x, x, np.nan)]
        rows += [(name, 2, "to_random", 0.0, 0.0, 0.0, 0.01)]
    table = pd.DataFrame(rows, columns=["policy", "n_views", "measure", "value", "low", "high", "p"]).assign(
        p_holm=0.01
    )
    figure = VIEWS["front"](table, {"gain": family})
    (axes,) = figure.axes
    texts = [t for t in axes.findobj(Text) if t in axes.texts and t.get_text()]
    assert {t.get_text() for t in texts} >= {"spread", "@0", "gain@0.01", "@0.05"}
    boxes = [t.get_window_extent() for t in texts]
    for a, b in combinations(boxes, 2):
        assert not a.padded(-0.5).overlaps(b.padded(-0.5))
    dots = [line for line in axes.lines if line.get_marker() == "o"]
    assert len(dots) == len(names)
    assert axes.get_ylim()[1] < 0.95  # the oracle does not squeeze the rest
    joined = next(line for line in axes.lines if len(line.get_xdata()) == 3)
    by = table.set_index(["policy", "measure"])["value"]
    assert [*joined.get_xdata()] == [by[name, "travel"] for _, name in family]


def test_a_price_that_is_the_policys_own_is_drawn_once(monkeypatch):
    own = {"random": None, "gain@0.01": 0.01, "gain": 0.01, "gain@0": 0.0}
    monkeypatch.setitem(
        VIEWS["families"].__globals__, "entry_policy", lambda name, _: SimpleNamespace(travel_weight=own[name])
    )
    found = VIEWS["families"](list(own), None)
    assert found == {"gain": [(0.0, "gain@0"), (0.01, "gain")]}
    measured = {"accuracy": 0.9, "travel": 2.0, "to_random": 0.0}
    rows = [(name, 2, measure, x, x, x, 0.01) for name in own for measure, x in measured.items()]
    (axes,) = VIEWS["front"](
        pd.DataFrame(rows, columns=["policy", "n_views", "measure", "value", "low", "high", "p"]).assign(p_holm=0.01),
        found,
    ).axes
    assert sorted(t.get_text() for t in axes.texts if t.get_text()) == ["@0", "gain@0.01", "random"]
