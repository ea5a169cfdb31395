"""The card of a policy that was learned from predictions: one JSON file, table and all; weights are ONNX beside it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nextview.errors import ModelError, OtherUseError, PolicyError
from nextview.outputs import written_whole
from nextview.policies.base import Policy
from nextview.policies.gain_weights import read_gain
from nextview.policies.learned_tables import ClassTable, FixedRing, FixedSequence
from nextview.viewsphere import ViewSphere

BUNDLED = Path(__file__).parent / "bundled"

KINDS: dict[str, Callable[[ViewSphere, dict[str, Any], Path], Policy]] = {
    "fixed-sequence": lambda sphere, facts, weights: FixedSequence(
        sphere, np.array(facts["table"]["moves"]), facts["anywhere"]
    ),
    "fixed-ring": lambda sphere, facts, weights: FixedRing(sphere, facts["table"]["ring"], facts["table"]["steps"]),
    "class-table": lambda sphere, facts, weights: ClassTable(
        sphere, np.array(facts["table"]["values"]), facts["anywhere"]
    ),
    "gain": read_gain,
}
"""How to make a policy of each kind from the sphere, what the card says, and the ONNX file, which most have not."""


def bundled_policies() -> dict[str, Path]:
    """Cards of the learned policies that ship with the package, by name."""
    return {path.stem: path for path in sorted(BUNDLED.glob("*.json"))}


def write_policy(path: Path, facts: dict[str, Any]) -> None:
    """Write a card aside, then rename it."""
    with written_whole(path) as part:
        part.write_text(json.dumps(facts) + "\n")


def read_policy(path: Path, sphere: ViewSphere, classes: Sequence[str] | None = None) -> Policy:
    """Make the policy that a card describes.

    Args:
        path: the card; weights, where it has any, are the file beside it with the same name that ends in .onnx.
        sphere: the viewpoints; they have to be those that it was learned for.
        classes: of the recogniser, which have to be those too; not compared by default.

    Raises:
        OtherUseError: it is for other viewpoints or classes.
        PolicyError: there is no such card, or it or its weights are damaged.
    """
    try:
        facts = json.loads(path.read_text())
        place = (tuple(facts["elevations"]), int(facts["azimuths"]))
        known = tuple(facts["classes"])
        make, fits = KINDS[facts["kind"]], place == (sphere.elevations, sphere.azimuths)
        made = make(sphere, facts, path.with_suffix(".onnx")) if fits else None
    except FileNotFoundError:
        raise PolicyError(f"{path}: there is no such policy card") from None
    except ModelError as error:
        raise PolicyError(str(error)) from None
    except (OSError, ValueError, KeyError, TypeError, RecursionError, MemoryError) as error:
        raise PolicyError(f"{path}: not a policy card ({type(error).__name__}: {error})") from None
    if made is None:
        raise OtherUseError(f"{path}: was learned for {len(place[0])} rings of {place[1]} views, not for this sphere")
    if classes is not None and known != tuple(classes):
        raise OtherUseError(f"{path}: was learned for other classes ({', '.join(known)})")
    return made
