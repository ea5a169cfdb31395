import io
import os
import resource
import signal
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import trimesh
from pipeline import CLASSES, make_map_network, make_recogniser, some_predictions

from nextview.cli.main import main
from nextview.data.predicting import predict
from nextview.data.predictions import Predictions
from nextview.data.rendering import render
from nextview.data.store import ViewStore
from nextview.errors import NextviewError, PredictionsError
from nextview.geometry.observation import Observation
from nextview.geometry.viewsphere import ViewSphere
from nextview.recognition.belief import Calibration, RiskBounds
from nextview.recognition.inference import MapNetwork, Recogniser
from nextview.recognition.model_card import read_card


@pytest.fixture(scope="module")
def shop(tmp_path_factory):
    """Rendered meshes, one of them under two labels, and tiny networks."""
    folder = tmp_path_factory.mktemp("shop")
    rng = np.random.default_rng(0)
    for label, split in [("ball", "train"), ("ball", "test"), ("box", "test"), ("pillar", "train"), ("pillar", "test")]:
        mesh = trimesh.creation.icosphere(2) if label == "ball" else trimesh.creation.box()
        mesh.apply_scale(rng.uniform(0.5, 2, 3) * ([1, 1, 4] if label == "pillar" else 1))
        path = folder / "meshes" / label / split / f"{label}_{split}.off"
        path.parent.mkdir(parents=True)
        mesh.export(path)
    same = folder / "meshes/box/train/box_train.off"
    same.parent.mkdir()
    same.write_bytes((folder / "meshes/pillar/test/pillar_test.off").read_bytes())
    list(render(folder / "meshes", folder / "views.zarr", ViewSphere.named("40"), 32, workers=1))
    make_recogniser(folder, CLASSES, azimuth_bins=8)
    make_map_network(folder, valleys=("box",))
    return folder


def cards(shop: Path) -> tuple:
    return read_card(shop / "tiny.json"), {"lem": read_card(shop / "tiny-lem.json")}


def test_what_is_saved_is_what_is_loaded(tmp_path):
    saved = replace(some_predictions(), calibration=Calibration(0.8, 0.3, RiskBounds((0.9,), ((0.1,),), 0.1)))
    saved.save(tmp_path / "p.npz")
    loaded = Predictions.load(tmp_path / "p.npz")
    for name in ("logits", "depth_entropy", "labels", "splits", "conflicting"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(saved, name))
        assert getattr(loaded, name).dtype == getattr(saved, name).dtype
    np.testing.assert_array_equal(loaded.maps["lem"], saved.maps["lem"])
    for name in ("names", "classes", "sphere", "models", "valley_classes", "calibration"):
        assert getattr(loaded, name) == getattr(saved, name)
    assert [p.name for p in tmp_path.iterdir()] == ["p.npz"]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"names": ()}, "hold no objects"),
        ({"classes": ()}, "name no classes"),
        ({"classes": ("ball", "box")}, r"logits .* has the shape \(6, 40, 3\), not \(6, 40, 2\)"),
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


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04 cut off"])
def test_a_file_that_is_no_predictions_is_refused_in_one_sentence(tmp_path, content):
    (tmp_path / "p.npz").write_bytes(content)
    with pytest.raises(PredictionsError, match=r"p\.npz: not a predictions file"):
        Predictions.load(tmp_path / "p.npz")
    with pytest.raises(PredictionsError, match="there is no such file"):
        Predictions.load(tmp_path / "q.npz")


def test_a_flipped_bit_is_harmless_or_refused_in_one_sentence(tmp_path):
    path, rng = tmp_path / "p.npz", np.random.default_rng(0)
    some_predictions(2).save(path)
    sound = path.read_bytes()
    with zipfile.ZipFile(path) as file:
        heads = [info.header_offset + k for info in file.infolist() for k in range(30 + len(info.filename))]
    # Everywhere, in the heads of the members, and in the list of members at the end.
    places = [*rng.integers(len(sound), size=150), *rng.choice(heads, 150), *range(len(sound) - 150, len(sound))]
    refused: list[str] = []
    for place in places:
        damaged = bytearray(sound)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            assert len(Predictions.load(path)) == 2
        except PredictionsError as refusal:
            refused.append(str(refusal))
    assert len(refused) > 100
    assert all(sentence.startswith(f"{path}: ") and "\n" not in sentence for sentence in refused)


