"""EfficientNet-Lite0: its shape, its checkpoints, and what its export keeps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nextview.models.inference import Recogniser
from nextview.models.model_card import ModelCard, file_hash, write_card
from nextview.models.network_input import InputSpec

torch = pytest.importorskip("torch")

from nextview.models.model_card import ModelError  # noqa: E402
from nextview.training.checkpoints import exported_networks, load_checkpoint, load_exported  # noqa: E402
from nextview.training.lite import Depthwise, InvertedBottleneck, LiteNet  # noqa: E402
from nextview.training.onnx_export import ShippedRecogniser, export_onnx  # noqa: E402

LITE0 = ((16, 3, 1), (24, 3, 2), (40, 5, 2), (80, 3, 3), (112, 5, 3), (192, 5, 4), (320, 3, 1))
"""Width, kernel and blocks of the stages."""


def checkpoint(path: Path, classes: int = 1000, seed: int = 0) -> dict:
    """Random weights under the names that published checkpoints use, from the network's plan in words."""
    rng, state = torch.Generator().manual_seed(seed), {}

    def convolution(name, *shape):
        state[f"{name}.weight"] = torch.randn(shape, generator=rng) / (shape[1] * shape[2] * shape[3]) ** 0.5

    def norm(name, width):
        for part in ("weight", "bias", "running_mean"):
            state[f"{name}.{part}"] = torch.randn(width, generator=rng) / 10 + (part == "weight")
        state[f"{name}.running_var"] = torch.rand(width, generator=rng) + 0.5
        state[f"{name}.num_batches_tracked"] = torch.tensor(7)

    convolution("_conv_stem", 32, 3, 3, 3)
    norm("_bn0", 32)
    inputs, index = 32, 0
    for widths, kernel, repeats in LITE0:
        for _ in range(repeats):
            block, wide = f"_blocks.{index}", inputs * (6 if index else 1)
            if index:
                convolution(f"{block}._expand_conv", wide, inputs, 1, 1)
                norm(f"{block}._bn0", wide)
            convolution(f"{block}._depthwise_conv", wide, 1, kernel, kernel)
            norm(f"{block}._bn1", wide)
            convolution(f"{block}._project_conv", widths, wide, 1, 1)
            norm(f"{block}._bn2", widths)
            inputs, index = widths, index + 1
    convolution("_conv_head", 1280, inputs, 1, 1)
    norm("_bn1", 1280)
    state["_fc.weight"] = torch.randn(classes, 1280, generator=rng) / 1280**0.5
    state["_fc.bias"] = torch.randn(classes, generator=rng)
    torch.save(state, path)
    return state


def test_it_is_as_large_as_published():
    """4.7 million parameters and 407 million multiplications (TensorFlow's EfficientNet-Lite, 2020)."""
    network, products = LiteNet(1000, 3).eval(), []
    for part in network.modules():
        if isinstance(part, torch.nn.Conv2d | torch.nn.Linear):
            weights = part.weight.numel()
            part.register_forward_hook(lambda _, __, out, weights=weights: products.append(weights * out[0, 0].numel()))
    network(torch.zeros(1, 3, 224, 224))
    assert sum(p.numel() for p in network.parameters()) == pytest.approx(4.7e6, rel=0.02)
    assert sum(products) == pytest.approx(407e6, rel=0.06)


def test_any_number_of_channels_and_the_sides():
    logits, azimuth_bins = LiteNet(7, 5, 8).eval()(torch.rand(2, 5, 64, 64))
    assert (logits.shape, azimuth_bins.shape) == ((2, 7), (2, 7, 8))
    assert torch.allclose(azimuth_bins.exp().sum(2), torch.ones(2, 7))


def test_a_published_checkpoint_loads_whole(tmp_path):
    state = checkpoint(tmp_path / "lite.pth")
    network = LiteNet(1000, 3)
    load_checkpoint(network, tmp_path / "lite.pth")
    ours = network.state_dict()
    assert len(ours) == len(state)
    assert torch.equal(ours["stem.weight"], state["_conv_stem.weight"])
    assert torch.equal(ours["stages.15.depthwise.weight"], state["_blocks.15._depthwise_conv.weight"])
    assert torch.equal(ours["stages.3.norm2.running_var"], state["_blocks.3._bn2.running_var"])
    assert torch.equal(ours["norm1.bias"], state["_bn1.bias"])
    assert torch.equal(ours["fc.weight"], state["_fc.weight"])


