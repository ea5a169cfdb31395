"""The card of a policy that was learned from predictions: one JSON file, table and all; weights are ONNX beside it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from nextview.arguments import takes_paths
from nextview.errors import ModelError, OtherUseError, PolicyError
from nextview.json_file import Fields, read_object
from nextview.outputs import written_whole
from nextview.policies.agent import Agent
from nextview.policies.base import Policy, Scope
from nextview.policies.gain import Gain
from nextview.policies.gain.gain_file import read_gain
from nextview.policies.learned_tables import ClassTable, FixedRing, FixedSequence
from nextview.viewsphere import Viewpoints, ViewSphere

BUNDLED = Path(__file__).parent / "bundled"
SCHEMA = 1
KINDS = ("fixed-sequence", "fixed-ring", "class-table", "gain", "agent")
NETWORKS: dict[str, type[Gain]] = {"gain": Gain, "agent": Agent}
"""The kinds whose scores are an ONNX file."""


@dataclass(frozen=True)
class LearnedFrom:
    """Predictions that a policy was learned from.

    Attributes:
        sha256: of their file.
        models: name and SHA-256 of each model that made them, by kind.
    """

    sha256: str
    models: Mapping[str, tuple[str, str]]


@dataclass(frozen=True)
class PolicyCard:
    """One policy that was learned.

    Attributes:
        kind: one of KINDS.
        scope: where it may go: "global", everywhere, or "local", in the local window.
        elevations: of the rings of the viewpoints that it was learned for, degrees.
        azimuths: views on each ring.
        classes: of the recogniser, unique, in the order of its logits.
        table: what the kind of policy needs, JSON values.
        learned_from: what it was learned from, in words.
        predictions: files of the same.
        calibration: temperature and correlation of the beliefs that it was learned with, one pair or more.
        settings: how it was learned, JSON values.
        commands: every command that made it from the models, in order.
        sha256: of the ONNX file beside the card; "" for a kind that has none.
        schema: version of the card's own form.
    """

    kind: str
    scope: Scope
    elevations: tuple[float, ...]
    azimuths: int
    classes: tuple[str, ...]
    table: Mapping[str, Any]
    learned_from: str = ""
    predictions: tuple[LearnedFrom, ...] = ()
    calibration: tuple[tuple[float, float], ...] = ()
    settings: Mapping[str, Any] | None = None
    commands: tuple[str, ...] = ()
    sha256: str = ""
    schema: int = SCHEMA

    @classmethod
    def from_dict(cls, values: Any) -> PolicyCard:
        """From what stands in a card.

        Raises:
            ModelError: it makes no sense.
        """
        fields = Fields(values, "the card")
        fields.schema(SCHEMA)
        kind = fields.one_of("kind", KINDS)
        pairs = fields.numbers("calibration", 2, None)
        if pairs is not None and pairs.shape[1] != 2:
            raise fields.wrong("calibration", "a list of pairs: temperature and correlation")
        card = cls(
            kind,
            fields.one_of("scope", get_args(Scope)),
            tuple(fields.numbers("elevations", 1).tolist()),
            fields.whole("azimuths", least=1),
            fields.texts("classes", unique=True),
            fields.mapping("table"),
            fields.text("learned_from", ""),
            _learned_from(fields.take("predictions", [])),
            () if pairs is None else tuple(map(tuple, pairs.tolist())),
            fields.mapping("settings", {}),
            fields.texts("commands", ()),
            fields.sha256("sha256") if kind in NETWORKS else fields.sha256("sha256", ""),
        )
        fields.end()
        return card

    def to_dict(self) -> dict[str, Any]:
        """What ``from_dict`` reads, for JSON."""
        sources = [{"sha256": p.sha256, "models": {k: list(m) for k, m in p.models.items()}} for p in self.predictions]
        values: dict[str, Any] = {
            "schema": self.schema,
            "kind": self.kind,
            "scope": self.scope,
            "elevations": list(self.elevations),
            "azimuths": self.azimuths,
            "classes": list(self.classes),
            "learned_from": self.learned_from,
            "predictions": sources,
            "settings": dict(self.settings or {}),
            "commands": list(self.commands),
        }
        if self.calibration:
            values["calibration"] = [*map(list, self.calibration)]
        return values | ({"sha256": self.sha256} if self.sha256 else {}) | {"table": dict(self.table)}

    def make(self, sphere: ViewSphere, weights: Path) -> Policy:
        """The policy that it describes.

        Args:
            sphere: the viewpoints; those that it was learned for.
            weights: the ONNX file, for a kind that has one.

        Raises:
            ModelError or PolicyError: the table makes no sense, or the file cannot be used.
        """
        if self.kind in NETWORKS:
            if self.table.get("classes") != len(self.classes):
                raise ModelError(f"the table is of {self.table.get('classes')} classes, not {len(self.classes)}")
            return read_gain(sphere, self.table, self.scope, weights, self.sha256, NETWORKS[self.kind])
        fields = Fields(self.table, "the table")
        policy: Policy
        if self.kind == "fixed-ring":
            policy = FixedRing(sphere, fields.whole("ring"), fields.whole("steps"))
        elif self.kind == "fixed-sequence":
            moves = fields.numbers("moves", 2)
            if ((moves != np.rint(moves)) | (np.abs(moves) > 2**31)).any():
                raise fields.wrong("moves", "a table of whole numbers")
            policy = FixedSequence(sphere, moves.astype(np.int64), self.scope)
        else:
            values = fields.numbers("values", 3)
            if len(values) != len(self.classes):
                raise ModelError(f"the table is of {len(values)} classes, not {len(self.classes)}")
            policy = ClassTable(sphere, values, self.scope)
        fields.end()
        return policy


def _learned_from(values: Any) -> tuple[LearnedFrom, ...]:
    found = []
    for each in values if isinstance(values, list) else [values]:
        fields = Fields(each, "the predictions")
        sha256, models = fields.sha256("sha256"), fields.mapping("models")
        fields.end()
        for model in models.values():
            if not isinstance(model, list) or len(model) != 2 or not all(isinstance(part, str) for part in model):
                raise fields.wrong("models", "an object of pairs: name and SHA-256")
        found.append(LearnedFrom(sha256, {kind: (name, sha) for kind, (name, sha) in models.items()}))
    return tuple(found)


def bundled_policies() -> dict[str, Path]:
    """Cards of the learned policies that ship with the package, by name."""
    return {path.stem: path for path in sorted(BUNDLED.glob("*.json"))}


@takes_paths("path")
def write_policy_card(path: Path, card: PolicyCard) -> None:
    """Write a card aside, then rename it."""
    with written_whole(path) as part:
        part.write_text(json.dumps(card.to_dict(), allow_nan=False) + "\n")


@takes_paths("path")
def read_policy_card(path: Path) -> PolicyCard:
    """Read a card.

    Raises:
        PolicyError: there is none, or it is damaged.
    """
    try:
        values = read_object(path, "a policy card")
    except FileNotFoundError:
        raise PolicyError(f"{path}: there is no such policy card") from None
    except ModelError as error:
        raise PolicyError(str(error)) from None
    try:
        return PolicyCard.from_dict(values)
    except ModelError as error:
        raise PolicyError(f"{path}: not a policy card ({error})") from None


@takes_paths("path")
def read_policy(path: Path, sphere: Viewpoints, classes: Sequence[str] | None = None) -> Policy:
    """Make the policy that a card describes.

    Args:
        path: the card; weights, where it has any, are the file beside it with the same name that ends in .onnx.
        sphere: the viewpoints; they have to be those that it was learned for.
        classes: of the recogniser, which have to be those too; not compared by default.

    Raises:
        OtherUseError: it is for other viewpoints or classes.
        PolicyError: there is no such card, or it or its weights are damaged.
    """
    card, weights = read_policy_card(path), path.with_suffix(".onnx")
    if not isinstance(sphere, ViewSphere) or (card.elevations, card.azimuths) != (sphere.elevations, sphere.azimuths):
        rings = len(card.elevations)
        raise OtherUseError(f"{path}: was learned for {rings} rings of {card.azimuths} views, not for this sphere")
    if classes is not None and card.classes != tuple(classes):
        raise OtherUseError(f"{path}: was learned for other classes ({', '.join(card.classes)})")
    try:
        return card.make(sphere, weights)
    except (ModelError, PolicyError) as error:
        named = str(error).startswith(f"{weights}")
        raise PolicyError(f"{error}" if named else f"{path}: not a policy card ({error})") from None
