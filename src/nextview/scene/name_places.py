"""Place labels in a figure with as little overlap as possible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nextview.types import Float

LETTER_WIDTH = 0.56  # average width of a letter, as a share of the font size
LINE_HEIGHT = 1.25  # as a share of the font size
NAME_GAP = 0.3  # between an object and its name, as a share of the line height
OTHER_OBJECT = 0.35  # cost of covering an object, where covering a name costs 1
AWAY = 0.02  # cost of each place later in the list of candidates
OUTSIDE = 4.0  # cost of a label outside the figure


@dataclass(frozen=True)
class Labelled:
    """An object with a label.

    Attributes:
        name: text.
        low: least x and y of the object in the figure, (2,).
        high: greatest x and y.
    """

    name: str
    low: Float
    high: Float


def name_places(
    objects: Sequence[Labelled],
    low: Float,
    high: Float,
    font: float,
    inside: bool = False,
) -> list[tuple[float, float]]:
    """Place the names of objects in their middle, above, below or beside them.

    Args:
        objects: with extents in the units of the figure.
        low: least x and y of the figure, (2,).
        high: greatest x and y.
        font: font size in the units of the figure.
        inside: whether a name may cover its own object.

    Returns:
        The centre of each name, x and y.
    """
    line = LINE_HEIGHT * font
    taken: list[tuple[Float, Float]] = []
    found: dict[int, tuple[float, float]] = {}
    order = sorted(range(len(objects)), key=lambda row: -len(objects[row].name))

    for row in order:
        thing = objects[row]
        half = np.array([LETTER_WIDTH * font * len(thing.name), line]) / 2
        best = None

        for rank, place in enumerate(_candidates(thing, half, line, inside)):
            box = place - half, place + half
            cost = AWAY * rank
            cost += sum(_overlap(box, other) for other in taken)
            cost += OTHER_OBJECT * sum(
                _overlap(box, (other.low, other.high))
                for other in objects
                if other is not thing
            )
            cost += OUTSIDE * (1 - _overlap(box, (low, high)))
            if best is None or cost < best[0] - 1e-9:
                best = cost, place

        assert best is not None
        place = np.clip(best[1], low + half, high - half)
        taken.append((place - half, place + half))
        found[row] = float(place[0]), float(place[1])
    return [found[row] for row in range(len(objects))]


def _candidates(thing: Labelled, half: Float, line: float, inside: bool) -> list[Float]:
    """Return candidate centres of a name, the best first; y may point up or down."""
    middle = (thing.low + thing.high) / 2
    reach = (thing.high - thing.low) / 2 + half + NAME_GAP * line
    near = [middle] if inside else []
    for further in (0.0, line):
        up = np.array([0.0, reach[1] + further])
        aside = np.array([reach[0] + further, 0.0])
        lean = np.array([reach[0] / 2, 0.0])
        near += [middle - up, middle + up, middle + aside, middle - aside]
        near += [middle - up + lean, middle - up - lean]
        near += [middle + up + lean, middle + up - lean]
    return near


def _overlap(one: tuple[Float, Float], other: tuple[Float, Float]) -> float:
    """Return the share of a box, given by its lowest and highest corner, inside another box."""
    sides = np.minimum(one[1], other[1]) - np.maximum(one[0], other[0])
    area = float(np.prod(one[1] - one[0]))
    return float(np.prod(np.maximum(sides, 0.0))) / area
