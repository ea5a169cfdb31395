"""Read a mesh file and bring it into the object frame."""

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.checks import one_line, whole
from nextview.errors import MeshError, option
from nextview.files import regular_file
from nextview.geometry.file_content import foreign_content
from nextview.geometry.mesh_file import READERS
from nextview.geometry.mesh_parts import (
    keep_largest_part,
    mesh_doubts,
    refuse_lost_shape,
)
from nextview.geometry.triangles import MAX_FACES, check_faces, no_faces
from nextview.types import Float, Floats, Index

# how many bytes a mesh file may have for each triangle that it may have
BYTES_PER_FACE = 60
FORMATS = tuple(READERS)
UNITS = {
    "mm": 0.001,
    "cm": 0.01,
    "inch": 0.0254,
    "foot": 0.3048,
    "m": 1.0,
}  # of length, metres
ODD_RADII = (0.001, 20.0)  # metres: a radius outside is likelier one in another unit
# twice the area, square object radii, below which a face counts as a line: rounding makes up to
# 1e-15
FLAT = 1e-12


Y_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Rotation from the axes of a file whose y axis points up to those of a ``Mesh``, whose z axis
does.
"""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in the object frame.

    In this frame z points up, the bounding-box centre is at the origin, and the farthest vertex has
    radius 1.

    Attributes:
        vertices: (V, 3) float64, object radii.
        faces: (F, 3) int32, indices into the vertices.
        centre: bounding-box centre in the file's frame, (3,) float64: metres, or lengths of the
            file if its unit is not known.
        radius: object radius, in the same; ``vertices * radius + centre`` are the file's positions.
        name: what to call it in messages.
        unit: what the file's lengths were in, one of UNITS; None if it is not known.
        notes: what was left out of the file's mesh, a sentence each; usually nothing.

    Example:
        >>> sample_mesh("chair").vertices.shape
        (80, 3)
    """

    vertices: Float
    faces: NDArray[np.int32]
    centre: Float
    radius: float
    name: str = "mesh"
    unit: str | None = None
    notes: tuple[str, ...] = ()

    @property
    def metres(self) -> float | None:
        """Object radius in metres; None if the unit is not known."""
        return None if self.unit is None else self.radius

    def reshaped(self, vertices: Float) -> "Mesh":
        """The mesh with its vertices elsewhere, brought into the object frame anew.

        Args:
            vertices: (V, 3) float64, object radii of this mesh.

        Returns:
            The mesh, its lengths in the same unit.

        Raises:
            MeshError: see ``make_mesh``.
        """
        made = make_mesh(vertices * self.radius, self.faces, self.name)
        return replace(made, unit=self.unit)


def make_mesh(
    vertices: Floats,
    faces: NDArray[np.integer],
    name: str = "mesh",
    unit: str | None = None,
) -> Mesh:
    """Check raw vertices and faces and normalise them to the object frame.

    Vertices that no face uses are dropped. Of triangles in the same place one is kept: copies show
    nothing new, and very many of them slow down the ray caster.

    Args:
        vertices: (V, 3), any unit.
        faces: indices of vertices, (F, 3).
        name: of the mesh, for messages.
        unit: of the vertices ("mm", "cm", "inch", "foot", "m"); None if it is not known.

    Returns:
        The mesh in the object frame; centre and radius are in metres if the unit is known.

    Raises:
        MeshError: the mesh has no faces, faces that are not triangles, an index out of range, a
            position that is not finite, no extent, or no area.
    """
    vertices = np.asarray(vertices, np.float64)
    faces = np.asarray(faces)
    for array, what in ((vertices, "vertices"), (faces, "faces")):
        if len(array) == 0:
            raise MeshError(f"{name}: the mesh has no {what}")
        if array.shape != (len(array), 3):
            raise MeshError(f"{name}: {what} have the shape {array.shape}, not (n, 3)")
    if faces.min() < 0 or faces.max() >= len(vertices):
        worst = int(faces.min() if faces.min() < 0 else faces.max())
        raise MeshError(
            f"{name}: a face refers to vertex {worst}, but there are only {len(vertices)} vertices"
        )
    places = np.sort(_first_of_equals(vertices)[faces], 1)
    faces = faces[_first_of_equals(places) == np.arange(len(faces))]
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    if not used.all():
        faces = (np.cumsum(used) - 1)[faces]
        vertices = vertices[used]
    if not np.isfinite(vertices).all():
        raise MeshError(
            f"{name}: NaN or infinite vertices: {int((~np.isfinite(vertices)).any(1).sum())}"
        )
    low = vertices.min(0)
    high = vertices.max(0)
    # Halves first: the sum or difference of two very large finite numbers may not be finite.
    centre = low / 2 + high / 2
    vertices = vertices - centre
    reach = np.abs(vertices).max()
    if not reach > 1e-9 * np.abs(centre).max() or reach < np.finfo(float).tiny:
        raise MeshError(
            f"{name}: the mesh has no extent, all its vertices are in one place"
        )
    vertices /= reach
    radius = np.sqrt((vertices**2).sum(1).max())
    if reach > np.finfo(float).max / radius:
        raise MeshError(
            f"{name}: the mesh is too large, its radius is not a finite number"
        )
    normalised: Float = vertices / radius
    # most often the first few tell
    parts = (faces[first : first + 4096].T for first in range(0, len(faces), 4096))
    areas = (
        np.cross(normalised[b] - normalised[a], normalised[c] - normalised[a])
        for a, b, c in parts
    )
    if not any(np.abs(area).max() > FLAT for area in areas):
        raise MeshError(
            f"{name}: the mesh has no area, all its faces are lines or points"
        )
    made = Mesh(
        normalised,
        faces.astype(np.int32),
        centre,
        float(radius * reach),
        name,
    )
    return _in_metres(made, unit)


