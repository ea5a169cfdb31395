"""A view of an object whose mesh is known, for the measures that need the surface: which face each
pixel shows, and how the surface bends.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.data.folders import list_dataset
from nextview.errors import DatasetError
from nextview.files import sha256_of
from nextview.geometry.camera import checked_pose, pinhole
from nextview.geometry.mesh import MAX_FACES, Mesh, load_mesh
from nextview.geometry.ray_caster import embree_scene
from nextview.geometry.viewsphere import CAMERA_DISTANCE
from nextview.simulation.simulated import SimulatedCamera
from nextview_lab.data.measures import MeasuredView, MeasuredViews
from nextview_lab.data.rendering import deformed
from nextview_lab.data.store import DEPTH_UNIT, ViewStore

APART = 4  # pixels of a row between those that are asked first which face they show; a power of 2
# what stands no farther before a face is not told from it, object radii: two steps of a store's
# depth
LEVEL = 2e-4


SAME = 1e-6
"""Vertices no farther apart than this, object radii, are one: many files hold each triangle with
corners of its own.
"""
GRAZING = 0.05
"""Where a surface turns farther from the camera than this cosine, it counts as turned so far: one
row of pixels more or less on a plane that is seen from its edge would else decide over as much area
as all the rest."""


@dataclass(frozen=True)
class Surface:
    """A triangle mesh, V vertices and F faces, as measures see it. Faces may be turned either way.

    Its curvature lies in edges and corners: in an edge, its length by the angle it bends by; in a
    corner, its angle deficit.

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

    @cached_property
    def places(self) -> NDArray[np.int64]:
        """The faces by places instead of vertices, (F, 3) int64: vertices in one place count as
        one.
        """
        cell = np.rint((self.vertices - self.vertices.min(0)) / SAME).astype(np.int64)
        # 2e6 at most: one number holds a place, and numbers are sorted ten times as fast
        width = cell.max(0) + 1
        key = (cell[:, 0] * width[1] + cell[:, 1]) * width[2] + cell[:, 2]
        return np.unique(key, return_inverse=True)[1].reshape(-1)[self.faces]

    @cached_property
    def _pairs(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The two sides of each edge at which the surface goes on, each (E,): 3 f + k for corners k
        to k + 1 of face f.

        Two faces that share an edge by their vertices, and no third; or else by the places of
        these. Where parts of an object touch, each so remains a surface of its own. Faces without
        area have no edges.
        """
        left = np.flatnonzero(np.repeat(self.areas > 0, 3))
        found = []
        for ends in (self.faces, self.places):
            both = (
                np.sort(np.stack([ends, np.roll(ends, -1, 1)], 2), 2)
                .reshape(-1, 2)[left]
                .astype(np.int64)
            )
            _, edge, count = np.unique(
                both @ [int(ends.max()) + 1, 1],
                return_inverse=True,
                return_counts=True,
            )
            two = count[edge] == 2
            found.append(left[two][np.argsort(edge[two], kind="stable")].reshape(-1, 2))
            left = left[~two]
        first, second = np.concatenate(found).T
        return first, second

    @cached_property
    def corners(self) -> NDArray[np.int64]:
        """Which corner of the surface each corner of a face is, (F, 3) int64: one for all faces
        around it.

        Surfaces that touch in a place have corners of their own there.
        """
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        first, second = self._pairs
        n = self.faces.size
        place = self.places.ravel()
        begin = second
        end = second - second % 3 + (second + 1) % 3
        # the neighbour may run along the edge either way
        same = place[first] == place[begin]
        ahead = first - first % 3 + (first + 1) % 3
        one = np.concatenate([first, ahead])
        other = np.concatenate([np.where(same, begin, end), np.where(same, end, begin)])
        graph = coo_array((np.ones(len(one), bool), (one, other)), (n, n))
        return (
            connected_components(graph, directed=False)[1]
            .astype(np.int64)
            .reshape(-1, 3)
        )

    @cached_property
    def angles(self) -> NDArray[np.float64]:
        """Of each face at its three corners, (F, 3) float64, radians; 0 of a face without area."""
        corners = self.vertices[self.faces]
        ahead = np.roll(corners, -1, 1) - corners
        behind = np.roll(corners, 1, 1) - corners
        return np.arctan2(2 * self.areas[:, None], (ahead * behind).sum(2))

    @cached_property
    def deficits(self) -> NDArray[np.float64]:
        """Angle deficit of each corner, float64, radians: 2 pi, or pi on an open edge, less the
        angles of its faces.
        """
        closed = np.zeros(self.faces.size, bool)
        closed[np.concatenate(self._pairs)] = True
        face, k = np.nonzero(~closed.reshape(-1, 3) & (self.areas > 0)[:, None])
        whole = np.full(int(self.corners.max()) + 1, 2 * np.pi)
        whole[self.corners[face, k]] = whole[self.corners[face, (k + 1) % 3]] = np.pi
        total = np.bincount(self.corners.ravel(), self.angles.ravel())
        return np.where(total > 0, whole - total, 0)

    @cached_property
    def gaussian(self) -> NDArray[np.float64]:
        """Gaussian curvature at each corner, per square object radius, float64.

        The angle deficit over a third of the area of the faces around it (Polonsky et al. 2005; the
        thesis's equation 4, which has the 3 below the line: nine times less, everywhere alike). 1 /
        r^2 on a sphere of radius r.
        """
        around = (
            np.bincount(
                self.corners.ravel(),
                np.repeat(self.areas, 3),
                len(self.deficits),
            )
            / 3
        )
        return np.divide(
            self.deficits,
            around,
            out=np.zeros_like(around),
            where=around > 0,
        )

    @cached_property
    def bends(self) -> NDArray[np.float64]:
        """Angle by which the surface bends at each face's three edges (corner k to k + 1), (F, 3)
        float64, 0 .. pi.

        0 where it does not go on: at open edges, and where more than two faces meet.
        """
        corners = self.vertices[self.faces]
        along = np.roll(corners, -1, 1) - corners
        inward = np.roll(corners, -2, 1) - corners
        square = np.maximum((along**2).sum(2, keepdims=True), np.finfo(float).tiny)
        inward = (
            inward - along * (inward * along).sum(2, keepdims=True) / square
        ).reshape(-1, 3)
        first, second = self._pairs
        u = inward[first]
        v = inward[second]
        opening = np.arctan2(np.sqrt((np.cross(u, v) ** 2).sum(1)), (u * v).sum(1))
        found = np.zeros(self.faces.size)
        found[first] = found[second] = np.pi - opening
        return found.reshape(-1, 3)

    @cached_property
    def lengths(self) -> NDArray[np.float64]:
        """Of each face's three edges, (F, 3) float64, object radii."""
        corners = self.vertices[self.faces]
        return np.sqrt(((np.roll(corners, -1, 1) - corners) ** 2).sum(2))

    @cached_property
    def mean_of_faces(self) -> NDArray[np.float64]:
        """Mean curvature, unsigned, integrated over each face, (F,) float64, object radii.

        The integral over a surface that bends at its edges is half the sum of length by angle
        (Cohen-Steiner and Morvan 2003); each of an edge's two faces has half of that. So cutting
        flat faces into smaller ones changes nothing.
        """
        return (self.lengths * self.bends).sum(1) / 4

    @cached_property
    def gaussian_of_faces(self) -> NDArray[np.float64]:
        """Gaussian curvature, unsigned, integrated over each face, (F,) float64, radians squared.

        Each corner's angle deficit, without sign, shared among its faces by their angles there.
        """
        total = np.bincount(
            self.corners.ravel(),
            self.angles.ravel(),
            len(self.deficits),
        )
        each = np.divide(
            np.abs(self.deficits),
            total,
            out=np.zeros_like(total),
            where=total > 0,
        )
        return (each[self.corners] * self.angles).sum(1)


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

    @cached_property
    def seen_area(self) -> NDArray[np.float64]:
        """How much is seen of each of the faces in ``pixels``, (k,), square object radii.

        A pixel shows z^2 / (fx fy |n . r|) of a face: z is its depth, n the face's unit normal, r
        the pixel's ray whose z is 1. z |n . r| is how far the camera is from the face's plane.
        Pixels are samples: of a face smaller than one, more may be counted than there is, and of
        others none; over many it evens out.
        """
        faces = self.pixels[0]
        hits = self.faces >= 0
        ids = self.faces[hits]
        z = self.depths[hits]
        corners = self.surface.vertices[self.surface.faces[faces, 0]]
        apart = np.zeros(int(faces[-1]) + 1 if len(faces) else 0)
        apart[faces] = np.abs(
            ((corners - self.pose[:3, 3]) * self.surface.normals[faces]).sum(1)
        )
        focal = self.intrinsics[0, 0] * self.intrinsics[1, 1]
        patches = z**2 / (focal * np.maximum(apart[ids] / z, GRAZING))
        return np.asarray(np.bincount(ids, patches)[faces], np.float64)

    @cached_property
    def seen_share(self) -> NDArray[np.float64]:
        """Which share is seen of each of these faces, (k,), about 0 .. 1; 0 of a face without
        area.
        """
        areas = self.surface.areas[self.pixels[0]]
        return np.divide(
            self.seen_area,
            areas,
            out=np.zeros(len(areas)),
            where=areas > 0,
        )


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


def mesh_views(
    store: ViewStore,
    meshes: Path,
    max_faces: int = MAX_FACES,
) -> MeasuredViews:
    """Return a function of a store and a row that iterates over the views of an object's mesh.

    Args:
        store: the views.
        meshes: the dataset folder that they were rendered from.
        max_faces: of a mesh at most.

    Raises:
        DatasetError: the views are of a sensor, or a mesh is missing.
    """
    if store.attributes.sensor is not None:
        raise DatasetError(
            f"{store.path}: was rendered through a sensor, whose depth does not tell which face is"
            " seen"
        )
    files = {entry.name: entry.path.absolute() for entry in list_dataset(meshes)}
    for i in np.flatnonzero(store.done):
        if store.names[i] not in files:
            raise DatasetError(
                f"{meshes}: holds no mesh called {store.names[i]}, of which {store.path} has views"
            )
    return partial(_views_of_mesh, files, max_faces)


def _views_of_mesh(
    files: dict[str, Path], max_faces: int, store: ViewStore, i: int
) -> Iterator[MeshView]:
    """Iterate over the views of an object of a store."""
    depths = store.read("depth", i)
    name = store.names[i]
    hashes = store.attributes.sha256
    if hashes and sha256_of(files[name]) != hashes[i]:
        raise DatasetError(
            f"{files[name]}: is not the mesh that {store.path} was rendered from"
        )
    part = store.attributes.largest_part
    read = load_mesh(files[name], max_faces=max_faces, largest_part=part)
    mesh = deformed(store, read, name)
    camera = FaceCamera(mesh, depths.shape[-1], store.sphere.distance)
    for depth, pose in zip(depths, store.sphere.poses, strict=True):
        yield camera.view(pose, depth * DEPTH_UNIT)  # float64, as when it was rendered
