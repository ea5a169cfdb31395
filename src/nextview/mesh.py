"""Read a mesh file and bring it into the object frame."""

from __future__ import annotations

import stat
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import as_line, of_kind, whole
from nextview.errors import MeshError
from nextview.glb import read_glb
from nextview.mesh_format import BYTES_PER_FACE, MAX_FACES, VERTICES_PER_FACE, check_faces
from nextview.obj import read_obj
from nextview.off import read_off
from nextview.ply import read_ply
from nextview.stl import read_stl

FORMATS = (".off", ".obj", ".ply", ".stl", ".glb")
UNITS = {"mm": 0.001, "cm": 0.01, "inch": 0.0254, "foot": 0.3048, "m": 1.0}
"""What a file's unit of length may be, and how many metres it is."""


FLAT = 1e-12
"""Twice the area of a face below which it counts as a line, square object radii: rounding makes up to 1e-15."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in the object frame: z up, bounding-box centre at the origin, farthest vertex at radius 1.

    Attributes:
        vertices: (V, 3) float64, object radii.
        faces: (F, 3) int32, indices into the vertices.
        centre: bounding-box centre in the file's frame, (3,) float64, the file's units.
        radius: object radius in the file's units; ``vertices * radius + centre`` are the file's positions.
        name: what to call it in messages.
        unit: the file's unit, one of UNITS; None if it is not known.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    centre: NDArray[np.float64]
    radius: float
    name: str = "mesh"
    unit: str | None = None

    @property
    def metres(self) -> float | None:
        """Object radius in metres; None if the unit is not known."""
        return None if self.unit is None else self.radius * UNITS[self.unit]


def make_mesh(
    vertices: NDArray[np.floating], faces: NDArray[np.integer], name: str = "mesh", unit: str | None = None
) -> Mesh:
    """Check raw arrays and normalise them.

    Args:
        vertices: (V, 3), any unit.
        faces: (F, 3), indices into the vertices.
        name: used in messages.
        unit: of the positions, one of UNITS; None if it is not known.

    Returns:
        The mesh in the object frame, without the vertices that no face uses, and each triangle once: copies in the same
        place show nothing new, and a great many of them take a minute a view.

    Raises:
        MeshError: no faces, not triangles, an index out of range, a position that is not finite, no extent, or no area.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    for array, what in ((vertices, "vertices"), (faces, "faces")):
        if len(array) == 0:
            raise MeshError(f"{name}: the mesh has no {what}")
        if array.shape != (len(array), 3):
            raise MeshError(f"{name}: {what} have the shape {array.shape}, not (n, 3)")
    if faces.min() < 0 or faces.max() >= len(vertices):
        worst = int(faces.min() if faces.min() < 0 else faces.max())
        raise MeshError(f"{name}: a face refers to vertex {worst}, but there are only {len(vertices)} vertices")
    places = np.sort(_first_of_equals(vertices)[faces], 1)
    faces = faces[_first_of_equals(places) == np.arange(len(faces))]
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    if not used.all():
        faces = (np.cumsum(used) - 1)[faces]
        vertices = vertices[used]
    if not np.isfinite(vertices).all():
        raise MeshError(f"{name}: {int((~np.isfinite(vertices)).any(1).sum())} vertices are NaN or infinite")
    low, high = vertices.min(0), vertices.max(0)
    # Halves first: the sum or difference of two very large finite numbers may not be finite.
    centre = low / 2 + high / 2
    vertices = vertices - centre
    reach = np.abs(vertices).max()
    if not reach > 1e-9 * np.abs(centre).max() or reach < np.finfo(float).tiny:
        raise MeshError(f"{name}: the mesh has no extent, all its vertices are in one place")
    vertices /= reach
    radius = np.sqrt((vertices**2).sum(1).max())
    if reach > np.finfo(float).max / radius:
        raise MeshError(f"{name}: the mesh is too large, its radius is not a finite number")
    normalised: NDArray[np.float64] = vertices / radius
    if not _has_area(normalised, faces):
        raise MeshError(f"{name}: the mesh has no area, all its faces are lines or points")
    return Mesh(normalised, faces.astype(np.int32), centre, float(radius * reach), name, unit)