def _in_metres(mesh: Mesh, unit: str | None) -> Mesh:
    """A mesh whose lengths are the file's, once its unit is known; itself if it is not."""
    if unit is None:
        return mesh
    metres = UNITS[unit]
    return replace(
        mesh,
        centre=mesh.centre * metres,
        radius=mesh.radius * metres,
        unit=unit,
    )


def _first_of_equals(rows: NDArray) -> Index:
    """For each of some rows, (N, 3), the index of the first that is equal to it, (N,)."""
    order = np.lexsort(rows.T)  # stable: the first of equals comes first
    first = np.ones(len(rows), bool)
    first[1:] = (rows[order[1:]] != rows[order[:-1]]).any(1)
    found = np.empty(len(rows), np.int64)
    found[order] = order[first][np.cumsum(first) - 1]
    return found


def mesh_warnings(mesh: Mesh) -> tuple[str, ...]:
    """What is likely to be wrong with the mesh of one object, a sentence each; usually nothing.

    That something was left out of it, that it has parts far from its main part, that it stands on a
    large plane, and that it is of an odd size. It takes about as long as reading the file.

    Args:
        mesh: as ``load_mesh`` returns it.
    """
    doubts = [*mesh.notes, *mesh_doubts(mesh.vertices, mesh.faces)]
    if mesh.metres is not None and not ODD_RADII[0] <= mesh.metres <= ODD_RADII[1]:
        doubts.append(
            f"it has a radius of {mesh.metres:.3g} m: is its unit {mesh.unit}?"
        )
    return tuple(doubts)


def is_y_up(path: Path, up: str | None = None) -> bool:
    """Return whether the y axis of a mesh file points up.

    Args:
        path: of the mesh file.
        up: "y" or "z"; None for the standard of the format (y for GLB, z for all others).

    Returns:
        True if y points up.
    """
    return (up or ("y" if path.suffix.lower() == ".glb" else "z")) == "y"


def load_mesh(
    path: str | Path,
    up: str | None = None,
    unit: str | None = None,
    max_faces: int = MAX_FACES,
    largest_part: bool = False,
) -> Mesh:
    """Read an OFF, OBJ, PLY, STL or GLB file into the object frame.

    The suffix tells the format. The parts of a scene are joined.

    Args:
        path: of the file.
        up: its up axis, "y" or "z"; by default z, and y for GLB, as in its standard.
        unit: its unit of length, one of UNITS; None if it is not known.
        max_faces: largest number of triangles of the mesh. The file may have BYTES_PER_FACE bytes
            for each.
        largest_part: whether to keep only the connected part with the largest surface. A plate,
            such as a turntable's, is not taken for that part.

    Returns:
        The mesh.

    Raises:
        MeshError: the file, ``up`` or ``unit`` cannot be used.
        UsageError: ``max_faces`` is no whole number from 1 on.

    Example:
        >>> nextview.load_mesh("samples/chair.off").faces.shape  # doctest: +SKIP
        (120, 3)
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if up not in (None, "y", "z"):
        raise MeshError(f"{path}: the up axis is y or z, not {one_line(repr(up))}")
    if unit is not None and unit not in UNITS:
        raise MeshError(
            f"{path}: the unit is one of {', '.join(UNITS)}, not {one_line(repr(unit))}"
        )
    if suffix not in FORMATS and os.path.isfile(path):
        raise MeshError(
            f"{path}: not a mesh format nextview reads ({', '.join(FORMATS)})"
        )
    regular_file(path, "a mesh", MeshError)
    most = BYTES_PER_FACE * whole(max_faces, "the largest number of faces", 1)
    if path.stat().st_size > most:
        raise MeshError(
            f"{path}: has more than {most:,} bytes; {option('max_faces')} allows more"
        )
    try:
        data = path.read_bytes()
        if not data.strip():
            raise MeshError("the file is empty")
        vertices, faces = READERS[suffix](data, max_faces)
        check_faces(len(faces), max_faces)
        if len(faces) == 0:
            raise MeshError(
                no_faces(len(vertices))
                if len(vertices)
                else "it holds neither vertices nor faces"
            )
    except OSError as error:
        raise MeshError(f"{path}: cannot be read ({error.strerror})") from None
    except MemoryError:
        raise MeshError(f"{path}: too large for this machine's memory") from None
    # MeshErrors, and numbers that are none or too large
    except (ValueError, OverflowError) as error:
        reason = foreign_content(data, suffix)
        if reason is None:
            reason = (
                str(error)
                if isinstance(error, MeshError)
                else f"{type(error).__name__}: {error}"
            )
        raise MeshError(
            f"{path}: not a readable {suffix[1:].upper()} mesh ({one_line(reason, 240)})"
        ) from None
    if is_y_up(path, up):
        vertices = vertices[:, [0, 2, 1]] * (1, -1, 1)
    mesh = make_mesh(vertices, faces, str(path))
    refuse_lost_shape(vertices, mesh.radius, str(path))
    if largest_part:  # of what has just been checked
        kept, notes = keep_largest_part(mesh.vertices, mesh.faces)
        if notes:
            positions = mesh.vertices * mesh.radius + mesh.centre
            mesh = replace(make_mesh(positions, kept, str(path)), notes=notes)
    return _in_metres(mesh, unit)
