"""The commands on a card make its model: they are run again, on the same few boxes, from the meshes on."""

import json
import shlex
import shutil

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("onnx")

from tests.test_readme import write_off

from nextview.cli.main import main
from nextview.data.samples import SAMPLES, boxes_mesh
from nextview.models.inference import Recogniser
from nextview.models.model_card import read_card

COMMANDS = """
render Boxes views.zarr --size 32 --workers 1
train recogniser views.zarr run --size 32 --epochs 1 --views 2 --batch 8 --validation 0.4
export recogniser run views.zarr models
predict views.zarr held_out.npz --held-out --recogniser models/recogniser-boxes.json --maps --workers 1
fit calibration held_out.npz models/recogniser-boxes.json --delta 0.2
"""


def meshes(folder):
    """Boxes of two classes, some of each for training."""
    rng = np.random.default_rng(0)
    for label in ("monitor", "table"):
        (folder / label / "train").mkdir(parents=True)
        for k in range(5):
            scale = rng.uniform(0.8, 1.25, 3)
            boxes = [tuple(tuple(np.multiply(corner, scale)) for corner in box) for box in SAMPLES[label]()]
            write_off(folder / label / "train" / f"{label}_{k}.off", boxes_mesh(boxes, label))


@pytest.mark.long
def test_the_commands_on_a_card_make_the_model_again(tmp_path, monkeypatch):
    first, again = tmp_path / "first", tmp_path / "again"
    meshes(first / "Boxes")
    shutil.copytree(first / "Boxes", again / "Boxes")
    monkeypatch.chdir(first)
    for line in COMMANDS.strip().splitlines():
        main(line.split())
    made = read_card(first / "models/recogniser-boxes.json")
    commands = [shlex.split(line) for line in made.training.commands]
    assert [line[0] for line in commands] == ["nextview"] * 5
    assert [line[1] for line in commands] == [line.split()[0] for line in COMMANDS.strip().splitlines()]

    monkeypatch.chdir(again)
    for line in commands:
        main(line[1:])
    remade = read_card(again / "models/recogniser-boxes.json")
    assert remade.training == made.training
    for what in ("name", "kind", "input", "classes", "azimuth_bins", "held_out", "fitted_to"):
        assert getattr(remade, what) == getattr(made, what)
    assert remade.calibration.risk is not None
    assert remade.calibration.risk.delta == 0.2
    view = np.random.default_rng(0).integers(0, 256, (4, 4, 32, 32)).astype(np.uint8)
    answers = [
        Recogniser(folder / "models/recogniser-boxes.json").from_inputs(view).logits for folder in (first, again)
    ]
    np.testing.assert_allclose(*answers, atol=1e-2)
    assert json.loads((again / "run/commands.json").read_text()) == list(made.training.commands[:2])
