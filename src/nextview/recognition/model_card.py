"""The card of a model: what it is, how it was made, how good it is, and which file holds its weights."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec.structs import replace

from nextview.errors import ModelError
from nextview.files import Sha256, read_record, regular_file, write_record
from nextview.recognition.belief import PLAIN_SUM, Calibration, SizeEvidence
from nextview.recognition.map_names import LCM, LEM, SPHERE, Good
from nextview.recognition.network_input import InputSpec

BUNDLED = Path(__file__).parent / "bundled"
RECOGNISER = "recogniser-modelnet10"
FEATURES = "features"  # the bundled network that knows no classes: what taught things are remembered by
MEMORY_SUFFIX = ".safetensors"
DISCRIMINATE = "discriminate"  # the policy of a memory of things; its card is that of the memory
COLLECTIONS = {"modelnet10": RECOGNISER, "ycb": "ycb"}  # bundled recognisers, by the name of their models
MAPS = {LEM: "lem-modelnet10", LCM: "lcm-modelnet10"}  # the map networks that are bundled, by the name of the map
NOWHERE = Path()


class Training(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a network learned from, in words, the settings of each training, and every command that made it."""

    data: str = ""
    recipes: tuple[dict[str, Any], ...] = ()
    commands: tuple[str, ...] = ()


class Thing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One taught thing: its name, the file or folder that it was taught from, and in how many resting poses."""

    name: str
    source: str
    poses: int


class Taught(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a memory of things is of."""

    things: tuple[Thing, ...]  # in order
    features_sha256: Sha256  # of the features that it is made of
    weight: float  # of a cosine
    attribution: str = ""
    # quantiles, see ``novelty.Quantiles``, after 1, 2, ... views, of the negative log-likelihood of known things, given
    # the class that explains them best
    novelty: tuple[tuple[float, ...], ...] = ()
    usual: tuple[tuple[float, ...], ...] = ()  # see ``novelty.Quantiles``


class ModelCard(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True, tag_field="schema", tag=2):
    """One model; as a file, a JSON object of these fields beside the file of the same name with its weights.

    That is an ONNX file; of a memory of taught things, which is a recogniser too, a safetensors file. ModelError: a
    recogniser without classes, sizes of other classes than these, or a network of no input.
    """

    name: str  # what users call it
    kind: str  # "recogniser" or the name of the map that it predicts ("lem")
    input: InputSpec  # what it takes of a view
    sha256: Sha256  # of that file
    path: Path = NOWHERE  # of that file; it does not stand in the card
    network: str = ""  # which architecture, in words
    classes: tuple[str, ...] = ()  # of a recogniser, unique, in the order of its logits
    azimuth_bins: int = 0  # of an object that a recogniser discriminates; 0 for none
    calibration: Calibration = PLAIN_SUM  # of a recogniser
    size: SizeEvidence | None = None  # what a recogniser knows of the sizes of objects; None if nothing
    # of the novelty score beside the card; "" if there is none
    novelty_sha256: Annotated[str, msgspec.Meta(pattern="^([0-9a-f]{64})?$")] = ""
    measure: str = ""  # of which a map network predicts the map
    good: Good = "peak"  # where such a map has the better views
    # of a map network: the local window, or the whole sphere, of which the window is a part
    output: Literal["window", "sphere"] = "window"
    valley_classes: tuple[str, ...] = ()  # for which the valley of its map was found to be the better view
    valley_gain: dict[str, float] = {}  # by how much, for each class
    training: Training = Training()  # how it was made
    scores: dict[str, Any] = {}  # on each set of objects
    largest_difference_to_torch: float | None = None  # of the file's answers; None if it was not measured
    note: str = ""  # what else is to be said
    held_out: tuple[str, ...] = ()  # objects of the training split that it was not trained on; () if it does not say
    # what calibration, size, novelty and valleys were fitted to, in words, by their names
    fitted_to: dict[str, str] = {}
    memory: Taught | None = None  # of a recogniser that was taught things; None for a network

    def __post_init__(self) -> None:
        if not self.name or not self.kind:
            raise ModelError("a model has a name and a kind")
        if self.is_recogniser and (not self.classes or self.input.kind == "cloud"):
            raise ModelError("a recogniser has classes, and takes geometry or images")
        if len(set(self.classes)) < len(self.classes):
            raise ModelError("two classes have the same name")
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

    def valleys(self, classes: Sequence[str]) -> tuple[str, ...]:
        """The classes for which the valley of its map is the better view: as was fitted, or else all or none."""
        return tuple(classes) if self.good == "valley" and not self.valley_gain else self.valley_classes

    def made_by(self, *commands: str) -> "ModelCard":
        """The same with further commands; one that it names already is not named again."""
        commands = tuple(dict.fromkeys((*self.training.commands, *commands)))
        return replace(self, training=replace(self.training, commands=commands))


