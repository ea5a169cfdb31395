"""What the attributes of a view store have to be, and the checksum that they carry."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from typing import Any

from nextview.data.folders import SPLITS
from nextview.errors import DatasetError
from nextview.mesh import UNITS

CHECKSUM = "checksum"


def checksum(attributes: Mapping[str, Any]) -> str:
    """SHA-256 of the attributes but the checksum itself, as JSON with sorted keys, in hexadecimal."""
    kept = {key: value for key, value in attributes.items() if key != CHECKSUM}
    return hashlib.sha256(json.dumps(kept, sort_keys=True).encode()).hexdigest()


def validate(attributes: Mapping[str, Any]) -> None:
    """Make sure that the attributes of a store are what the rest of nextview takes them for.

    Stores of earlier versions may lack those that came later: failures, seed, stretch, turn, sha256, unit, checksum.

    Raises:
        DatasetError: which of them is missing, or is not what it has to be; or they do not have their checksum.
    """
    for key, (required, fits, wanted) in RULES.items():
        if key not in attributes:
            if required:
                raise DatasetError(f"the attribute {key} is missing")
        elif not fits(attributes[key]):
            raise DatasetError(f"the attribute {key} is not {wanted}")
    names = attributes["names"]
    for key in ("labels", "splits", "sha256"):
        if key in attributes and len(attributes[key]) != len(names):
            raise DatasetError(f"the attribute {key} is of {len(attributes[key])} objects, names of {len(names)}")
    strange = sorted(set(attributes.get("failures", {})) - set(names))
    if strange:
        raise DatasetError(f"the attribute failures names {strange[0]!r}, which is no object")
    if CHECKSUM in attributes and attributes[CHECKSUM] != checksum(attributes):
        raise DatasetError("the attributes do not have their checksum")


def restored(attributes: Mapping[str, Any], known: Mapping[str, Any], unit: str | None) -> dict[str, Any] | None:
    """Damaged attributes as they were written, from those that are known otherwise; None if that is not sure.

    It is sure if the result has the checksum, or if none of the known ones was damaged. In the latter case reasons for
    failures are forgotten, and the unit is that of the store if it is one, else the one given.
    """
    mended: dict[str, Any] = {k: v for k, v in attributes.items() if k in RULES or k == "format"}
    mended |= known
    reasons: list[Any] = [mended.get("failures"), {}]
    for failures in reasons:
        for tried in (mended.get("unit"), None, *UNITS):
            found = mended | {"failures": failures, "unit": tried}
            if checksum(found) == attributes.get(CHECKSUM):
                return found
    if any(key not in attributes or attributes[key] != value for key, value in known.items()):
        return None
    fits = RULES["unit"][1](mended.get("unit"))
    mended |= {"failures": {}, "unit": mended.get("unit") if fits else unit}
    return mended | {CHECKSUM: checksum(mended)}


def _number(value: Any, low: float, high: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


def _whole(value: Any, low: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= low


def _texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(text, str) for text in value)


LARGEST = 1e300
RULES: dict[str, tuple[bool, Callable[[Any], bool], str]] = {
    "names": (True, lambda v: _texts(v) and 0 < len(v) == len(set(v)) and all(v), "a list of different names"),
    "labels": (True, lambda v: _texts(v) and all(v), "a list of names of classes"),
    "splits": (True, lambda v: _texts(v) and set(v) <= {*SPLITS, ""}, f"a list of {', '.join(SPLITS)} or nothing"),
    "elevations": (
        True,
        lambda v: isinstance(v, list) and len(v) > 0 and all(_number(e, -90, 90) for e in v),
        "a list of angles from -90 to 90 degrees",
    ),
    "azimuths": (True, lambda v: _whole(v, 3), "a whole number from 3"),
    "distance": (True, lambda v: _number(v, math.nextafter(1, 2), LARGEST), "a finite number greater than 1"),
    "size": (True, lambda v: _whole(v, 1), "a whole number from 1"),
    "failures": (False, lambda v: isinstance(v, dict) and _texts(list(v.values())), "a reason for each name"),
    "seed": (False, lambda v: _whole(v, 0), "a whole number from 0"),
    "stretch": (False, lambda v: _number(v, 0, LARGEST), "a finite number from 0"),
    "turn": (False, lambda v: isinstance(v, bool), "true or false"),
    "sha256": (False, _texts, "a list of hashes"),
    "unit": (False, lambda v: v is None or (isinstance(v, str) and v in UNITS), f"one of {', '.join(UNITS)}"),
    "dataset": (False, lambda v: isinstance(v, str), "the name of the mesh folder"),
    "commands": (False, _texts, "a list of commands"),
    CHECKSUM: (False, lambda v: isinstance(v, str), "a hash"),
}
"""Of each attribute: whether it has to be there, whether a value will do, and what it has to be, in words."""
