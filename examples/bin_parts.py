"""Five machine parts for picking from a bin; generated, so they are free of any rights (CC0).

python examples/bin_parts.py PARTS          # five STL files in millimetres; needs nextview-lab
nextview learn PARTS taught --unit mm       # needs nextview[teach]

Each part is a union of convex pieces with holes. A physics engine uses the pieces; the meshes that
are taught and seen have the holes, too. No finger of a gripper fits into a hole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
import tyro
from scipy.spatial.transform import Rotation

from nextview.cli.exit_status import orderly_end
from nextview.files import new_folder
from nextview_lab.worlds.solids import Solid, extruded, joined, moved, ring_points

ROUND = 48  # sides of a cylinder


@dataclass(frozen=True, eq=False)
class BinPart:
    """A machine part.

    Attributes:
        solid: vertices, (V, 3), millimetres, and triangles, (F, 3).
        pieces: convex solids whose union it is, without the holes.
    """

    solid: Solid
    pieces: tuple[Solid, ...]


def rectangle(left: float, low: float, right: float, high: float) -> np.ndarray:
    """Corners of a rectangle, (4, 2)."""
    return np.array([[left, low], [right, low], [right, high], [left, high]])


def part_of(layers: Sequence[tuple[Sequence[np.ndarray], float, float]]) -> BinPart:
    """Stack extruded outlines.

    Args:
        layers: outline and holes, (N, 2) each, the height of its underside, and its thickness.
    """
    solids = [
        moved(extruded(rings, thick), by=(0, 0, low)) for rings, low, thick in layers
    ]
    pieces = [
        moved(extruded(rings[:1], thick), by=(0, 0, low))
        for rings, low, thick in layers
    ]
    return BinPart(joined(solids), tuple(pieces))


def bin_parts() -> dict[str, BinPart]:
    """The five parts by their names."""
    bolts = [
        ring_points(3.5, 16, (21.5 * np.cos(angle), 21.5 * np.sin(angle)))
        for angle in np.arange(4) / 4 * 2 * np.pi
    ]
    bore = ring_points(8, 32)
    flange = part_of(
        [
            ([ring_points(28, ROUND), bore, *bolts], 0, 10),
            ([ring_points(15, ROUND), bore], 10, 16),
        ]
    )
    shaft = part_of(
        [
            ([ring_points(9, ROUND)], 0, 22),
            ([ring_points(14, ROUND)], 22, 12),
            ([ring_points(9, ROUND)], 34, 40),
        ]
    )
    bolt = part_of([([ring_points(15, 6)], 0, 12), ([ring_points(8, ROUND)], 12, 45)])

    holes = [ring_points(3.5, 16, (36, 10)), ring_points(3.5, 16, (36, 24))]
    flat = extruded([rectangle(0, 0, 50, 34), *holes], 7)
    upright = extruded([rectangle(0, 0, 7, 34)], 33)
    upright = moved(upright, by=(0, 0, 7))
    plain = extruded([rectangle(0, 0, 50, 34)], 7)
    bracket = BinPart(joined([flat, upright]), (plain, upright))

    feet = [ring_points(3.5, 16, (-27, 0)), ring_points(3.5, 16, (27, 0))]
    base = extruded([rectangle(-35, -13, 35, 13), *feet], 10)
    side = Rotation.from_euler("x", 90, degrees=True)
    house = [rectangle(-17, 10, 17, 38), ring_points(9, 32, (0, 25))]
    boss = moved(extruded(house, 26), side, (0, 13, 0))
    block = BinPart(
        joined([base, boss]),
        (
            extruded([rectangle(-35, -13, 35, 13)], 10),
            moved(extruded(house[:1], 26), side, (0, 13, 0)),
        ),
    )
    return {
        "bearing_block": block,
        "bracket": bracket,
        "flange": flange,
        "hex_bolt": bolt,
        "stepped_shaft": shaft,
    }


def write_parts(folder: Path) -> None:
    """Write the meshes of all parts, STL files in millimetres.

    Args:
        folder: that is written; an empty one may be there.

    Raises:
        ResultsError: the folder holds files, or cannot be written.
    """
    with new_folder(folder) as written:
        for name, part in bin_parts().items():
            mesh = trimesh.Trimesh(*part.solid, process=False)
            mesh.export(written / f"{name}.stl")


def main(folder: tyro.conf.Positional[Path]) -> None:
    """Write the meshes.

    Args:
        folder: of the meshes.
    """
    write_parts(folder)
    print(f"{len(bin_parts())} parts in {folder}, in millimetres")


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
