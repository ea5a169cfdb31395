"""Check user input where it enters: numbers, points, and plugins."""

import importlib
import os
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from functools import cache
from importlib.util import find_spec
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np

from nextview.errors import (
    MissingExtraError,
    ModelError,
    NextviewError,
    UsageError,
    printable,
)
from nextview.types import Float

EXTRAS = {  # packages by the optional part of the installation that brings them
    "bags": ("lz4", "rosbags"),
    "cluster": ("dask", "distributed"),
    "explore": ("viser", "websockets"),
    "record": ("rerun",),
    "teach": ("fast_simplification", "mapbox_earcut", "networkx"),
}
# an environment variable: set, the whole traceback of a plugin's error is printed too
TRACEBACK = "NEXTVIEW_TRACEBACK"
_NOT_PLUGINS = (
    f"{Path(__file__).parent}{os.sep}",
    "<frozen ",
    *map(sysconfig.get_path, ("stdlib", "purelib")),
)


def needs_packages(
    packages: Sequence[str], wanted: Sequence[str], project: str = "nextview"
) -> str:
    """What to say of missing packages: the end of a sentence that begins with what needs them.

    Args:
        packages: as Python imports them.
        wanted: extras that bring them.
        project: whose extras they are.
    """
    return (
        f"needs the package{'s' * (len(packages) > 1)} {', '.join(packages)}:"
        f" pip install '{project}[{','.join(wanted)}]'"
    )


def missing_extra(
    error: ModuleNotFoundError,
    packages: Mapping[str, tuple[str, ...]] = EXTRAS,
    project: str = "nextview",
) -> str | None:
    """What to install, a sentence; None where the module belongs to no optional part.

    Args:
        error: of an import.
        packages: those of each optional part.
        project: whose parts they are, by its name for pip.
    """
    package = (error.name or "").partition(".")[0]
    extra = next(
        (extra for extra, of_extra in packages.items() if package in of_extra),
        None,
    )
    if extra is None:
        return None
    missing = [one for one in packages[extra] if one == package or not find_spec(one)]
    return f"this {needs_packages(missing, [extra], project)}"