def _has_area(vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> bool:
    """Whether any face is more than a line; most often the first few tell."""
    for first in range(0, len(faces), 4096):
        a, b, c = (vertices[faces[first : first + 4096, k]] for k in range(3))
        if np.abs(np.cross(b - a, c - a)).max() > FLAT:
            return True
    return False


def _first_of_equals(rows: NDArray) -> NDArray[np.int64]:
    """For each of some rows, (N, 3), the index of the first that is equal to it, (N,)."""
    order = np.lexsort(rows.T)  # stable: the first of equals comes first
    first = np.ones(len(rows), bool)
    first[1:] = (rows[order[1:]] != rows[order[:-1]]).any(1)
    found = np.empty(len(rows), np.int64)
    found[order] = order[first][np.cumsum(first) - 1]
    return found


def load_mesh(path: str | Path, up: str | None = None, unit: str | None = None, max_faces: int = MAX_FACES) -> Mesh:
    """Read an OFF, OBJ, PLY, STL or GLB file; the parts of a scene are joined.

    Args:
        path: the file; its suffix tells the format.
        up: the file's up axis, "y" or "z". By default z, but y for GLB, whose standard says so.
        unit: the file's unit of length, one of UNITS; None if it is not known.
        max_faces: refuse a mesh of more triangles, of more than VERTICES_PER_FACE vertices for each of these, or in a
            file of more than BYTES_PER_FACE bytes for each.

    Returns:
        The mesh in the object frame.

    Raises:
        MeshError: what is wrong with the file, in one sentence.
    """
    of_kind(path, str | Path, "a mesh file is a path", MeshError)
    path = Path(path)
    suffix = path.suffix.lower()
    if up is not None and (not isinstance(up, str) or up not in ("y", "z")):
        raise MeshError(f"{path}: the up axis is y or z, not {as_line(up)}")
    if unit is not None and (not isinstance(unit, str) or unit not in UNITS):
        raise MeshError(f"{path}: the unit is one of {', '.join(UNITS)}, not {as_line(unit)}")
    whole(max_faces, "the largest number of faces", 1)
    data = _read(path, BYTES_PER_FACE * max_faces)
    if not data.strip():
        raise MeshError(f"{path}: the file is empty")
    try:
        vertices, faces = read_glb(data, max_faces) if suffix == ".glb" else _READERS[suffix](data)
        check_faces(len(faces), max_faces)
        if len(vertices) > VERTICES_PER_FACE * max_faces:
            most = f"{VERTICES_PER_FACE * max_faces:,}"
            raise MeshError(f"it has {len(vertices):,} vertices, more than {most}; --max-faces (max_faces) allows more")
    except MemoryError:
        raise MeshError(f"{path}: too large for this machine's memory") from None
    except (ValueError, OverflowError) as error:  # Python's own say which word is not a number
        raise MeshError(f"{path}: not a readable {suffix[1:].upper()} mesh ({str(error).rstrip('.')})") from None
    if (up or ("y" if suffix == ".glb" else "z")) == "y":
        vertices = vertices[:, [0, 2, 1]] * (1, -1, 1)
    return make_mesh(vertices, faces, str(path), unit)


def _read(path: Path, most: int) -> bytes:
    """A mesh file's bytes, of a regular file only: a pipe would wait for its writer, a device might never end."""
    try:
        found = path.stat()
    except FileNotFoundError:
        raise MeshError(f"{path}: there is no such file") from None
    except (OSError, ValueError) as error:  # a zero byte in the name
        raise MeshError(f"{path}: cannot be read ({getattr(error, 'strerror', error)})") from None
    if stat.S_ISDIR(found.st_mode):
        raise MeshError(f"{path}: is a folder, not a mesh file")
    if path.suffix.lower() not in FORMATS:
        raise MeshError(f"{path}: not a mesh format nextview reads ({', '.join(FORMATS)})")
    if not stat.S_ISREG(found.st_mode):
        raise MeshError(f"{path}: is a pipe or a device, not a mesh file")
    if found.st_size > most:
        size = f"{found.st_size:,} bytes, more than {most:,}"
        raise MeshError(f"{path}: the file has {size}; --max-faces (max_faces) allows more")
    try:
        return path.read_bytes()
    except OSError as error:
        raise MeshError(f"{path}: cannot be read ({error.strerror})") from None


_READERS = {".off": read_off, ".obj": read_obj, ".ply": read_ply, ".stl": read_stl}
