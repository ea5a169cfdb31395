"""The bundled recording of a table: simulated depth frames, and the ground truth.

``benchmarks/demo_table.py`` made it.
"""

from pathlib import Path

import msgspec

from nextview.files import read_record

BUNDLED_TABLE = Path(__file__).parent / "bundled/table"
TRUTH_FILE = "truth.json"


class TableTruth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Ground truth of the bundled table.

    Attributes:
        attribution: of the scans.
        seed: of the draw.
        places: middle of each thing in the world, metres, by its name.
        poses: rows of the pose of each thing's scan in the world, metres, by its name.
    """

    attribution: str
    seed: int
    places: dict[str, list[float]]
    poses: dict[str, list[list[float]]]


def table_truth() -> TableTruth:
    """Return the ground truth of the bundled table."""
    return read_record(BUNDLED_TABLE / TRUTH_FILE, TableTruth, "ground truth")
