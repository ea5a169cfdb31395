"""Read JSON files that people may have written or damaged: every value is checked before anything is made of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import regular_file
from nextview.errors import ModelError

LARGEST = 64 * 2**20
"""Bytes; a card takes some hundred thousand."""
MISSING: Any = object()


def read_object(path: Path, what: str) -> dict[str, Any]:
    """The JSON object in a file.

    Args:
        path: the file.
        what: it should be, "a model card".

    Raises:
        FileNotFoundError: there is no such file.
        ModelError: it cannot be read, is too large, or is not a JSON object.
    """

    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is not a finite number")

    regular_file(path, what, ModelError)
    try:
        if path.stat().st_size > LARGEST:
            raise ModelError(f"{path}: not {what}, which takes {LARGEST >> 20} MB at most")
        values = json.loads(path.read_bytes(), parse_constant=refuse)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ModelError(f"{path}: cannot be read ({error.strerror})") from None
    except RecursionError:
        raise ModelError(f"{path}: not {what} (its JSON is nested too deeply)") from None
    except ModelError:
        raise
    except ValueError as error:
        raise ModelError(f"{path}: not {what} ({error})") from None
    if not isinstance(values, dict):
        raise ModelError(f"{path}: not {what} (it holds no JSON object)")
    return values


class Fields:
    """Takes the fields out of a JSON object one by one and checks each; a field that nobody takes is refused.

    Every method takes the name of a field and what it is if it is not there; without that it has to be there.

    Args:
        values: the object.
        what: it is, for messages.

    Raises:
        ModelError: it is no object; and in every method, the field is missing or not of that type.
    """

    def __init__(self, values: Any, what: str) -> None:
        if not isinstance(values, dict):
            raise ModelError(f"{what} is not a JSON object")
        self._left, self.what = dict(values), what

    def take(self, name: str, default: Any = MISSING) -> Any:
        """The value as it is."""
        if name not in self._left and default is MISSING:
            raise ModelError(f"{self.what} lacks {name!r}")
        return self._left.pop(name, default)

    def wrong(self, name: str, wanted: str) -> ModelError:
        """The error that says what a field should be."""
        return ModelError(f"{name!r} of {self.what} is not {wanted}")

    def text(self, name: str, default: Any = MISSING) -> str:
        """A string."""
        value = self.take(name, default)
        if value is not default and not isinstance(value, str):
            raise self.wrong(name, "a string")
        return value

    def one_of(self, name: str, choices: tuple[str, ...], default: Any = MISSING) -> Any:
        """One of some strings."""
        value = self.take(name, default)
        if value is not default and value not in choices:
            raise self.wrong(name, f"one of {', '.join(choices)}")
        return value

    def whole(self, name: str, default: Any = MISSING, least: int = 0) -> int:
        """A whole number of at least ``least``."""
        value = self.take(name, default)
        if value is default:
            return value
        if isinstance(value, bool) or not isinstance(value, int) or not least <= value < 2**31:
            raise self.wrong(name, f"a whole number from {least} on")
        return value

    def number(self, name: str, default: Any = MISSING) -> float:
        """A finite number."""
        value = self.take(name, default)
        return value if value is default else float(self._array(name, value, 0))

    def numbers(self, name: str, dimensions: int, default: Any = MISSING) -> NDArray[np.float64]:
        """Nested lists of finite numbers, as an array of so many dimensions."""
        value = self.take(name, default)
        return value if value is default else self._array(name, value, dimensions)

    def _array(self, name: str, value: Any, dimensions: int) -> NDArray[np.float64]:
        try:
            found = np.asarray(value)
            fits = found.dtype.kind in "iuf" and found.ndim == dimensions and bool(np.isfinite(found).all())
        except (ValueError, OverflowError):  # lists of unequal length
            fits = False
        if not fits:
            shape = ("a finite number", "a list of finite numbers")
            raise self.wrong(
                name, shape[dimensions] if dimensions < 2 else f"a {dimensions}-dimensional table of numbers"
            )
        return found.astype(np.float64)

    def texts(self, name: str, default: Any = MISSING, unique: bool = False) -> tuple[str, ...]:
        """A list of strings."""
        value = self.take(name, default)
        if value is default:
            return value
        if not isinstance(value, list) or not all(isinstance(each, str) for each in value):
            raise self.wrong(name, "a list of strings")
        if unique and len(set(value)) < len(value):
            raise self.wrong(name, "a list of different strings")
        return tuple(value)

    def mapping(self, name: str, default: Any = MISSING) -> dict[str, Any]:
        """An object, every number in it finite; {} for one that is not there."""
        value = self.take(name, default)
        if not isinstance(value, dict):
            raise self.wrong(name, "a JSON object")
        _check_finite(value, f"{name!r} of {self.what}")
        return value

    def sha256(self, name: str, default: Any = MISSING) -> str:
        """A SHA-256 in lower-case hexadecimal."""
        value = self.take(name, default)
        if value is default:
            return value
        if not isinstance(value, str) or len(value) != 64 or set(value) - set("0123456789abcdef"):
            raise self.wrong(name, "a SHA-256 in 64 hexadecimal digits")
        return value

    def schema(self, *known: int) -> int:
        """The schema version of an object; refuse one that is not known."""
        version = self.take("schema", None)
        if version not in known or isinstance(version, bool):
            reads = " and ".join(map(str, known))
            raise ModelError(f"{self.what} is of schema {version!r}, and this version of nextview reads schema {reads}")
        return int(version)

    def end(self) -> None:
        """Refuse what was not taken."""
        if self._left:
            raise ModelError(f"{self.what} says {min(self._left)!r}, which this version of nextview does not know")


def _check_finite(value: Any, what: str) -> None:
    if isinstance(value, dict):
        for each in value.values():
            _check_finite(each, what)
    elif isinstance(value, list):
        for each in value:
            _check_finite(each, what)
    elif isinstance(value, float) and not np.isfinite(value):
        raise ModelError(f"{what} holds a number that is not finite")
