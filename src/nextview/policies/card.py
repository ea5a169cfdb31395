"""The card of a policy that was learned from predictions: one JSON file, table and all."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nextview.policies.base import Policy
from nextview.policies.gain import Gain
from nextview.policies.tables import ClassTable, FixedRing, FixedSequence
from nextview.viewsphere import ViewSphere

BUNDLED = Path(__file__).parent / "bundled"

KINDS: dict[str, Callable[[ViewSphere, Any, bool], Policy]] = {
    "fixed-sequence": lambda sphere, table, anywhere: FixedSequence(sphere, np.array(table["moves"]), anywhere),
    "fixed-ring": lambda sphere, table, anywhere: FixedRing(sphere, table["ring"], table["steps"]),
    "class-table": lambda sphere, table, anywhere: ClassTable(sphere, np.array(table["values"]), anywhere),
    "gain": Gain.of_table,
}
"""How to make a policy of each kind from the sphere, the card's table, and whether it may leave the local window."""


class PolicyCardError(ValueError):
    """A policy's card that cannot be used; the message is one sentence."""


def bundled_policies() -> dict[str, Path]:
    """Cards of the learned policies that ship with the package, by name."""
    return {path.stem: path for path in sorted(BUNDLED.glob("*.json"))}


def write_policy(path: Path, facts: dict[str, Any]) -> None:
    """Write a card aside, then rename it."""
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(facts) + "\n")
    part.rename(path)


def read_policy(path: Path, sphere: ViewSphere, classes: Sequence[str] | None = None) -> Policy:
    """Make the policy that a card describes.

    Args:
        path: the card.
        sphere: the viewpoints; they have to be those that it was learned for.
        classes: of the recogniser, which have to be those too; not compared by default.

    Raises:
        PolicyCardError: there is no such card, it is damaged, or it is for other viewpoints or classes.
    """
    try:
        facts = json.loads(path.read_text())
        place = (tuple(facts["elevations"]), facts["azimuths"])
        made = KINDS[facts["kind"]](sphere, facts["table"], facts["anywhere"])
        known = tuple(facts["classes"])
    except FileNotFoundError:
        raise PolicyCardError(f"{path}: there is no such policy card") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise PolicyCardError(f"{path}: not a policy card ({type(error).__name__}: {error})") from None
    if place != (sphere.elevations, sphere.azimuths):
        raise PolicyCardError(f"{path}: was learned for {len(place[0])} rings of {place[1]} views, not for this sphere")
    if classes is not None and known != tuple(classes):
        raise PolicyCardError(f"{path}: was learned for other classes ({', '.join(known)})")
    return made
