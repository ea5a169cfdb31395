"""The segmentation network: its labelled frames, its training, and the file that is exported."""

import csv
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from lab_programs import main
from scipy import ndimage
from scipy.spatial.transform import Rotation

from nextview.geometry.pinhole import PinholeCamera
from nextview.segmentation.features import SmallPicture
from nextview.segmentation.network import (
    AFFINITY_STEPS,
    load_network,
)
from nextview_lab.data.labelled_frames import (
    Example,
    LabelledFrames,
    draw_frames,
    frame_files,
)
from nextview_lab.worlds.worlds import BACKGROUND, SURFACE, World, photograph, slab

# size, middle of the foot, height of the top and turn of each box, and its label
BOXES = (
    ((6.0, 6.0, 0.1), (0.0, 0.0), -0.7, 0.0, BACKGROUND),
    ((0.7, 0.5, 0.04), (0.0, 0.0), 0.0, 0.3, SURFACE),
    ((0.16, 0.1, 0.12), (0.03, 0.02), 0.12, 0.8, 0),
)
SEED = (5, 0)


def reaches(origin, rays, size, middle, top, turn):
    """How far rays go to a box, by the three pairs of planes that bound it; infinity for a miss."""
    axes = Rotation.from_euler("z", turn).as_matrix()
    start = (origin - [*middle, top - size[2] / 2]) @ axes
    along = rays @ axes
    with np.errstate(divide="ignore"):
        bounds = np.array([[-1], [1]]) * size / 2 - start
        ends = bounds[:, None, None] / along
    enter = ends.min(0).max(-1)
    leave = ends.max(0).min(-1)
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)


def test_labels_and_depth_are_those_of_rays_that_meet_boxes():
    world = World(np.array([0, 0, 0.05]), 0.1, (25.0, 80.0))
    for *place, label in BOXES:
        world.add(slab(*place), label)

    frames = photograph(world, np.random.default_rng(3), (90, 120), 8)
    shown = set()
    for frame in frames:
        rays = PinholeCamera.of(frame.intrinsics, frame.depth.shape).rays
        turned = rays @ frame.pose[:3, :3].T
        far = np.stack([reaches(frame.pose[:3, 3], turned, *box[:4]) for box in BOXES])
        expected = np.array([label for *_, label in BOXES])[far.argmin(0)]
        inner = ndimage.minimum_filter(expected, 7) == ndimage.maximum_filter(
            expected, 7
        )
        judged = inner & (frame.depth > 0) & np.isfinite(far.min(0))

        assert judged.sum() > 1000
        assert (frame.labels[judged] == expected[judged]).mean() > 0.995
        missed = frame.depth[judged] / far.min(0)[judged] - 1
        assert np.median(np.abs(missed)) < 0.02
        shown |= set(np.unique(expected[judged]).tolist())
        assert np.allclose(frame.pose[:3, :3] @ frame.up, [0, 0, 1])
    assert shown == {BACKGROUND, SURFACE, 0}


def test_training_targets_of_a_picture():
    labels = np.full((20, 30), SURFACE, np.int16)
    labels[4:8, 5:11] = 0
    labels[4:8, 11:14] = 1
    slopes = [np.linspace(-0.3, 0.3, size, dtype=np.float32) for size in (30, 20)]
    picture = SmallPicture(np.full((20, 30), 2.0, np.float32), tuple(slopes), 1)
    example = Example.of(picture, labels, None)

    assert example.features.shape[1:] == example.classes.shape == (32, 32)
    assert (example.classes[20:] == -1).all()
    assert example.classes[[0, 4, 4], [0, 5, 11]].tolist() == [1, 2, 2]
    right = AFFINITY_STEPS.index((0, 4))
    assert example.same[right, 5, 5:11].tolist() == [1, 1, 0, 0, 0, 0]
    large, small = (
        24**-0.5,
        12**-0.5,
    )  # by the pixels of a thing; the smaller one counts
    np.testing.assert_allclose(
        example.compared[right, 5, [0, 5, 9, 11, 13]], [0, large, small, 0, 0]
    )


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Two files of frames."""
    files = frame_files(tmp_path_factory.mktemp("drawn"), 4, SEED, most=2)
    assert [done for done, _ in draw_frames(files, workers=0)] == [0, 1, 2]
    return files


KILLED = """
import os, sys
from pathlib import Path
from nextview_lab.data.labelled_frames import draw_frames, frame_files

finish = os.replace
def fatal(source, target):
    if str(target).endswith("00001.npz"):
        os._exit(9)
    finish(source, target)
