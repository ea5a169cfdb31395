"""Predictions: what the networks say of a store, kept whole, resumed, and refused where the file
is damaged.
"""

import io
import resource
import shutil
import signal
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pipeline import SPHERE, some_predictions

from nextview.geometry.viewsphere import ViewSphere
from nextview.recognition.belief import Calibration, RiskBounds
from nextview.recognition.inference import MapNetwork, NetworkRecogniser
from nextview.recognition.model_card import read_card
from nextview.sensing.observation import Observation
from nextview_lab.data.predicting import predict
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.rendering import render
from nextview_lab.data.store import ViewStore
from nextview_lab.errors import PredictionsError


def test_what_is_saved_is_what_is_loaded(tmp_path):
    calibration = Calibration(0.8, 0.3, RiskBounds((0.9,), ((0.1,),), 0.1))
    saved = replace(
        some_predictions(),
        calibration=calibration,
        of_size=np.arange(18, dtype=np.float32).reshape(6, 3),
    )
    saved.save(tmp_path / "p.npz")
    loaded = Predictions.load(tmp_path / "p.npz")
    arrays = "logits", "of_size", "depth_entropy", "labels", "splits", "conflicting"
    for name in arrays:
        np.testing.assert_array_equal(getattr(loaded, name), getattr(saved, name))
        assert getattr(loaded, name).dtype == getattr(saved, name).dtype
    np.testing.assert_array_equal(loaded.maps["lem"], saved.maps["lem"])
    others = "names", "classes", "sphere", "models", "valley_classes", "calibration"
    for name in others:
        assert getattr(loaded, name) == getattr(saved, name)
    assert [p.name for p in tmp_path.iterdir()] == ["p.npz"]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            {"classes": ("ball", "box")},
            r"logits .* has the shape \(6, 40, 3\), not \(6, 40, 2\)",
        ),
        ({"labels": np.full(6, 3)}, "not one of the 3 classes"),
        ({"names": ("a",) * 6}, "the same name"),
        ({"maps": {"lem": np.zeros((6, 40, 5, 2), np.float32)}}, "map lem"),
        ({"azimuth_bins": np.zeros((6, 40, 2, 8), np.float32)}, "azimuth_bins"),
        ({"sphere": ViewSphere.named("12")}, "logits"),
    ],
)
def test_predictions_that_do_not_fit_together_are_refused(change, sentence):
    with pytest.raises(PredictionsError, match=sentence):
        replace(some_predictions(), **change)


def test_nothing_is_unpickled(tmp_path):
    np.savez(tmp_path / "p.npz", format=1, logits=np.array([{"a": 1}], object))
    with pytest.raises(PredictionsError):
        Predictions.load(tmp_path / "p.npz")


def cards(models: Path) -> tuple:
    return read_card(models / "tiny.json"), {"lem": read_card(models / "tiny-lem.json")}


def test_predictions_are_what_the_networks_say_of_each_look(views, models, predictions):
    found, store = Predictions.load(predictions), ViewStore.open(views)
    assert found.names == tuple(store.names)
    assert found.store == str(views.resolve())
    assert found.models["lem"] == ("tiny-lem", cards(models)[1]["lem"].sha256)
    assert found.valley_classes == {"lem": ("table",)}
    i, v = 3, 17
    observation = Observation(
        store.depth(i)[v], store.sphere.poses[v], store.intrinsics
    )
    evidence = NetworkRecogniser(models / "tiny.json")([observation])
    np.testing.assert_allclose(found.logits[i, v], evidence.logits[0], atol=1e-5)
    np.testing.assert_allclose(
        found.azimuth_bins[i, v], evidence.azimuth_bins[0], atol=1e-5
    )
    # Here the points come from the stored depth, which is rounded; those in the store are from the
    # depth as rendered.
    lem = MapNetwork(models / "tiny-lem.json")([observation])["lem"][0]
    np.testing.assert_allclose(found.maps["lem"][i, v], lem, atol=5e-4)


KILLED = """
import os, signal, sys
from pathlib import Path
from nextview_lab.data.predicting import predict
from nextview.recognition.model_card import read_card

if __name__ == "__main__":
    views, models, out = map(Path, sys.argv[1:])
    maps = {"lem": read_card(models / "tiny-lem.json")}
    for done, _ in predict(views, out, read_card(models / "tiny.json"), maps, workers=1):
        if done == 2:
            os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_run_goes_on_where_it_was(views, models, predictions, tmp_path):
    out, (recogniser, maps) = tmp_path / "again.npz", cards(models)
    (tmp_path / "killed.py").write_text(KILLED)
    killed = subprocess.run(
        [sys.executable, tmp_path / "killed.py", views, models, out], check=False
    )
    assert killed.returncode == -signal.SIGKILL
    assert not out.exists()
    steps = list(predict(views, out, recogniser, maps, workers=0))
    assert (
        2 <= steps[0][0] < 18
    )  # the worker may have finished another one before it ended
    assert not out.with_name("again.npz.part").exists()
    np.testing.assert_array_equal(
        Predictions.load(out).logits, Predictions.load(predictions).logits
    )


def test_an_array_that_announces_more_than_the_file_holds_is_refused_before_it_takes_memory(
    tmp_path,
):
    some_predictions().save(tmp_path / "p.npz")
    with np.load(tmp_path / "p.npz") as file:
        arrays = {name: file[name] for name in file.files}
    zeros = np.broadcast_to(np.float32(0), (300, 40, 5000))
    np.savez_compressed(tmp_path / "zeros.npz", **(arrays | {"logits": zeros}))
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f4", "fortran_order": False, "shape": (10**9,)}
    )
    with zipfile.ZipFile(tmp_path / "header.npz", "w") as file:
        file.writestr("logits.npy", header.getvalue())
    for name in ("zeros", "header"):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        with pytest.raises(PredictionsError):
            Predictions.load(tmp_path / f"{name}.npz")
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + 50_000


def test_the_same_mesh_under_two_labels_is_marked_across_splits(
    furniture, models, tmp_path
):
    chair, monitor = "chair/test/chair_4", "monitor/test/monitor_4"
    for place in (chair, "table/train/twin", monitor):
        path = tmp_path / f"meshes/{place}.off"
        path.parent.mkdir(parents=True)
        shutil.copy(furniture / f"{monitor if place == monitor else chair}.off", path)
    list(render(tmp_path / "meshes", tmp_path / "views.zarr", SPHERE, 32, workers=0))
    stored = tmp_path / "views.zarr", tmp_path / "p.npz"
    list(predict(*stored, cards(models)[0], {}, "test", workers=0))
    found = Predictions.load(tmp_path / "p.npz")
    assert dict(zip(found.names, found.conflicting, strict=True)) == {
        "chair_4": True,
        "monitor_4": False,
    }
