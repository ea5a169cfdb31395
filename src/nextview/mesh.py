"""Read a mesh file and bring it into the object frame."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.errors import MeshError
from nextview.obj import read_obj
from nextview.off import read_off

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
        The mesh in the object frame, without the vertices that no face uses.

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


def load_mesh(path: str | Path, up: str | None = None, unit: str | None = None) -> Mesh:
    """Read an OFF, OBJ, PLY, STL or GLB file; the parts of a scene are joined.

    Args:
        path: the file; its suffix tells the format.
        up: the file's up axis, "y" or "z". By default z, but y for GLB, whose standard says so.
        unit: the file's unit of length, one of UNITS; None if it is not known.

    Returns:
        The mesh in the object frame.

    Raises:
        MeshError: what is wrong with the file, in one sentence.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if up not in (None, "y", "z"):
        raise MeshError(f"{path}: the up axis is y or z, not {up!r}")
    if unit is not None and unit not in UNITS:
        raise MeshError(f"{path}: the unit is one of {', '.join(UNITS)}, not {unit!r}")
    if path.is_dir():
        raise MeshError(f"{path}: is a folder, not a mesh file")
    if not path.exists():
        raise MeshError(f"{path}: there is no such file")
    if suffix not in FORMATS:
        raise MeshError(f"{path}: not a mesh format nextview reads ({', '.join(FORMATS)})")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise MeshError(f"{path}: cannot be read ({error.strerror})") from None
    if not data.strip():
        raise MeshError(f"{path}: the file is empty")
    try:
        vertices, faces = _READERS[suffix](data) if suffix in _READERS else _read_with_trimesh(data, suffix)
    except Exception as error:  # parsers raise whatever a broken file makes them raise
        reason = str(error).strip().split("\n")[0].rstrip(".") or type(error).__name__
        raise MeshError(f"{path}: not a readable {suffix[1:].upper()} mesh ({reason})") from None
    if (up or ("y" if suffix == ".glb" else "z")) == "y":
        vertices = vertices[:, [0, 2, 1]] * (1, -1, 1)
    return make_mesh(vertices, faces, str(path), unit)


def _read_with_trimesh(data: bytes, suffix: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    import io

    import trimesh  # a third of a second to import, and OFF and OBJ do not need it

    damage = _DAMAGE.get(suffix, lambda data: None)(data)
    if damage:
        raise MeshError(damage)
    loaded = trimesh.load(io.BytesIO(data), file_type=suffix[1:], process=False)
    if isinstance(loaded, trimesh.Scene):
        loaded = loaded.to_mesh()
    vertices = np.asarray(loaded.vertices, np.float64).reshape(-1, 3)
    if not isinstance(loaded, trimesh.Trimesh):
        return vertices, np.zeros((0, 3), np.int64)  # a point cloud: no faces
    return vertices, np.asarray(loaded.faces, np.int64)


def _damage_stl(data: bytes) -> str | None:
    if b"\0" not in data:  # text: a binary file holds zeros, though it may begin with "solid" too
        unended = re.search(rb"[\r\n]\s*facet\b", data.lower().rpartition(b"endsolid")[2])
        return "the file is cut short, endsolid is missing" if unended else None
    if len(data) < 84:
        return "the file is cut short in its header"
    facets, room = int.from_bytes(data[80:84], "little"), (len(data) - 84) // 50
    return f"the file is cut short, {facets} faces announced, {room} found" if facets > room else None


def _damage_ply(data: bytes) -> str | None:
    header, _, body = data.partition(b"end_header")
    if b"format ascii" not in header:
        return None  # trimesh checks the length of binary files
    lines = [line for line in body.splitlines() if line.strip()]
    announced = sum(int(count) for count in re.findall(rb"(?m)^element\s+\S+\s+(\d+)", header))
    if len(lines) < announced:
        return f"the file is cut short, {announced} lines announced, {len(lines)} found"
    faces_last = re.search(rb"element\s+face\s+\d+\s+property\s+list.*\s*$", header)
    last = lines[-1].split() if lines and faces_last else [b"0"]
    return "the file is cut short in its last line" if int(last[0]) >= len(last) else None


_READERS = {".off": read_off, ".obj": read_obj}
_DAMAGE = {".stl": _damage_stl, ".ply": _damage_ply}
"""What trimesh lets pass: for some formats, a function of the file's bytes that says what is wrong with them."""
