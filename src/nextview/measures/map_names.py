"""What the map of a measure is called. Apart from the measures themselves: who only follows a map imports none."""

from __future__ import annotations

from typing import Literal

Good = Literal["peak", "valley"]
"""Where a measure's map has the better views: at its highest values or its lowest."""

CONFIDENCE = "confidence"
"""The recogniser's confidence where it is right, as a measure of views; it takes predictions instead of views, see
``confidence_map``."""

MAP_NAMES = {"depth_entropy": "lem", CONFIDENCE: "lcm"}
"""The maps of two measures have names of their own, the thesis's; those of all others are called as the measure."""


def map_name(measure: str) -> str:
    """What the map of a measure is called in cards, predictions and policies."""
    return MAP_NAMES.get(measure, measure)


def measure_of(name: str) -> str:
    """The measure whose map is called so."""
    return next((measure for measure, own in MAP_NAMES.items() if own == name), name)
