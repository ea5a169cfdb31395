"""The folder of a training run: its recipe when it begins; its network, whole, when it is done."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import nn

from nextview.data.lock import only_one
from nextview.models.card import ModelError
from nextview.training.fit import is_first


@contextmanager
def begin(run: Path, recipe: Any) -> Iterator[None]:
    """Open a run's folder to this process alone, or that of its devices, and keep its recipe there.

    Raises:
        ModelError: it holds a run of another recipe.
        DatasetError: another process trains there, or it cannot be written.
    """
    with only_one(run) if is_first() else nullcontext():
        noted = run / "recipe.json"
        if noted.exists():
            _compare(noted, recipe)
        elif is_first():
            run.mkdir(parents=True, exist_ok=True)
            part = noted.with_suffix(".part")
            part.write_text(json.dumps(asdict(recipe), indent=1) + "\n")
            part.rename(noted)
        yield


def is_done(run: Path) -> bool:
    """Whether a run has its network."""
    return (run / "network.pt").exists()


def finish(network: nn.Module, run: Path) -> None:
    """Keep a trained network's parameters as network.pt, whole or not at all."""
    part = run / f"network.part{os.getpid()}"
    torch.save(network.state_dict(), part)
    part.rename(run / "network.pt")


def _compare(noted: Path, recipe: Any) -> None:
    try:
        before = asdict(type(recipe)(**json.loads(noted.read_text())))
    except (ValueError, TypeError) as error:
        raise ModelError(f"{noted}: not a recipe of this version ({error}); give another folder") from None
    after = json.loads(json.dumps(asdict(recipe)))
    for name, value in after.items():
        if before[name] != value:
            raise ModelError(
                f"{noted.parent}: holds a run of another recipe ({name} was {before[name]}, not {value}); "
                "give the same options to resume it, or another folder"
            )
