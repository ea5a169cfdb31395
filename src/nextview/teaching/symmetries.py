"""Symmetries that a user specifies, such as ``flange=z:6``, instead of detected ones."""

from collections.abc import Sequence

import numpy as np

from nextview.checks import one_line
from nextview.errors import UsageError
from nextview.recognition.model_card import LARGEST_ORDER, Symmetry

NO_SYMMETRY = "none"  # value for a thing without symmetries
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
EVERY_TURN = tuple(Symmetry(axis, 0) for axis in AXES.values())
HOW = (
    "NAME=none, NAME=ball, or NAME=AXIS:ORDER,... where AXIS is x, y, z or three numbers such as"
    " 1/0/1, in the axes of the file; without an order any angle is meant"
)


def named_symmetries(given: Sequence[str]) -> dict[str, tuple[Symmetry, ...]]:
    """Parse specifications of symmetries.

    Args:
        given: one specification for each thing, ``NAME=none``, ``NAME=ball`` or
            ``NAME=AXIS:ORDER,...`` of each thing, such as ``flange=z:6`` or ``can=z,x:2``.

    Returns:
        The symmetries of each thing by its name.

    Raises:
        UsageError: a specification is invalid, or two name the same thing.
    """
    found: dict[str, tuple[Symmetry, ...]] = {}
    for text in given:
        name, equals, symmetries = text.rpartition("=")
        if not equals or not name:
            raise UsageError(f"a symmetry is {HOW}, not {one_line(repr(text))}")
        if name in found:
            raise UsageError(f"the symmetries of {one_line(name)} are given twice")
        if symmetries == NO_SYMMETRY:
            found[name] = ()
        elif symmetries == "ball":
            found[name] = EVERY_TURN
        else:
            found[name] = tuple(_read(part, text) for part in symmetries.split(","))
    return found


def _read(part: str, text: str) -> Symmetry:
    """Parse one symmetry, AXIS or AXIS:ORDER; ``text`` is the whole input, for error messages."""
    axis, colon, order = part.partition(":")
    try:
        x, y, z = AXES[axis] if axis in AXES else map(float, axis.split("/"))
        turns = int(order) if colon else 0
        length = float(np.linalg.norm((x, y, z)))
    except ValueError:
        length = np.nan
    if not 0 < length < np.inf or (colon and not 2 <= turns <= LARGEST_ORDER):
        raise UsageError(f"a symmetry is {HOW}, not {one_line(repr(text))}")
    return Symmetry((x / length, y / length, z / length), turns)
