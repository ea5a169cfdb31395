"""Several networks that went on from one another, merged into one by the mean of their weights."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import deepcopy

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import update_bn

from nextview.errors import ModelError


def merge(networks: Sequence[nn.Module], views: Iterable[Tensor]) -> nn.Module:
    """One network with the mean of the weights of several, and with norms that know what it sees.

    It costs what one of them costs, and is often better than each on objects unlike those of training (Wortsman et al.,
    "Model soups", ICML 2022). That holds for networks of which one went on from the other, or both from a third; the
    mean of strangers is noise.

    Args:
        networks: of one kind.
        views: batches as in training, (B, C, S, S), over which the norms measure anew.

    Returns:
        Another network, in evaluation mode.

    Raises:
        ModelError: they are not of one kind.
    """
    states = [network.state_dict() for network in networks]
    shapes = [{name: value.shape for name, value in state.items()} for state in states]
    if any(shape != shapes[0] for shape in shapes):
        raise ModelError("networks of other depths or outputs cannot be merged into one")
    merged = deepcopy(networks[0])
    mean = {
        name: torch.stack([state[name] for state in states]).mean(0) if value.is_floating_point() else value
        for name, value in states[0].items()
    }
    merged.load_state_dict(mean)
    update_bn(views, merged)
    return merged.eval()
