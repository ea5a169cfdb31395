"""``nextview capture``: write what a depth camera would capture of a mesh."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from nextview.cli.sources import Unit
from nextview.geometry.mesh import MAX_FACES


@dataclass(frozen=True)
class Captured:
    """How it is captured.

    Attributes:
        table: the object stands on a table, which is seen too.
        masks: write masks of the object also with --table. Without a table they are always written.
        radius: object radius, metres, if the file's unit does not tell.
        distance: of the camera from the object's centre, object radii.
        jitter: standard deviation of the camera's direction from the viewpoint's, degrees.
    """

    table: bool = False
    masks: bool = False
    radius: float | None = None
    distance: float = 3.0
    jitter: float = 0.0


def capture(
    mesh: Path,
    folder: Path,
    /,
    viewpoints: Literal["40", "12"] = "40",
    captured: Captured = Captured(),
    up: Literal["y", "z"] | None = None,
    unit: Unit | None = None,
    max_faces: int = MAX_FACES,
    seed: int = 0,
    overwrite: bool = False,
) -> None:
    """Write captured views of a mesh: depth images, poses, intrinsics, as ``nextview recognise FOLDER`` reads them.

    Args:
        mesh: OFF, OBJ, PLY, STL or GLB file of one object that stands upright.
        folder: to write, in the layout of the BOP challenge; whole or not there at all.
        viewpoints: from where it is captured, as in nextview recognise.
        captured: how it is captured.
        up: the file's up axis; z if not given, but y for GLB.
        unit: the file's unit of length.
        max_faces: refuse a mesh of more triangles, or a file of more than 60 bytes for each of these.
        seed: decides the jitter.
        overwrite: replace the files of an earlier capture.
    """
    import numpy as np

    from nextview.cli.progress import console, track
    from nextview.errors import UsageError
    from nextview.files import check_new
    from nextview.geometry.mesh import load_mesh
    from nextview.geometry.viewsphere import ViewSphere
    from nextview.simulation.capturing import Setting, write_capture

    check_new(folder, overwrite, folder=True)
    loaded = load_mesh(mesh, up, unit, max_faces)
    how, metres = captured, loaded.metres if captured.radius is None else captured.radius
    if metres is None:
        raise UsageError(f"{mesh}: how large is it? Give the file's --unit or the object's --radius in metres")
    setting = Setting(metres, how.distance, how.table, how.masks or not how.table, how.jitter)
    sphere = ViewSphere.named(viewpoints)
    frames = write_capture(loaded, folder, sphere, setting, np.random.default_rng(seed), overwrite)
    track(frames, len(sphere), f"capturing {mesh.name}")
    console.print(f"{folder}: {len(sphere)} views; look at them with: nextview recognise {folder}", highlight=False)
