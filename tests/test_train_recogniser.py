"""What the recogniser is trained on and how, the published recipe to the letter, and the command around it."""

import csv
import inspect
import json
import os
import re
import resource
import signal
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from skimage.measure import block_reduce

torch = pytest.importorskip("torch")

from nextview.cli.main import COMMANDS, main  # noqa: E402
from nextview.cli.presets import with_preset  # noqa: E402
from nextview.cli.train_recogniser import train_recogniser  # noqa: E402
from nextview.data.folders import Entry  # noqa: E402
from nextview.data.lock import only_one  # noqa: E402
from nextview.data.splits import split_training  # noqa: E402
from nextview.data.store import DONE, ViewStore  # noqa: E402
from nextview.errors import DatasetError, ModelError, ResultsError  # noqa: E402
from nextview.models.image_input import image_input  # noqa: E402
from nextview.models.inference import RECOGNISER  # noqa: E402
from nextview.models.model_card import bundled_cards, find_card  # noqa: E402
from nextview.training.architectures import ResNet  # noqa: E402
from nextview.training.inputs import load_inputs, prepare_inputs  # noqa: E402
from nextview.training.loop import WholeCheckpoints  # noqa: E402
from nextview.training.packed import load_packed, pack, save_packed  # noqa: E402
from nextview.training.recipes import THESIS_RECOGNISER, MapRecipe, RecogniserRecipe  # noqa: E402
from nextview.training.recogniser.grid_training import published_cells  # noqa: E402
from nextview.training.recogniser.recogniser_module import (  # noqa: E402
    RecogniserModule,
    Source,
    ValidationViews,
    Views,
    augment,
    part_way,
)
from nextview.training.runs import begin  # noqa: E402
from nextview.viewsphere import ViewSphere  # noqa: E402

V, SIZE = 5, 64


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """A store of ten objects of two classes, their views squares of noise."""
    root = tmp_path_factory.mktemp("store")
    rng = np.random.default_rng(0)
    entries = [Entry(root / f"{i}.off", f"object_{i}", "ab"[i % 2], "test" if i > 7 else "train") for i in range(10)]
    views = ViewStore.create(root / "views.zarr", entries, ViewSphere((0.0,), V, 3.0), SIZE, {})
    inside = np.zeros((SIZE, SIZE), bool)
    inside[16:48, 16:48] = True
    noise = rng.integers(1, 255, (10, V, SIZE, SIZE))
    views.group["image"][:] = np.where(inside, noise, 0).astype(np.uint8)
    views.group["depth"][:] = np.where(inside, 20_000 + noise, 0).astype(np.uint16)
    views.group["measures/depth_entropy"][:] = rng.random((10, V))
    views.group["status"][:] = DONE
    return root / "views.zarr"


def test_inputs_made_before_an_object_was_rendered_are_refused(tmp_path):
    """Its views would be blank."""
    entries = [Entry(tmp_path / f"{i}.off", f"object_{i}", "ab"[i % 2], "train") for i in range(3)]
    views = ViewStore.create(tmp_path / "views.zarr", entries, ViewSphere((0.0,), V, 3.0), SIZE, {})
    views.group["image"][:] = 7
    views.group["status"][:2] = DONE
    list(prepare_inputs(views.path, 32, "image", workers=1))
    assert load_inputs(views.path, 32, "image")[1].any()
    views.group["status"][2] = DONE
    with pytest.raises(DatasetError, match=r"image32: lacks objects that .*views.zarr holds by now; delete it"):
        load_inputs(views.path, 32, "image")


def views_of(recipe, objects=6, views=V):
    """Inputs whose pixels say which object and view they are."""
    which = np.arange(objects * views, dtype=np.uint8).reshape(objects, views, 1, 1, 1)
    labels = np.arange(objects) % 2
    source = Source(np.broadcast_to(which, (objects, views, 4, 2, 2)), np.arange(objects))
    return Views([source], np.arange(objects), labels, recipe)


def drawn(views):
    return [int(x) for images, _ in views for x in images[:, 0, 0, 0]]


