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

torch = pytest.importorskip("torch")
L = pytest.importorskip("lightning")


from nextview.errors import ModelError, ResultsError, UsageError
from nextview.recognition.inference import MapNetwork, NetworkRecogniser
from nextview.recognition.model_card import read_card
from nextview_lab.data.store import ViewStore
from nextview_lab.training import recogniser_training as training
from nextview_lab.training.export import export_map, export_recogniser
from nextview_lab.training.fitting_set import hold_out
from nextview_lab.training.map_training import train_map
from nextview_lab.training.recipes import Hardware, MapRecipe, RecogniserRecipe
from nextview_lab.training.recogniser_training import StoredInputs, train_recogniser
from nextview_lab.training.runs import fit, read_run

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


def test_folds_divide_every_class_evenly_and_keep_twins_together():
    labels = np.repeat([0, 1], [12, 8])
    measured = np.random.default_rng(0).random((20, 5))
    measured[15] = measured[3]  # one mesh, two labels
    folds = hold_out(labels, measured, 3, seed=1)
    assert sorted(np.concatenate(folds)) == list(range(20))
    counts = np.array([np.bincount(labels[fold], minlength=2) for fold in folds])
    assert np.ptp(counts, axis=0).max() <= 2  # a twin of the other class may shift one
    assert any({3, 15} <= set(fold) for fold in folds)


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

    def __init__(self, scores):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.scores, self.trained = scores, []
        self.recipe = replace(RECIPE, epochs=len(scores))

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
    card = read_card(trained / "models/tiny.json")
    run = read_run(trained / "runs/recogniser")
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
