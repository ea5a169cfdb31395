"""What a measure is handed: one view of an object, and, where its mesh is known, which face each pixel shows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nextview.errors import MeasureError
from nextview.geometry.depth import object_depth
from nextview.geometry.observation import depth_image

GRAZING = 0.05
"""Where a surface turns farther from the camera than this cosine, it counts as turned so far: one row of pixels more or
less on a plane that is seen from its edge would else decide over as much area as all the rest."""


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

    @cached_property
    def area(self) -> float:
        """Of all faces, square object radii."""
        return float(self.areas.sum())

    @cached_property
    def heights(self) -> tuple[float, float]:
        """Of the lowest and the highest vertex, object radii."""
        return float(self.vertices[:, 2].min()), float(self.vertices[:, 2].max())

    @cached_property
    def centres(self) -> NDArray[np.float64]:
        """Of the faces, (F, 3) float64, object radii."""
        return self.vertices[self.faces].mean(1)

    @cached_property
    def tops(self) -> NDArray[np.float64]:
        """Of the faces' highest corners, the height, (F,) float64, object radii."""
        return self.vertices[:, 2][self.faces].max(1)


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
    def pixels(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Faces that are seen, (k,), ascending, and in how many pixels, (k,)."""
        counts = np.bincount(self._ids)
        faces = np.flatnonzero(counts)
        return faces, counts[faces]

    @cached_property
    def seen_area(self) -> NDArray[np.float64]:
        """How much of each of these faces is seen, (k,), square object radii.

        A pixel shows z^2 / (fx fy |n . r|) of a face: z is its depth, n the face's unit normal, r the pixel's ray whose
        z is 1. z |n . r| is how far the camera is from the face's plane. Pixels are samples: of a face smaller than
        one, more may be counted than there is, and of others none; over many it evens out.
        """
        faces, _ = self.pixels
        corners = self.surface.vertices[self.surface.faces[faces, 0]]
        apart = np.zeros(int(faces[-1]) + 1 if len(faces) else 0)
        apart[faces] = np.abs(((corners - self.pose[:3, 3]) * self.surface.normals[faces]).sum(1))
        z = self.depths[self._hits]
        focal = self.intrinsics[0, 0] * self.intrinsics[1, 1]
        patches = z**2 / (focal * np.maximum(apart[self._ids] / z, GRAZING))
        return np.asarray(np.bincount(self._ids, patches)[faces], np.float64)

    @cached_property
    def seen_share(self) -> NDArray[np.float64]:
        """Which share of each of these faces is seen, (k,), about 0 .. 1; 0 of a face without area."""
        areas = self.surface.areas[self.pixels[0]]
        return np.divide(self.seen_area, areas, out=np.zeros(len(areas)), where=areas > 0)

    @cached_property
    def _faces(self) -> NDArray[np.int32]:
        """The face that each of the pixels shows which show the object, -1 for none."""
        assert self.face_ids is not None
        return self.face_ids[self.box][self.seen]

    @cached_property
    def _hits(self) -> NDArray[np.bool_]:
        """Which of these pixels show a face."""
        return self._faces >= 0

    @cached_property
    def _ids(self) -> NDArray[np.int32]:
        """The face of each pixel that shows one."""
        self.surface  # noqa: B018  # says if there is none
        return self._faces[self._hits]
