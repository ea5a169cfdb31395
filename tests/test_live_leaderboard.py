"""What predict and benchmark show in the terminal of what they have found."""

import io
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pandas")

from rich.console import Console
from test_predictions import some_predictions

from nextview.benchmark.run import run_benchmark
from nextview.cli import predictions_table, progress
from nextview.cli.live_leaderboard import LiveLeaderboard

NAMES = ("random", "furthest", "best-5")


def test_its_numbers_are_those_of_the_tables(tmp_path):
    some_predictions(20, seed=1).save(tmp_path / "p.npz")
    live, options = LiveLeaderboard(), {"thresholds": (0.8, 0.97), "runs": 2, "samples": 20}
    results = run_benchmark(tmp_path / "p.npz", tmp_path / "out", NAMES, **options, through=live.add)
    rows = results.tables.summary.query("threshold == 0.97").pivot(index="policy", columns="measure", values="value")
    assert {row[0] for row in live.rows} == {"random", "furthest"}  # fixed views know no threshold
    for name, *numbers in live.rows:
        np.testing.assert_allclose(numbers, rows.loc[name, ["accuracy", "n_views", "travel_all"]].astype(float))
    assert [row[1] for row in live.rows] == sorted((row[1] for row in live.rows), reverse=True)


@pytest.mark.parametrize("terminal", [True, False])
def test_it_stands_above_the_bar_in_a_terminal_until_all_is_done(monkeypatch, terminal):
    file, live = io.StringIO(), LiveLeaderboard()
    console = Console(file=file, width=80, force_terminal=terminal, color_system=None)
    monkeypatch.setattr(progress, "console", console)

    def done():
        live.title, live.rows = "so far", [("furthest", 0.75, 1.5, 2.0)]
        yield 1
        console.print("between")  # draws anew
        yield 2

    progress.track(done(), 2, "replaying", above=live.table)
    shown = file.getvalue()
    assert ("so far" in shown) == ("furthest" in shown) == terminal
    last = shown.rsplit("replaying", 1)[1]
    assert " 2/2 " in last
    assert "furthest" not in last


def test_predictions_are_summed_up(monkeypatch, capsys):
    p = some_predictions(12, seed=0)
    n, v, c = p.logits.shape
    truth = np.eye(c, dtype=np.float32)[p.labels]
    logits = np.repeat(truth[:, None], v, 1)
    logits[:, : v // 4] = 1.5 * np.roll(truth, 1, axis=1)[:, None]  # a quarter of the views names another class
    p = replace(p, logits=logits, splits=np.array(["test"] * n), models={"recogniser": ("tiny", "0" * 64)})
    predictions_table.print_predictions(p)
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "test objects" in line]
    assert line.split()[-3:] == [str(n), "0.750", "1.000"]
