"""What a measure is handed: one view of an object, and, where its mesh is known, which face each pixel shows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nextview.errors import MeasureError
from nextview.geometry.depth import object_depth
from nextview.geometry.observation import depth_image


@dataclass(frozen=True)
class Surface:
    """A triangle mesh, V vertices and F faces, as measures see it. Faces may be turned either way.

    Attributes:
        vertices: (V, 3) float64, object radii; no two farther apart than 2, as those of a ``Mesh``.
        faces: (F, 3) int, indices into the vertices.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.integer]

    @cached_property
    def _cross(self) -> NDArray[np.float64]:
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return np.cross(b - a, c - a)

    @cached_property
    def areas(self) -> NDArray[np.float64]:
        """Of the faces, (F,) float64, square object radii."""
        return np.sqrt((self._cross**2).sum(1)) / 2

    @cached_property
    def normals(self) -> NDArray[np.float64]:
        """Unit normals of the faces, (F, 3) float64; 0 of a face without area."""
        length = 2 * self.areas[:, None]
        return np.divide(self._cross, length, out=np.zeros_like(self._cross), where=length > 0)


@dataclass(frozen=True)
class MeasuredView:
    """One view of an object. What several measures ask for is computed once, when the first one asks.

    Attributes:
        depth: distance along the optical axis, (H, W) float, object radii, 0 where there is no object. What a sensor
            gives for nothing else becomes 0 here.
        pose: camera-to-world, (4, 4) float64, OpenCV axes; the world is the object frame, z up.
        intrinsics: pinhole matrix, (3, 3) float64, pixels, the first pixel's centre at 0.5.
        mesh: the surface that is seen; None where only the depth is known.
        face_ids: which face of it each pixel shows, (H, W) int32, -1 for none; see ``SimulatedCamera.face_ids``.
    """

    depth: NDArray[np.floating]
    pose: NDArray[np.float64]
    intrinsics: NDArray[np.float64]
    mesh: Surface | None = None
    face_ids: NDArray[np.int32] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "depth", object_depth(depth_image(self.depth)))

    @cached_property
    def box(self) -> tuple[slice, slice]:
        """Rows and columns that hold the object, (H', W'); none of them where nothing is seen."""
        seen = self.depth > 0
        rows, columns = (np.flatnonzero(seen.any(axis)) for axis in (1, 0))
        if len(rows) == 0:
            return slice(0, 0), slice(0, 0)
        return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)

    @cached_property
    def near(self) -> NDArray[np.floating]:
        """The depth in the box, (H', W'): most of an image is background, and so most of the work is saved."""
        return self.depth[self.box]

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """Where the box shows the object, (H', W')."""
        return self.near > 0

    @cached_property
    def depths(self) -> NDArray[np.floating]:
        """Depth of the pixels that show the object, (n,), row by row."""
        return self.near[self.seen]

    @cached_property
    def rays(self) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Slopes x/z of the box's columns, (W',), and y/z of its rows, (H',), in the camera's axes."""
        rows, columns = self.box
        (fx, _, cx), (_, fy, cy) = self.intrinsics[:2]
        x = (np.arange(columns.start, columns.stop) + 0.5 - cx) / fx
        y = (np.arange(rows.start, rows.stop) + 0.5 - cy) / fy
        return x, y

    @cached_property
    def surface(self) -> Surface:
        """The mesh."""
        if self.mesh is None or self.face_ids is None:
            raise MeasureError("this measure needs the mesh and the face that each pixel shows, not the depth alone")
        return self.mesh

    @cached_property
    def faces(self) -> NDArray[np.int32]:
        """The face that each of the pixels shows that show the object, (n,), row by row; -1 for none."""
        self.surface  # noqa: B018  # says if there is none
        assert self.face_ids is not None
        return self.face_ids[self.box][self.seen]

    @cached_property
    def pixels(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Faces that are seen, (k,), ascending, and in how many pixels, (k,)."""
        counts = np.bincount(self.faces[self.faces >= 0])
        seen = np.flatnonzero(counts)
        return seen, counts[seen]
