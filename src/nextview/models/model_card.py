"""The card of a model: what it is, how it was made, how good it is, and which file holds its weights."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from nextview.arguments import a_path, takes_paths
from nextview.belief import PLAIN_SUM, Calibration
from nextview.errors import ModelError
from nextview.json_file import Fields, read_object
from nextview.measures.map_names import SPHERE, Good, measure_of
from nextview.models.network_input import InputSpec
from nextview.models.size_evidence import SizeEvidence
from nextview.outputs import written_whole

BUNDLED = Path(__file__).parent / "bundled"
SCHEMA = 2
"""Version 1 did not say which measure a map is of: its name told that, and peaks were good."""


@dataclass(frozen=True)
class Training:
    """How a network was made.

    Attributes:
        data: what it learned from, in words.
        recipes: settings of each training, JSON values; see ``training.recipes``.
        commands: every command that made the model, in order.
    """

    data: str = ""
    recipes: tuple[Mapping[str, Any], ...] = ()
    commands: tuple[str, ...] = ()

    @classmethod
    def from_dict(cls, values: Any) -> Training:
        """From a card's "training".

        Raises:
            ModelError: it makes no sense.
        """
        fields = Fields(values, "the training")
        data, recipes = fields.text("data", ""), fields.take("recipes", [])
        if not isinstance(recipes, list) or not all(isinstance(recipe, dict) for recipe in recipes):
            raise fields.wrong("recipes", "a list of JSON objects")
        commands = fields.texts("commands", ())
        fields.end()
        return cls(data, tuple(recipes), commands)

    def to_dict(self) -> dict[str, Any]:
        """What ``from_dict`` reads, for JSON."""
        return {"data": self.data, "recipes": [dict(r) for r in self.recipes], "commands": list(self.commands)}


@dataclass(frozen=True)
class ModelCard:
    """One model.

    Attributes:
        name: what users call it.
        kind: "recogniser" or the name of the map that it predicts ("lem").
        input: what it takes of a view.
        sha256: of its ONNX file.
        path: of that file, beside the card and of the same name; it does not stand in the card.
        network: which architecture, in words; several that are averaged are joined by " + ".
        classes: of a recogniser, unique, in the order of its logits.
        azimuth_bins: of an object that a recogniser tells apart; 0 if it was not taught to.
        calibration: of a recogniser; its temperature is the only one there is.
        size: what a recogniser knows of the sizes of objects; None if nothing.
        novelty_sha256: of the file beside the card by which it tells objects of no known class, see
            ``nextview.novelty``; "" if there is none: such a recogniser never answers that it does not know an object.
        measure: of which a map network predicts the map; "" of a recogniser.
        good: where such a map has the better views: at its peaks, or its valleys.
        output: what a map network predicts: the local window, or the whole sphere, of which the window is a part.
        valley_classes: for which the valley of its map was found to be the better view.
        valley_gain: by how much, for each class; see ``calibration.valleys``.
        training: how it was made.
        scores: on each set of objects, by what that is.
        largest_difference_to_torch: of the file's answers; None if it was not measured.
        note: what else is to be said.
        held_out: objects of the training split that it was not trained on; () if it does not say.
        fitted_to: what calibration, size, novelty and valleys were fitted to, in words, by their names.
        schema: version of the card's own form.

    Raises:
        ModelError: a recogniser without classes, sizes of other classes than these, or a network of no input.
    """

    name: str
    kind: str
    input: InputSpec
    sha256: str
    path: Path
    network: str = ""
    classes: tuple[str, ...] = ()
    azimuth_bins: int = 0
    calibration: Calibration = PLAIN_SUM
    size: SizeEvidence | None = None
    novelty_sha256: str = ""
    measure: str = ""
    good: Good = "peak"
    output: Literal["window", "sphere"] = "window"
    valley_classes: tuple[str, ...] = ()
    valley_gain: Mapping[str, float] = field(default_factory=dict)
    training: Training = Training()
    scores: Mapping[str, Any] = field(default_factory=dict)
    largest_difference_to_torch: float | None = None
    note: str = ""
    held_out: tuple[str, ...] = ()
    fitted_to: Mapping[str, str] = field(default_factory=dict)
    schema: int = SCHEMA

    def __post_init__(self) -> None:
        if not self.name or not self.kind:
            raise ModelError("a model has a name and a kind")
        if self.is_recogniser and (not self.classes or self.input.kind == "cloud"):
            raise ModelError("a recogniser has classes, and takes geometry or images")
        if self.size is not None and len(self.size.log_density) != len(self.classes):
            raise ModelError(f"sizes of {len(self.size.log_density)} classes, not {len(self.classes)}")

    @property
    def is_recogniser(self) -> bool:
        """Whether it is a recogniser, and not a map network."""
        return self.kind == "recogniser"

    @property
    def maps(self) -> tuple[str, ...]:
        """Names of the maps that a map network predicts: of the local window and, if it knows it, of the sphere."""
        return (self.kind, self.kind + SPHERE)[: 2 if self.output == "sphere" else 1]

    @classmethod
    def from_dict(cls, values: Any, path: Path) -> ModelCard:
        """From what stands in a card.

        Args:
            values: the JSON object.
            path: of the ONNX file.

        Raises:
            ModelError: it makes no sense.
        """
        fields = Fields(values, "the card")
        version = fields.schema(1, SCHEMA)
        seen = Fields(fields.take("input"), "the input")
        spec = InputSpec(seen.text("kind"), seen.whole("size", 0))  # type: ignore[arg-type]  # checked on making
        seen.end()
        kind = fields.text("kind")
        own: dict[str, Any]
        if kind == "recogniser":
            said, size = fields.take("calibration", None), fields.take("size", None)
            own = {
                "classes": fields.texts("classes", unique=True),
                "azimuth_bins": fields.whole("azimuth_bins", 0),
                "calibration": PLAIN_SUM if said is None else Calibration.from_dict(said),
                "size": None if size is None else SizeEvidence.from_dict(size),
                "novelty_sha256": fields.sha256("novelty_sha256", ""),
            }
        else:
            own = {
                "measure": measure_of(kind) if version == 1 else fields.text("measure"),
                "good": "peak" if version == 1 else fields.one_of("good", ("peak", "valley")),
                "output": fields.one_of("output", ("window", "sphere")),
                "valley_classes": fields.texts("valley_classes", (), unique=True),
                "valley_gain": _by_name(fields, "valley_gain", float),
            }
        card = cls(
            fields.text("name"),
            kind,
            spec,
            fields.sha256("sha256"),
            path,
            network=fields.text("network", ""),
            training=Training.from_dict(fields.take("training", {})),
            scores=fields.mapping("scores", {}),
            largest_difference_to_torch=fields.number("largest_difference_to_torch", None),
            note=fields.text("note", ""),
            held_out=fields.texts("held_out", (), unique=True),
            fitted_to=_by_name(fields, "fitted_to", str),
            **own,
        )
        fields.end()
        return card

    def to_dict(self) -> dict[str, Any]:
        """What ``from_dict`` reads, for JSON."""
        values: dict[str, Any] = {
            "schema": self.schema,
            "name": self.name,
            "kind": self.kind,
            "network": self.network,
            "input": {"kind": self.input.kind, "size": self.input.size},
        }
        if self.is_recogniser:
            values |= {"classes": list(self.classes), "azimuth_bins": self.azimuth_bins}
        else:
            values |= {
                "measure": self.measure,
                "good": self.good,
                "output": self.output,
                "valley_classes": list(self.valley_classes),
                "valley_gain": dict(self.valley_gain),
            }
        values |= {"training": self.training.to_dict(), "scores": dict(self.scores)}
        if self.largest_difference_to_torch is not None:
            values["largest_difference_to_torch"] = self.largest_difference_to_torch
        values |= {"note": self.note, "held_out": list(self.held_out), "sha256": self.sha256}
        if self.calibration != PLAIN_SUM:
            values["calibration"] = self.calibration.to_dict()
        if self.size is not None:
            values["size"] = self.size.to_dict()
        if self.novelty_sha256:
            values["novelty_sha256"] = self.novelty_sha256
        return values | {"fitted_to": dict(self.fitted_to)}

    def valleys(self, classes: Sequence[str]) -> tuple[str, ...]:
        """The classes for which the valley of its map is the better view: as was fitted, or else all or none."""
        return tuple(classes) if self.good == "valley" and not self.valley_gain else self.valley_classes

    def made_by(self, *commands: str) -> ModelCard:
        """The same with further commands; one that it names already is not named again."""
        training = replace(self.training, commands=tuple(dict.fromkeys((*self.training.commands, *commands))))
        return replace(self, training=training)


def _by_name(fields: Fields, name: str, kind: type[Any]) -> dict[str, Any]:
    """A mapping to strings or to numbers."""
    values = fields.mapping(name, {})
    wanted = (int, float) if kind is float else (kind,)
    if any(isinstance(value, bool) or not isinstance(value, wanted) for value in values.values()):
        raise fields.wrong(name, f"an object of {'numbers' if kind is float else 'strings'}")
    return values


@takes_paths("path")
def read_card(path: Path) -> ModelCard:
    """Read a card; the weights are the file beside it with the same name.

    Raises:
        ModelError: the card or its weights are missing, or the card is not one.
    """
    try:
        values = read_object(path, "a model card")
    except FileNotFoundError:
        raise ModelError(f"{path}: there is no such model card") from None
    try:
        card = ModelCard.from_dict(values, path.with_suffix(".onnx"))
    except ModelError as error:
        raise ModelError(f"{path}: not a model card ({error})") from None
    if not card.path.exists():
        raise ModelError(f"{card.path}: the weights of model {card.name} are missing")
    return card


def bundled_cards() -> dict[str, ModelCard]:
    """The models that ship with the package, by name."""
    return {card.name: card for card in map(read_card, sorted(BUNDLED.glob("*.json")))}


def find_card(model: str | Path) -> ModelCard:
    """A bundled model by name, or any model by the path of its card.

    Raises:
        ModelError: there is none.
    """
    cards = bundled_cards()
    if str(model) in cards:
        return cards[str(model)]
    path = a_path(model, "the card of a model", ModelError)
    if path.suffix != ".json":
        raise ModelError(f"no bundled model is called {str(model)!r}; there are {', '.join(cards)}")
    return read_card(path)


@takes_paths("path")
def write_card(path: Path, card: ModelCard) -> None:
    """Write a card, aside and then renamed."""
    with written_whole(path) as part:
        part.write_text(json.dumps(card.to_dict(), indent=1, allow_nan=False) + "\n")


@takes_paths("path")
def file_hash(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
