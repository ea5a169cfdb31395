"""The card of a model: what it is, how it was made, how good it is, and which file holds its weights."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nextview.errors import ModelError
from nextview.outputs import written_whole

BUNDLED = Path(__file__).parent / "bundled"


@dataclass(frozen=True)
class Card:
    """One model.

    Attributes:
        name: what users call it.
        kind: "recogniser" or the name of the map that it predicts ("lem").
        path: the ONNX file.
        sha256: of that file.
        facts: everything the card says: network, input, classes, data, commands, recipe, seed, scores and the rest.
    """

    name: str
    kind: str
    path: Path
    sha256: str
    facts: dict[str, Any]


def read_card(path: Path) -> Card:
    """Read a card; the weights are the file beside it with the same name.

    Raises:
        ModelError: the card or its weights are missing, or the card is not one.
    """
    try:
        facts = json.loads(path.read_text())
        card = Card(facts["name"], facts["kind"], path.with_suffix(".onnx"), facts["sha256"], facts)
    except FileNotFoundError:
        raise ModelError(f"{path}: there is no such model card") from None
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ModelError(f"{path}: not a model card ({type(error).__name__}: {error})") from None
    if not card.path.exists():
        raise ModelError(f"{card.path}: the weights of model {card.name} are missing")
    return card


def bundled_cards() -> dict[str, Card]:
    """The models that ship with the package, by name."""
    return {card.name: card for card in map(read_card, sorted(BUNDLED.glob("*.json")))}


def find_card(model: str | Path) -> Card:
    """A bundled model by name, or any model by the path of its card.

    Raises:
        ModelError: there is none.
    """
    cards = bundled_cards()
    if str(model) in cards:
        return cards[str(model)]
    if Path(model).suffix != ".json":
        raise ModelError(f"no bundled model is called {str(model)!r}; there are {', '.join(cards)}")
    return read_card(Path(model))


def write_card(path: Path, facts: dict[str, Any]) -> None:
    """Write a card, aside and then renamed, with the hash of the weights beside it."""
    with written_whole(path) as part:
        part.write_text(json.dumps(facts | {"sha256": file_hash(path.with_suffix(".onnx"))}, indent=1) + "\n")


def file_hash(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
