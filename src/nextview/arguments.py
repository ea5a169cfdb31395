"""Arguments as they should be, or one sentence: whole numbers, numbers, paths, and things of one kind."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable
from functools import wraps
from numbers import Integral, Real
from pathlib import Path
from types import UnionType
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from nextview.errors import NextviewError, UsageError

P = ParamSpec("P")
R = TypeVar("R")


def in_one_line(text: str, most: int = 80) -> str:
    r"""A text for a sentence: in one line, not at length, and what cannot be printed as escapes.

    >>> print(in_one_line("a\n  b\x1b[31m"))
    a b\x1b[31m
    """
    text = " ".join(text[: 10 * most].split())
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return text if len(text) <= most else text[: most - 3] + "..."


def as_line(value: Any) -> str:
    """What was handed in, for a sentence."""
    try:
        return in_one_line(repr(value))
    except Exception:  # a number of thousands of digits, or a class whose __repr__ fails
        return f"a {type(value).__name__}"


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


def places(value: Any, what: str) -> NDArray[np.float64]:
    """Points in space, (N, 3).

    Raises:
        UsageError: ``what`` are none.
    """
    try:
        found = np.asarray(value)
    except (TypeError, ValueError):  # rows of different lengths, or what no array is made of
        found = np.zeros(0)
    if found.ndim != 2 or found.shape[1] != 3 or found.dtype.kind not in "fiu" or not np.isfinite(found).all():
        raise UsageError(f"{what} are points, (N, 3) finite numbers, not {as_line(value)}")
    return found.astype(np.float64, copy=False)


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


def a_path(value: Any, what: str, error: type[NextviewError] = UsageError) -> Path:
    """A path, of something or of nothing.

    Raises:
        NextviewError: ``what`` is none, or one that no file can have: an ``error``.
    """
    of_kind(value, str | os.PathLike, f"{what} is a path", error)
    try:
        path = Path(value)
    except TypeError:  # the path is one of bytes
        raise error(f"{what} is a path in text, not {as_line(value)}") from None
    if "\0" in str(path):
        raise error(f"{what} is a path, and none holds a zero byte as {as_line(value)} does")
    return path


def takes_paths(*names: str, many: tuple[str, ...] = ()) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Let a function take some of its arguments as strings too, and refuse what is no path before it does anything.

    Args:
        names: of arguments that are a path, or may be None where that is the default.
        many: of those that are several.

    Raises:
        UsageError: from the function, where one is no path.
    """

    def taking(function: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(function)

        @wraps(function)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            given = signature.bind(*args, **kwargs)
            for name in (name for name in (*names, *many) if name in given.arguments):
                value, left_out = given.arguments[name], signature.parameters[name].default
                if value is None and left_out is None:
                    continue
                if name in many:
                    of_kind(value, list | tuple, f"{name} are several paths")
                    given.arguments[name] = tuple(a_path(each, f"each of {name}") for each in value)
                else:
                    given.arguments[name] = a_path(value, name)
            return function(*given.args, **given.kwargs)

        return checked

    return taking


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