def test_the_published_recipe_sees_every_view_once_an_epoch_in_a_new_order():
    views = views_of(replace(THESIS_RECOGNISER, batch=5))
    first = drawn(views)
    views.epoch = 1
    second = drawn(views)
    assert sorted(first) == sorted(second) == list(range(6 * V))
    assert first != second
    labels = np.concatenate([label for _, label in views])
    assert (labels == np.array(second) // V % 2).all()


def test_networks_to_be_averaged_draw_apart():
    first, again, other = (drawn(views_of(RecogniserRecipe(ensemble_seed=k, batch=5))) for k in (0, 0, 1))
    assert first == again
    assert first != other


def test_balanced_draws_even_out_the_classes():
    labels = np.repeat([0, 1], [90, 10])
    inputs = np.zeros((100, V, 1, 1, 1), np.uint8)
    recipe = RecogniserRecipe(views=100, batch=100)
    views = Views([Source(inputs, np.arange(100))], np.arange(100), labels, recipe)
    seen = np.concatenate([label for _, label in views])
    share = 10**0.5 / (10**0.5 + 90**0.5)  # a class of n objects is drawn with weight n / sqrt(n)
    assert (seen == 1).mean() == pytest.approx(share, abs=4 * (share * (1 - share) / len(seen)) ** 0.5)


def test_deformed_twins_may_have_fewer_views_and_each_gets_its_share():
    own = np.zeros((6, 40, 1, 1, 1), np.uint8)
    duplicates = [np.full((3, 20, 1, 1, 1), k, np.uint8) for k in (1, 2)]
    row = np.array([0, 1, 2, -1, -1, -1])
    recipe = RecogniserRecipe(views=2000, batch=50, deformed_share=0.5)
    sources = [Source(own, np.arange(6)), *(Source(duplicate, row) for duplicate in duplicates)]
    views = Views(sources, np.arange(3), np.zeros(6, int), recipe)
    found = np.concatenate([images.numpy().ravel() for images, _ in views])
    assert np.bincount(found) / len(found) == pytest.approx([0.5, 0.25, 0.25], abs=0.03)


def test_objects_without_a_deformed_twin_are_seen_as_they_are():
    own, twins = (np.full((2, 40, 1, 1, 1), k, np.uint8) for k in (0, 1))
    recipe = RecogniserRecipe(views=2000, batch=50, deformed_share=0.5, balanced=False)
    sources = [Source(own, np.arange(2)), Source(twins, np.array([-1, 0]))]
    views = Views(sources, np.arange(2), np.arange(2), recipe)
    images, labels = (
        np.concatenate(part).ravel() for part in zip(*([x.numpy() for x in drawn] for drawn in views), strict=True)
    )
    assert not images[labels == 0].any()
    assert 0 < images[labels == 1].mean() < 1


@pytest.mark.parametrize("balanced", [True, False])
def test_devices_share_every_batch(balanced):
    recipe = replace(THESIS_RECOGNISER, batch=6, balanced=balanced, views=V)
    whole, parts = views_of(recipe), [views_of(recipe) for _ in range(2)]
    for rank, part in enumerate(parts):
        part.share = slice(rank, None, 2)
    for (images, labels), (a, la), (b, lb) in zip(whole, *parts, strict=True):
        assert torch.equal(torch.stack([a, b], 1).flatten(0, 1), images)
        assert torch.equal(torch.stack([la, lb], 1).flatten(), labels)


def test_the_disk_is_asked_for_the_views_that_come(tmp_path, monkeypatch):
    inputs = np.random.default_rng(0).integers(0, 256, (6, V, 4, 16, 16), dtype=np.uint8)
    list(save_packed(tmp_path / "inputs", inputs.shape, ((i, pack(inputs[i])) for i in range(6))))
    mapped = load_packed(tmp_path / "inputs")
    file, asked = (tmp_path / "inputs/views.lz4").read_bytes(), []

    def note(_file, start, length, _advice):
        asked.append(file[start : start + length])

    monkeypatch.setattr(os, "posix_fadvise", note)
    recipe = RecogniserRecipe(views=V, batch=5)
    batches = Views([Source(mapped, np.arange(6))], np.arange(6), np.arange(6) % 2, recipe)
    came = 0
    for images, _ in batches:
        came += len(images)
        assert {pack(image.numpy()[None])[0] for image in images} <= set(asked)
    assert came == len(asked) == 6 * V
    asked.clear()
    objects = [images.numpy().tobytes() for images, _ in ValidationViews(mapped, np.arange(6), np.arange(6))]
    assert len(objects) == 6
    assert asked == [b"".join(pack(inputs[i])) for i in range(1, 6)]


def test_packed_views_are_read_like_an_array(tmp_path):
    views = np.random.default_rng(0).integers(0, 256, (4, V, 2, 8, 8), dtype=np.uint8)
    views[2] = 0
    there = ((i, pack(views[i])) for i in (3, 0, 1))  # in any order; object 2 was not rendered
    assert list(save_packed(tmp_path / "views", views.shape, there)) == [1, 2, 3]
    packed = load_packed(tmp_path / "views")
    assert packed.shape == views.shape
    assert len(packed) == 4
    for at in (0, 2, (3, 4), (1, slice(1, None, 2)), (3, slice(2)), (2, 0)):
        assert (packed[at] == views[at]).all()

    file = tmp_path / "views/views.lz4"
    sound = bytearray(file.read_bytes())
    start, count = packed.places[1, 2]
    for at in (start, start + count // 2, start + count - 1):
        damaged = sound.copy()
        damaged[at] ^= 4
        file.write_bytes(damaged)
        packed = load_packed(tmp_path / "views")
        assert (packed[1, 1] == views[1, 1]).all()
        for touched in ((1, 2), 1, (1, slice(2, 4))):
            with pytest.raises(DatasetError, match="views: is damaged; delete it, and it is made again"):
                packed[touched]
    file.write_bytes(sound[:-1])
    with pytest.raises(ValueError, match="views: is damaged; delete it, and it is made again"):
        load_packed(tmp_path / "views")
    index = tmp_path / "views/index.npz"
    index.write_bytes(index.read_bytes()[:-30])
    with pytest.raises(DatasetError, match=r"index\.npz is damaged.* delete it, and it is made again"):
        load_packed(tmp_path / "views")


def test_views_that_are_packed_only_in_part_are_no_views(tmp_path):
    def fails():
        yield 0, pack(np.ones((V, 1, 2, 2), np.uint8))
        raise InterruptedError

    with pytest.raises(InterruptedError):
        list(save_packed(tmp_path / "views", (2, V, 1, 2, 2), fails()))
    assert not (tmp_path / "views").exists()
    list(save_packed(tmp_path / "views", (2, V, 1, 2, 2), []))  # what was left does not stand in the way
    assert not load_packed(tmp_path / "views")[1].any()


def test_devices_share_the_validation():
    inputs = np.arange(7 * 10, dtype=np.uint8).reshape(7, 10, 1, 1, 1)
    labels = np.arange(7)
    shares = []
    for rank in range(2):
        validation = ValidationViews(inputs, np.arange(7), labels)
        validation.share = slice(rank, None, 2)
        shares.append({int(x) for images, _ in validation for x in images.flatten()})
    whole = {int(x) for images, _ in ValidationViews(inputs, np.arange(7), labels) for x in images.flatten()}
    assert shares[0] | shares[1] == whole
    assert not shares[0] & shares[1]


def test_the_published_rate_halves_every_fifth_epoch():
    chosen = RecogniserModule(replace(THESIS_RECOGNISER, depth=18), 10, 1000).configure_optimizers()
    assert chosen["lr_scheduler"]["interval"] == "epoch"
    rates = []
    for _ in range(15):
        rates.append(chosen["optimizer"].param_groups[0]["lr"])
        chosen["optimizer"].step()
        chosen["lr_scheduler"]["scheduler"].step()
    assert rates == pytest.approx([1e-3] * 5 + [5e-4] * 5 + [2.5e-4] * 5)


def test_the_published_optimiser_is_adam():
    torch.manual_seed(0)
    module = RecogniserModule(replace(THESIS_RECOGNISER, depth=18), 10, 1000)
    duplicate = RecogniserModule(replace(THESIS_RECOGNISER, depth=18), 10, 1000)
    duplicate.load_state_dict(module.state_dict())
    for network, optimizer in (
        (module.net, module.configure_optimizers()["optimizer"]),
        (duplicate.net, torch.optim.Adam(duplicate.net.parameters(), lr=1e-3)),
    ):
        for _ in range(2):
            for k, parameter in enumerate(network.parameters()):
                parameter.grad = torch.full_like(parameter, 0.1 * (k % 3 - 1)) + parameter.detach()
            optimizer.step()
    for ours, theirs in zip(module.net.parameters(), duplicate.net.parameters(), strict=True):
        assert torch.allclose(ours, theirs, atol=1e-7)


def test_the_published_recipe_is_what_the_thesis_says():
    published = {"depth": 34, "size": 224, "batch": 32, "lr": 1e-3, "input": "image", "views": 40}
    ours = asdict(THESIS_RECOGNISER)
    assert {name: ours[name] for name in published} == published
    assert (ours["weight_decay"], ours["smoothing"], ours["augment"], ours["balanced"]) == (0, 0, False, False)


def test_augmented_background_stays_empty():
    torch.manual_seed(0)
    x = torch.zeros(8, 1, 32, 32)
    assert augment(x)[0].abs().max() == 0
    x[:, :, 8:24, 8:24] = 0.5
    y, _ = augment(x)
    assert y.shape == x.shape
    assert (y[:, :, 16, 16] > 0).float().mean() > 0.5


def test_augment_says_which_views_it_mirrored():
    torch.manual_seed(0)
    x = torch.zeros(64, 1, 32, 32)
    x[:, :, :, 4:12] = 0.5  # something on the left
    y, mirrored = augment(x)
    on_the_right = y[..., 16:].sum((1, 2, 3)) > y[..., :16].sum((1, 2, 3))
    assert torch.equal(on_the_right, mirrored)
    assert 16 < mirrored.sum() < 48


def test_image_input_is_the_mean_of_squares():
    images = np.random.default_rng(0).integers(0, 256, (3, 64, 64), dtype=np.uint8)
    expected = block_reduce(images, (1, 2, 2), np.mean)
    assert np.abs(image_input(images, 32)[:, 0] - expected).max() <= 0.5
    assert (image_input(images, 64)[:, 0] == images).all()
    with pytest.raises(ValueError, match="use a multiple of 48"):
        image_input(images, 48)


def test_a_preset_sets_defaults_that_options_change():
    for arguments, recipe in (([], RecogniserRecipe()), (["--preset", "thesis"], THESIS_RECOGNISER)):
        offered = inspect.signature(with_preset(train_recogniser, arguments)).parameters["recipe"].default
        assert offered == recipe
    assert with_preset(main, ["--preset", "thesis"]) is main


FAST = ["--epochs", "1", "--size", "32", "--views", "2", "--batch", "4", "--validation", "0.25"]


def test_published_recipe_on_images_by_the_command(store, tmp_path, capsys):
    run = tmp_path / "run"
    # depth 18 is the default's value: given with a preset of another, it counts
    main(["train", "recogniser", str(store), str(run), "--preset", "thesis", "--depth", "18", *FAST])
    noted = json.loads((run / "recipe.json").read_text())
    assert noted == asdict(replace(THESIS_RECOGNISER, depth=18, epochs=1, size=32, views=2, batch=4, validation=0.25))
    assert {path.name for path in run.iterdir()} == {
        "recipe.json", "weights.json", "commands.json", "held_out.json", "network.pt", "best.ckpt", "last.ckpt", "log",
        "curves.png",
    }  # fmt: skip
    assert torch.load(run / "network.pt", weights_only=True)["conv1.weight"].shape == (64, 1, 7, 7)
    images = load_inputs(store, 32, "image")
    assert (images[3] == image_input(ViewStore.open(store).image(3), 32)).all()
    assert not store.with_name("views.zarr.inputs32").exists()

    before = (run / "network.pt").read_bytes()
    main(["train", "recogniser", str(store), str(run), "--preset", "thesis", "--depth", "18", *FAST])
    assert "is trained" in capsys.readouterr().err
    assert (run / "network.pt").read_bytes() == before
    with pytest.raises(SystemExit) as stopped:
        main(["train", "recogniser", str(store), str(run), "--preset", "thesis", *FAST])
    assert stopped.value.code == 2
    assert "holds a run of another recipe (depth was 18, not 34)" in capsys.readouterr().err


@pytest.mark.parametrize("what", [["recogniser", "--folds", "2"], ["recogniser"], ["lem"]], ids=" ".join)
def test_going_on_from_a_network_that_has_seen_the_validation_objects_is_refused(store, what, tmp_path, capsys):
    views = ViewStore.open(store)
    kept = [views.names[i] for i in split_training(views, 0.25, 0)[1]]
    held_out = kept if "--folds" in what else kept[:1]  # every object is held out for some fold
    bundled = Path(find_card(RECOGNISER).path)
    card = json.loads(bundled.with_suffix(".json").read_text())
    (tmp_path / "mine.onnx").write_bytes(bundled.read_bytes())
    (tmp_path / "mine.json").write_text(json.dumps(card | {"name": "mine", "held_out": held_out}))
    command = ["train", what[0], str(store), str(tmp_path / "out"), *what[1:], "--weights", str(tmp_path / "mine.json")]
    with pytest.raises(SystemExit):
        main([*command, *FAST])
    assert re.search(r"mine.json: was trained on \d of the \d objects", capsys.readouterr().err)
    assert not (tmp_path / "out").exists()


def test_a_size_that_the_views_do_not_have_is_refused_before_anything_is_made(store, tmp_path, capsys):
    before = sorted(store.parent.iterdir())
    with pytest.raises(SystemExit):
        main(["train", "recogniser", str(store), str(tmp_path / "out"), *FAST, "--size", "48"])
    assert "cannot be thinned to 48x48: use a multiple of 48" in capsys.readouterr().err
    assert [path for path in sorted(store.parent.iterdir()) if path.suffix != ".lock"] == [
        path for path in before if path.suffix != ".lock"
    ]


def test_one_fold_alone_starts_from_weights(store, tmp_path, capsys):
    with torch.device("meta"):
        shapes = RecogniserModule(RecogniserRecipe(), 1000, 10).net.state_dict()
    state = {name: torch.zeros(value.shape, dtype=value.dtype) for name, value in shapes.items()}
    state["conv1.weight"] = torch.zeros(64, 3, 7, 7)
    torch.save(state, tmp_path / "zeros.pth")
    command = ["train", "recogniser", str(store), str(tmp_path / "out"), "--folds", "2", "--weights"]
    main([*command, str(tmp_path / "zeros.pth"), "--fold", "1", "--lr", "0", *FAST])
    assert [path.name for path in (tmp_path / "out").iterdir() if path.is_dir()] == ["fold1"]
    trained = torch.load(tmp_path / "out/fold1/network.pt", weights_only=True)
    assert not trained["layer4.1.conv2.weight"].any()  # a rate of 0 leaves the weights that it was given
    (tmp_path / "others.pth").write_bytes((tmp_path / "zeros.pth").read_bytes() + b" ")
    for options, message in (
        ([str(tmp_path / "others.pth"), "--fold", "1", "--lr", "0"], "started from other weights"),
        ([str(tmp_path / "missing.pth"), "--fold", "0"], "there is no such checkpoint"),
        ([str(tmp_path / "zeros.pth"), "--fold", "2"], "there is no fold 2 of 2"),
    ):
        with pytest.raises(SystemExit):
            main([*command, *options, *FAST])
        assert message in capsys.readouterr().err


def test_a_run_resumes_with_a_recipe_from_before_new_options_and_refuses_what_it_cannot_read(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    old = {name: value for name, value in asdict(RecogniserRecipe()).items() if name not in ("input", "schedule")}
    (run / "recipe.json").write_text(json.dumps(old))
    with begin(run, RecogniserRecipe()):
        pass
    with pytest.raises(ModelError, match=r"\(seed was 0, not 1\)"), begin(run, RecogniserRecipe(seed=1)):
        pass
    for text in ("{", "[]", json.dumps({"flavour": 3})):
        (run / "recipe.json").write_text(text)
        with (
            pytest.raises(ModelError, match="not a recipe of such a network in this version"),
            begin(run, RecogniserRecipe()),
        ):
            pass


@pytest.mark.parametrize("name", ["weights.json", "held_out.json", "curves.png", "thesis.txt", "photos/a.png"])
def test_a_folder_of_others_is_not_trained_in(tmp_path, name):
    """It would get files of the run, some of the same names."""
    file = tmp_path / "run" / name
    file.parent.mkdir(parents=True)
    file.write_text("years of work")
    holds = name.partition("/")[0]
    with (
        pytest.raises(ModelError, match=f"^[^\\n]*run: holds {holds} and no training run; give a new folder[^\\n]*$"),
        begin(tmp_path / "run", RecogniserRecipe()),
    ):
        pass
    assert file.read_text() == "years of work"
    assert [str(path.relative_to(tmp_path / "run")) for path in (tmp_path / "run").rglob("*") if path.is_file()] == [
        name
    ]


def test_a_run_that_was_killed_before_its_recipe_was_written_begins_anew(tmp_path):
    with begin(tmp_path / "run", RecogniserRecipe()):
        pass
    (tmp_path / "run/recipe.json").unlink()
    (tmp_path / "run/.nextview-recipe.json-abcd1234").mkdir()
    with begin(tmp_path / "run", RecogniserRecipe()):
        pass
    names = ["commands.json", "recipe.json", "weights.json"]
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == names


def test_a_checkpoint_that_cannot_be_written_leaves_the_one_before_and_nothing_elsewhere(tmp_path, monkeypatch):
    """Lightning would write it to the folder for temporary files, and copy it if that is on another disk."""
    elsewhere = tmp_path / "elsewhere"
    monkeypatch.setattr("tempfile.tempdir", str(elsewhere))
    file = tmp_path / "run/last.ckpt"
    WholeCheckpoints().save_checkpoint({"epoch": 1}, file)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
    try:
        with pytest.raises(ResultsError, match=r"last\.ckpt: cannot be written \(File too large\)"):
            WholeCheckpoints().save_checkpoint({"epoch": 2, "weights": torch.zeros(10_000)}, file)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert torch.load(file, weights_only=True) == {"epoch": 1}
    assert [path.name for path in file.parent.iterdir()] == ["last.ckpt"]
    assert not elsewhere.exists()


def test_two_processes_do_not_train_in_one_folder(tmp_path):
    with (
        only_one(tmp_path / "run"),
        pytest.raises(DatasetError, match="another run"),
        begin(tmp_path / "run", RecogniserRecipe()),
    ):
        pass


TEN = ("bathtub", "bed", "chair", "desk", "dresser", "monitor", "night_stand", "sofa", "table", "toilet")


def test_the_grid_holds_the_networks_of_table_6():
    assert published_cells(TEN, 40) == {  # two numbers are printed for ResNet-34 in batches of 4
        (18, 4): [0.8588], (34, 4): [0.8599, 0.8588], (34, 8): [0.8642], (34, 16): [0.8662], (34, 32): [0.871],
        (34, 64): [0.8704], (50, 4): [0.8444], (101, 4): [0.8523], (152, 4): [0.862],
    }  # fmt: skip
    assert published_cells(TEN, 12) == {(18, 32): [0.8901]}
    elsewhere = published_cells(("a", "b"), 5)
    assert {depth for depth, _ in elsewhere} == {18, 34, 50, 101, 152}
    assert not any(elsewhere.values())


def test_the_grid_is_one_command(store, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "nextview.training.recogniser.grid_training.published_cells", lambda *_: {(18, 4): [0.5, 0.75], (34, 4): []}
    )
    command = ["train", "grid", str(store), str(tmp_path), "--depths", "18", *FAST, "--augment"]
    main(command)
    rows = list(csv.DictReader((tmp_path / "grid.csv").read_text().splitlines()))
    assert [(row["depth"], row["batch_size"], row["published"]) for row in rows] == [
        ("18", "4", "0.5"),
        ("18", "4", "0.75"),
    ]
    network = ResNet(18, 2, 1)
    network.load_state_dict(torch.load(tmp_path / "resnet18-batch4/network.pt", weights_only=True))
    views = ViewStore.open(store)
    with torch.no_grad():  # objects 8 and 9, of class a and b, are the test split
        answers = [
            network.eval()(torch.from_numpy(image_input(views.image(i), 32)).float() / 255)[0].argmax(1) == i % 2
            for i in (8, 9)
        ]
    assert float(rows[0]["accuracy"]) == pytest.approx(torch.cat(answers).float().mean().item(), abs=1e-4)
    assert (tmp_path / "grid.png").exists()
    (tmp_path / "grid.csv").unlink()
    main(command)  # nothing is trained or judged again
    assert list(csv.DictReader((tmp_path / "grid.csv").read_text().splitlines())) == rows


@pytest.mark.parametrize("name", ["grid.csv", "grid.png", "manifest.json"])
def test_the_grid_replaces_nothing_that_is_a_user_s(store, tmp_path, capsys, name):
    (tmp_path / name).write_text("mine")
    with pytest.raises(SystemExit) as ended:
        main(["train", "grid", str(store), str(tmp_path), *FAST])
    assert ended.value.code == 2
    assert f"{name}: is there and is no" in capsys.readouterr().err
    assert (tmp_path / name).read_text() == "mine"
    assert not list(tmp_path.glob("resnet*"))  # before anything is trained


@pytest.mark.long
def test_two_devices_train_one_network(store, tmp_path):
    """As Lightning starts them; each is a process of its own."""
    run = tmp_path / "run"
    options = ["--devices", "2", "--accelerator", "cpu", "--precision", "32-true", *FAST]
    command = [sys.executable, "-m", "nextview.cli.main", "train", "recogniser", str(store), str(run), *options]
    done = subprocess.run(
        command, env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert "MEMBER: 2/2" in done.stderr
    assert (run / "network.pt").exists()
    assert (run / "curves.png").exists()
    state = torch.load(run / "last.ckpt", weights_only=True)
    assert state["global_step"] == 6 * 2 // 4  # the batch is that of all devices together


GUIDE = (Path(__file__).parent.parent / "docs/training.md").read_text()
TRAINED = {name: card.training for name, card in bundled_cards().items()}
COMMAND_LINES = [*re.findall(r"^nextview .*?(?=  +#|$)", GUIDE, re.M)]
COMMAND_LINES += [line for training in TRAINED.values() for line in training.commands]


@pytest.mark.parametrize("line", dict.fromkeys(COMMAND_LINES))
def test_the_guide_and_the_cards_name_commands_and_options_that_exist(line, capsys):
    words = line.split()
    command = words[1:3] if isinstance(COMMANDS[words[1]], dict) else words[1:2]
    with pytest.raises(SystemExit):
        main([*command, "--help"])
    offered = capsys.readouterr().out
    for option in re.findall(r"--[a-z-]+", line):
        assert option == "--help" or f"{option} " in offered, f"{option} is no option of {command}"


@pytest.mark.parametrize("name", TRAINED)
def test_the_recipes_of_the_cards_are_recipes_of_this_version(name):
    training = TRAINED[name]
    kind = RecogniserRecipe if name.startswith("recogniser") else MapRecipe
    for noted in training.recipes:
        recipe = asdict(kind(**noted))
        assert recipe | noted == recipe  # an option that came later has its default


def test_part_of_the_way_is_between_the_beginning_and_the_end():
    start = {"weight": torch.tensor([0.0, 2.0]), "count": torch.tensor(3)}
    end = {"weight": torch.tensor([1.0, 0.0]), "count": torch.tensor(8)}
    between = part_way(start, end, 0.75)
    np.testing.assert_allclose(between["weight"], [0.75, 0.5])
    assert between["count"] == 8
    assert torch.equal(part_way(start, end, 1.0)["weight"], end["weight"])
