"""Networks, scores and the way from a folder of meshes to a model that recognises, in small."""

import json
import math
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest
from scipy.special import softmax
from tests.test_lite import checkpoint
from tests.test_readme import write_off

import nextview
from nextview.benchmark.replay import make_specs, replay
from nextview.benchmark.true_maps import known_maps
from nextview.calibration.valleys import valley_gains
from nextview.cli.main import main
from nextview.data import splits
from nextview.data.predictions import Predictions
from nextview.data.samples import SAMPLES, boxes_mesh
from nextview.data.store import ViewStore
from nextview.errors import ModelError
from nextview.models.inference import MapNetwork, Recogniser
from nextview.observation import Observation
from nextview.viewsphere import ViewSphere

torch = pytest.importorskip("torch")

from nextview.metrics import map_scores, recogniser_scores  # noqa: E402
from nextview.models.model_card import find_card, read_card  # noqa: E402
from nextview.models.network_input import InputSpec, from_store  # noqa: E402
from nextview.training.architectures import PointNet, ResNet, orthogonality  # noqa: E402
from nextview.training.checkpoints import load_exported, load_run  # noqa: E402
from nextview.training.folds import hold_out  # noqa: E402
from nextview.training.inputs import load_inputs  # noqa: E402
from nextview.training.lite import LiteNet  # noqa: E402
from nextview.training.maps.map_module import MapModule, Windows  # noqa: E402
from nextview.training.onnx_export import export_onnx  # noqa: E402
from nextview.training.recipes import MapRecipe, RecogniserRecipe  # noqa: E402
from nextview.training.recogniser.recogniser_module import Source, Views  # noqa: E402


def test_pointnet_ignores_the_order_of_points_and_begins_with_identities():
    torch.manual_seed(0)
    network = PointNet(5).eval()
    cloud = torch.rand(3, 200, 3)
    predicted, a, b = network(cloud)
    assert predicted.shape == (3, 5, 3)
    assert torch.allclose(a, torch.eye(3).expand(3, 3, 3))
    assert torch.allclose(b, torch.eye(64).expand(3, 64, 64))
    assert torch.allclose(network(cloud[:, torch.randperm(200)])[0], predicted, atol=1e-5)


def test_orthogonality_of_rotations_and_scalings():
    rotation = torch.linalg.qr(torch.randn(4, 3, 3)).Q
    assert orthogonality(rotation) < 1e-5
    assert orthogonality(2 * torch.eye(64).expand(2, 64, 64)).item() == pytest.approx(3 * math.sqrt(64))


