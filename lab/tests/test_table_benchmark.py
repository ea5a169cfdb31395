"""The benchmark of tables: looked at once, counted by hand, compared table by table."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from lab_programs import main

from nextview.errors import ResultsError, UsageError
from nextview_lab.benchmark import tables as stage
from nextview_lab.benchmark.results import compared_markdown
from nextview_lab.benchmark.tables import (
    TableRun,
    TableRuns,
    TableSettings,
    benchmark_tables,
    summarise_tables,
)

SIX = 11  # the seed of a table with six things
SETTINGS = TableSettings(
    tables=1, views=(1,), policies=("random",), samples=100, seed=SIX
)


@pytest.fixture(scope="module")
def looked(household, scans, tmp_path_factory):
    """A folder of results of one table, and what was found."""
    out = tmp_path_factory.mktemp("tables") / "out"
    return out, benchmark_tables(household, scans, out, SETTINGS, workers=0)


def test_things_on_a_table_are_named_and_everything_is_written(looked):
    out, found = looked
    recall = found.measures.query("measure == 'recall'")
    assert recall["value"].item() > 0.4
    for name in ("measures.csv", "tests.csv", "tables.md", "accuracy.png"):
        assert (out / name).stat().st_size > 50
    assert "### After 1 frame" in (out / "tables.md").read_text()


def test_what_was_looked_at_is_not_looked_at_again(
    looked, household, scans, monkeypatch, capsys
):
    out, _ = looked
    before = {file: file.read_bytes() for file in (out / "runs").iterdir()}
    monkeypatch.setattr(stage, "work_at_table", lambda job: pytest.fail("looked again"))
    line = ["benchmark", "tables", household, scans, out, "--tables", 1, "--views", 1]
    line += ["--policies", "random", "--samples", 100, "--seed", SIX, "--workers", 0]
    main([str(word) for word in line])
    shown = capsys.readouterr().out
    assert "After 1 frame" in shown
    assert max(map(len, shown.splitlines())) <= 80
    assert before == {file: file.read_bytes() for file in (out / "runs").iterdir()}


def test_tables_of_another_seed_or_of_few_scans_are_refused(looked, household, scans):
    out, _ = looked
    other = TableSettings(tables=1, views=(1,), seed=SIX + 1)
    with pytest.raises(ResultsError):
        benchmark_tables(household, scans, out, other, workers=0)
    with pytest.raises(UsageError):
        benchmark_tables(scans, scans, out.parent / "few", SETTINGS, workers=0)
    with pytest.raises(UsageError):
        TableSettings(views=(2, 1)).check()


def counts(right, named):
    sure = {"sure": 3, "sure_right": 3}
    return {"things": 8, "named": named, "right": right} | sure


def test_shares_and_p_values_are_those_of_a_hand_count():
    rng = np.random.default_rng(0)
    right = rng.integers(2, 8, (6, 2))
    runs = [
        TableRuns(
            k,
            {
                policy: TableRun([counts(2, 4), counts(int(own), 8)], 3)
                for policy, own in zip(("target", "random"), both, strict=True)
            },
        )
        for k, both in enumerate(right)
    ]
    found = summarise_tables(
        runs, ("target", "random"), replace(SETTINGS, views=(1, 2))
    )
    value = found.measures.set_index(["policy", "measure", "views"])["value"]
    assert value["target", "recall", 2] == pytest.approx(right[:, 0].sum() / 48)
    assert value["random", "precision", 2] == pytest.approx(right[:, 1].sum() / 48)
    assert value["random", "precision, confident", 1] == 1
    assert np.isnan(value["target", "strangers unknown", 1])

    (test,) = found.tests.query("measure == 'recall'").itertuples()
    lead = right[:, 0] - right[:, 1]
    assert test.difference == pytest.approx(lead.sum() / 48)
    sums = [abs(np.dot(signs, lead)) for signs in product((1, -1), repeat=6)]
    assert test.p == pytest.approx(np.mean(np.array(sums) >= abs(lead.sum())))
    assert "Too few to tell" in compared_markdown(found)
