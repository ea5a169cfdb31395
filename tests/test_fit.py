"""A training that is stopped and resumed ends with the weights of one that never was; the best epoch is kept."""

import multiprocessing
import os
import signal
import sys
import time

import numpy as np
import pytest

torch = pytest.importorskip("torch")
L = pytest.importorskip("lightning")

from nextview.models.model_card import ModelError  # noqa: E402
from nextview.report.training_curves import read_log, training_curves  # noqa: E402
from nextview.training import loop as fitting  # noqa: E402
from nextview.training.ahead import Ahead  # noqa: E402
from nextview.training.hardware import Hardware  # noqa: E402
from nextview.training.recipes import RecogniserRecipe  # noqa: E402
from nextview.training.recogniser import recogniser_module as recogniser  # noqa: E402

RECIPE = RecogniserRecipe(size=32, epochs=3, views=4, batch=8)


def data(classes=3, objects=12, views=5, size=32):
    """Inputs that tell the classes apart a little, and their labels."""
    rng = np.random.default_rng(0)
    labels = np.arange(objects) % classes
    inputs = rng.integers(1, 200, (objects, views, 4, size, size)) + 20 * labels[:, None, None, None, None]
    return [recogniser.Source(inputs.astype(np.uint8), np.arange(objects))], labels


class SmallNet(torch.nn.Module):
    """In place of a ResNet, whose checkpoints are 130 MB: convolution, batch norm and what is needed around them."""

    def __init__(self, recipe, classes, azimuths):
        super().__init__()
        self.features = torch.nn.Sequential(
            torch.nn.Conv2d(4, 8, 5, 4), torch.nn.BatchNorm2d(8), torch.nn.ReLU(), torch.nn.AdaptiveAvgPool2d(1)
        )
        self.fc = torch.nn.Linear(8, classes)

    def forward(self, x):
        return (self.fc(self.features(x).flatten(1)),)


def train(out, recipe=RECIPE, hardware=Hardware(), stop=None):
    """Train on the small set; ``stop`` is (epoch, batch, "raise" or "kill")."""
    torch.set_num_threads(
        1
    )  # sums of several threads depend on how many there are, and a test before may have set that
    sources, labels = data()
    recogniser.recogniser_network, usual = SmallNet, recogniser.recogniser_network
    if stop:
        rest = recogniser.RecogniserModule.training_step

        def fatal(self, batch, index):
            if (self.current_epoch, index) == stop[:2]:
                if stop[2] == "raise":
                    raise RuntimeError("stopped")
                os.kill(os.getpid(), signal.SIGKILL)
            return rest(self, batch, index)

        recogniser.RecogniserModule.training_step = fatal
    try:
        objects = np.arange(len(labels))
        return recogniser.fit_recogniser(sources, labels, objects[:9], objects[9:], recipe, out, None, hardware)
    finally:
        recogniser.recogniser_network = usual
        if stop:
            recogniser.RecogniserModule.training_step = rest


def same(a, b):
    a, b = a.state_dict(), b.state_dict()
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    out = tmp_path_factory.mktemp("whole")
    return train(out), out


def last_weights(out):
    return torch.load(out / "last.ckpt", weights_only=True)["state_dict"]


@pytest.mark.parametrize("stop", [(1, 0), (1, 2), (2, 1), (0, 1)], ids=["begin", "middle", "last", "first"])
def test_a_run_that_failed_and_resumed_is_the_same_to_the_bit(tmp_path, uninterrupted, stop):
    whole, folder = uninterrupted
    with pytest.raises(RuntimeError, match="stopped"):
        train(tmp_path, stop=(*stop, "raise"))
    assert (tmp_path / "last.ckpt").exists() == (stop[0] > 0)
    assert same(train(tmp_path), whole)
    ours, theirs = last_weights(tmp_path), last_weights(folder)
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    log, expected = read_log(tmp_path), read_log(folder)
    assert {name: log[name] for name in log if name != "seconds"} == {
        name: expected[name] for name in expected if name != "seconds"
    }


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_a_run_that_was_killed_in_mid_epoch_and_moved_resumes_the_same_to_the_bit(tmp_path, uninterrupted):
    process = multiprocessing.get_context("spawn").Process(
        target=train, args=(tmp_path / "a", RECIPE, Hardware(), (1, 2, "kill"))
    )
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    (tmp_path / "a").rename(tmp_path / "b")
    assert same(train(tmp_path / "b"), uninterrupted[0])
    assert not (tmp_path / "a").exists()


class Scripted(L.LightningModule):
    """Its one weight counts epochs; its score on validation is read off a list."""

    def __init__(self, scores):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.scores, self.recipe, self.trained = scores, RECIPE, []

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


