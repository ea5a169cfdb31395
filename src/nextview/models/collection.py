"""Models that belong together: the bundled ones by name, or those in a folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nextview.arguments import a_path, regular_file
from nextview.errors import ModelError
from nextview.models.inference import MAPS, RECOGNISER
from nextview.models.model_card import find_card, read_card


@dataclass(frozen=True)
class Collection:
    """Where the models are.

    Attributes:
        recogniser: its card.
        maps: cards of map networks, by the name of the map.
        policies: cards of policies, by name; the bundled policies are not among them.
    """

    recogniser: Path
    maps: dict[str, Path]
    policies: dict[str, Path]


def find_models(models: str | Path) -> Collection:
    """The models of that name, or in that folder.

    A folder holds the card of one recogniser. Maps that it lacks are the bundled ones: they know no classes.

    Raises:
        ModelError: there are none, or several recognisers.
    """
    bundled = {name: find_card(card).path.with_suffix(".json") for name, card in MAPS.items()}
    if str(models) == RECOGNISER.removeprefix("recogniser-"):
        return Collection(find_card(RECOGNISER).path.with_suffix(".json"), bundled, {})
    folder = a_path(models, "a folder with models", ModelError)
    if not folder.is_dir():
        name = RECOGNISER.removeprefix("recogniser-")
        raise ModelError(f"{folder}: is neither a folder with models nor the name of bundled ones ({name})")
    networks: dict[str, list[Path]] = {}
    policies: dict[str, Path] = {}
    for path in sorted(folder.glob("*.json")):
        if path.with_suffix(".onnx").exists() and not _is_policy(path):
            networks.setdefault(read_card(path).kind, []).append(path)
        else:
            policies[path.stem] = path
    for kind, paths in networks.items():
        if len(paths) > 1:
            raise ModelError(f"{folder}: holds several models of the kind {kind}: {paths[0].name}, {paths[1].name}")
    if "recogniser" not in networks:
        raise ModelError(f"{folder}: holds no card of a recogniser; nextview export recogniser makes one")
    own = {kind: paths[0] for kind, paths in networks.items()}
    return Collection(own.pop("recogniser"), bundled | own, policies)


def _is_policy(path: Path) -> bool:
    """Whether a card is of a policy: these name the viewpoints that they were learned for."""
    regular_file(path, "a card", ModelError)
    try:
        return '"elevations"' in path.read_text(errors="replace")
    except OSError as error:
        raise ModelError(f"{path}: cannot be read ({error.strerror})") from None
