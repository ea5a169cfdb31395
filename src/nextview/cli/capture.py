"""``nextview capture``: write what a depth camera would capture of a mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro

from nextview.cli.recognise import Unit
from nextview.mesh_format import MAX_FACES


def capture(
    mesh: tyro.conf.Positional[Path],
    folder: tyro.conf.Positional[Path],
    /,
    layout: Literal["bop", "tum", "7scenes"] = "bop",
    viewpoints: Literal["40", "12"] = "40",
    table: bool = False,
    masks: bool = False,
    radius: float | None = None,
    distance: float = 3.0,
    jitter: float = 0.0,
    up: Literal["y", "z"] | None = None,
    unit: Unit | None = None,
    max_faces: int = MAX_FACES,
    seed: int = 0,
) -> None:
    """Write captured views of a mesh: depth images, poses and intrinsics, as ``nextview recognise FOLDER`` reads them.

    Args:
        mesh: OFF, OBJ, PLY, STL or GLB file of one object that stands upright.
        folder: where to; it must not be there yet, or be empty. It is whole or not there at all.
        layout: of the files: the BOP challenge's, TUM RGB-D's or 7-Scenes'.
        viewpoints: from where it is captured, as in nextview recognise.
        table: the object stands on a table, which is seen too.
        masks: write masks of the object also with --table. Without a table they are always written.
        radius: object radius, metres, if the file's unit does not tell.
        distance: of the camera from the object's centre, object radii.
        jitter: standard deviation of the camera's direction from the viewpoint's, degrees.
        up: the file's up axis; z if not given, but y for GLB.
        unit: the file's unit of length.
        max_faces: refuse a mesh of more triangles, or a file of more than 60 bytes for each of these.
        seed: decides the jitter.
    """
    import numpy as np

    from nextview.cameras.capturing import Setting, write_capture
    from nextview.cli.progress import console, track
    from nextview.errors import UsageError
    from nextview.mesh import load_mesh
    from nextview.outputs import check_new_folder
    from nextview.viewsphere import ViewSphere

    check_new_folder(folder)
    loaded = load_mesh(mesh, up, unit, max_faces)
    metres = loaded.metres if radius is None else radius
    if metres is None:
        raise UsageError(f"{mesh}: how large is it? Give the file's --unit or the object's --radius in metres")
    setting = Setting(metres, distance, table, masks or not table, jitter)
    sphere = ViewSphere.named(viewpoints)
    frames = write_capture(loaded, folder, layout, sphere, setting, np.random.default_rng(seed))
    track(frames, len(sphere), f"capturing {mesh.name}")
    console.print(f"{folder}: {len(sphere)} views; look at them with: nextview recognise {folder}", highlight=False)