def test_a_split_is_its_objects_and_nothing_else():
    some = replace(some_predictions(), splits=np.array(["train", "test"] * 3))
    test = some.of_split("test")
    assert test.names == ("thing_1", "thing_3", "thing_5")
    np.testing.assert_array_equal(test.logits, some.logits[1::2])
    np.testing.assert_array_equal(test.maps["lem"], some.maps["lem"][1::2])
    azimuth_bins = np.random.default_rng(0).normal(size=(6, 40, 3, 8)).astype(np.float32)
    np.testing.assert_array_equal(
        replace(some, azimuth_bins=azimuth_bins).of_split("test").azimuth_bins, azimuth_bins[1::2]
    )
    with pytest.raises(PredictionsError, match="no objects of the split 'train', only of 'test'"):
        test.of_split("train")


def test_nothing_is_unpickled(tmp_path):
    np.savez(tmp_path / "p.npz", format=1, logits=np.array([{"a": 1}], object))
    with pytest.raises(PredictionsError, match="not a predictions file"):
        Predictions.load(tmp_path / "p.npz")


def test_predictions_are_what_the_networks_say_of_each_look(shop):
    recogniser, maps = cards(shop)
    *_, last = predict(shop / "views.zarr", shop / "all.npz", [recogniser], maps, workers=2)
    assert last == (6, 6)
    found, store = Predictions.load(shop / "all.npz"), ViewStore.open(shop / "views.zarr")
    assert found.names == tuple(store.names)
    assert found.store == str((shop / "views.zarr").resolve())
    assert found.models["lem"] == ("tiny-lem", maps["lem"].sha256)
    assert found.valley_classes == {"lem": ("box",)}
    i, v = 3, 17
    observation = Observation(store.depth(i)[v], store.sphere.poses[v], store.intrinsics)
    evidence = Recogniser(shop / "tiny.json")([observation])
    np.testing.assert_allclose(found.logits[i, v], evidence.logits[0], atol=1e-5)
    np.testing.assert_allclose(found.azimuth_bins[i, v], evidence.azimuth_bins[0], atol=1e-5)
    # Here the points come from the stored depth, which is rounded; those in the store are from the depth as rendered.
    np.testing.assert_allclose(
        found.maps["lem"][i, v], MapNetwork(shop / "tiny-lem.json")([observation])["lem"][0], atol=2e-4
    )


def test_the_same_mesh_under_two_labels_is_marked_across_splits(shop):
    recogniser, maps = cards(shop)
    list(predict(shop / "views.zarr", shop / "test.npz", [recogniser], maps, "test", workers=1))
    found = Predictions.load(shop / "test.npz")
    assert dict(zip(found.names, found.conflicting, strict=True)) == {
        "ball_test": False, "box_test": False, "pillar_test": True,
    }  # fmt: skip


