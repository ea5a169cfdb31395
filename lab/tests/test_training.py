"""Training: what batches hold, runs that stop and resume to the bit, and the way from views to
models with cards.
"""

import csv
import multiprocessing
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pipeline import store_of

torch = pytest.importorskip("torch")
L = pytest.importorskip("lightning")


from nextview.errors import ModelError, ResultsError, UsageError
from nextview.geometry.viewsphere import ViewSphere
from nextview.recognition.inference import MapNetwork, NetworkRecogniser
from nextview.recognition.model_card import read_card
from nextview_lab.data.store import ViewStore
from nextview_lab.training import recogniser_training as training
from nextview_lab.training.export import export_map, export_recogniser
from nextview_lab.training.fitting_set import hold_out
from nextview_lab.training.map_training import Windows, train_map
from nextview_lab.training.recipes import (
    THESIS_RECOGNISER,
    Hardware,
    MapRecipe,
    RecogniserRecipe,
)
from nextview_lab.training.recogniser_training import (
    StoredInputs,
    Views,
    train_recogniser,
)
from nextview_lab.training.runs import fit, read_run

V = 5
SPHERE = ViewSphere((0.0, 30.0), 8, 3.0)
RECIPE = RecogniserRecipe(size=32, epochs=3, views_per_object=4, batch=8)
# Of 16 pixels the last step of a ResNet is a strided convolution of one pixel, whose bfloat16
# gradient on a CPU is not always finite (torch 2.13).
SMALL = RecogniserRecipe(
    size=32,
    epochs=1,
    views_per_object=2,
    batch=4,
    validation_share=0.25,
    azimuth_bins_weight=0.3,
)
EXACT = Hardware(precision="32-true")
SMALL_MAP = MapRecipe(
    size=32, epochs=1, views_per_object=2, batch=4, validation_share=0.25
)


# Batches


def views_of(recipe, objects=6, views=V):
    """Inputs whose pixels say which object and view they are."""
    which = np.arange(objects * views, dtype=np.uint8).reshape(objects, views, 1, 1, 1)
    source = StoredInputs(
        np.broadcast_to(which, (objects, views, 4, 2, 2)), np.arange(objects)
    )
    return Views([source], np.arange(objects), np.arange(objects) % 2, recipe)


def test_the_published_recipe_sees_every_view_once_an_epoch_in_a_new_order():
    views, orders = views_of(replace(THESIS_RECOGNISER, batch=5)), []
    for views.epoch in (0, 1):
        orders.append([int(x) for images, _ in views for x in images[:, 0, 0, 0]])
    first, second = orders
    assert sorted(first) == sorted(second) == list(range(6 * V))
    assert first != second
    assert (
        np.concatenate([label for _, label in views]) == np.array(second) // V % 2
    ).all()


def test_map_batches_hold_each_view_with_its_own_map():
    sphere, rng = ViewSphere.named("40"), np.random.default_rng(0)
    values = rng.random((7, 40)).astype(np.float32)
    # object and view, in the left half of the image
    seen = np.zeros((7, 40, 4, 2, 2), np.uint8)
    seen[..., 0, 0, 0], seen[..., 1, 0, 0] = (
        np.arange(7)[:, None] + 1,
        np.arange(40) + 1,
    )
    windows = Windows(
        seen,
        values,
        sphere,
        np.array([1, 2, 5]),
        MapRecipe(views_per_object=6, batch=4),
        training=True,
    )
    drawn, flips = [], []
    for images, targets in windows:
        assert len(images) == 4
        for image, target in zip(images.numpy(), targets.numpy(), strict=True):
            o, v = int(image[0].max()) - 1, int(image[1].max()) - 1
            drawn.append((o, v))
            flips.append(image[0, 0, 1] > 0)
            steps = np.arange(8) * (-1 if flips[-1] else 1)
            assert (
                target == values[o, np.arange(5)[:, None] * 8 + (v + steps) % 8]
            ).all()
    assert len(drawn) == 16
    assert len(set(drawn)) == 16  # no view comes twice before all have come
    assert {o for o, _ in drawn} == {1, 2, 5}
    assert 0 < sum(flips) < 16


def test_folds_divide_every_class_evenly_and_keep_twins_together():
    labels, measured = (
        np.repeat([0, 1], [12, 8]),
        np.random.default_rng(0).random((20, 5)),
    )
    measured[15] = measured[3]  # one mesh, two labels
    folds = hold_out(labels, measured, 3, seed=1)
    assert sorted(np.concatenate(folds)) == list(range(20))
    counts = np.array([np.bincount(labels[fold], minlength=2) for fold in folds])
    assert np.ptp(counts, axis=0).max() <= 2  # a twin of the other class may shift one
    assert any({3, 15} <= set(fold) for fold in folds)


