"""The ResNets are torchvision's by name, shape and number; its checkpoints load, and nothing else does."""

import os
import pickle

import pytest

torch = pytest.importorskip("torch")

from nextview.models.model_card import ModelError  # noqa: E402
from nextview.training.architectures import ResNet  # noqa: E402
from nextview.training.checkpoints import load_checkpoint  # noqa: E402

BLOCKS = {18: (2, 2, 2, 2), 34: (3, 4, 6, 3), 50: (3, 4, 6, 3), 101: (3, 4, 23, 3), 152: (3, 8, 36, 3)}
PUBLISHED = {18: 11_689_512, 34: 21_797_672, 50: 25_557_032, 101: 44_549_160, 152: 60_192_808}
"""Parameters at 1,000 classes, from torchvision's table of models."""


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
    for stage, (blocks, width) in enumerate(zip(BLOCKS[depth], (64, 128, 256, 512), strict=True), 1):
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
            if block == 0 and before != after:  # ResNet-50 and deeper widen already in the first stage
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
        state[name] = torch.tensor(7) if counts else torch.rand(shape, generator=generator) * 0.1
    torch.save(state, path)
    return state


@pytest.mark.parametrize("depth", sorted(BLOCKS))
def test_resnet_is_torchvisions(depth):
    with torch.device("meta"):  # shapes only
        network = ResNet(depth, 1000, 3)
    assert sum(p.numel() for p in network.parameters()) == PUBLISHED[depth]
    assert {name: tuple(value.shape) for name, value in network.state_dict().items()} == torchvisions_shapes(depth)


@pytest.mark.parametrize("depth", [18, 50])
def test_any_number_of_channels(depth):
    (logits,) = ResNet(depth, 7, 5).eval()(torch.rand(2, 5, 64, 64))
    assert logits.shape == (2, 7)


@pytest.mark.parametrize("depth", [34, 50])
def test_a_torchvision_checkpoint_loads_whole(tmp_path, depth):
    state = checkpoint(tmp_path / "resnet.pth", depth, classes=10)
    network = ResNet(depth, 10, 3)
    load_checkpoint(network, tmp_path / "resnet.pth")
    ours = network.state_dict()
    assert all(torch.equal(ours[name], value) for name, value in state.items())


def test_a_checkpoint_from_before_batches_were_counted_loads(tmp_path):
    state = checkpoint(tmp_path / "old.pth", counts_batches=False)
    network = ResNet(18, 1000, 3)
    load_checkpoint(network, tmp_path / "old.pth")
    assert torch.equal(network.layer4[1].bn2.running_var, state["layer4.1.bn2.running_var"])


@pytest.mark.parametrize("channels", [1, 4])
def test_other_channels_answer_grey_images_as_before(tmp_path, channels):
    checkpoint(tmp_path / "rgb.pth", classes=5)
    rgb, ours = ResNet(18, 5, 3), ResNet(18, 5, channels)
    for network in (rgb, ours):
        load_checkpoint(network, tmp_path / "rgb.pth")
    grey = torch.rand(2, 1, 32, 32)
    with torch.no_grad():
        expected = rgb.conv1(grey.expand(-1, 3, -1, -1))
        assert torch.allclose(ours.conv1(grey.expand(-1, channels, -1, -1)), expected, rtol=1e-4, atol=1e-5)


def test_other_classes_keep_the_last_layer_of_the_network(tmp_path):
    state = checkpoint(tmp_path / "imagenet.pth")
    network = ResNet(18, 10, 3)
    before = network.fc.weight.clone()
    load_checkpoint(network, tmp_path / "imagenet.pth")
    assert torch.equal(network.fc.weight, before)
    assert torch.equal(network.layer3[0].conv1.weight, state["layer3.0.conv1.weight"])


class Bomb:
    """Unpickled, it makes a folder."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


def truncated(path):
    checkpoint(path)
    path.write_bytes(path.read_bytes()[: 2 << 20])


def wrong_shape(path):
    state = checkpoint(path)
    torch.save(state | {"layer2.0.conv1.weight": torch.zeros(128, 64, 1, 1)}, path)


def not_finite(path):
    state = checkpoint(path)
    state["layer1.0.bn1.weight"][3] = float("nan")
    torch.save(state, path)


BROKEN = {
    "there is no such": lambda path: None,
    "cannot be a pickle": lambda path: path.write_bytes(pickle.dumps(Bomb(path.parent / "executed"))),
    "cannot be a pickle inside torch's own file": lambda path: torch.save({"x": Bomb(path.parent / "executed")}, path),
    "truncated": truncated,
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("404: Not Found"),
    "a list": lambda path: torch.save([torch.zeros(3)], path),
    "a dict of numbers": lambda path: torch.save({"conv1.weight": 3}, path),
    "another network": lambda path: torch.save({"features.0.weight": torch.zeros(3)}, path),
    "another depth": lambda path: checkpoint(path, 34),
    "a bottleneck network": lambda path: checkpoint(path, 50),
    "wrong shape": wrong_shape,
    "flat": lambda path: torch.save(checkpoint(path) | {"conv1.weight": torch.zeros(64)}, path),
    "not finite": not_finite,
}


@pytest.mark.parametrize("fault", BROKEN)
def test_broken_and_foreign_files_are_refused_and_nothing_is_executed(tmp_path, fault):
    path = tmp_path / "weights.pth"
    BROKEN[fault](path)
    network = ResNet(18, 10, 4)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    with pytest.raises(ModelError, match=r"weights\.pth: ") as refusal:
        load_checkpoint(network, path)
    assert "\n" not in str(refusal.value)
    assert not (tmp_path / "executed").exists()
    assert all(torch.equal(before[name], value) for name, value in network.state_dict().items())
