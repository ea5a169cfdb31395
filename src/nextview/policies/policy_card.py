"""The card of a learned policy: a JSON file with its table, next to an ONNX file with weights."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from nextview.errors import ModelError, OtherUseError, PolicyError
from nextview.files import decode_record, read_record, write_record
from nextview.geometry.viewsphere import Viewpoints, ViewSphere
from nextview.policies.base import Policy, Scope
from nextview.policies.gain import GainTable, read_gain
from nextview.policies.learned_tables import ClassTable, FixedRing, FixedSequence
from nextview.recognition.model_card import check_numbers

BUNDLED_POLICIES = Path(__file__).parent / "bundled"
OptionalHash = Annotated[str, msgspec.Meta(pattern="^([0-9a-f]{64})?$")]


class LearnedFrom(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Training data of a policy: hash of the file of predictions, and the models."""

    sha256: OptionalHash
    models: dict[str, tuple[str, str]]


def _table(**fields: Any) -> type:
    return msgspec.defstruct(
        "Table",
        fields.items(),
        frozen=True,
        forbid_unknown_fields=True,
    )


TABLES = {  # contents of a card's table, by kind
    "fixed-sequence": _table(moves=list[list[int]]),
    "fixed-ring": _table(ring=int, steps=int),
    "class-table": _table(values=list[list[list[float]]]),
    "gain": GainTable,
}


class PolicyCard(
    msgspec.Struct,
    frozen=True,
    forbid_unknown_fields=True,
    omit_defaults=True,
    tag_field="schema",
    tag=1,
):
    """A learned policy for viewpoints on rings, with an ONNX file if it has weights."""

    kind: Literal["fixed-sequence", "fixed-ring", "class-table", "gain"]
    scope: Scope
    elevations: tuple[float, ...]  # of the rings, degrees
    azimuths: Annotated[int, msgspec.Meta(ge=1)]  # views on each ring
    classes: tuple[str, ...]  # of the recogniser, unique, in the order of its logits
    table: dict[str, Any]  # see TABLES
    learned_from: str = ""  # description of the training data
    predictions: tuple[LearnedFrom, ...] = ()
    # temperature and correlation of the beliefs in each part
    calibration: tuple[tuple[float, float], ...] = ()
    settings: dict[str, Any] = {}  # how it was learned
    commands: tuple[
        str, ...
    ] = ()  # all commands that created it from the models, in order
    sha256: OptionalHash = ""  # of the ONNX file; "" if there is none

    def make(self, sphere: ViewSphere, weights: Path) -> Policy:
        """Create the policy of the card.

        Args:
            sphere: the candidate views.
            weights: path of its ONNX file; used by gain policies only.

        Returns:
            The policy.

        Raises:
            ModelError: the card's table or the file is not valid.
        """
        table: Any = decode_record(
            self.table,
            TABLES[self.kind],
            "the table",
            ModelError,
        )
        found = getattr(table, "values", getattr(table, "classes", self.classes))
        classes = found if isinstance(found, int) else len(found)
        if classes != len(self.classes):
            raise ModelError(
                f"the table is of {classes} classes, not {len(self.classes)}"
            )

        if isinstance(table, GainTable):
            return read_gain(sphere, table, self.scope, weights, self.sha256)
        if self.kind == "fixed-ring":
            return FixedRing(sphere, table.ring, table.steps)

        try:
            if self.kind == "fixed-sequence":
                return FixedSequence(
                    sphere,
                    np.array(table.moves, np.int64),
                    self.scope,
                )
            return ClassTable(sphere, np.array(table.values, np.float64), self.scope)
        except (ValueError, OverflowError) as error:
            raise ModelError(f"{error}") from None


def bundled_policies() -> dict[str, Path]:
    """Return the cards of the learned policies that ship with the package, by name."""
    return {path.stem: path for path in sorted(BUNDLED_POLICIES.glob("*.json"))}


def write_policy_card(path: Path, card: PolicyCard, overwrite: bool = False) -> None:
    """Write the card of a policy.

    Args:
        path: of the card.
        card: its content.
        overwrite: whether to replace an existing card.
    """
    write_record(path, card, overwrite)


def read_policy_card(path: Path) -> PolicyCard:
    """Read a card."""
    card = read_record(path, PolicyCard, "a policy card", PolicyError)
    check_numbers(path, card, PolicyError)
    if len(set(card.classes)) < len(card.classes):
        raise PolicyError(f"{path}: not a policy card (two classes have the same name)")
    return card


def read_policy(
    path: Path,
    sphere: Viewpoints,
    classes: Sequence[str] | None = None,
) -> Policy:
    """Open the policy of a card.

    Args:
        path: of the card.
        sphere: the candidate views.
        classes: of the recogniser in use; None to skip the check.

    Returns:
        The policy.

    Raises:
        OtherUseError: it was trained for other viewpoints or classes.
        PolicyError: there is no such card, or it is damaged.
    """
    card = read_policy_card(path)
    weights = path.with_suffix(".onnx")

    if not isinstance(sphere, ViewSphere) or (card.elevations, card.azimuths) != (
        sphere.elevations,
        sphere.azimuths,
    ):
        rings = len(card.elevations)
        raise OtherUseError(
            f"{path}: was learned for {rings} rings of {card.azimuths} views, not for this sphere"
        )
    if classes is not None and card.classes != tuple(classes):
        raise OtherUseError(
            f"{path}: was learned for other classes ({', '.join(card.classes)})"
        )

    try:
        return card.make(sphere, weights)
    except (ModelError, PolicyError) as error:
        named = str(error).startswith(f"{weights}")
        raise PolicyError(
            f"{error}" if named else f"{path}: not a policy card ({error})"
        ) from None
