"""The folder of a training run, and networks that begin from one or from a published checkpoint."""

from __future__ import annotations

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
from nextview.learning.loop import is_first, save_whole

Recipe = TypeVar("Recipe")


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
    start = weights / "network.pt" if weights is not None and weights.is_dir() else weights
    if start is not None and not start.is_file():
        raise ModelError(f"{start}: there is no such checkpoint")
    sha256 = None if start is None else sha256_of(start)
    commands = tuple(dict.fromkeys((*before, command())))
    return Run(asdict(recipe), sha256, tuple(held_out), tuple(validation), commands)


def train_once(out: Path, run: Run, train: Callable[[], nn.Module]) -> None:
    """Train a network into a run's folder unless it is there; alone, or with the other devices of this run."""
    with only_one(out) if is_first() else nullcontext():
        noted = out / "run.json"
        if noted.exists():
            _compare(out, run)
        elif is_first():
            other = [path.name for path in (out.iterdir() if out.is_dir() else ()) if not path.name.startswith(".")]
            if other:
                raise ModelError(f"{out}: holds {other[0]} and no training run; give a new folder, or an empty one")
            write_record(noted, run)
        if not (out / "network.pt").exists():
            save_whole(train().state_dict(), out / "network.pt")


def _compare(out: Path, run: Run) -> None:
    before = read_record(out / "run.json", Run, "a training run")
    after = msgspec.to_builtins(run.recipe)
    changed = [name for name, value in after.items() if before.recipe.get(name) != value]
    if changed:
        name = changed[0]
        fault = f"another recipe ({name} was {before.recipe.get(name)}, not {after[name]})"
    elif before.weights != run.weights:
        fault = "other first weights"
    elif before.held_out != run.held_out:
        fault = "other objects"
    else:
        return
    raise ModelError(f"{out}: holds a run of {fault}; give the same options to resume it, or another folder")


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


N = TypeVar("N", bound=nn.Module)

LITE_NAMES = {
    r"^_conv_": "",
    "^_blocks": "stages",
    r"\._(expand|depthwise|project)_conv": r".\1",
    "_bn": "norm",
    "^_fc": "fc",
}
"""Names of the parts in ports of EfficientNet to PyTorch, as patterns, and in a ``LiteNet``."""


def load_run(network: N, run: Path) -> N:
    """Give a network the parameters of a finished run: the network, in evaluation mode."""
    path = run / "network.pt"
    try:
        network.load_state_dict(_read(path))
    except RuntimeError:  # names every parameter that is missing, foreign or of another shape
        raise ModelError(f"{path}: not the weights of the network that {run}/run.json describes") from None
    return network.eval()


def start_from(network: ResNet | LiteNet, weights: Path, head: bool = True) -> None:
    """Give a network its first parameters: of a finished run (a folder), or of a published checkpoint."""
    path = weights / "network.pt" if weights.is_dir() else weights
    state = {name.removeprefix("resnet."): value for name, value in _read(path).items()}
    first = "stem.weight" if isinstance(network, LiteNet) else "conv1.weight"
    if isinstance(network, LiteNet) and not weights.is_dir():
        state = {_of_lite(name): value for name, value in state.items()}
    own = network.state_dict()
    for name, value in own.items():
        # Files from before PyTorch 0.4.1, some of torchvision's among them, do not count batches.
        optional = name.endswith("_tracked") or name.startswith("side.")
        other = name in state and state[name].shape != value.shape
        if (name.startswith(("fc.", "side.")) and (other or not head)) or (optional and name not in state):
            state[name] = value
    state = {name: value for name, value in state.items() if name in own or not name.startswith("side.")}
    missing, foreign = sorted(own.keys() - state.keys()), sorted(state.keys() - own.keys())
    if missing or foreign:
        fault = f"it lacks {missing[0]}" if missing else f"it holds {foreign[0]}"
        raise ModelError(f"{path}: not the weights of this {network.name} ({fault})")
    if state[first].ndim == 4 and state[first].shape[1] != (channels := own[first].shape[1]):
        state[first] = torch.einsum("okhw,kc->ochw", state[first], _dealt(state[first].shape[1], channels))
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
    for theirs, ours in LITE_NAMES.items():
        name = re.sub(theirs, ours, name)
    return name


def refuse_seen(weights: Path | None, held_out: list[str]) -> None:
    """Refuse to go on from a run that was trained on objects which are held out now, unless it had another dataset."""
    if weights is None or not weights.is_dir():
        return
    seen = sorted(set(held_out) - set(read_run(weights).held_out))
    if 0 < len(seen) < len(set(held_out)):
        raise ModelError(
            f"{weights}: was trained on {len(seen)} of the {len(set(held_out))} objects that this network must not "
            f"have seen, {seen[0]} among them; take its --seed and --validation, and no folds but its own"
        )


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
