"""The comparison of measures: what stands in its table is true of a made-up recogniser whose likings are known."""

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import trimesh
from scipy.stats import spearmanr
from test_predictions import some_predictions

from nextview.data.measuring import measure
from nextview.data.predictions import Predictions
from nextview.data.rendering import render
from nextview.data.store import ViewStore
from nextview.errors import EntryError, UsageError
from nextview.viewsphere import ViewSphere

STUDY = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "measure_study.py"))
SPHERE = ViewSphere.named("40")
N = 6


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Boxes of two classes; the recogniser sees one best where most of it shows, the other where least does."""
    folder = tmp_path_factory.mktemp("study")
    rng = np.random.default_rng(0)
    for k in range(2 * N):
        path = folder / "meshes" / ("broad", "narrow")[k % 2] / f"{k:02}.off"
        path.parent.mkdir(parents=True, exist_ok=True)
        trimesh.creation.box(rng.uniform(0.5, 2, 3)).export(path)
    list(render(folder / "meshes", folder / "views.zarr", SPHERE, 32, workers=0))
    list(measure(folder / "views.zarr", ["view_area", "above_preference"], workers=0))
    store = ViewStore.open(folder / "views.zarr")
    area = store.measure("view_area")
    scaled = (area - area.min(1, keepdims=True)) / np.ptp(area, axis=1, keepdims=True)
    sure = np.where(store.labels[:, None] == 0, scaled, 1 - scaled) * 4 - 1
    logits = np.zeros((2 * N, 40, 2), np.float32)
    logits[np.arange(2 * N), :, store.labels] = sure
    p = replace(
        some_predictions(2 * N),
        logits=logits,
        maps={},
        depth_entropy=store.measure(),
        names=tuple(store.names),
        labels=store.labels.astype(np.int64),
        classes=tuple(store.classes),
        valley_classes={},
        models={},
        store=str(folder / "views.zarr"),
    )
    p.of_objects(np.flatnonzero(np.arange(2 * N) % 4 < 2)).save(folder / "test.npz")
    p.of_objects(np.flatnonzero(np.arange(2 * N) % 4 >= 2)).save(folder / "validation.npz")
    STUDY["main"](
        folder / "test.npz",
        folder / "validation.npz",
        folder / "out",
        policies=("unidirectional", "true-view_area-5"),
        runs=4,
        samples=50,
    )
    return folder


def found(made, measure, quantity, label=""):
    table = pd.read_csv(made / "out" / "measures.csv", keep_default_na=False, na_values=["nan"])
    (row,) = table[
        (table["measure"] == measure) & (table["quantity"] == quantity)
        & ((table["label"] == label) | (quantity == "valleys"))
    ].itertuples()  # fmt: skip
    return row


def test_correlations_are_those_of_the_made_up_recogniser(made):
    assert float(found(made, "view_area", "correlation", "broad").value) == pytest.approx(1)
    assert float(found(made, "view_area", "correlation", "narrow").value) == pytest.approx(-1)
    labels = Predictions.load(made / "test.npz").labels
    mean = np.where(labels == 0, 1, -1).mean()
    assert float(found(made, "view_area", "correlation").value) == pytest.approx(mean)
    assert float(found(made, "confidence", "correlation").value) == pytest.approx(1)


def test_the_valley_is_chosen_for_the_class_that_wants_it(made):
    assert found(made, "view_area", "valleys").label == "narrow"
    ours, chance = (float(found(made, name, "accuracy_2").value) for name in ("view_area", "random"))
    over = found(made, "view_area", "over_random_2")
    assert float(over.value) == pytest.approx(ours - chance)
    assert float(over.p_holm) >= float(over.p)


def test_policies_stand_beside_the_measures_under_one_correction(made):
    """The best views by the true area are those of one class and the worst of the other, from the first one on."""
    best = found(made, "true-view_area-5", "over_random_2")
    chance = float(found(made, "random", "accuracy_2").value)
    assert float(best.value) == pytest.approx(float(found(made, "true-view_area-5", "accuracy_2").value) - chance)
    assert float(found(made, "unidirectional", "travel_3").value) == pytest.approx(2)
    table = pd.read_csv(made / "out" / "measures.csv")
    tested = table[table["p"].notna()]
    assert set(tested["measure"]) == {*table["measure"]} - {"random"}
    assert (tested["p_holm"] >= tested["p"]).all()


def test_the_confidence_agrees_with_itself():
    p = some_predictions(5)
    sure = STUDY["of_true_class"](p)
    assert (STUDY["agreement"](p, sure)["best"] == 1).all()
    np.testing.assert_allclose(STUDY["agreement"](p, np.ones((5, 40)))["best"], 1 / 40)
    moved = np.roll(sure.reshape(5, 5, 8), 1, axis=2).reshape(5, 40)
    assert (STUDY["agreement"](p, moved)["best"] == 0).all()
    assert (STUDY["agreement"](p, moved)["best_near"] == 1).all()


def test_scipy_agrees_on_ranks():
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, 9, (5, 40)), rng.random((5, 40))
    expected = [spearmanr(x, y).statistic for x, y in zip(a, b, strict=True)]
    np.testing.assert_allclose(STUDY["correlations"](a, b), expected)
    assert (STUDY["correlations"](np.ones((2, 40)), b[:2]) == 0).all()


def test_table_and_figure_are_there(made):
    text = (made / "out" / "measures.md").read_text()
    assert "| view area |" in text
    assert "| random |" in text
    assert "| true-view_area-5 |" in text
    assert (made / "out" / "measures.png").stat().st_size > 10_000


def test_some_objects_alone(made):
    options = {"policies": (), "runs": 2, "samples": 10, "measures": ("view_area",), "objects": 3}
    STUDY["main"](made / "test.npz", made / "validation.npz", made / "some", **options)
    table = pd.read_csv(made / "some" / "measures.csv")
    p = Predictions.load(made / "test.npz").of_objects(np.array([0, 2, 4]))
    values = ViewStore.open(made / "views.zarr").measure("view_area")[[0, 4, 8]]
    expected = STUDY["correlations"](values, STUDY["of_true_class"](p)).mean()
    rows = table[(table["quantity"] == "correlation") & table["label"].isna()]
    assert rows["value"].tolist() == pytest.approx([expected])


def test_what_makes_no_sense_is_refused(made):
    with pytest.raises(UsageError, match="holds objects of"):
        STUDY["main"](made / "test.npz", made / "test.npz", made / "no")
    with pytest.raises(UsageError, match="two views or more"):
        STUDY["main"](made / "test.npz", made / "validation.npz", made / "no", n_views=(1, 2))
    with pytest.raises(EntryError, match="mesh_saliency"):
        STUDY["main"](made / "test.npz", made / "validation.npz", made / "no", measures=("mesh_saliency",), runs=1)
