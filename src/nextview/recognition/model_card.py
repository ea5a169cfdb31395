"""The card of a model: content, origin, scores, and the file of its weights."""

import glob
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec.structs import replace

from nextview.errors import ModelError, NextviewError
from nextview.files import (
    LARGEST_RECORD,
    HashText,
    read_record,
    regular_file,
    write_record,
)
from nextview.recognition.belief import PLAIN_SUM, Calibration, SizeEvidence
from nextview.recognition.map_names import LCM, LEM, SPHERE_SUFFIX, Good
from nextview.recognition.network_input import InputSpec

BUNDLED_MODELS = Path(__file__).parent / "bundled"
RECOGNISER = "recogniser-modelnet10"
# the bundled network that knows no classes: the novelty of an object is that of its features
FEATURE_NETWORK = "features"
MEMORY_SUFFIX = ".safetensors"
# the policy of a memory of things; its card is that of the memory
DISCRIMINATE = "discriminate"
# bundled recognisers, by the name of their models
COLLECTIONS = {"modelnet10": RECOGNISER, "ycb": "ycb"}
# the map networks that are bundled, by the name of the map
MAPS = {LEM: "lem-modelnet10", LCM: "lcm-modelnet10"}
NO_FOLDER = Path()
SCHEMA = 2  # of the cards of models; those of policies have 1
LARGEST_CARD_NUMBER = 1e9  # of a card; densities, gains and sizes are far smaller
LARGEST_ORDER = 1000  # of a symmetry; what is found is below ten
# by which the axis of a symmetry may be too long: cards hold rounded numbers
UNIT_LENGTH = 1e-3
# hexadecimal digits of the SHA-256 of a memory that its file's name holds
SHORT_HASH = 16


