"""A small dataset folder for a quick run of the workflow: the first meshes of each class, or box
furniture.

    python workflow/sample.py OUT --objects 3 [--meshes path/to/ModelNet10]

Writes OUT/CLASS/train|test/NAME.off, so many in each. Without a dataset, chairs, tables and
monitors are built of boxes of random sizes.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import numpy as np

from nextview.data.folders import list_dataset
from nextview.data.samples import SAMPLE_MESHES, boxes_mesh
from nextview.geometry.mesh import Mesh

LARGEST = 2_000_000
"""Bytes of a mesh file that is taken: large ones take long and show no more."""


def write_off(path: Path, mesh: Mesh, radius: float) -> None:
    """Write a mesh as an OFF file, so large."""
    lines = ["OFF", f"{len(mesh.vertices)} {len(mesh.faces)} 0"]
    lines += [
        " ".join(map(str, vertex)) for vertex in (radius * mesh.vertices).tolist()
    ]
    lines += [" ".join(map(str, (3, *face))) for face in mesh.faces.tolist()]
    path.write_text("\n".join(lines) + "\n")


def main() -> None:
    """Read the command line and write the folder."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--objects", type=int, required=True)
    parser.add_argument("--meshes", type=Path)
    given = parser.parse_args()

    rng = np.random.default_rng(0)
    taken: dict[tuple[str, str], int] = {}
    for entry in list_dataset(given.meshes) if given.meshes else []:
        place = entry.label, entry.split or "train"
        if taken.get(place, 0) < given.objects and entry.path.stat().st_size < LARGEST:
            taken[place] = taken.get(place, 0) + 1
            folder = given.out.joinpath(*place)
            folder.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(entry.path, folder / entry.path.name)
    for name, build in SAMPLE_MESHES.items() if given.meshes is None else []:
        for split in ("train", "test"):
            folder = given.out / name / split
            folder.mkdir(parents=True, exist_ok=True)
            for k in range(given.objects):
                number = f"{name}_{split}_{k:02}"
                stretch = rng.uniform(0.7, 1.4, 3)
                boxes = [
                    (tuple(np.multiply(a, stretch)), tuple(np.multiply(b, stretch)))
                    for a, b in build()
                ]
                write_off(
                    folder / f"{number}.off",
                    boxes_mesh(boxes, number),
                    rng.uniform(15, 45),
                )


if __name__ == "__main__":
    main()