os.replace = fatal
list(draw_frames(frame_files(Path(sys.argv[1]), 4, (5, 0), most=2), workers=0))
"""


def test_an_interrupted_drawing_resumes_with_the_same_frames(tmp_path, drawn):
    command = [sys.executable, "-c", KILLED, str(tmp_path)]
    assert subprocess.run(command, check=False).returncode == 9
    files = frame_files(tmp_path, 4, SEED, most=2)
    assert [file.path.exists() for file in files] == [True, False]

    before = files[0].path.stat()
    assert [done for done, _ in draw_frames(files, workers=0)] == [1, 2]
    assert files[0].path.stat() == before
    whole = [vars(LabelledFrames.load([file.path])) for file in drawn]
    again = [vars(LabelledFrames.load([file.path])) for file in files]
    for one, other in zip(whole, again, strict=True):
        assert all(np.array_equal(one[name], other[name]) for name in one)
    assert not np.array_equal(whole[0]["depth"], whole[1]["depth"])


torch = pytest.importorskip("torch")
pytest.importorskip("lightning")

from nextview_lab.training import segmentation_training as training
from nextview_lab.training.architectures import SegmentationNet
from nextview_lab.training.recipes import Hardware, SegmentationRecipe
from nextview_lab.training.runs import load_run, read_run
from nextview_lab.training.segmentation_training import (
    LabelledBatches,
    fit_segmentation,
    start_from_export,
)

RECIPE = SegmentationRecipe(
    frames=8, width=4, epochs=6, batch=2, lr=0.01, validation_share=0.25, seed=3
)
EXACT = Hardware(precision="32-true")


def losses(run: Path):
    with (run / "log/metrics.csv").open() as file:
        return [float(row["loss"]) for row in csv.DictReader(file)]


def trained(out, *more, **changed):
    """A run of a few steps, as the command line starts it."""
    torch.set_num_threads(1)  # sums of several threads depend on how many there are
    options = {
        "frames": RECIPE.frames,
        "width": RECIPE.width,
        "epochs": RECIPE.epochs,
        "batch": RECIPE.batch,
        "lr": RECIPE.lr,
        "validation-share": RECIPE.validation_share,
        "seed": RECIPE.seed,
        "workers": 0,
        "precision": EXACT.precision,
    } | changed
    words = [
        word for name, value in options.items() for word in (f"--{name}", str(value))
    ]
    main(["train", "segmentation", str(out), *words, *more])
    return out


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("runs") / "run")


def test_a_stopped_training_ends_with_the_weights_of_one_that_was_not(
    tmp_path, run, monkeypatch
):
    step = training.SegmentationModule.training_step

    def stopping(self, batch, index):
        if (self.current_epoch, index) == (2, 1):
            raise ZeroDivisionError
        return step(self, batch, index)

    files = training.files_of(run, RECIPE)
    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr(training.SegmentationModule, "training_step", stopping)
        fit_segmentation(files, RECIPE, tmp_path, EXACT)
    assert len(losses(tmp_path)) == 2

    resumed = fit_segmentation(files, RECIPE, tmp_path, EXACT).state_dict()
    whole = load_run(SegmentationNet(RECIPE.width), run).state_dict()
    assert all(torch.equal(resumed[name], whole[name]) for name in whole)
    assert losses(tmp_path) == losses(run)


@pytest.fixture(scope="module")
def exported(run):
    pytest.importorskip("onnx")
    main(["export", "segmentation", str(run), str(run.parent / "models")])
    return run.parent / "models/segmentation.json"


@pytest.mark.parametrize("shape", [(48, 64), (37, 90)])
def test_the_file_answers_as_the_network(run, exported, shape):
    network = load_run(SegmentationNet(RECIPE.width), run)
    seen = np.random.default_rng(1).normal(0, 1, (15, *shape)).astype(np.float32)
    padded = np.pad(seen, ((0, 0), (0, -shape[0] % 16), (0, -shape[1] % 16)))
    with torch.no_grad():
        expected = network(torch.from_numpy(padded)[None])[0].numpy()
    answer = load_network(exported)(seen)
    assert answer.shape == (15, *shape)
    assert answer.dtype == np.float32
    assert np.abs(answer - expected[:, : shape[0], : shape[1]]).max() < 0.01


def test_a_network_starts_as_the_exported_one_with_norms_of_the_frames(run, exported):
    network = SegmentationNet(RECIPE.width)
    (seen, *_) = next(
        iter(LabelledBatches(training.files_of(run, RECIPE)[0], RECIPE, True))
    )
    start_from_export(network, load_network(exported), seen)
    with torch.no_grad():
        by_what_is_kept = network.eval()(seen)
        by_the_batch = network.train()(seen)
    assert torch.allclose(by_the_batch, by_what_is_kept, atol=1e-3)
    expected = [load_network(exported)(one) for one in seen.numpy()]
    assert np.abs(by_what_is_kept.numpy() - expected).max() < 1e-3


def test_a_training_from_an_exported_network_begins_with_its_weights(
    tmp_path, run, exported
):
    further = trained(tmp_path / "further", "--start", str(exported), epochs=1, lr=0)
    one, other = (
        load_run(SegmentationNet(RECIPE.width), folder).o.weight
        for folder in (run, further)
    )
    assert torch.allclose(one, other, atol=1e-3)
    assert read_run(further).weights == load_network(exported).card.sha256
    with pytest.raises(SystemExit):
        trained(tmp_path / "wide", "--start", str(exported), epochs=1, width=8)