def test_the_mirror_plane_is_the_one_that_maps_the_views_into_each_other(tmp_path):
    rng = np.random.default_rng(0)
    azimuth = np.arange(8)
    labels = np.repeat([0, 1, 2], 5)
    values = []
    # class k is its own mirror image in the plane at k steps: values depend on the distance to it
    for plane in labels:
        profile = rng.random((2, 5))
        distance = np.minimum((azimuth - plane) % 8, (plane - azimuth) % 8)
        values.append(profile[:, distance].ravel())
    names = [f"object_{i}" for i in range(15)]
    store = store_of(
        tmp_path / "views.zarr", names, labels, SPHERE, depth_entropy=np.array(values)
    )
    assert training.mirror_planes(store, np.arange(15)).tolist() == [0, 1, 2]
    bins = training.azimuth_bins(store, 8, np.array([0.0, 1.0, 2.0])).reshape(15, 2, 8)
    assert bins[:, :, 0].tolist() == [[(-label) % 8] * 2 for label in labels]


def test_the_side_between_two_steps_counts_by_nearness():
    torch.manual_seed(0)
    likely = torch.randn(3, 4, 8).log_softmax(2)
    label, side = torch.tensor([0, 3, 1]), torch.tensor([2.0, 5.25, 7.5])
    between = (
        0.75 * likely[1, 3, 5]
        + 0.25 * likely[1, 3, 6]
        + 0.5 * likely[2, 1, 7]
        + 0.5 * likely[2, 1, 0]
    )
    assert training.side_loss(likely, label, side) == pytest.approx(
        -float(likely[0, 0, 2] + between) / 3, rel=1e-5
    )


# Runs


def data(classes=3, objects=12, views=5, size=32):
    """Inputs that tell the classes apart a little, and their labels."""
    rng = np.random.default_rng(0)
    labels = np.arange(objects) % classes
    inputs = (
        rng.integers(1, 200, (objects, views, 4, size, size))
        + 20 * labels[:, None, None, None, None]
    )
    return [StoredInputs(inputs.astype(np.uint8), np.arange(objects))], labels


class SmallNet(torch.nn.Module):
    """In place of a ResNet, whose checkpoints are 130 MB: convolution, batch norm and what is
    needed around them.
    """

    def __init__(self, recipe, classes, azimuths):
        super().__init__()
        layers = (
            torch.nn.Conv2d(4, 8, 5, 4),
            torch.nn.BatchNorm2d(8),
            torch.nn.ReLU(),
            torch.nn.AdaptiveAvgPool2d(1),
        )
        self.features = torch.nn.Sequential(*layers)
        self.fc = torch.nn.Linear(8, classes)

    def forward(self, x):
        return (self.fc(self.features(x).flatten(1)),)


def train(out, recipe=RECIPE, hardware=Hardware(), stop=None):
    """Train on the small set; a process of its own is killed at ``stop``, (epoch, batch)."""
    torch.set_num_threads(1)  # sums of several threads depend on how many there are
    (sources, labels), objects = data(), np.arange(12)
    step = training.RecogniserModule.training_step

    def fatal(self, batch, index):
        if (self.current_epoch, index) == stop:
            os.kill(os.getpid(), signal.SIGKILL)
        return step(self, batch, index)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "recogniser_network", SmallNet)
        patch.setattr(training.RecogniserModule, "training_step", fatal)
        return training.fit_recogniser(
            sources, labels, (objects[:9], objects[9:]), recipe, out, None, hardware
        )


def same(a, b):
    a, b = a.state_dict(), b.state_dict()
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    out = tmp_path_factory.mktemp("whole")
    return train(out), out


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
@pytest.mark.parametrize("stop", [(1, 2), (0, 1)], ids=["middle", "first"])
def test_a_run_that_was_killed_in_mid_epoch_and_moved_resumes_the_same_to_the_bit(
    tmp_path, uninterrupted, stop
):
    whole, folder = uninterrupted
    (tmp_path / "a").mkdir()
    arguments = tmp_path / "a", RECIPE, Hardware(), stop
    process = multiprocessing.get_context("fork").Process(target=train, args=arguments)
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert (tmp_path / "a/last.ckpt").exists() == (stop[0] > 0)
    (tmp_path / "a").rename(tmp_path / "b")
    assert same(train(tmp_path / "b"), whole)
    assert not (tmp_path / "a").exists()
    log, expected = log_of(tmp_path / "b"), log_of(folder)
    del log["seconds"], expected["seconds"]
    assert log == expected


