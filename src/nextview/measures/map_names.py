"""What the map of a measure is called. Apart from the measures themselves: who only follows a map imports none."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

Good = Literal["peak", "valley"]
"""Where a measure's map has the better views: at its highest values or its lowest."""

CONFIDENCE = "confidence"
"""The recogniser's confidence where it is right, as a measure of views; it takes predictions instead of views, see
``confidence_map``."""

LEM, LCM = "lem", "lcm"
MAP_NAMES = {"depth_entropy": LEM, CONFIDENCE: LCM}
"""The maps of two measures have names of their own, the thesis's; those of all others are called as the measure."""

SPHERE = "-sphere"
"""How the name of a map of the whole sphere ends; without this it is that of the map of the local window."""


def map_name(measure: str) -> str:
    """What the map of a measure is called in cards, predictions and policies."""
    return MAP_NAMES.get(measure, measure)


def measure_of(name: str) -> str:
    """The measure whose map is called so."""
    return next((measure for measure, own in MAP_NAMES.items() if own == name), name)


def in_order(maps: Iterable[str]) -> list[str]:
    """Names of maps, each once, in the order in which networks take them and tables show them.

    Those of local windows stand before those of whole spheres; of each kind the ones with names of their own come first
    (see MAP_NAMES), then the others by the alphabet.
    """
    own = list(MAP_NAMES.values())

    def place(name: str) -> tuple[bool, int, str]:
        window = name.removesuffix(SPHERE)
        return window != name, own.index(window) if window in own else len(own), window

    return sorted(set(maps), key=place)
