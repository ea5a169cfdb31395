"""A view of an object whose mesh is known: which face each pixel shows, for the measures that
need the surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nextview.geometry.mesh import Mesh
from nextview.geometry.observation import checked_pose, pinhole
from nextview.geometry.ray_caster import embree_scene
from nextview.geometry.viewsphere import CAMERA_DISTANCE
from nextview.simulation.simulated import SimulatedCamera
from nextview_lab.data.measures import MeasuredView

APART = 4  # pixels of a row between those that are asked first which face they show; a power of 2
# what stands no farther before a face is not told from it, object radii: two steps of a store's
# depth
LEVEL = 2e-4


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
        return np.divide(
            self._cross,
            length,
            out=np.zeros_like(self._cross),
            where=length > 0,
        )


@dataclass(frozen=True)
class MeshView(MeasuredView):
    """A view of a mesh.

    Attributes:
        surface: the surface that is seen.
        face_ids: which face of it each pixel shows, (H, W) int32, -1 for none; see ``FaceCamera``.
    """

    surface: Surface
    face_ids: NDArray[np.int32]

    @cached_property
    def faces(self) -> NDArray[np.int32]:
        """The face that each of the pixels shows that show the object, (n,), row by row; -1 for
        none.
        """
        return self.face_ids[self.box][self.seen]

    @cached_property
    def pixels(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Faces that are seen, (k,), ascending, and in how many pixels, (k,)."""
        counts = np.bincount(self.faces[self.faces >= 0])
        seen = np.flatnonzero(counts)
        return seen, counts[seen]


class FaceCamera:
    """Tells which face of a mesh each pixel of a ``SimulatedCamera`` shows; ``size`` and
    ``distance`` are as there.
    """

    def __init__(
        self,
        mesh: Mesh,
        size: int = 224,
        distance: float = CAMERA_DISTANCE,
    ) -> None:
        self.surface = Surface(mesh.vertices, mesh.faces)
        self.intrinsics = pinhole(size, distance)
        self._scene = embree_scene([(mesh.vertices, mesh.faces)])
        # in single precision, as in ``SimulatedCamera``
        focal, centre = self.intrinsics[0, [0, 2]]
        across = (
            np.arange(size, dtype=np.float32) + np.float32(0.5 - centre)
        ) / np.float32(focal)
        x, y = np.meshgrid(across, across)
        self._rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)

    def view(self, pose: NDArray[np.float64], depth: NDArray[np.floating]) -> MeshView:
        """What a measure is handed of the depth image, (H, W), object radii, from a pose, (4,
        4), object frame.
        """
        return MeshView(
            depth,
            pose,
            self.intrinsics,
            self.surface,
            self.face_ids(pose, depth),
        )

    def face_ids(
        self,
        pose: NDArray[np.float64],
        depth: NDArray[np.floating],
    ) -> NDArray[np.int32]:
        """Which face of the mesh each pixel shows, (H, W) int32, -1 for none; arguments as of
        ``view``.

        Where two pixels of a row show one face, so does all between them, unless the depth tells
        that something stands before it: half of the rays are saved.
        """
        pose = checked_pose(pose)
        z = depth.astype(np.float32, copy=False)
        found = np.full(z.shape, -1, np.int32)
        seen = z > 0
        self._cast(pose, seen, found, slice(0, None, APART))
        for step in (APART >> k for k in range(1, APART.bit_length())):
            _fill(found, z, step)
            self._cast(pose, seen & (found < 0), found, slice(step, None, 2 * step))
        return found

    def _cast(
        self,
        pose: NDArray[np.float64],
        where: NDArray[np.bool_],
        found: NDArray[np.int32],
        columns: slice,
    ) -> None:
        """Look what some pixels show, of some columns; the nearest face alone: distances and
        normals cost more.
        """
        chosen = np.zeros(where.shape, bool)
        chosen[:, columns] = where[:, columns]
        pixels = np.flatnonzero(chosen)
        if len(pixels):
            rays = self._rays.take(pixels, 0)  # by a mask it takes four times as long
            rays = rays @ np.ascontiguousarray(pose[:3, :3].astype(np.float32).T)
            origins = np.tile(pose[:3, 3].astype(np.float32), len(rays)).reshape(-1, 3)
            found.reshape(-1)[pixels] = self._scene.run(origins, rays)


def _fill(found: NDArray[np.int32], z: NDArray[np.float32], step: int) -> None:
    """Fill every other of the columns that are ``step`` apart, where both neighbours show one face
    and it does, too.

    The inverse depth of a plane changes evenly over the picture.
    """
    # the last column that was asked
    reach = (found.shape[1] - 1) // (2 * step) * 2 * step
    left, middle, right = (
        slice(begin, begin + reach, 2 * step) for begin in (0, step, 2 * step)
    )
    one = found[:, left]
    before = z[:, left]
    after = z[:, right]
    both = before + after
    off = np.abs(z[:, middle] * both - 2 * before * after)
    same = (one == found[:, right]) & (one >= 0) & (off < LEVEL * both)
    np.copyto(found[:, middle], one, where=same)


def view_of(
    mesh: Mesh,
    pose: NDArray[np.float64],
    size: int = 224,
    distance: float = CAMERA_DISTANCE,
) -> MeshView:
    """What a measure is handed of a mesh, seen from a pose, (4, 4), object frame, object radii."""
    return FaceCamera(mesh, size, distance).view(
        pose,
        SimulatedCamera(mesh, size, distance).observe(pose).depth,
    )