EXACT = Hardware(precision="32-true")


@pytest.mark.parametrize(("mode", "best"), [("max", 2), ("min", 4)])
def test_the_best_epoch_is_kept(tmp_path, mode, best):
    module = Scripted([0.5, 0.9, 0.7, 0.1])
    fitting.fit(module, One(), One(), 4, tmp_path, "score", mode, hardware=EXACT)
    assert module.weight.item() == best  # after as many steps
    assert read_log(tmp_path)["score"] == pytest.approx([0.5, 0.9, 0.7, 0.1])


class Nothing(torch.utils.data.IterableDataset):
    def __iter__(self):
        return iter(())


def test_without_validation_the_last_epoch_is_kept(tmp_path):
    module = Scripted([])
    fitting.fit(module, One(), Nothing(), 3, tmp_path, "score", hardware=EXACT)
    assert module.weight.item() == 3


def test_a_run_without_progress_stops_and_stays_stopped(tmp_path):
    scores = [0.5, 0.9, 0.7, 0.6, 1.0]
    module = Scripted(scores)
    fitting.fit(module, One(), One(), 5, tmp_path, "score", "max", 2, EXACT)
    assert module.trained == [0, 1, 2, 3]
    assert module.weight.item() == 2  # after as many steps
    again = Scripted(scores)
    fitting.fit(again, One(), One(), 5, tmp_path, "score", "max", 2, EXACT)
    assert again.trained == []
    assert again.weight.item() == 2


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b"not a checkpoint"])
def test_a_damaged_checkpoint_is_named(tmp_path, damage):
    fitting.fit(Scripted([1.0]), One(), One(), 1, tmp_path, "score", hardware=EXACT)
    last = tmp_path / "last.ckpt"
    last.write_bytes(damage(last.read_bytes()))
    with pytest.raises(ModelError, match=r"last\.ckpt: a damaged checkpoint .* delete it"):
        fitting.fit(Scripted([1.0, 1.0]), One(), One(), 2, tmp_path, "score", hardware=EXACT)


def test_tensorboard_is_asked_for_by_name(tmp_path, monkeypatch):
    monkeypatch.setattr(fitting.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ModelError, match="pip install tensorboard"):
        fitting.fit(Scripted([1.0]), One(), One(), 1, tmp_path, "score", hardware=Hardware(tensorboard=True))


def test_tensorboard_gets_every_epoch(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    hardware = Hardware(precision="32-true", tensorboard=True)
    fitting.fit(Scripted([0.5, 0.25]), One(), One(), 2, tmp_path, "score", hardware=hardware)
    events = accumulator.EventAccumulator(str(tmp_path / "log")).Reload()
    assert [event.value for event in events.Scalars("score")] == [0.5, 0.25]


@pytest.mark.parametrize("precision", ["bf16-mixed", "16-mixed", "32-true"])
def test_every_precision_trains_here(tmp_path, precision):
    network = train(tmp_path, RecogniserRecipe(size=32, epochs=1, views=1, batch=4), Hardware(precision=precision))
    assert all(p.dtype == torch.float32 and torch.isfinite(p).all() for p in network.parameters())


class Numbers(torch.utils.data.IterableDataset):
    def __init__(self):
        self.made = 0

    def __iter__(self):
        for k in range(10):
            if k == 7:
                raise OSError("unreadable")
            self.made += 1
            yield k


def test_ahead_keeps_the_order_and_passes_on_what_fails():
    batches = iter(Ahead(Numbers(), 3))
    assert [next(batches) for _ in range(7)] == list(range(7))
    with pytest.raises(OSError, match="unreadable"):
        next(batches)


def test_ahead_makes_so_many_in_advance_and_no_more():
    numbers = Numbers()
    batches = iter(Ahead(numbers, 2))
    for taken in range(1, 5):
        next(batches)
        time.sleep(0.05)
        assert numbers.made == taken + 2
    batches.close()


def test_curves_show_every_score_and_the_kept_epoch(tmp_path, uninterrupted):
    log = read_log(uninterrupted[1])
    figure = training_curves(log)
    drawn = {axes.get_ylabel(): axes for axes in figure.axes}
    assert set(drawn) == {"loss", "class mean accuracy", "learning rate"}
    assert [len(axes.lines) for axes in drawn.values()] == [2, 2, 1]  # the kept epoch is a line too
    accuracy = next(axes for axes in figure.axes if axes.texts)
    best = max(log["class_accuracy"])
    assert f"epoch {log['class_accuracy'].index(best) + 1}, {best:.4f}" in accuracy.texts[0].get_text()