def test_blocks_are_skipped_for_some_images_in_training_alone():
    block = InvertedBottleneck(4, 6, 4, 3, 1, skip=0.25)
    x = torch.rand(1, 4, 5, 5).expand(4000, -1, -1, -1)
    whole = (block(x) - x).detach()
    done = whole.flatten(1).abs().amax(1) > 0
    assert done.float().mean().item() == pytest.approx(0.75, abs=0.03)
    block.skip = 0.0
    assert torch.allclose(whole[done] * 0.75, (block(x) - x)[done], atol=1e-6)
    block.skip = 0.25
    block.eval()
    assert (block(x) - x).flatten(1).abs().amax(1).min() > 0


@pytest.mark.parametrize("channels", [1, 2, 4])
def test_other_channels_answer_grey_images_as_before(tmp_path, channels):
    checkpoint(tmp_path / "lite.pth")
    rgb, ours = LiteNet(5, 3, 8), LiteNet(5, channels, 8)
    for network in (rgb, ours):
        load_checkpoint(network, tmp_path / "lite.pth")
    grey = torch.rand(2, 1, 32, 32)
    with torch.no_grad():
        expected = rgb.stem(grey.expand(-1, 3, -1, -1))
        assert torch.allclose(ours.stem(grey.expand(-1, channels, -1, -1)), expected, atol=1e-5)
        if channels == 4:  # the first three are told apart as colours were
            assert not torch.allclose(ours.stem.weight[:, 0], ours.stem.weight[:, 1])


def test_a_checkpoint_of_another_network_is_refused(tmp_path):
    state = checkpoint(tmp_path / "lite.pth")
    torch.save({name: value for name, value in state.items() if "_blocks.15." not in name}, tmp_path / "short.pth")
    with pytest.raises(ModelError, match=r"not the weights of this EfficientNet-Lite0 \(it lacks stages\.15\."):
        load_checkpoint(LiteNet(10, 4), tmp_path / "short.pth")


def test_single_kernels_stay_in_single_precision():
    kernels = Depthwise(8, 3, 1)
    with torch.autocast("cpu", torch.bfloat16):
        assert kernels(torch.rand(1, 8, 5, 5, dtype=torch.bfloat16)).dtype == torch.float32


@pytest.mark.long
def test_it_goes_on_from_its_export_also_beside_another(tmp_path):
    torch.manual_seed(0)
    networks = [LiteNet(2, 4, 8), LiteNet(2, 4, 8)]
    for seed, network in enumerate(networks):
        checkpoint(tmp_path / "lite.pth", 2, seed)
        load_checkpoint(network, tmp_path / "lite.pth")
    views = np.random.default_rng(0).integers(0, 256, (16, 4, 64, 64)).astype(np.uint8)
    shipped = ShippedRecogniser(networks).eval()
    export_onnx(shipped, views[:2], "input", shipped.outputs, tmp_path / "two.onnx", 8)
    weights, spec = tmp_path / "two.onnx", InputSpec("geometry", 64)
    card = ModelCard("two", "recogniser", spec, file_hash(weights), weights, classes=("a", "b"), azimuth_bins=8)
    card = replace(card, network="EfficientNet-Lite0 + EfficientNet-Lite0")
    write_card(tmp_path / "two.json", card)
    x = torch.from_numpy(views).float() / 255
    again = exported_networks(tmp_path / "two.json", 4, x)
    with torch.no_grad():
        output = torch.stack([network(x)[0] for network in again]).mean(0).numpy()
    exact = Recogniser(tmp_path / "two.json").from_inputs(views).logits
    assert np.abs(output - exact).max() < 1e-3
    assert np.ptp(exact) > 0.1
    with pytest.raises(ModelError, match="not one network of this depth and input"):
        load_exported(LiteNet(2, 4, 8), tmp_path / "two.json", x)
    write_card(tmp_path / "two.json", replace(card, network="EfficientNet-Lite0 + EfficientNet-Lite2"))
    with pytest.raises(ModelError, match=r"two\.json: there is no EfficientNet-Lite2"):
        exported_networks(tmp_path / "two.json", 4, x)