def read_card(path: Path) -> ModelCard:
    """Read a card; the weights are the file beside it with the same name. ModelError if one is missing."""
    path = Path(path)
    card = read_record(path, ModelCard, "a model card")
    card = replace(card, path=path.with_suffix(MEMORY_SUFFIX if card.memory else ".onnx"))
    if not card.path.exists():
        raise ModelError(f"{card.path}: the weights of model {card.name} are missing")
    return card


def write_card(path: Path, card: ModelCard) -> None:
    """Write a card, or replace it by one that says more."""
    write_record(path, replace(card, path=NOWHERE), overwrite=True)


def bundled_cards() -> dict[str, ModelCard]:
    """The models that ship with the package, by name."""
    return {path.stem: read_card(path) for path in sorted(BUNDLED.glob("*.json"))}


def find_card(model: str | Path) -> ModelCard:
    """A bundled model by name, or any model by the path of its card."""
    names = [path.stem for path in sorted(BUNDLED.glob("*.json"))]
    if str(model) in names:
        return read_card(BUNDLED / f"{model}.json")
    if Path(model).suffix != ".json":
        raise ModelError(f"no bundled model is called {str(model)!r}; there are {', '.join(names)}")
    return read_card(Path(model))


@dataclass(frozen=True)
class Collection:
    """Cards of models that belong together: maps by their names, policies, without the bundled ones, by theirs."""

    recogniser: Path
    maps: dict[str, Path]
    policies: dict[str, Path]


def find_models(models: str | Path) -> Collection:
    """The bundled models by name, one of COLLECTIONS, or those in a folder.

    A folder holds the card of one recogniser. Maps that it lacks are the bundled ones: they know no classes.
    """
    bundled = {name: BUNDLED / f"{card}.json" for name, card in MAPS.items()}
    folder = Path(models)
    if str(models) in COLLECTIONS:
        return _with_memory(Collection(BUNDLED / f"{COLLECTIONS[str(models)]}.json", bundled, {}))
    if not folder.is_dir():
        known = ", ".join(COLLECTIONS)
        raise ModelError(f"{folder}: is neither a folder with models nor the name of bundled ones ({known})")
    networks, policies = dict[str, list[Path]](), dict[str, Path]()
    for path in sorted(folder.glob("*.json")):
        regular_file(path, "a card", ModelError)
        # A policy's card names the viewpoints that it was learned for.
        weights = path.with_suffix(".onnx").exists() or path.with_suffix(MEMORY_SUFFIX).exists()
        if weights and b'"elevations"' not in path.read_bytes():
            networks.setdefault(read_card(path).kind, []).append(path)
        else:
            policies[path.stem] = path
    for kind, paths in networks.items():
        if len(paths) > 1:
            raise ModelError(f"{folder}: holds several models of the kind {kind}: {paths[0].name}, {paths[1].name}")
    if "recogniser" not in networks:
        raise ModelError(f"{folder}: holds no card of a recogniser; nextview learn makes one")
    own = {kind: paths[0] for kind, paths in networks.items()}
    return _with_memory(Collection(own.pop("recogniser"), bundled | own, policies))


def _with_memory(found: Collection) -> Collection:
    """With the policy that needs no more than a memory of things, where the recogniser is one."""
    if not found.recogniser.with_suffix(MEMORY_SUFFIX).exists():
        return found
    return Collection(found.recogniser, found.maps, {DISCRIMINATE: found.recogniser} | found.policies)