@contextmanager
def extras(
    packages: Mapping[str, tuple[str, ...]] = EXTRAS,
    project: str = "nextview",
) -> Iterator[None]:
    """Stands around imports from optional parts of the installation.

    Args:
        packages: those of each optional part.
        project: whose parts they are, by its name for pip.

    Raises:
        MissingExtraError: such a part is not installed; the sentence says how to install it.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        sentence = missing_extra(error, packages, project)
        if sentence is None:
            raise
        raise MissingExtraError(sentence) from error


def check_extras(*needed: str) -> None:
    """Check that optional parts of the installation are there, before any work.

    Args:
        needed: names of the parts, of EXTRAS.

    Raises:
        MissingExtraError: some are not installed; the sentence says how to install them all.
    """
    missing = {
        package: extra
        for extra in needed
        for package in EXTRAS[extra]
        if find_spec(package) is None
    }
    if missing:
        wanted = sorted({*missing.values()})
        raise MissingExtraError(f"this {needs_packages([*missing], wanted)}")


def one_line(text: str, most: int = 80) -> str:
    r"""A text for a sentence: on one line, at most so long, what cannot be printed escaped.

    >>> print(one_line("a\n  b\x1b[31m"))
    a b\x1b[31m

    Args:
        text: anything.
        most: length in characters.
    """
    text = printable(" ".join(text[: 10 * most].split()))
    return text if len(text) <= most else text[: most - 3] + "..."


def number_of(count: int, noun: str) -> str:
    """Return a count in words: "1 view", "2 views".

    Args:
        count: how many there are.
        noun: its plural ends in s.
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return the known name that is nearest to a wrong one, as the next part of a sentence.

    The text is empty if no name is near.

    Args:
        name: that is not known.
        known: names.
    """
    near = get_close_matches(name, list(known), 1, 0.6)
    return f"; did you mean {near[0]!r}?" if near else ""


def whole(value: Any, what: str, least: int = 0, most: int = 2**31 - 1) -> int:
    """A whole number within limits; UsageError if it is none.

    Args:
        value: what was handed in.
        what: its name in the sentence.
        least: smallest value.
        most: largest value.
    """
    if (
        isinstance(value, bool | np.bool_)
        or not isinstance(value, Integral)
        or not least <= int(value) <= most
    ):
        reach = f"from {least} on" if most == 2**31 - 1 else f"from {least} to {most}"
        raise UsageError(
            f"{what} is a whole number {reach}, not {one_line(repr(value))}"
        )
    return int(value)


def one_of(value: Any, known: Iterable[Any], what: str) -> None:
    """See that a value is one of some; UsageError if it is none, with those that are known.

    Args:
        value: what was handed in.
        known: values that are taken.
        what: its name in the sentence.
    """
    known = list(known)
    if value not in known:
        named = ", ".join(str(one) for one in known if one is not None)
        raise UsageError(f"{what} is one of {named}, not {one_line(repr(value))}")


def number(
    value: Any,
    what: str,
    least: float = -np.inf,
    most: float = np.inf,
    above: float = -np.inf,
) -> float:
    """A finite number within limits, ``above`` the last excluded; UsageError if it is none.

    Args:
        value: what was handed in.
        what: its name in the sentence.
        least: smallest value.
        most: largest value.
        above: the value has to be larger than this.
    """
    fits = isinstance(value, Real) and not isinstance(value, bool | np.bool_)
    if (
        not fits
        or not np.isfinite(float(value))
        or not (least <= value <= most and value > above)
    ):
        reach = []
        if least > -np.inf:
            reach.append(f"of at least {least:g}")
        if above > -np.inf:
            reach.append(f"above {above:g}")
        if most < np.inf:
            reach.append(f"of at most {most:g}")

        raise UsageError(
            f"{what} is a number{' ' if reach else ''}{', '.join(reach)}, not"
            f" {one_line(repr(value))}"
        )
    return float(value)


def check_array(
    what: str,
    values: Any,
    kind: Any,
    shape: tuple[int | None, ...],
) -> None:
    """Check an array that was read from a file of weights.

    Args:
        what: The array in words ("its quantiles"), for the sentence.
        values: The array.
        kind: The kind of its numbers: ``np.floating``, ``np.integer`` or one dtype.
        shape: Its shape; None where any size but zero will do.

    Raises:
        ModelError: it is none, or has other numbers or another shape, or a value is not finite.
    """
    if not isinstance(values, np.ndarray) or not np.issubdtype(values.dtype, kind):
        raise ModelError(f"{what} are no array of the type {kind.__name__}")

    fits = values.ndim == len(shape)
    for wanted, there in zip(shape, values.shape, strict=False):
        fits = fits and (there > 0 if wanted is None else there == wanted)
    if not fits:
        sizes = ", ".join("any" if size is None else str(size) for size in shape)
        raise ModelError(f"{what} have the shape {values.shape}, not ({sizes})")

    if not np.isfinite(values).all():
        raise ModelError(f"{what} are not all finite numbers")


def points(value: Any, what: str) -> Float:
    """Points in space, (N, 3) float64; UsageError if they are none.

    Args:
        value: what was handed in.
        what: its name in the sentence.
    """
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.ndim != 2 or array.shape[1] != 3 or not np.isfinite(array).all():
        raise UsageError(
            f"{what} are points, (N, 3) finite numbers, not {one_line(repr(value))}"
        )
    return array


def plugin(path: str) -> Any:
    """What MODULE:NAME means, seen from the working folder. Raises whatever importing it raises."""
    module, _, name = path.partition(":")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    return getattr(importlib.import_module(module), name)


@cache
def plugins(group: str) -> dict[str, str]:
    """Return the entry points of a group, such as "nextview.policies".

    They are what installed packages add: MODULE:NAME by name.
    """
    from importlib.metadata import entry_points

    return {entry.name: entry.value for entry in entry_points(group=group)}


@contextmanager
def plugin_errors(error: Callable[[str], NextviewError]) -> Iterator[None]:
    """Run a plugin: what it raises, an exit too, becomes one sentence. A Ctrl-C passes.

    ``error`` makes the error from what is said of the exception: its kind, its message, and the
    plugin's last line.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise
    except BaseException as raised:
        if os.environ.get(TRACEBACK):
            traceback.print_exception(raised)

        message = one_line(str(raised), 300)
        text = type(raised).__name__
        text += f": {message}" if message else ""

        frames = [
            f
            for f in traceback.extract_tb(raised.__traceback__)
            if not f.filename.startswith(_NOT_PLUGINS)
        ]
        text += (
            f", at {Path(frames[-1].filename).name}:{frames[-1].lineno}"
            if frames
            else ""
        )
        raise error(text) from raised
