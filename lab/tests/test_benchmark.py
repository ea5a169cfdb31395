"""The benchmark from predictions to a folder of results, against pandas, plain loops and the
thesis's own tables.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from lab_programs import refused
from pipeline import benchmark

from nextview_lab.benchmark.classes import load
from nextview_lab.data.metrics import calibration_error
from nextview_lab.data.predictions import Predictions


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
        ["policy", "threshold"], observed=True
    ):
        moved, sure = cell[cell.n_views > 1], cell[cell.stop == "confident"]
        by_class = cell.groupby("label", observed=True)
        wanted = {
            "accuracy": cell.right.mean(),
            "clean_accuracy": cell.right[cell.clean].mean(),
            "class_accuracy": by_class.right.mean().mean(),
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
                cell.confidence.to_numpy(), cell.right.to_numpy()
            ),
        }
        for measure, value in wanted.items():
            assert summary[policy, threshold, measure] == pytest.approx(
                value, nan_ok=True
            ), (policy, measure)


def test_a_policy_of_ones_own_runs_beside_the_reference_and_one_that_fails_takes_nothing_from_it(
    results, tmp_path, capsys
):
    line = f"benchmark classes {results / 'p.npz'} {tmp_path / 'own'} --runs 1"
    names = "test_replay:Asked test_replay:Raises"
    sentences = refused(capsys, *f"{line} --policies {names}".split())
    assert "Raises" in sentences
    assert "thing_11" in sentences
    found = load(tmp_path / "own")
    assert set(found.tables.measures.policy) == {"random", "test_replay:Asked"}
    assert set(found.settings["failures"]) == {"test_replay:Raises"}


@pytest.mark.parametrize(
    "name", ["test_replay:Nowhere", "lcm", "best-99", "randum", "geometry"]
)
def test_a_policy_that_cannot_be_made_is_refused_before_any_is_run(
    name, results, tmp_path, capsys
):
    line = f"benchmark classes {results / 'p.npz'} {tmp_path / 'own'} --runs 1"
    assert name in refused(capsys, *f"{line} --policies random {name}".split())
    assert not (tmp_path / "own").exists()


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
