"""The folder of a training run: its recipe when it begins; its network, whole, when it is done."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from torch import nn

from nextview.arguments import takes_paths
from nextview.data.lock import only_one, writing
from nextview.data.predictions import Predictions
from nextview.data.store import ViewStore
from nextview.errors import ModelError
from nextview.models.model_card import BUNDLED, file_hash, find_card
from nextview.outputs import written_whole
from nextview.training.loop import is_first, save_whole

Recipe = TypeVar("Recipe")

COMMANDS = "commands.json"


@contextmanager
def begin(run: Path, recipe: Any, weights: Path | None = None, commands: Sequence[str] = ()) -> Iterator[None]:
    """Open a run's folder to this process alone, or that of its devices; keep there its recipe, start and commands.

    Args:
        run: the folder.
        recipe: a dataclass.
        weights: a checkpoint, or the card of an exported network.
        commands: all that lead to the run, its own last, see ``training_commands``.

    Raises:
        ModelError: it holds a run of another recipe, or one that started from other weights; there are none. Or it
            holds anything else, which would be overwritten or taken for a part of the run.
        DatasetError: another process trains there, or it cannot be written.
    """
    with only_one(run) if is_first() else nullcontext():
        noted, start = run / "recipe.json", {"sha256": _hash(weights)}
        if noted.exists():
            _compare(noted, recipe)
            _compare_start(run / "weights.json", start)
        elif is_first():
            # The recipe comes last: with it the folder is a run's.
            first = {COMMANDS: json.dumps(list(commands), indent=1), "weights.json": json.dumps(start)}
            _refuse_others(run, first)
            with writing(run):
                run.mkdir(parents=True, exist_ok=True)
            for name, text in (first | {"recipe.json": json.dumps(asdict(recipe), indent=1)}).items():
                with written_whole(run / name) as part:
                    part.write_text(text + "\n")
        yield


def _refuse_others(run: Path, ours: dict[str, str]) -> None:
    """Refuse a folder that holds anything but what a run that was killed at its very beginning leaves there."""
    for path in sorted(run.iterdir()) if run.is_dir() else ():
        left = path.name.startswith(tuple(f".nextview-{name}-" for name in (*ours, "recipe.json")))
        if not left and not (
            path.is_file() and path.name in ours and path.read_bytes() == (ours[path.name] + "\n").encode()
        ):
            raise ModelError(f"{run}: holds {path.name} and no training run; give a new folder, or an empty one")


def training_commands(command: str, made: Iterable[ViewStore | Predictions], weights: Path | None) -> tuple[str, ...]:
    """All commands that lead to a training run, in order.

    Args:
        command: that trains.
        made: what it is given: stores and predictions, which say what made them.
        weights: a checkpoint, or the card of an exported network, which says so too.
    """
    before = [line for each in made for line in each.commands]
    if weights is not None and weights.suffix == ".json":
        card = find_card(weights)
        before += card.training.commands if card.path.parent != BUNDLED else ()
    return tuple(dict.fromkeys((*before, command)))


def read_commands(run: Path) -> tuple[str, ...]:
    """The commands that led to a run; () for one that was begun before they were noted.

    Raises:
        ModelError: they cannot be read.
    """
    noted = run / COMMANDS
    if not noted.exists():
        return ()
    try:
        return tuple(str(line) for line in json.loads(noted.read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise ModelError(f"{noted}: cannot be read ({type(error).__name__}); remove it") from None


@takes_paths("run")
def is_done(run: Path) -> bool:
    """Whether a run has its network."""
    return (run / "network.pt").exists()


@takes_paths("run")
def read_recipe(run: Path, kind: type[Recipe]) -> Recipe:
    """The recipe of a run that is done.

    Raises:
        ModelError: there is no such run, it is of another kind of network, or not done.
    """
    noted = run / "recipe.json"
    if not noted.exists():
        raise ModelError(f"{run}: holds no training run")
    recipe = _noted(noted, kind)
    if not is_done(run):
        raise ModelError(f"{run}: the training is not done; give its command again to go on")
    return recipe


def finish(network: nn.Module, run: Path) -> None:
    """Keep a trained network's parameters as network.pt, whole or not at all."""
    save_whole(network.state_dict(), run / "network.pt")


def _hash(weights: Path | None) -> str | None:
    if weights is None:
        return None
    if weights.suffix == ".json":
        return find_card(weights).sha256
    if not weights.is_file():
        raise ModelError(f"{weights}: there is no such checkpoint")
    return file_hash(weights)


def _compare_start(noted: Path, start: dict[str, str | None]) -> None:
    if not noted.exists():
        return  # begun before this was noted
    try:
        same = json.loads(noted.read_text()) == start
    except (OSError, ValueError) as error:
        raise ModelError(f"{noted}: cannot be read ({type(error).__name__}); give another folder") from None
    if not same:
        raise ModelError(
            f"{noted.parent}: holds a run that started from other weights; give the same --weights to resume it, or "
            "another folder"
        )


def _noted(noted: Path, kind: type[Recipe]) -> Recipe:
    try:
        return kind(**json.loads(noted.read_text()))
    except (ValueError, TypeError) as error:
        raise ModelError(f"{noted}: not a recipe of such a network in this version ({error})") from None


def _compare(noted: Path, recipe: Any) -> None:
    before = asdict(_noted(noted, type(recipe)))
    after = json.loads(json.dumps(asdict(recipe)))
    for name, value in after.items():
        if before[name] != value:
            raise ModelError(
                f"{noted.parent}: holds a run of another recipe ({name} was {before[name]}, not {value}); "
                "give the same options to resume it, or another folder"
            )
