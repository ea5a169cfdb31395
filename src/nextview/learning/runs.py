"""The folder of a training run, and networks that begin from one or from a published checkpoint."""

import re
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import torch
from torch import Tensor, nn

from nextview.data.predictions import Predictions
from nextview.data.store import ViewStore
from nextview.errors import ModelError
from nextview.files import command, decode_record, only_one, read_record, sha256_of, write_record
from nextview.learning.architectures import LiteNet, ResNet
from nextview.learning.loop import is_first, read_checkpoint, save_whole

Recipe = TypeVar("Recipe")
N = TypeVar("N", bound=nn.Module)


class Run(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a run's folder says of it."""

    recipe: dict[str, Any]
    weights: str | None
    held_out: tuple[str, ...]
    validation: tuple[str, ...]
    commands: tuple[str, ...]


def new_run(
    recipe: Any,
    weights: Path | None,
    held_out: Iterable[str],
    validation: Iterable[str],
    made: Iterable[ViewStore | Predictions],
) -> Run:
    """A run by the command that runs now, from stores and predictions, and maybe from other weights."""
    before = [line for source in made for line in source.commands]
    if weights is not None and weights.is_dir():
        before += read_run(weights).commands
        weights /= "network.pt"
    if weights is not None and not weights.is_file():
        raise ModelError(f"{weights}: there is no such checkpoint")
    sha256 = None if weights is None else sha256_of(weights)
    return Run(asdict(recipe), sha256, tuple(held_out), tuple(validation), tuple(dict.fromkeys((*before, command()))))


def train_once(out: Path, run: Run, train: Callable[[], nn.Module]) -> None:
    """Train a network into a run's folder unless it is there; alone, or with the other devices of this run."""
    with only_one(out) if is_first() else nullcontext():
        if (out / "run.json").exists():
            _refuse_other(out, run)
        elif is_first():
            other = [path.name for path in (out.iterdir() if out.is_dir() else ()) if not path.name.startswith(".")]
            if other:
                raise ModelError(f"{out}: holds {other[0]} and no training run; give a new folder, or an empty one")
            write_record(out / "run.json", run)
        if not (out / "network.pt").exists():
            save_whole(train().state_dict(), out / "network.pt")


def _refuse_other(out: Path, run: Run) -> None:
    """Refuse to resume a run of another recipe, of other objects or from other weights."""
    before, recipe = read_record(out / "run.json", Run, "a training run"), msgspec.to_builtins(run.recipe)
    changed = [name for name, value in recipe.items() if before.recipe.get(name) != value]
    faults = [f"another recipe ({name} was {before.recipe.get(name)}, not {recipe[name]})" for name in changed]
    faults += ["other first weights"] * (before.weights != run.weights)
    faults += ["other objects"] * (before.held_out != run.held_out)
    if faults:
        raise ModelError(f"{out}: holds a run of {faults[0]}; give the same options to resume it, or another folder")


def read_run(out: Path) -> Run:
    """A finished run."""
    if not (out / "run.json").exists():
        raise ModelError(f"{out}: holds no training run")
    run = read_record(out / "run.json", Run, "a training run")
    if not (out / "network.pt").exists():
        raise ModelError(f"{out}: the training is not done; give its command again to go on")
    return run


def read_recipe(out: Path, kind: type[Recipe]) -> Recipe:
    """The recipe of a finished run."""
    recipe = read_run(out).recipe
    if set(recipe) != set(kind.__annotations__):
        raise ModelError(f"{out}: holds no run of a {kind.__name__} of this version")
    return decode_record(recipe, kind, f"{out}: not a recipe of such a network", ModelError)


def load_run(network: N, run: Path) -> N:
    """Give a network the parameters of a finished run: the network, in evaluation mode."""
    path = run / "network.pt"
    try:
        network.load_state_dict(_read_state(path))
    except RuntimeError:  # names every parameter that is missing, foreign or of another shape
        raise ModelError(f"{path}: not the weights of the network that {run}/run.json describes") from None
    return network.eval()


LITE_NAMES = {
    r"^_conv_": "",
    "^_blocks": "stages",
    r"\._(expand|depthwise|project)_conv": r".\1",
    "_bn": "norm",
    "^_fc": "fc",
}
"""Names of the parts in ports of EfficientNet to PyTorch, as patterns, and in a ``LiteNet``."""


def start_from(network: ResNet | LiteNet, weights: Path, head: bool = True) -> None:
    """Give a network its first parameters: of a finished run (a folder), or of a published checkpoint.

    Its own last layers stay where those of the checkpoint are of another shape, or ``head`` is false.
    """
    path = weights / "network.pt" if weights.is_dir() else weights
    state = {name.removeprefix("resnet."): value for name, value in _read_state(path).items()}
    lite = isinstance(network, LiteNet)
    for theirs, ours in LITE_NAMES.items() if lite and path == weights else ():
        state = {re.sub(theirs, ours, name): value for name, value in state.items()}
    own, first = network.state_dict(), "stem.weight" if lite else "conv1.weight"
    for name, value in own.items():
        # Files from before PyTorch 0.4.1, some of torchvision's among them, do not count batches.
        lacks = name not in state and (name.endswith("_tracked") or name.startswith("side."))
        other = name in state and state[name].shape != value.shape
        if lacks or (name.startswith(("fc.", "side.")) and (other or not head)):
            state[name] = value
    state = {name: value for name, value in state.items() if name in own or not name.startswith("side.")}
    if first in state and state[first].ndim == 4 and state[first].shape != own[first].shape:
        share = _dealt(state[first].shape[1], own[first].shape[1])
        state[first] = torch.einsum("okhw,kc->ochw", state[first], share)
    faults = [f"it lacks {name}" for name in sorted(own.keys() - state.keys())]
    faults += [f"it holds {name}" for name in sorted(state.keys() - own.keys())]
    faults += [
        f"{name} is {tuple(state[name].shape)}, not {tuple(value.shape)}"
        for name, value in own.items()
        if name in state and state[name].shape != value.shape
    ]
    if faults:
        raise ModelError(f"{path}: not the weights of this {network.name} ({faults[0]})")
    for name, value in state.items():
        if not torch.isfinite(value).all():
            raise ModelError(f"{path}: {name} holds numbers that are not finite; download the checkpoint again")
    network.load_state_dict(state)


def _dealt(colours: int, channels: int) -> Tensor:
    """The share of each colour's kernel that goes to each channel, dealt in turn, (colours, channels)."""
    turn = torch.arange(max(colours, channels))
    share = torch.zeros(colours, channels)
    share[turn % colours, turn % channels] = 1
    return share / share.sum(1, keepdim=True)


def refuse_seen(weights: Path | None, held_out: list[str]) -> None:
    """Refuse to go on from a run that was trained on objects which are held out now, unless it had another dataset."""
    if weights is None or not weights.is_dir():
        return
    seen = sorted(set(held_out) - set(read_run(weights).held_out))
    if 0 < len(seen) < len(set(held_out)):
        raise ModelError(
            f"{weights}: was trained on {len(seen)} of the {len(set(held_out))} objects that this network must not "
            f"have seen, {seen[0]} among them; take its --seed and --validation"
        )


def _read_state(path: Path) -> dict[str, Tensor]:
    state = read_checkpoint(path)
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise ModelError(f"{path}: not a state dict: it should map names of parameters to tensors")
    return dict(state)
