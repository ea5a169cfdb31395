"""Start a ResNet from a checkpoint of torchvision's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nextview.models.card import ModelError
from nextview.training.networks import ResNet


def load_torchvision(network: ResNet, path: Path) -> None:
    """Give a network the parameters of a torchvision checkpoint of the same depth. Nothing in the file is executed.

    A first convolution of other input channels takes the mean of the checkpoint's kernels over its channels, scaled so
    that an image that is the same in all channels is answered as before; a last layer of other classes is left as it
    is. Inputs are not normalised as ImageNet's are: the first batch norm learns that.

    Args:
        network: is changed in place, or not at all.
        path: a state dict, as ``torch.save`` writes it.

    Raises:
        ModelError: the file is missing, is no such checkpoint, or belongs to another network.
    """
    state = _read(path)
    own = network.state_dict()
    # Files from before PyTorch 0.4.1, some of torchvision's among them, do not count batches.
    state = {name: value for name, value in own.items() if name.endswith("num_batches_tracked")} | state
    missing, foreign = sorted(own.keys() - state.keys()), sorted(state.keys() - own.keys())
    if missing or foreign:
        fault = f"it lacks {missing[0]}" if missing else f"it holds {foreign[0]}"
        raise ModelError(f"{path}: not the weights of this ResNet ({fault}); is it of another depth?")
    first = state["conv1.weight"]
    if first.ndim == 4 and first.shape[1] != (channels := own["conv1.weight"].shape[1]):
        state["conv1.weight"] = (first.sum(1, keepdim=True) / channels).expand(-1, channels, -1, -1)
    if state["fc.weight"].shape[:1] != own["fc.weight"].shape[:1]:
        state |= {name: own[name] for name in ("fc.weight", "fc.bias")}
    for name, value in own.items():
        if state[name].shape != value.shape:
            there, wanted = tuple(state[name].shape), tuple(value.shape)
            raise ModelError(f"{path}: not the weights of this ResNet ({name} is {there}, not {wanted})")
        if not torch.isfinite(state[name]).all():
            raise ModelError(f"{path}: {name} holds numbers that are not finite; download the checkpoint again")
    network.load_state_dict(state)


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
