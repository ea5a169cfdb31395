"""The comparison of measures: what stands in its table is true of a made-up recogniser whose
likings are known.
"""

import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from pipeline import some_predictions
from scipy.stats import spearmanr

from nextview_lab.data.measures import measure
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.store import ViewStore
from nextview_lab.thesis import measure_study


@pytest.fixture(scope="module")
def made(views, tmp_path_factory):
    """The recogniser sees chairs and monitors best where most of them shows, and tables where
    least does.
    """
    folder = tmp_path_factory.mktemp("study")
    shutil.copytree(views, folder / "views.zarr")
    list(measure(folder / "views.zarr", ["view_area", "above_preference"], workers=0))
    store = ViewStore.open(folder / "views.zarr")
    area = store.measure("view_area")
    labels = store.labels
    scaled = (area - area.min(1, keepdims=True)) / np.ptp(area, axis=1, keepdims=True)
    logits = np.zeros((len(store), 40, 3), np.float32)
    logits[np.arange(len(store)), :, labels] = (
        np.where(labels[:, None] < 2, scaled, 1 - scaled) * 4 - 1
    )
    p = replace(
        some_predictions(len(store)),
        logits=logits,
        maps={},
        depth_entropy=store.measure(),
        names=tuple(store.names),
        labels=labels.astype(np.int64),
        classes=tuple(store.classes),
        valley_classes={},
        models={},
        store=str(folder / "views.zarr"),
    )
    p.of_objects(np.arange(0, 18, 2)).save(folder / "test.npz")
    p.of_objects(np.arange(1, 18, 2)).save(folder / "validation.npz")
    options = {
        "policies": ("unidirectional", "true-view_area-5"),
        "runs": 4,
        "samples": 50,
    }
    options["measures"] = ("view_area", "above_preference", "confidence")
    predictions = {"test": folder / "test.npz", "validation": folder / "validation.npz"}
    measure_study.main(folder / "views.zarr", folder / "out", **predictions, **options)
    return folder


def found(made, measure, quantity, label=""):
    table = pd.read_csv(
        made / "out" / "measures.csv",
        keep_default_na=False,
        na_values=["nan"],
    )
    (row,) = table[
        (table["measure"] == measure)
        & (table["quantity"] == quantity)
        & ((table["label"] == label) | (quantity == "valleys"))
    ].itertuples()
    return row


def test_correlations_are_those_of_the_made_up_recogniser(made):
    assert float(
        found(made, "view_area", "correlation", "chair").value
    ) == pytest.approx(1)
    assert float(
        found(made, "view_area", "correlation", "table").value
    ) == pytest.approx(-1)
    labels = Predictions.load(made / "test.npz").labels
    mean = np.where(labels < 2, 1, -1).mean()
    assert float(found(made, "view_area", "correlation").value) == pytest.approx(mean)
    assert float(found(made, "confidence", "correlation").value) == pytest.approx(1)


def test_the_valley_is_chosen_for_the_class_that_wants_it(made):
    assert found(made, "view_area", "valleys").label == "table"
    ours, chance = (
        float(found(made, name, "accuracy_2").value) for name in ("view_area", "random")
    )
    over = found(made, "view_area", "over_random_2")
    assert float(over.value) == pytest.approx(ours - chance)
    assert float(over.p_holm) >= float(over.p)


def test_policies_stand_beside_the_measures_under_one_correction(made):
    """The best views by the true area are those of one class and the worst of the other, from
    the first one on.
    """
    best = found(made, "true-view_area-5", "over_random_2")
    chance = float(found(made, "random", "accuracy_2").value)
    assert float(best.value) == pytest.approx(
        float(found(made, "true-view_area-5", "accuracy_2").value) - chance
    )
    assert float(found(made, "unidirectional", "travel_3").value) == pytest.approx(2)
    table = pd.read_csv(made / "out" / "measures.csv")
    tested = table[table["p"].notna()]
    assert set(tested["measure"]) == {*table["measure"]} - {"random"}
    assert (tested["p_holm"] >= tested["p"]).all()


def test_scipy_agrees_on_ranks():
    rng = np.random.default_rng(0)
    a = rng.integers(0, 9, (5, 40))
    b = rng.random((5, 40))
    expected = [spearmanr(x, y).statistic for x, y in zip(a, b, strict=True)]
    np.testing.assert_allclose(measure_study.correlations(a, b), expected)
    assert (measure_study.correlations(np.ones((2, 40)), b[:2]) == 0).all()


def test_the_table_has_a_row_for_each_measure_and_policy(made):
    lines = (made / "out" / "measures.md").read_text().splitlines()
    first = {line.split(" | ")[0].strip("| ") for line in lines}
    assert first >= {"random", "view area", "confidence", "unidirectional"}