KILLED = """
import os, signal, sys
from pathlib import Path
from nextview.data.predicting import predict
from nextview.recognition.model_card import read_card

if __name__ == "__main__":
    shop, out = map(Path, sys.argv[1:])
    maps = {"lem": read_card(shop / "tiny-lem.json")}
    for done, _ in predict(shop / "views.zarr", out, [read_card(shop / "tiny.json")], maps, workers=1):
        if done == 2:
            os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_run_goes_on_where_it_was(shop):
    recogniser, maps = cards(shop)
    out = shop / "again.npz"
    (shop / "killed.py").write_text(KILLED)
    killed = subprocess.run([sys.executable, shop / "killed.py", shop, out], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert not out.exists()
    steps = predict(shop / "views.zarr", out, [recogniser], maps, workers=1)
    assert next(steps) == (2, 6)
    list(steps)
    assert not out.with_name("again.npz.part").exists()
    list(predict(shop / "views.zarr", shop / "whole.npz", [recogniser], maps, workers=1))
    np.testing.assert_array_equal(Predictions.load(out).logits, Predictions.load(shop / "whole.npz").logits)


@pytest.mark.skipif(sys.platform != "linux", reason="mounts a small disk")
def test_a_full_disk_is_one_sentence_and_loses_nothing(shop, tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    if os.geteuid() or subprocess.run(["mount", "-t", "tmpfs", "-o", "size=56k", "tmpfs", disk]).returncode:
        pytest.skip("only root can mount a small disk")
    recogniser, maps = cards(shop)
    try:
        with pytest.raises(NextviewError, match=r"p\.npz: cannot be written \(No space left on device\)"):
            list(predict(shop / "views.zarr", disk / "p.npz", [recogniser], maps, workers=0))
        subprocess.run(["mount", "-o", "remount,size=100m", disk], check=True)
        steps = list(predict(shop / "views.zarr", disk / "p.npz", [recogniser], maps, workers=0))
        assert steps[0][0] > 0
        assert len(Predictions.load(disk / "p.npz")) == 6
        assert [file.name for file in disk.iterdir()] == ["p.npz"]
    finally:
        subprocess.run(["umount", disk], check=True)


def test_an_array_that_announces_more_than_the_file_holds_is_refused_before_it_takes_memory(tmp_path):
    some_predictions().save(tmp_path / "p.npz")
    with np.load(tmp_path / "p.npz") as file:
        arrays = {name: file[name] for name in file.files}
    zeros = np.broadcast_to(np.float32(0), (300, 40, 5000))
    np.savez_compressed(tmp_path / "zeros.npz", **(arrays | {"logits": zeros}))
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": (10**9,)})
    with zipfile.ZipFile(tmp_path / "header.npz", "w") as file:
        file.writestr("logits.npy", header.getvalue())
    for name in ("zeros", "header"):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        with pytest.raises(PredictionsError, match="announces more than"):
            Predictions.load(tmp_path / f"{name}.npz")
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + 50_000


def test_a_card_that_was_calibrated_since_brings_predictions_up_to_date(shop):
    (recogniser, maps), out = cards(shop), shop / "calibrated.npz"
    list(predict(shop / "views.zarr", out, [recogniser], maps, workers=1))
    before = Predictions.load(out)
    later = msgspec.structs.replace(recogniser, calibration=Calibration(0.5, 0.25))
    assert list(predict(shop / "views.zarr", out, [later], maps, workers=1)) == [(6, 6)]
    after = Predictions.load(out)
    assert (before.calibration, after.calibration) == (Calibration(), Calibration(0.5, 0.25))
    np.testing.assert_array_equal(after.logits, before.logits)


def test_all_maps_that_the_models_predict_are_predicted_by_default(shop, tmp_path, monkeypatch):
    """Whatever their measure: those of the folder, and of the bundled ones that it lacks."""
    make_recogniser(tmp_path, CLASSES)
    make_map_network(tmp_path)
    make_map_network(tmp_path, "mine:clutter")
    asked = []

    def listen(*arguments, **options):
        asked.append(arguments[3])
        return predict(*arguments[:3], {}, *arguments[4:], **options)

    monkeypatch.setattr("nextview.data.predicting.predict", listen)
    command = ["predict", str(shop / "views.zarr"), str(tmp_path / "p.npz"), "--models", str(tmp_path)]
    for given in ([], ["--maps"], ["--maps", "mine:clutter"]):
        main([*command, *given, "--workers", "1"])
    names = [[card.name for card in maps.values()] for maps in asked]
    assert names == [["tiny-lem", "lcm-modelnet10", "tiny-mine:clutter"], [], ["tiny-mine:clutter"]]
    assert [list(maps) for maps in asked[::2]] == [["lem", "lcm", "mine:clutter"], ["mine:clutter"]]
