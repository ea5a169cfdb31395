"""What the attributes of a view store have to be, and the checksum that they carry."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from nextview.data.folders import SPLITS
from nextview.errors import DatasetError
from nextview.mesh import UNITS

FORMAT = 2
CHECKSUM = "checksum"


def checksum(attributes: Mapping[str, Any]) -> str:
    """SHA-256 of the attributes but the checksum itself, as JSON with sorted keys, in hexadecimal."""
    kept = {key: value for key, value in attributes.items() if key != CHECKSUM}
    return hashlib.sha256(json.dumps(kept, sort_keys=True).encode()).hexdigest()


def validate(attributes: Mapping[str, Any]) -> None:
    """Make sure that the attributes of a store are what the rest of nextview takes them for.

    Stores of earlier versions may lack those that came later: failures, seed, stretch, turn, sha256, unit,
    dataset, commands, checksum. Only those rendered through a sensor have one, only those of worlds a scene.

    Raises:
        DatasetError: which of them is missing, or is not what it has to be; or they do not have their checksum.
    """
    for key, rule in RULES.items():
        if key not in attributes:
            if rule.required:
                raise DatasetError(f"the attribute {key} is missing")
        elif not rule.fits(attributes[key]):
            raise DatasetError(f"the attribute {key} is not {rule.wanted}")
    names = attributes["names"]
    for key in ("labels", "splits", "sha256"):
        if key in attributes and len(attributes[key]) != len(names):
            raise DatasetError(f"the attribute {key} is of {len(attributes[key])} objects, names of {len(names)}")
    strange = sorted(set(attributes.get("failures", {})) - set(names))
    if strange:
        raise DatasetError(f"the attribute failures names {strange[0]!r}, which is no object")
    if CHECKSUM in attributes and attributes[CHECKSUM] != checksum(attributes):
        raise DatasetError("the attributes do not have their checksum")


def restored(file: Path, known: dict[str, Any], unit: str | None, dataset: str) -> dict[str, Any] | None:
    """The damaged attributes of a store as they were written; None if that is not sure.

    It is sure if the checksum says so, or if none of the known ones was damaged. In the latter case others that are no
    longer what they have to be are begun anew: the failures, which rendering finds again, the commands, the unit and
    the name of the dataset.

    Args:
        file: the zarr.json that holds them, or what is left of it.
        known: those that are known from elsewhere.
        unit: the unit if the file does not tell.
        dataset: the name of the mesh folder if the file does not tell.
    """
    attributes = _legible(file)
    mended = {key: value for key, value in attributes.items() if key in RULES} | known
    others: dict[str, list[Any]] = {"failures": [{}], "commands": [[]], "dataset": [dataset], "unit": [unit, *UNITS]}
    legible = [[mended[key]] if key in mended and RULES[key].fits(mended[key]) else [] for key in others]
    choices = [first + rest for first, rest in zip(legible, others.values(), strict=True)]
    for values in product(*choices):
        found = mended | dict(zip(others, values, strict=True))
        if checksum(found) == attributes.get(CHECKSUM):
            return found
    if any(key not in attributes or attributes[key] != value for key, value in known.items()):
        return None
    mended |= dict(zip(others, (choice[0] for choice in choices), strict=True))
    return mended | {CHECKSUM: checksum(mended)}


def _legible(file: Path) -> dict[str, Any]:
    """The attributes that can still be read, each for itself."""
    text = file.read_bytes().decode(errors="replace")
    found = {}
    for key in RULES:
        place = re.search(rf'"{key}"\s*:\s*', text)
        if place:
            with suppress(ValueError):
                found[key] = json.JSONDecoder().raw_decode(text, place.end())[0]
    return found


def _number(value: Any, low: float, high: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


def _whole(value: Any, low: int, high: int) -> bool:
    return isinstance(value, int) and _number(value, low, high)


def _texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(text, str) for text in value)


class Rule(NamedTuple):
    """What an attribute has to be.

    Attributes:
        fits: whether a value will do.
        wanted: the same in words.
        required: whether it has to be there.
    """

    fits: Callable[[Any], bool]
    wanted: str
    required: bool = True


WIDEST, MOST, LARGEST = 100_000, 2**63 - 1, 1e300
RULES = {
    "format": Rule(lambda v: v == FORMAT, f"{FORMAT}"),
    "names": Rule(lambda v: _texts(v) and 0 < len(v) == len(set(v)) and all(v), "a list of different names"),
    "labels": Rule(lambda v: _texts(v) and all(v), "a list of names of classes"),
    "splits": Rule(lambda v: _texts(v) and set(v) <= {*SPLITS, ""}, f"a list of {', '.join(SPLITS)} or nothing"),
    "elevations": Rule(
        lambda v: isinstance(v, list) and len(v) > 0 and all(_number(e, -90, 90) for e in v),
        "a list of angles from -90 to 90 degrees",
    ),
    "azimuths": Rule(lambda v: _whole(v, 3, WIDEST), f"a whole number from 3 to {WIDEST}"),
    "distance": Rule(lambda v: _number(v, math.nextafter(1, 2), LARGEST), "a finite number greater than 1"),
    "size": Rule(lambda v: _whole(v, 1, WIDEST), f"a whole number from 1 to {WIDEST}"),
    "failures": Rule(lambda v: isinstance(v, dict) and _texts(list(v.values())), "a reason for each name", False),
    "seed": Rule(lambda v: _whole(v, 0, MOST), "a whole number from 0", False),
    "stretch": Rule(lambda v: _number(v, 0, LARGEST), "a finite number from 0", False),
    "turn": Rule(lambda v: isinstance(v, bool), "true or false", False),
    "sensor": Rule(lambda v: isinstance(v, dict) and isinstance(v.get("name"), str), "a sensor", False),
    "scene": Rule(lambda v: _whole(v, 1, WIDEST), f"a whole number from 1 to {WIDEST}", False),
    "sha256": Rule(_texts, "a list of hashes", False),
    "unit": Rule(lambda v: v is None or (isinstance(v, str) and v in UNITS), f"one of {', '.join(UNITS)}", False),
    "dataset": Rule(lambda v: isinstance(v, str), "the name of the mesh folder", False),
    "commands": Rule(_texts, "a list of commands", False),
    CHECKSUM: Rule(lambda v: isinstance(v, str), "a hash", False),
}
