"""Networks: shapes and numbers as published, checkpoints that load and nothing else, and ONNX
with the same answers.
"""

import os
import pickle
import sys

import numpy as np
import onnxruntime as ort
import pytest

torch = pytest.importorskip("torch")

from nextview.errors import ModelError
from nextview_lab.training.architectures import ResNet
from nextview_lab.training.export import export_onnx
from nextview_lab.training.runs import start_from

BLOCKS = {
    18: (2, 2, 2, 2),
    34: (3, 4, 6, 3),
    50: (3, 4, 6, 3),
    101: (3, 4, 23, 3),
    152: (3, 8, 36, 3),
}


def torchvisions_shapes(depth, classes=1000, channels=3, counts_batches=True):
    """Names and shapes of torchvision's state dict, written down from its published structure."""
    shapes = {}

    def convolution(name, outputs, inputs, side):
        shapes[f"{name}.weight"] = (outputs, inputs, side, side)

    def norm(name, width):
        for part in ("weight", "bias", "running_mean", "running_var"):
            shapes[f"{name}.{part}"] = (width,)
        if counts_batches:
            shapes[f"{name}.num_batches_tracked"] = ()

    convolution("conv1", 64, channels, 7)
    norm("bn1", 64)
    before = 64
    for stage, (blocks, width) in enumerate(
        zip(BLOCKS[depth], (64, 128, 256, 512), strict=True), 1
    ):
        after = width if depth < 50 else 4 * width
        # (inner convolutions, each: outputs, inputs, side)
        for block in range(blocks):
            at = f"layer{stage}.{block}"
            if depth < 50:
                inner = [(width, before, 3), (width, width, 3)]
            else:
                inner = [(width, before, 1), (width, width, 3), (after, width, 1)]
            for k, (outputs, inputs, side) in enumerate(inner, 1):
                convolution(f"{at}.conv{k}", outputs, inputs, side)
                norm(f"{at}.bn{k}", outputs)
            # ResNet-50 and deeper widen already in the first stage
            if block == 0 and before != after:
                convolution(f"{at}.downsample.0", after, before, 1)
                norm(f"{at}.downsample.1", after)
            before = after
    shapes["fc.weight"], shapes["fc.bias"] = (classes, before), (classes,)
    return shapes


def checkpoint(path, depth=18, **what):
    """A file as torchvision would have it, with random numbers."""
    generator = torch.Generator().manual_seed(0)
    state = {}
    for name, shape in torchvisions_shapes(depth, **what).items():
        counts = name.endswith("num_batches_tracked")
        state[name] = (
            torch.tensor(7) if counts else torch.rand(shape, generator=generator) * 0.1
        )
    torch.save(state, path)
    return state


@pytest.mark.parametrize("depth", [34, 50])
def test_a_torchvision_checkpoint_loads_whole(tmp_path, depth):
    state = checkpoint(tmp_path / "resnet.pth", depth, classes=10)
    network = ResNet(depth, 10, 3)
    start_from(network, tmp_path / "resnet.pth")
    ours = network.state_dict()
    assert all(torch.equal(ours[name], value) for name, value in state.items())


class Bomb:
    """Unpickled, it makes a folder."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


def damaged(path, name, value):
    torch.save(checkpoint(path) | {name: value}, path)


BROKEN = {
    "there is no such": lambda path: None,
    "cannot be a pickle": lambda path: path.write_bytes(
        pickle.dumps(Bomb(path.parent / "executed"))
    ),
    "cannot be a pickle inside torch's own file": lambda path: torch.save(
        {"x": Bomb(path.parent / "executed")}, path
    ),
    "truncated": lambda path: (
        checkpoint(path),
        path.write_bytes(path.read_bytes()[: 2 << 20]),
    ),
    "another network": lambda path: torch.save(
        {"features.0.weight": torch.zeros(3)}, path
    ),
    "wrong shape": lambda path: damaged(
        path, "layer2.0.conv1.weight", torch.zeros(128, 64, 1, 1)
    ),
    "not finite": lambda path: damaged(
        path, "layer1.0.bn1.weight", torch.full((64,), torch.nan)
    ),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_broken_and_foreign_files_are_refused_and_nothing_is_executed(tmp_path, fault):
    path = tmp_path / "weights.pth"
    BROKEN[fault](path)
    network = ResNet(18, 10, 4)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    with pytest.raises(ModelError, match=r"weights\.pth: ") as refusal:
        start_from(network, path)
    assert "\n" not in str(refusal.value)
    assert not (tmp_path / "executed").exists()
    assert all(
        torch.equal(before[name], value) for name, value in network.state_dict().items()
    )


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A network whose rows of weights differ in magnitude, as in trained ones, and the folder of
    its files, 16.onnx and 8.onnx, by the bits of a weight.
    """
    folder = tmp_path_factory.mktemp("exported")
    torch.manual_seed(0)
    network = ResNet(18, 10, 4).eval()
    magnitudes = torch.logspace(-2, 1, 512)[:, None, None, None]
    with torch.no_grad():
        network.layer4[1].conv1.weight *= magnitudes
    example = torch.rand(2, 4, 64, 64).numpy()
    for bits in (16, 8):
        export_onnx(
            network, example, "input", ["logits"], folder / f"{bits}.onnx", bits
        )
    return network, folder


def answers(network, folder, bits):
    """What a file and its network say of another number of inputs than the example's."""
    x = torch.rand(3, 4, 64, 64, generator=torch.Generator().manual_seed(1))
    session = ort.InferenceSession(
        folder / f"{bits}.onnx", providers=["CPUExecutionProvider"]
    )
    with torch.no_grad():
        expected = network(x)[0].numpy()
    return session.run(["logits"], {"input": x.numpy()})[0], expected


def test_export_keeps_the_answers(exported):
    network, folder = exported
    found, expected = answers(network, folder, 16)
    assert np.abs(found - expected).max() < 0.01 * np.abs(expected).max()
    assert sorted(path.name for path in folder.iterdir()) == ["16.onnx", "8.onnx"]
    file = folder / "16.onnx"
    assert sys.modules[ResNet.__module__].__file__.encode() not in file.read_bytes()
    full = sum(p.numel() for p in network.parameters()) * 4
    assert file.stat().st_size < 0.6 * full


def test_eight_bits_a_weight_are_enough_for_the_answers_and_nearly_halve_the_file_again(
    exported,
):
    network, folder = exported
    error = {}
    for bits in (16, 8):
        found, expected = answers(network, folder, bits)
        error[bits] = np.abs(found - expected).max()
    assert error[8] < 0.02 * np.abs(expected).max()
    assert error[8] > error[16]  # so they do have fewer
    sizes = [(folder / f"{bits}.onnx").stat().st_size for bits in (8, 16)]
    assert sizes[0] < 0.55 * sizes[1]
