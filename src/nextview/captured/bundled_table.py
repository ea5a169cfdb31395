"""The bundled recording of a table: simulated depth frames with ground truth.

An earlier script of the repository created it.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from nextview.files import read_record
from nextview.types import Float

BUNDLED_TABLE = Path(__file__).parent / "bundled/table"
TRUTH_FILE = "truth.json"


class TableTruth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Ground truth of the bundled table.

    Attributes:
        attribution: of the scans.
        seed: of the random draw.
        places: centre of each thing in the world, metres, by name.
        poses: rows of the pose of each thing's scan in the world, metres, by name.
    """

    attribution: str
    seed: int
    places: dict[str, list[float]]
    poses: dict[str, list[list[float]]]


def table_truth() -> TableTruth:
    """Return the ground truth of the bundled table."""
    return read_record(BUNDLED_TABLE / TRUTH_FILE, TableTruth, "ground truth")


@dataclass(frozen=True, eq=False)
class NamedPlace:
    """A recognised object with its position.

    Attributes:
        name: None if it is unknown.
        confident: whether the name is confident.
        place: in the world, (3,), metres.
    """

    name: str | None
    confident: bool
    place: Float


def compared_with_truth(
    found: Sequence[NamedPlace],
    known: Collection[str],
) -> list[str]:
    """Describe how many things of the bundled table are named correctly.

    Each object is compared with the nearest true thing; of several objects at one thing the nearest
    counts.

    Args:
        found: the objects.
        known: names of the taught things.

    Returns:
        Sentences.
    """
    places = table_truth().places
    true_places = np.array(list(places.values()))
    nearest: dict[str, tuple[float, NamedPlace]] = {}
    for one in found:
        apart = np.linalg.norm(true_places - one.place, axis=1)
        true = list(places)[int(apart.argmin())]
        if true not in nearest or apart.min() < nearest[true][0]:
            nearest[true] = (float(apart.min()), one)

    right = 0
    wrong = []
    missed = []
    for true in places:
        _, seen = nearest.get(true, (0.0, None))
        name = None if seen is None else seen.name
        if seen is not None and name == (true if true in known else None):
            right += 1
        elif seen is None or name is None:
            missed.append(true)
        else:
            doubt = "" if seen.confident else ", not confident"
            wrong.append(f"{true} (named {name}{doubt})")

    strangers = " and the ".join(name for name in places if name not in known)
    said = [
        f"Ground truth: {right} of {len(places)} are correct. The {strangers} was not taught;"
        " unknown is the correct answer."
    ]
    said += [f"Wrong: {', '.join(wrong)}."] if wrong else []
    said += [f"Not named: {', '.join(missed)}."] if missed else []
    return said
