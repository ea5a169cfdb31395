"""The benchmark's table of made-up predictions, which must not change.

``python lab/tests/test_lab_contract.py`` writes the golden data beside this file anew, after a
wanted change of answers.
"""

import json
import tempfile
from pathlib import Path

import numpy as np
import pytest
from lab_programs import main

import nextview
from nextview_lab.data.predictions import Predictions

GOLDEN = Path(__file__).with_name("table.json")


def synthetic_predictions():
    """60 objects of three classes, whose views resemble each other within an object."""
    rng = np.random.default_rng(7)
    labels, n = np.arange(60) % 3, 60
    logits = (
        rng.normal(size=(n, 40, 3))
        + rng.normal(size=(n, 1, 3))
        + 1.5 * np.eye(3)[labels][:, None]
    )
    maps = {"lem": rng.random((n, 40, 5, 3)).astype(np.float32)}
    return Predictions(
        logits.astype(np.float32),
        maps,
        rng.random((n, 40)).astype(np.float32),
        tuple(f"object_{i}" for i in range(n)),
        labels,
        ("bed", "desk", "sofa"),
        np.array(["test"] * n),
        np.zeros(n, bool),
        nextview.ViewSphere.named("40"),
        {},
        {"lem": ("desk",)},
    )


TABLE_OF = """
random random-all furthest spread lem lem-peak oracle-gain
"""
MEASURES = ("accuracy", "n_views", "travel_all", "confident", "calibration_error")


def table(folder):
    """The benchmark's numbers by policy, threshold and measure: value, low, high."""
    pd = pytest.importorskip("pandas")
    synthetic_predictions().save(folder / "p.npz")
    how = "--thresholds 0.8 0.97 --runs 3 --max-views 4 --samples 200 --seed 1"
    places = [str(folder / "p.npz"), str(folder / "out")]
    main(
        ["benchmark", "classes", *places, "--policies", *TABLE_OF.split(), *how.split()]
    )
    rows = pd.read_csv(folder / "out" / "measures.csv").query("set == 'all'")
    rows = rows[rows.measure.isin(MEASURES) & rows.threshold.isin([0.8, 0.97])]
    return {
        f"{r.policy} {r.threshold} {r.measure}": [r.value, r.low, r.high]
        for r in rows.itertuples()
    }


def test_the_benchmarks_table(tmp_path):
    found, golden = table(tmp_path), json.loads(GOLDEN.read_text())
    assert found.keys() == golden.keys()
    for row, numbers in golden.items():
        assert found[row] == pytest.approx(numbers, abs=1e-6, nan_ok=True), row


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        rows = [
            f"{json.dumps(k)}: {json.dumps(v)}" for k, v in table(Path(folder)).items()
        ]
    GOLDEN.write_text("{\n" + ",\n".join(rows) + "\n}\n")