class Training(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a network was trained on, and how.

    Attributes:
        data: what the network was trained on, in words.
        recipes: settings of each training, in order.
        commands: all commands that led to the network.
    """

    data: str = ""
    recipes: tuple[dict[str, Any], ...] = ()
    commands: tuple[str, ...] = ()


class Symmetry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A symmetry of a thing: a rotation about an axis that leaves it unchanged.

    The axis goes through the centroid of its surface.

    Attributes:
        axis: Unit vector in the frame of the scan file.
        order: So many turns by equal angles make a full one, two at least; 0 for any angle.
    """

    axis: tuple[float, float, float]
    order: Annotated[int, msgspec.Meta(ge=0, le=LARGEST_ORDER)]

    def __post_init__(self) -> None:
        if self.order == 1:
            raise ModelError("a symmetry of order 1 is no symmetry")
        if abs(sum(value**2 for value in self.axis) - 1) > UNIT_LENGTH:
            raise ModelError("the axis of a symmetry is not a unit vector")


class Thing(msgspec.Struct, frozen=True):
    """One taught thing. Fields that only earlier versions knew are ignored.

    Attributes:
        name: Its name, unique among the things of a memory.
        source: The file or folder that it was taught from.
        symmetries: Of its surface; () for none.
        near_symmetries: Turns after which it hardly looks different; its symmetries are among them.
        upright: Whether it is known only as it stands: it was taught so, or captured.
        sha256: Hash of its mesh file; None for captured frames, and in cards of earlier versions.
    """

    name: Annotated[str, msgspec.Meta(min_length=1)]
    source: str
    symmetries: tuple[Symmetry, ...] = ()
    near_symmetries: tuple[Symmetry, ...] = ()
    upright: bool = False
    sha256: HashText | None = None


class Taught(msgspec.Struct, frozen=True):
    """What a memory of things is of. Fields that only earlier versions knew are ignored.

    Attributes:
        things: The things, in order.
        attribution: Whose work the things are, in words.
        sensor: Camera of the test, NAME or NAME:STRENGTH; "" in cards of earlier versions.
    """

    things: Annotated[tuple[Thing, ...], msgspec.Meta(min_length=1)]
    attribution: str = ""
    sensor: str = ""

    def __post_init__(self) -> None:
        names = {thing.name for thing in self.things}
        if len(names) < len(self.things):
            raise ModelError("two things have the same name")


class ModelCard(
    msgspec.Struct,
    frozen=True,
    forbid_unknown_fields=True,
    omit_defaults=True,
    tag_field="schema",
    tag=SCHEMA,
):
    """The card of a model: a JSON file beside the file with its weights.

    The weights of a network are an ONNX file, those of a memory of taught things (a recogniser too)
    a safetensors file. ModelError is raised for a recogniser without classes, sizes of other
    classes, a network without an input, or a memory whose classes do not match its things.

    Attributes:
        name: name of the model.
        kind: "recogniser", or the name of the map that the network predicts ("lem").
        input: input that the network takes.
        sha256: of the file with the weights.
        path: of the file with the weights; not written into the card.
        network: architecture, in words.
        classes: of a recogniser: unique, in the order of the logits.
        azimuth_bins: number of azimuth bins that a recogniser predicts; 0 for none.
        calibration: of a recogniser.
        size: sizes of the objects of each class; None if they are not known.
        novelty_sha256: of the novelty file beside the card; "" if there is none.
        measure: of a map network: the measure that it predicts.
        good: of a map network: whether high or low values mark the better views.
        output: of a map network: the local window, or the whole sphere, of which the window is a
            part.
        valley_classes: classes for which the valley of the map is the better view.
        valley_gain: by how much, for each of these classes.
        training: how the network was trained.
        scores: results on each set of objects.
        largest_difference_to_torch: between the answers of this file and those of the network in
            torch; None if it was not measured.
        note: further remarks.
        held_out: objects of the training split that were not used for training; () if they are not
            known.
        fitted_to: what calibration, size, novelty and valleys were fitted to, in words, by name.
        memory: things that were taught to a recogniser; None for a network.
    """

    name: str
    kind: str
    input: InputSpec
    sha256: HashText
    path: Path = NO_FOLDER
    network: str = ""
    classes: tuple[str, ...] = ()
    azimuth_bins: int = 0
    calibration: Calibration = PLAIN_SUM
    size: SizeEvidence | None = None
    novelty_sha256: Annotated[str, msgspec.Meta(pattern="^([0-9a-f]{64})?$")] = ""
    measure: str = ""
    good: Good = "peak"
    output: Literal["window", "sphere"] = "window"
    valley_classes: tuple[str, ...] = ()
    valley_gain: dict[str, float] = {}
    training: Training = Training()
    scores: dict[str, Any] = {}
    largest_difference_to_torch: float | None = None
    note: str = ""
    held_out: tuple[str, ...] = ()
    fitted_to: dict[str, str] = {}
    memory: Taught | None = None

    def __post_init__(self) -> None:
        if not self.name or not self.kind:
            raise ModelError("a model has a name and a kind")
        if self.is_recogniser and (not self.classes or self.input.kind == "cloud"):
            raise ModelError("a recogniser has classes, and takes geometry or images")
        if len(set(self.classes)) < len(self.classes):
            raise ModelError("two classes have the same name")
        if self.size is not None and len(self.size.log_density) != len(self.classes):
            raise ModelError(
                f"sizes of {len(self.size.log_density)} classes, not {len(self.classes)}"
            )
        if self.memory is not None:
            self._check_memory()

    def _check_memory(self) -> None:
        """See that things and classes fit together."""
        if not self.is_recogniser:
            raise ModelError(f"a memory of things is a recogniser, not a {self.kind}")

        # The calibration checks that the hypotheses ascend by steps of one: the last tells the
        # number of classes.
        hypotheses = self.calibration.hypotheses
        if not hypotheses or hypotheses[-1] + 1 != len(self.classes):
            raise ModelError(
                f"its hypotheses are not of its {len(self.classes)} classes"
            )

    @property
    def card_path(self) -> Path:
        """Where the card itself is: in the folder of the file that ``path`` names."""
        stem = self.path.stem
        if self.memory is not None:
            stem = stem.removesuffix(f"-{self.sha256[:SHORT_HASH]}")
        return self.path.with_name(f"{stem}.json")

    @property
    def is_recogniser(self) -> bool:
        """Whether it is a recogniser, and not a map network."""
        return self.kind == "recogniser"

    @property
    def maps(self) -> tuple[str, ...]:
        """Names of the maps that a map network predicts, of the window and of the sphere."""
        return (self.kind, self.kind + SPHERE_SUFFIX)[
            : 2 if self.output == "sphere" else 1
        ]

    def valleys(self, classes: Sequence[str]) -> tuple[str, ...]:
        """Return the classes for which the valley of its map is the better view.

        Without a fit they are all or none.
        """
        return (
            tuple(classes)
            if self.good == "valley" and not self.valley_gain
            else self.valley_classes
        )

    def made_by(self, *commands: str) -> "ModelCard":
        """The same with further commands; one that it names already is not named again."""
        commands = tuple(dict.fromkeys((*self.training.commands, *commands)))
        return replace(self, training=replace(self.training, commands=commands))


def read_card(path: Path) -> ModelCard:
    """Read a card; its weights are the file beside it that ``ModelCard.path`` then names.

    Raises:
        ModelError: card or weights are missing, or the card is damaged.
    """
    path = Path(path)
    card = read_record(path, ModelCard, "a model card")
    check_numbers(path, card, ModelError)
    weights = (
        path.with_suffix(".onnx")
        if card.memory is None
        else _memory_there(path, card.sha256)
    )
    if not weights.exists():
        raise ModelError(f"{weights}: the weights of model {card.name} are missing")
    return replace(card, path=weights)


def check_numbers(path: Path, card: Any, error: type[NextviewError]) -> None:
    """See that no number of a card is beyond what any fit gives: sums of such ones overflow.

    Args:
        path: of the card, for the sentence.
        card: a record of a model or of a policy.
        error: kind of error that is raised.
    """
    left: list[tuple[str, Any]] = [("", msgspec.to_builtins(card))]
    while left:
        name, value = left.pop()
        # of a long list of numbers, the largest is enough
        if isinstance(value, list | tuple) and {int, float}.issuperset(
            map(type, value)
        ):
            value = max(value, key=abs, default=0)

        if isinstance(value, dict):
            left += [(f"{name}.{key}".lstrip("."), item) for key, item in value.items()]
        elif isinstance(value, list | tuple):
            left += [(name, item) for item in value]
        elif isinstance(value, int | float) and abs(value) > LARGEST_CARD_NUMBER:
            raise error(
                f"{path}: its {name} holds {value:g}, and {LARGEST_CARD_NUMBER:g} is most"
            )


def memory_path(card: Path, sha256: str) -> Path:
    """Return where the file of a memory of things is written.

    It is NAME-HASH.safetensors beside NAME.json, with the first digits of the SHA-256 as HASH. A
    new memory thus lies beside the old one until the card names it.

    Args:
        card: path of the memory's card.
        sha256: of the memory's file.

    Returns:
        Path of the memory's file.
    """
    return card.with_name(f"{card.stem}-{sha256[:SHORT_HASH]}{MEMORY_SUFFIX}")


def _memory_there(card: Path, sha256: str) -> Path:
    """Where the file of a memory is: earlier versions called it NAME.safetensors."""
    named = memory_path(card, sha256)
    earlier = card.with_suffix(MEMORY_SUFFIX)
    return earlier if earlier.exists() and not named.exists() else named


class _Peek(msgspec.Struct):
    """The fields that tell what a card is of.

    Attributes:
        schema: 1 of the card of a policy, 2 of that of a model.
        memory: What only the card of a memory of things holds.
        elevations: The rings of viewpoints that a policy was learned for.
    """

    schema: int = 0
    memory: Any = None
    elevations: Any = None


def _peek(path: Path) -> _Peek:
    """Return what a JSON file says that it is; nothing if it is damaged.

    The reason is given when it is read as a card.
    """
    regular_file(path, "a card", ModelError, LARGEST_RECORD)
    try:
        return msgspec.json.decode(path.read_bytes(), type=_Peek)
    except (msgspec.DecodeError, UnicodeDecodeError):
        return _Peek()


def is_memory(card: Path) -> bool:
    """Return whether a card is that of a memory of things.

    If the card is damaged, the file beside it decides.
    """
    if not card.is_file():
        return False
    peek = _peek(card)
    if peek.schema == SCHEMA and peek.memory is not None:
        return True
    if card.with_suffix(MEMORY_SUFFIX).exists():
        return True
    digits = "[0-9a-f]" * SHORT_HASH
    return any(card.parent.glob(f"{glob.escape(card.stem)}-{digits}{MEMORY_SUFFIX}"))


def write_card(path: Path, card: ModelCard) -> None:
    """Write a card, or replace it.

    Args:
        path: of the card.
        card: its content.
    """
    write_record(path, replace(card, path=NO_FOLDER), overwrite=True)


def bundled_cards() -> dict[str, ModelCard]:
    """The models that ship with the package, by name."""
    return {
        path.stem: read_card(path) for path in sorted(BUNDLED_MODELS.glob("*.json"))
    }


def find_card(model: str | Path) -> ModelCard:
    """A bundled model by name, or any model by the path of its card."""
    names = [path.stem for path in sorted(BUNDLED_MODELS.glob("*.json"))]
    if str(model) in names:
        return read_card(BUNDLED_MODELS / f"{model}.json")
    if Path(model).suffix != ".json":
        raise ModelError(
            f"no bundled model is called {str(model)!r}; there are {', '.join(names)}"
        )
    return read_card(Path(model))


@dataclass(frozen=True)
class Collection:
    """Cards of models that belong together.

    Attributes:
        recogniser: card of the recogniser.
        maps: cards of the map networks, by map.
        policies: cards of the learned policies, by name; bundled policies are not among them.
    """

    recogniser: Path
    maps: dict[str, Path]
    policies: dict[str, Path]


def find_models(models: str | Path) -> Collection:
    """The bundled models by name, one of COLLECTIONS, or those in a folder.

    A folder holds the card of one recogniser. Maps that it lacks are the bundled ones: they know no
    classes.
    """
    bundled = {name: BUNDLED_MODELS / f"{card}.json" for name, card in MAPS.items()}
    folder = Path(models)
    if str(models) in COLLECTIONS:
        return _with_memory(
            Collection(BUNDLED_MODELS / f"{COLLECTIONS[str(models)]}.json", bundled, {})
        )

    if not folder.is_dir():
        known = ", ".join(COLLECTIONS)
        raise ModelError(
            f"{folder}: is neither a folder with models nor the name of bundled ones ({known})"
        )

    networks = dict[str, list[Path]]()
    policies = dict[str, Path]()
    for path in sorted(folder.glob("*.json")):
        has_network = (
            path.with_suffix(".onnx").exists() and _peek(path).elevations is None
        )
        if has_network or is_memory(path):
            networks.setdefault(read_card(path).kind, []).append(path)
        else:
            policies[path.stem] = path

    for kind, paths in networks.items():
        if len(paths) > 1:
            raise ModelError(
                f"{folder}: holds several models of the kind {kind}: {paths[0].name},"
                f" {paths[1].name}"
            )
    if "recogniser" not in networks:
        raise ModelError(f"{folder}: no memory here; nextview learn makes one")

    own = {kind: paths[0] for kind, paths in networks.items()}
    return _with_memory(Collection(own.pop("recogniser"), bundled | own, policies))


def _with_memory(found: Collection) -> Collection:
    """With the policy that needs no more than a memory of things, where the recogniser is one."""
    if not is_memory(found.recogniser):
        return found
    return Collection(
        found.recogniser,
        found.maps,
        {DISCRIMINATE: found.recogniser} | found.policies,
    )
