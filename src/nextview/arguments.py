"""Arguments as they should be, or one sentence: whole numbers, numbers, and things of one kind."""

from __future__ import annotations

from numbers import Integral, Real
from pathlib import Path
from types import UnionType
from typing import Any

import numpy as np

from nextview.errors import NextviewError, UsageError


def as_line(value: Any) -> str:
    """What was handed in, for a sentence: in one line and not at length."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else text[:77] + "..."


def whole(value: Any, what: str, least: int = 0, most: int | None = None) -> int:
    """A whole number within limits.

    Raises:
        UsageError: ``what`` is none.
    """
    highest = 2**31 - 1 if most is None else most
    if isinstance(value, bool | np.bool_) or not isinstance(value, Integral) or not least <= int(value) <= highest:
        reach = f"from {least} on" if most is None else f"from {least} to {most}"
        raise UsageError(f"{what} is a whole number {reach}, not {as_line(value)}")
    return int(value)


def number(value: Any, what: str) -> float:
    """A number, perhaps NaN or infinite: its limits are the caller's.

    Raises:
        UsageError: ``what`` is none.
    """
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real) or _too_large(value):
        raise UsageError(f"{what} is a number, not {as_line(value)}")
    return float(value)


def _too_large(value: Any) -> bool:
    """Whether a number is finite, but hardly: what is computed with it would not be."""
    return bool(1e300 < abs(value) < np.inf)


def of_kind(value: Any, kinds: type | UnionType, what: str, error: type[NextviewError] = UsageError) -> None:
    """See that a value is of one of some kinds.

    Args:
        value: handed in.
        kinds: classes.
        what: it is to be, beginning with what it stands for: "the policy is a name".
        error: to raise.

    Raises:
        NextviewError: it is of none of them: an ``error``.
    """
    if not isinstance(value, kinds):
        raise error(f"{what}, not {as_line(value)}")


def regular_file(path: Path, what: str, error: type[NextviewError]) -> None:
    """See that a path names no pipe, which would wait for its writer, and no device, which might never end.

    Args:
        path: of a file, a folder, or of nothing.
        what: it is to be, "a model card".
        error: to raise.

    Raises:
        NextviewError: it names one: an ``error``.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise error(f"{path}: is a pipe or a device, not {what}")
