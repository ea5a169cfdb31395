"""``nextview-lab capture``: write depth images of a mesh."""

from pathlib import Path
from typing import Literal

from nextview.cli.common_options import Unit
from nextview.cli.progress import console, track
from nextview.errors import UsageError
from nextview.files import check_new
from nextview.geometry.mesh import MAX_FACES, load_mesh
from nextview.geometry.viewsphere import ViewSphere


def capture(
    mesh: Path,
    out: Path,
    /,
    viewpoints: Literal["40", "12"] = "40",
    table: bool = False,
    radius: float | None = None,
    up: Literal["y", "z"] | None = None,
    unit: Unit | None = None,
    max_faces: int = MAX_FACES,
    largest_part: bool = False,
    overwrite: bool = False,
) -> None:
    """Write rendered depth images of a mesh, with poses and intrinsics.

    Use it to try nextview recognise FOLDER, or as an example of the BOP layout.

    Args:
        mesh: OFF, OBJ, PLY, STL or GLB file of one upright object.
        out: folder to write, in the layout of the BOP challenge.
        viewpoints: number of viewpoints.
        table: place the object on a visible table; without a table, object masks are written.
        radius: object radius, metres, if the unit of the file is not known.
        up: up axis of the file; by default z, and y for GLB.
        unit: unit of length of the file.
        max_faces: largest number of triangles; also limits the file to 60 bytes per triangle.
        largest_part: keep only the largest connected part of the mesh.
        overwrite: replace an earlier capture.
    """
    from nextview_lab.data.writing import write_capture

    check_new(out, overwrite, folder=True)
    loaded = load_mesh(mesh, up, unit, max_faces, largest_part)
    metres = loaded.metres if radius is None else radius
    if metres is None:
        raise UsageError(
            f"{mesh}: how large is it? Give the file's --unit or the object's --radius in metres"
        )
    sphere = ViewSphere.named(viewpoints)
    frames = write_capture(loaded, out, sphere, metres, table, not table, overwrite)
    track(frames, len(sphere), f"capturing {mesh.name}")
    console.print(
        f"{out}: {len(sphere)} views; look at them with: nextview recognise {out}"
    )
