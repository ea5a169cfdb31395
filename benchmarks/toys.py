"""Things of 20 cm from models that have no scale, to teach and to recognise.

    python -m benchmarks.toys PSB princeton --every-second --each 5
    python -m benchmarks.toys ModelNet10 chairs --classes chair --each 50 --split test

Each model is scaled to a diameter of 20 cm, placed on the plane z = 0 and written as PLY in metres
under the name of its file. Models are taken in the order of their names. Those that cannot be read,
and those with more than 60,000 faces, are passed over and printed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
import tyro

from nextview.errors import MeshError, UsageError
from nextview.geometry.mesh import load_mesh

TOY_SIZE = 0.2  # metres, the diagonal of the box around a toy
TOY_FACES = 60_000  # at most


def toy(path: Path) -> trimesh.Trimesh:
    """The model in a file as a toy on the plane z = 0.

    Args:
        path: of the mesh.

    Raises:
        MeshError: it cannot be read, or has too many faces.
    """
    mesh = load_mesh(path)
    if len(mesh.faces) > TOY_FACES:
        raise MeshError(f"{path}: has {len(mesh.faces):,} faces")

    body = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    body.apply_scale(TOY_SIZE / np.linalg.norm(body.extents))
    low, high = body.bounds
    body.apply_translation((-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]))
    return body


def main(
    models: Path,
    out: Path,
    /,
    classes: tuple[str, ...] = (),
    each: int = 5,
    every_second: bool = False,
    split: str = "",
) -> None:
    """Make the toys.

    Args:
        models: folder with one folder of meshes for each class.
        out: folder of the toys, which is made.
        classes: names of folders; by default all.
        each: models of each class.
        every_second: only every second class, from the second on.
        split: folder inside that of a class, such as "test".

    Raises:
        UsageError: OUT exists, or a class has no models.
    """
    if out.exists():
        raise UsageError(f"{out}: exists already")
    names = classes or tuple(sorted(p.name for p in models.iterdir() if p.is_dir()))
    if every_second:
        names = names[1::2]

    out.mkdir(parents=True)
    for name in names:
        paths = sorted((models / name / split).glob("*.off"))
        if not paths:
            raise UsageError(f"{models / name / split}: holds no OFF files")
        made = 0
        for path in paths:
            if made == each:
                break
            try:
                body = toy(path)
            except MeshError as error:
                print(f"passed over: {error}")
                continue
            stem = path.stem if path.stem.startswith(name) else f"{name}_{path.stem}"
            body.export(out / f"{stem}.ply")
            made += 1
        print(f"{name}: {made}")


if __name__ == "__main__":
    tyro.cli(main)
