"""Where names are written in a picture, so that they cover each other and the objects least."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nextview.types import Float

LETTER_WIDTH = 0.56  # of the font size, of a letter on average
LINE_HEIGHT = 1.25  # of the font size
NAME_GAP = 0.3  # of the line's height, between an object and its name
OTHER_OBJECT = 0.35  # cost of covering an object, beside 1 for covering a name
AWAY = 0.02  # cost of each later place
OUTSIDE = 4.0  # cost of lying outside of the picture


@dataclass(frozen=True)
class Labelled:
    """An object that gets a name.

    Attributes:
        name: text.
        low: least x and y of the object in the picture, (2,).
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
    """Place the names of objects: in the middle, above, below or beside.

    Args:
        objects: with extents in the units of the picture.
        low: least x and y of the picture, (2,).
        high: greatest x and y.
        font: size of the letters in the units of the picture.
        inside: whether a name may be written over its own object.

    Returns:
        The middle of each name, x and y.
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
                best = cost, place, box

        assert best is not None
        taken.append(best[2])
        found[row] = float(best[1][0]), float(best[1][1])
    return [found[row] for row in range(len(objects))]


def _candidates(thing: Labelled, half: Float, line: float, inside: bool) -> list[Float]:
    """Places of the middle of a name, the best first; y may point up or down."""
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
    """Share of a box, given by its lowest and highest corner, that lies in another one."""
    sides = np.minimum(one[1], other[1]) - np.maximum(one[0], other[0])
    area = float(np.prod(one[1] - one[0]))
    return float(np.prod(np.maximum(sides, 0.0))) / area
