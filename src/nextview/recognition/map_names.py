"""Names of the maps of measures, in cards, predictions and policies."""

from collections.abc import Iterable, Sequence
from typing import Literal

# where a measure's map has the better views: at its highest values or its lowest
Good = Literal["peak", "valley"]
# a measure of views: that of the recogniser where it is right; of predictions
CONFIDENCE = "confidence"
LEM = "lem"
LCM = "lcm"
# the thesis's; all others are called as their measure
MAP_NAMES = {"depth_entropy": LEM, CONFIDENCE: LCM}
# how the name of a map of the whole sphere ends; without this it is the map of the local window
SPHERE_SUFFIX = "-sphere"
# what else a policy may need
NO_MAPS = ("azimuth_bins", "observations", "outlook", "visibility")


def map_name(measure: str) -> str:
    """The name of the map of a measure."""
    return MAP_NAMES.get(measure, measure)


def measure_of(name: str) -> str:
    """The measure of the map of this name."""
    return next((measure for measure, own in MAP_NAMES.items() if own == name), name)


def maps_among(needs: Sequence[str]) -> list[str]:
    """Those of a policy's needs that are maps."""
    return [name for name in needs if name not in NO_MAPS]


def in_order(maps: Iterable[str]) -> list[str]:
    """Sort names of maps: local windows first, those of the thesis first, then by name.

    Each occurs once.
    """
    own = list(MAP_NAMES.values())

    def place(name: str) -> tuple[bool, int, str]:
        window = name.removesuffix(SPHERE_SUFFIX)
        return window != name, own.index(window) if window in own else len(own), window

    return sorted(set(maps), key=place)