def log_of(run):
    """The log of a run, a value for every epoch by column."""
    with (run / "log/metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: [float(row[name]) for row in rows] for name in rows[0]}


class Scripted(L.LightningModule):
    """Its one weight counts epochs; its score on validation is read off a list."""

    def __init__(self, scores, patience=0, epochs=0):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.scores, self.trained = scores, []
        self.recipe = replace(RECIPE, epochs=epochs or len(scores), patience=patience)

    def training_step(self, batch, index):
        self.trained.append(self.current_epoch)
        return -self.weight.sum()

    def validation_step(self, batch, index):
        self.log("score", torch.tensor(self.scores[self.current_epoch]))

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=1.0)


class One(torch.utils.data.IterableDataset):
    def __iter__(self):
        yield torch.zeros(1)


@pytest.mark.parametrize(("mode", "best"), [("max", 2), ("min", 4)])
def test_the_best_epoch_is_kept(tmp_path, mode, best):
    module = Scripted([0.5, 0.9, 0.7, 0.1])
    fit(module, One(), One(), tmp_path, "score", mode, EXACT)
    assert module.weight.item() == best  # after as many steps
    assert log_of(tmp_path)["score"] == pytest.approx([0.5, 0.9, 0.7, 0.1])


def test_a_run_without_progress_stops_and_stays_stopped(tmp_path):
    scores = [0.5, 0.9, 0.7, 0.6, 1.0]
    module = Scripted(scores, patience=2)
    fit(module, One(), One(), tmp_path, "score", "max", EXACT)
    assert module.trained == [0, 1, 2, 3]
    assert module.weight.item() == 2  # after as many steps
    again = Scripted(scores, patience=2)
    fit(again, One(), One(), tmp_path, "score", "max", EXACT)
    assert again.trained == []
    assert again.weight.item() == 2


# From views to models


@pytest.fixture(scope="module")
def trained(shared, views):
    """Both networks after one epoch, and their models: runs/recogniser, runs/lem,
    models/tiny.json, tiny-lem.json.
    """

    def make(folder: Path) -> None:
        train_recogniser(views, folder / "runs/recogniser", recipe=SMALL)
        export_recogniser(
            folder / "runs/recogniser", views, folder / "models", name="tiny"
        )
        train_map(views, folder / "runs/lem", recipe=SMALL_MAP)
        export_map(folder / "runs/lem", views, folder / "models", name="tiny-lem")

    return shared("trained", make)


def test_trained_models_have_cards_and_run(trained, views):
    card, run = (
        read_card(trained / "models/tiny.json"),
        read_run(trained / "runs/recogniser"),
    )
    assert card.classes == ("chair", "monitor", "table")
    # training leaves the test split alone
    assert [part.split()[0] for part in card.scores] == ["validation"]
    assert card.held_out == tuple(sorted(run.held_out))
    store = ViewStore.open(views)
    assert set(card.held_out) < {
        n
        for n, split in zip(store.names, store.splits, strict=True)
        if split == "train"
    }
    evidence = NetworkRecogniser(trained / "models/tiny.json").from_inputs(
        np.zeros((3, 4, 32, 32), np.uint8)
    )
    assert evidence.logits.shape == (3, 3)
    assert np.exp(evidence.azimuth_bins).sum(2) == pytest.approx(
        np.ones((3, 3)), abs=1e-4
    )
    lem = MapNetwork(trained / "models/tiny-lem.json").from_inputs(
        np.zeros((2, 4, 32, 32), np.uint8)
    )
    assert (lem["lem"] == lem["lem-sphere"][:, :, [-1, 0, 1]]).all()
    assert lem["lem-sphere"].shape == (2, 5, 8)
    before = (trained / "models/tiny.onnx").read_bytes()
    with pytest.raises(ResultsError):
        export_map(trained / "runs/lem", views, trained / "models", name="tiny")
    with pytest.raises(UsageError):
        export_map(trained / "runs/lem", views, trained / "models", name="../tiny")
    assert (trained / "models/tiny.onnx").read_bytes() == before


def test_an_unfinished_run_is_not_exported(trained, views, tmp_path):
    with pytest.raises(ModelError):
        export_map(tmp_path, views, tmp_path / "models")
    with pytest.raises(ModelError):
        export_recogniser(trained / "runs/lem", views, tmp_path / "models")
    (tmp_path / "run.json").write_bytes((trained / "runs/lem/run.json").read_bytes())
    with pytest.raises(ModelError):
        export_map(tmp_path, views, tmp_path / "models")
    (tmp_path / "network.pt").write_bytes(
        (trained / "runs/lem/network.pt").read_bytes()[:10_000]
    )
    with pytest.raises(ModelError):
        export_map(tmp_path, views, tmp_path / "models")
    assert not (tmp_path / "models").exists()