def test_export_keeps_the_answers(tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    torch.manual_seed(0)
    network = ResNet(18, 5, 4).eval()
    x = torch.rand(2, 4, 64, 64)
    export_onnx(network, x.numpy(), "input", ["logits"], tmp_path / "net.onnx")
    assert [p.name for p in tmp_path.iterdir()] == ["net.onnx"]
    session = onnxruntime.InferenceSession(tmp_path / "net.onnx")
    more = torch.rand(3, 4, 64, 64)  # another batch size than the example's
    with torch.no_grad():
        expected = network(more)
    for ours, theirs in zip(session.run(None, {"input": more.numpy()}), expected, strict=True):
        assert np.abs(ours - theirs.numpy()).max() < 0.01 * theirs.abs().max()
    source = sys.modules[ResNet.__module__].__file__
    assert source.encode() not in (tmp_path / "net.onnx").read_bytes()
    full = sum(p.numel() for p in network.parameters()) * 4
    assert (tmp_path / "net.onnx").stat().st_size < 0.6 * full


def test_scores_by_hand():
    logits = np.zeros((2, 2, 2))
    logits[0, 0, 0], logits[0, 1, 1] = 5, 1  # object 0 (class 0): one view right, and it outweighs the other
    logits[1, :, 1] = 1  # object 1 (class 1): both right
    scores = recogniser_scores(logits, np.array([0, 1]))
    assert scores["single_view"] == {"instance": 0.75, "class": 0.75}
    assert scores["all_views_fused"] == {"instance": 1.0, "class": 1.0}
    true = np.zeros((3, 5, 3))
    true[:, 2, 1] = 1
    true[2, 4, 1] = 0.25
    predicted = np.zeros((3, 5, 3))
    predicted[0, 2, 1] = predicted[1, 2, 0] = predicted[2, 4, 1] = 1  # at distance 0, 1 and 2
    scores = map_scores(predicted, true)
    assert scores["d0"] == pytest.approx(1 / 3, abs=1e-4)
    assert scores["d_le_1"] == scores["d_lt_2"] == pytest.approx(2 / 3, abs=1e-4)
    assert scores["regret"] == pytest.approx((0 + 1 + 0.75) / 3, abs=1e-4)


def test_valley_classes_are_those_that_gain_by_the_valley():
    sphere = ViewSphere.named("40")
    logits = np.zeros((2, 40, 2))
    high = sphere.ring == 4
    logits[0, ~high, 0], logits[1, high, 1] = 3, 3  # class 0 is clear from below, class 1 from above
    maps = np.broadcast_to((sphere.ring / 4)[sphere.windows], (2, 40, 5, 3))  # the map rises with the ring
    gains = valley_gains(sphere, logits, maps, np.array([0, 1]))
    assert gains[0] > 0.1
    assert gains[1] < -0.1


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Twenty boxy objects of two classes, rendered, and both networks trained on them for a moment."""
    root = tmp_path_factory.mktemp("train")
    rng = np.random.default_rng(0)
    for label in ("monitor", "table"):
        for k in range(10):
            scale = rng.uniform(0.8, 1.25, 3)
            boxes = [tuple(tuple(np.multiply(corner, scale)) for corner in box) for box in SAMPLES[label]()]
            folder = root / "meshes" / label / ("test" if k > 7 else "train")
            folder.mkdir(parents=True, exist_ok=True)
            write_off(folder / f"{label}_{k}.off", boxes_mesh(boxes, label))
    table = boxes_mesh(SAMPLES["table"](), "table")
    for name, scale in (("table_small", 1), ("table_larger", 2)):
        write_off(root / "meshes/table/train" / f"{name}.off", replace(table, vertices=scale * table.vertices))
    duplicate = root / "meshes/table/train/table_0.off"
    (root / "meshes/monitor/train/monitor_twin.off").write_bytes(duplicate.read_bytes())
    store, runs, models = root / "views.zarr", root / "runs", root / "models"
    small = ["--epochs", "2", "--views", "4", "--batch", "8", "--validation", "0.25"]
    main(["render", str(root / "meshes"), str(store), "--workers", "1"])
    main(["train", "recogniser", str(store), str(runs / "recogniser"), *small, "--azimuth-bins-weight", "0.3"])
    main(["export", "recogniser", str(runs / "recogniser"), str(store), str(models), "--name", "tiny"])
    main(["train", "lem", str(store), str(runs / "lem"), *small])
    main(["export", "lem", str(runs / "lem"), str(store), str(models), "--name", "tiny-lem"])
    return root


def test_split_keeps_twins_together_and_test_objects_out(trained):
    store = ViewStore.open(trained / "views.zarr")
    for seed in range(6):
        training, validation = splits.split_training(store, 0.25, seed)
        assert not set(training) & set(validation)
        assert set(training) | set(validation) | set(splits.test_objects(store)) == set(range(len(store)))
        assert (store.splits[[*training, *validation]] == "train").all()
        duplicates = [store.names.index(name) for name in ("table_0", "monitor_twin")]
        assert np.isin(duplicates, validation).sum() in (0, 2)
        assert set(store.labels[validation]) == {0, 1}
        copies = np.isin([store.names.index(name) for name in ("table_small", "table_larger")], validation)
        assert copies.all() == copies.any()
        judging = splits.deduplicate(store, validation)  # the twin has another label
        assert len(judging) == len(validation) - copies.all()


def test_a_shape_that_was_copied_judges_training_once(trained, tmp_path, monkeypatch):
    store = ViewStore.open(trained / "views.zarr")
    copy = store.names.index("table_larger")
    seed = next(s for s in range(99) if copy in splits.split_training(store, 0.25, s)[1])

    class Judged(Exception):
        pass

    def judged_on(objects: np.ndarray) -> None:
        raise Judged([store.names[i] for i in objects])

    monkeypatch.setattr(
        "nextview.training.recogniser.recogniser_training.fit_recogniser", lambda *given: judged_on(given[3])
    )
    monkeypatch.setattr("nextview.training.maps.map_training.fit_map", lambda *given: judged_on(given[4]))
    for what in ("recogniser", "lem"):
        command = ["train", what, str(trained / "views.zarr"), str(tmp_path / what)]
        with pytest.raises(Judged) as judged:
            main([*command, "--validation", "0.25", "--seed", str(seed)])
        assert len({"table_small", "table_larger"} & set(judged.value.args[0])) == 1


def test_trained_models_have_cards_and_run(trained):
    card = json.loads((trained / "models/tiny.json").read_text())
    assert card["classes"] == ["monitor", "table"]
    assert {part.split()[0] for part in card["scores"]} == {"validation"}  # training leaves the test split alone
    recogniser = Recogniser(trained / "models/tiny.json")
    output = recogniser.from_inputs(np.zeros((3, 4, 112, 112), np.uint8))
    assert output.logits.shape == (3, 2)
    assert card["azimuth_bins"] == recogniser.azimuth_bins == 8
    assert np.exp(output.azimuth_bins).sum(2) == pytest.approx(np.ones((3, 2)), abs=1e-4)
    lem = MapNetwork(trained / "models/tiny-lem.json").from_inputs(np.zeros((2, 4, 56, 56), np.uint8))
    assert lem["lem"].shape == (2, 5, 3)
    assert lem["lem-sphere"].shape == (2, 5, 8)
    assert (lem["lem"] == lem["lem-sphere"][:, :, [-1, 0, 1]]).all()


def test_the_published_map_network_trains_on_clouds_and_predicts_the_window(trained):
    store, run = str(trained / "views.zarr"), trained / "runs/published"
    main(["train", "lem", store, str(run), "--preset", "thesis", "--epochs", "1", "--views", "2", "--points", "64"])
    recipe = json.loads((run / "recipe.json").read_text())
    assert (recipe["input"], recipe["batch"], recipe["schedule"]) == ("cloud", 16, "tenth")
    main(["export", "lem", str(run), store, str(trained / "models"), "--name", "published"])
    cloud = from_store(InputSpec("cloud"), ViewStore.open(trained / "views.zarr"), 0)[:2]
    assert {k: v.shape for k, v in MapNetwork(trained / "models/published.json").from_inputs(cloud).items()} == {
        "lem": (2, 5, 3)
    }


def test_map_batches_hold_each_view_with_its_own_map():
    sphere, rng = ViewSphere.named("40"), np.random.default_rng(0)
    values = rng.random((7, 40)).astype(np.float32)
    seen = np.zeros((7, 40, 4, 2, 2), np.uint8)  # object and view, in the left half of the image
    seen[..., 0, 0, 0], seen[..., 1, 0, 0] = np.arange(7)[:, None] + 1, np.arange(40) + 1
    windows = Windows(seen, values, sphere, np.array([1, 2, 5]), MapRecipe(views=6, batch=4), training=True)
    drawn, flips = [], []
    for images, targets in windows:
        assert len(images) == 4
        for image, target in zip(images.numpy(), targets.numpy(), strict=True):
            o, v = int(image[0].max()) - 1, int(image[1].max()) - 1
            drawn.append((o, v))
            flips.append(image[0, 0, 1] > 0)
            steps = np.arange(8) * (-1 if flips[-1] else 1)
            assert (target == values[o, np.arange(5)[:, None] * 8 + (v + steps) % 8]).all()
    assert len(drawn) == 16
    assert len(set(drawn)) == 16  # no view comes twice before all have come
    assert {o for o, _ in drawn} == {1, 2, 5}
    assert 0 < sum(flips) < 16


def test_fewer_views_than_a_batch_are_one_batch():
    sphere, seen = ViewSphere.named("40"), np.zeros((2, 40, 4, 2, 2), np.uint8)
    recipe = MapRecipe(views=3, batch=64)
    for training in (True, False):
        windows = Windows(seen, np.zeros((2, 40), np.float32), sphere, np.arange(2), recipe, training)
        assert [len(images) for images, _ in windows] == [6]
    views = Views([Source(seen, np.arange(2))], np.arange(2), np.arange(2), RecogniserRecipe(views=3, batch=64))
    assert [len(images) for images, _ in views] == [6]


@pytest.mark.parametrize("kind", ["geometry", "cloud"])
@pytest.mark.parametrize("training", [True, False])
def test_devices_share_every_batch_of_maps(kind, training):
    sphere, rng = ViewSphere.named("40"), np.random.default_rng(0)
    shape = (1024, 3) if kind == "cloud" else (4, 2, 2)
    seen = rng.integers(0, 255, (5, 40, *shape)).astype(np.int16 if kind == "cloud" else np.uint8)
    values, recipe = rng.random((5, 40)).astype(np.float32), MapRecipe(input=kind, views=8, batch=6)

    def windows(share):
        made = Windows(seen, values, sphere, np.arange(5), recipe, training)
        made.share = share
        return made

    whole, parts = windows(slice(None)), [windows(slice(rank, None, 2)) for rank in range(2)]
    for found, (a, of_a), (b, of_b) in zip(whole, *parts, strict=True):
        assert len(a) == len(b) == 3
        assert torch.equal(torch.stack([a, b], 1).flatten(0, 1), found[0])
        assert torch.equal(torch.stack([of_a, of_b], 1).flatten(0, 1), found[1])


@pytest.mark.long
def test_two_devices_train_one_map_network(trained, tmp_path):
    """As Lightning starts them; each is a process of its own."""
    run = tmp_path / "run"
    command = [sys.executable, "-m", "nextview.cli.main", "train", "lem", str(trained / "views.zarr"), str(run)]
    command += ["--epochs", "2", "--views", "4", "--batch", "8", "--validation", "0.25", "--size", "28"]
    command += ["--devices", "2", "--accelerator", "cpu", "--precision", "32-true"]
    done = subprocess.run(
        command, env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert "MEMBER: 2/2" in done.stderr
    assert (run / "network.pt").exists()
    state = torch.load(run / "last.ckpt", weights_only=True)
    training, _ = splits.split_training(ViewStore.open(trained / "views.zarr"), 0.25, 0)
    assert state["global_step"] == 2 * (len(training) * 4 // 8)  # the batch is that of both together
    assert len((run / "log/metrics.csv").read_text().splitlines()) == 3


def within_one_cell(at, other):
    return abs(at // 3 - other // 3) + abs(at % 3 - other % 3) <= 1


@pytest.mark.parametrize("reach", [0, 1])
def test_the_peak_weighs_in_which_cell_of_the_window_is_highest(monkeypatch, reach):
    rng, sphere = np.random.default_rng(0), ViewSphere.named("40")
    output, true = rng.random((2, 4, 5, 8)).astype(np.float32)
    module = MapModule(MapRecipe(peak=0.3, sharpness=0.1, reach=reach), sphere, 1)
    monkeypatch.setattr(module, "forward", lambda seen: (torch.from_numpy(output),))
    monkeypatch.setattr(module, "log", lambda *args, **options: None)
    loss = module.training_step((torch.zeros(4), torch.from_numpy(true)), 0)
    near, goal = (values[:, :, [-1, 0, 1]].reshape(4, 15) for values in (output, true))
    counts = [[k == best or (reach and within_one_cell(k, best)) for k in range(15)] for best in goal.argmax(1)]
    chance = (softmax(near / 0.1, 1) * counts).sum(1)
    squared = (((near - goal) ** 2).mean() + ((output - true) ** 2).mean()) / 2
    assert loss.item() == pytest.approx(squared - 0.3 * np.log(chance).mean(), rel=1e-5)


def test_a_finished_run_is_not_trained_again(trained):
    run = trained / "runs/lem"
    log = (run / "log/metrics.csv").read_text()
    before = torch.load(run / "network.pt", weights_only=True)
    arguments = ["--epochs", "2", "--views", "4", "--batch", "8", "--validation", "0.25"]
    main(["train", "lem", str(trained / "views.zarr"), str(run), *arguments])
    after = torch.load(run / "network.pt", weights_only=True)
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert "1," in log


@pytest.mark.long
def test_an_lcm_learns_from_recognisers_that_have_not_seen_the_objects(trained):
    store, runs, models = trained / "views.zarr", trained / "runs", trained / "models"
    small = ["--epochs", "1", "--views", "2", "--batch", "8", "--validation", "0.25"]
    main(["train", "recogniser", str(store), str(runs / "folds"), "--folds", "2", *small])
    held_out = []
    for k in range(2):
        main(["export", "recogniser", str(runs / f"folds/fold{k}"), str(store), str(models), "--name", f"fold{k}"])
        held_out.append(set(json.loads((models / f"fold{k}.json").read_text())["held_out"]))
    views = ViewStore.open(store)
    training, validation = splits.split_training(views, 0.25, 0)
    assert held_out[0] | held_out[1] == {views.names[i] for i in [*training, *validation]}
    assert held_out[0] & held_out[1] == {views.names[i] for i in validation}
    out = trained / "unseen.npz"
    cards = [str(models / f"fold{k}.json") for k in range(2)]
    main(["predict", str(store), str(out), "--held-out", "--maps", "--recogniser", *cards, "--workers", "1"])
    predictions = Predictions.load(out)
    assert set(predictions.names) == held_out[0] | held_out[1]
    for k, card in enumerate(cards):  # each network judged what it has not seen, and nothing else
        name = sorted(held_out[k] - held_out[1 - k])[0]
        inputs = load_inputs(store, 112)[views.names.index(name)]
        assert predictions.logits[predictions.names.index(name)] == pytest.approx(
            Recogniser(card).from_inputs(inputs).logits, abs=1e-4
        )
    never_right = predictions.names.index(views.names[validation[0]])
    predictions.logits[never_right] = np.where(np.arange(2) == predictions.labels[never_right], 0, 5)
    predictions.save(out)
    main(["train", "lcm", str(store), str(out), str(runs / "lcm"), *small])
    main(["export", "lcm", str(runs / "lcm"), str(store), str(out), str(models), "--name", "tiny-lcm"])
    card = MapNetwork(models / "tiny-lcm.json").card
    assert card.kind == "lcm"
    assert set(card.held_out) == {views.names[i] for i in validation}  # also of which it could not be judged


def test_a_measure_of_ones_own_is_learned_followed_and_compared(trained, tmp_path, monkeypatch):
    """With no change in the package: measured, trained for, exported, predicted, a policy, in the benchmark, live."""
    monkeypatch.chdir(tmp_path)
    Path("height_of_mine.py").write_text(
        "from nextview.measures.registry import Measure\n"
        "rows = Measure(lambda view: view.near.shape[0] / view.depth.shape[0], good='valley')\n"
    )
    store, name = str(trained / "views.zarr"), "height_of_mine:rows"
    main(["measure", store, "--measures", name, "--workers", "0"])
    main(["inspect", store, "table.png", "--object", "table_0"])
    small = ["--epochs", "1", "--views", "2", "--batch", "8", "--validation", "0.25", "--output", "window"]
    main(["train", "map", store, "run", "--measure", name, *small])
    main(["export", "map", "run", store, "models"])
    path = Path("models/height_of_mine-rows-meshes.json")
    card = read_card(path)
    assert (card.kind, card.measure, card.good) == (name, name, "valley")
    assert json.loads(path.read_text())["schema"] == 2
    for end in (".json", ".onnx"):
        shutil.copy(trained / f"models/tiny{end}", "models")
    maps = ["--maps", f"{name}={path}"]
    main(["predict", store, "p.npz", "--split", "train", "--models", "models", *maps, "--workers", "1"])
    p = Predictions.load("p.npz")
    assert p.valley_classes == {name: p.classes}  # low values are good, and nothing else was fitted
    specs = make_specs(p, 1, 0)
    first, peak, true = (replay(each, specs, 2, 0).views for each in (name, f"{name}-peak", f"true-{name}-peak"))
    predicted = p.maps[name].reshape(len(p), 40, 15)[np.arange(len(p)), specs.starts]
    there = p.sphere.windows.reshape(40, 15)[specs.starts]
    free = there != specs.starts[:, None]
    for found, values in ((first, -predicted), (peak, predicted)):
        assert (found[:, 1] == there[np.arange(len(p)), np.where(free, values, -np.inf).argmax(1)]).mean() > 0.6
    rows = [ViewStore.open(store).names.index(name) for name in p.names]
    measured = ViewStore.open(store).measure(name)[rows]
    at, best = measured[np.arange(len(p)), true[:, 1]], np.where(free, np.take_along_axis(measured, there, 1), 0).max(1)
    assert (at == best).mean() > 0.6  # where the window's highest cell is a peak of it
    assert name in known_maps(p)
    system = nextview.load("models", policy=name)
    assert system.policy.valley_classes == (0, 1)
    assert len(system.recognise(trained / "meshes/table/test/table_8.off").views) >= 1


def test_maps_of_what_is_not_there_are_refused(trained, tmp_path, capsys):
    store = str(trained / "views.zarr")
    for arguments, sentence in (
        (["map", store, "--measure", "mesh_saliency"], "--measures mesh_saliency makes it"),
        (["map", store, "--measure", "confidence"], "learned from predictions"),
        (["map", store, "--predictions", str(tmp_path / "none.npz")], "there is no such file"),
        (["lem", store, "--measure", "max_depth"], "nextview train map takes --measure max_depth"),
    ):
        with pytest.raises(SystemExit) as end:
            main(["train", *arguments[:2], str(tmp_path / "run"), *arguments[2:]])
        assert end.value.code == 2
        assert sentence in capsys.readouterr().err


def test_valley_classes_are_fitted_to_objects_that_neither_network_has_seen(trained, capsys):
    store, models, out = str(trained / "views.zarr"), trained / "models", trained / "validation.npz"
    card = models / "tiny-lem.json"
    cards = ["--maps", f"lem={card}", "--recogniser", str(models / "tiny.json"), "--workers", "1"]
    main(["predict", store, str(out), "--held-out", *cards])
    main(["fit", "valleys", str(out), str(card)])
    values, p = json.loads(card.read_text()), Predictions.load(out).deduplicate()
    gains = valley_gains(p.sphere, p.logits, p.maps["lem"], p.labels)
    assert values["valley_classes"] == [p.classes[c] for c, gain in gains.items() if gain > 0]
    assert values["valley_gain"] == {p.classes[c]: round(gain, 4) for c, gain in gains.items()}
    assert f"{len(p)} objects" in values["fitted_to"]["valleys"]
    main(["predict", store, str(out), "--held-out", *cards])  # takes up what the card says now
    assert Predictions.load(out).valley_classes == {"lem": tuple(values["valley_classes"])}
    for wrong, sentence in ((models / "tiny.json", "holds no maps by"), (models / "none.json", "no such model card")):
        with pytest.raises(SystemExit) as end:
            main(["fit", "valleys", str(out), str(wrong)])
        assert end.value.code == 2
        assert sentence in " ".join(capsys.readouterr().err.split())


@pytest.mark.long
def test_a_recogniser_of_images_sees_images_live_and_in_predictions(trained):
    store, run, models = trained / "views.zarr", trained / "runs/image", trained / "models"
    small = ["--epochs", "1", "--views", "2", "--batch", "8", "--validation", "0.25", "--size", "56"]
    main(["train", "recogniser", str(store), str(run), "--input", "image", *small])
    main(["export", "recogniser", str(run), str(store), str(models), "--name", "of-images"])
    out = trained / "images.npz"
    main(["predict", str(store), str(out), "--maps", "--recogniser", str(models / "of-images.json"), "--workers", "1"])
    views, predictions = ViewStore.open(store), Predictions.load(out)
    observation = Observation(views.depth(3)[7], views.sphere.poses[7], views.intrinsics, image=views.image(3)[7])
    at = predictions.names.index(views.names[3])
    live = Recogniser(models / "of-images.json")([observation]).logits
    assert predictions.logits[at, 7] == pytest.approx(live[0], abs=1e-4)
    dark = Recogniser(models / "of-images.json")([replace(observation, image=observation.image // 4)]).logits
    assert np.abs(live - dark).max() > 1e-3  # it does look at the image
    mixture = ["export", "recogniser", str(run), str(store), str(models), "--also", str(trained / "runs/recogniser")]
    with pytest.raises(SystemExit) as mixed:
        main(mixture)
    assert mixed.value.code == 2


def test_what_is_no_finished_run_is_not_exported(trained, tmp_path, capsys):
    def refused(kind, run):
        with pytest.raises(SystemExit) as stop:
            main(["export", kind, str(run), str(trained / "views.zarr"), str(tmp_path / "models")])
        assert stop.value.code == 2
        return capsys.readouterr().err

    assert "holds no training run" in refused("lem", tmp_path)
    assert "holds no training run" in refused("recogniser", tmp_path / "nowhere")
    assert "not a recipe of such a network" in refused("recogniser", trained / "runs/lem")
    shutil.copy(trained / "runs/lem/recipe.json", tmp_path)
    assert "the training is not done" in refused("lem", tmp_path)
    whole = (trained / "runs/lem/network.pt").read_bytes()
    (tmp_path / "network.pt").write_bytes(whole[: len(whole) // 2])
    assert "damaged" in refused("lem", tmp_path)
    shutil.copy(trained / "runs/recogniser/network.pt", tmp_path)
    assert "not the weights of the network" in refused("lem", tmp_path)
    assert not (tmp_path / "models").exists()


@pytest.mark.long
def test_a_run_joins_recognisers_that_were_exported_before(trained, capsys):
    run, store, models = trained / "runs/recogniser", trained / "views.zarr", trained / "models"
    command = ["export", "recogniser", str(run), str(store), str(models)]
    main([*command, "--name", "two", "--also", str(models / "tiny.json")])
    x = from_store(InputSpec("geometry", 112), ViewStore.open(store), 0)[:3]
    alone, joined = Recogniser(models / "tiny.json"), Recogniser(models / "two.json")
    assert joined.card.network == "ResNet-18 + ResNet-18"
    assert joined.card.held_out == alone.card.held_out
    assert len(joined.card.training.recipes) == 2
    assert joined.from_inputs(x).logits == pytest.approx(alone.from_inputs(x).logits, abs=2e-2)
    with pytest.raises(SystemExit):
        main([*command, "--name", "three", "--also", str(models / "two.json")])
    with pytest.raises(ModelError, match="not one network"):
        load_exported(ResNet(18, 2, 4, 8), models / "two.json", torch.from_numpy(x).float() / 255)
    assert "are two of them the same" in capsys.readouterr().err.replace("\n", " ")
    with pytest.raises(SystemExit):
        main([*command, "--also", str(models / "tiny-lem.json")])
    assert "not a recogniser" in capsys.readouterr().err
    values = json.loads((models / "tiny.json").read_text())
    for name, features in (("foreign", values | {"held_out": ["chair_9"]}), ("silent", values | {"training": {}})):
        (models / f"{name}.json").write_text(json.dumps(features))
        shutil.copy(models / "tiny.onnx", models / f"{name}.onnx")
        with pytest.raises(SystemExit):
            main([*command, "--also", str(models / f"{name}.json")])
        error = capsys.readouterr().err.replace("\n", " ")
        assert ("of other objects" if name == "foreign" else "how it was trained") in error


def test_folds_divide_every_class_evenly_and_keep_twins_together(tmp_path):
    rng = np.random.default_rng(0)
    labels = np.repeat(["a", "b"], [12, 8])
    measured = rng.random((20, 5))
    measured[15] = measured[3]  # one mesh, two labels
    labels = (labels == "b").astype(np.int64)
    folds = hold_out(labels, measured, 3, seed=1)
    assert sorted(np.concatenate(folds)) == list(range(20))
    counts = np.array([np.bincount(labels[fold], minlength=2) for fold in folds])
    assert np.ptp(counts, axis=0).max() <= 2  # a twin of the other class may shift one
    assert any({3, 15} <= set(fold) for fold in folds)
    assert any((a != b).any() for a, b in zip(folds, hold_out(labels, measured, 3, 2), strict=True) if len(a) == len(b))
    with pytest.raises(ValueError, match="cannot be divided"):
        hold_out(labels, measured, 1, seed=0)


def test_eight_bits_a_weight_are_enough_for_the_answers_and_nearly_halve_the_file_again(tmp_path):
    torch.manual_seed(0)
    network = ResNet(18, 10, 4).eval()
    with torch.no_grad():  # every row of another magnitude, as in trained networks
        network.layer4[1].conv1.weight *= torch.logspace(-2, 1, 512)[:, None, None, None]
    x = np.random.default_rng(0).random((2, 4, 64, 64)).astype(np.float32)
    output = {}
    for bits in (16, 8):
        export_onnx(network, x, "input", ["logits"], tmp_path / f"{bits}.onnx", bits)
        session = ort.InferenceSession(tmp_path / f"{bits}.onnx", providers=["CPUExecutionProvider"])
        output[bits] = session.run(["logits"], {"input": x})[0]
    true = network(torch.from_numpy(x))[0].detach().numpy()
    assert np.abs(output[8] - true).max() < 0.02 * np.abs(true).max()
    assert np.abs(output[8] - true).max() > np.abs(output[16] - true).max()  # so they do have fewer
    assert (tmp_path / "8.onnx").stat().st_size < 0.55 * (tmp_path / "16.onnx").stat().st_size


@pytest.mark.long
def test_a_lite_network_goes_from_a_checkpoint_to_a_card_that_it_shares(trained, tmp_path, capsys):
    checkpoint(tmp_path / "imagenet.pth")
    run, store, models = trained / "runs/lite", str(trained / "views.zarr"), trained / "models"
    small = ["--epochs", "1", "--views", "4", "--batch", "8", "--validation", "0.25", "--azimuth-bins-weight", "0.3"]
    command = ["train", "recogniser", store, str(run), *small, "--network", "lite0", "--dropout", "0.2"]
    main([*command, "--weights", str(tmp_path / "imagenet.pth")])
    main(["export", "recogniser", str(run), store, str(models), "--name", "pair", "--also", str(models / "tiny.json")])
    card = find_card(models / "pair.json")
    assert card.network == "EfficientNet-Lite0 + ResNet-18"
    assert [recipe["network"] for recipe in card.training.recipes] == ["lite0", "resnet"]
    x = from_store(InputSpec("geometry", 112), ViewStore.open(trained / "views.zarr"), 0)[:3]
    alone, pair = Recogniser(models / "tiny.json"), Recogniser(models / "pair.json")
    with torch.no_grad():
        logits, bins = (output.numpy() for output in load_run(LiteNet(2, 4, 8), run)(torch.from_numpy(x).float() / 255))
    mean = (logits + alone.from_inputs(x).logits) / 2
    assert pair.from_inputs(x).logits == pytest.approx(mean, abs=2e-2)
    both = np.exp((bins + alone.from_inputs(x).azimuth_bins) / 2)
    assert np.exp(pair.from_inputs(x).azimuth_bins) == pytest.approx(both / both.sum(2, keepdims=True), abs=2e-2)
    main([*command[:3], str(trained / "runs/on"), *command[4:], "--weights", str(models / "pair.json")])
    with pytest.raises(SystemExit):
        main([*command[:3], str(trained / "runs/wrong"), *small, "--weights", str(tmp_path / "imagenet.pth")])
    assert "not the weights of this ResNet-18" in " ".join(capsys.readouterr().err.split())
