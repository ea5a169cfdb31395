"""Surfaces of taught things in metres, with ray casting in batches."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree
from scipy.spatial.distance import pdist

from nextview.checks import extras
from nextview.errors import MeshError, option
from nextview.geometry.mesh import Mesh
from nextview.geometry.ray_caster import embree_scene
from nextview.types import Float, Float32, Index

# fewest triangles after simplification, unless the scan has fewer
FEWEST_FACES = 500
# tolerated error of a simplified surface, metres: below the resolution of depth cameras
FINEST_ERROR = 0.0004
SURFACE_SAMPLES = 2000  # sample points of the error of a simplified surface
LARGEST_ERROR = 5.0  # largest tolerated error of any point, multiples of the tolerance
# sample points of a simplified surface for nearest-neighbour queries
NEARBY_SAMPLES = 50_000
SCAN_ERROR = 0.0007  # standard deviation of a scan from the thing, metres
MISSED = np.float32(np.inf)  # depth along a ray without a hit


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface of one thing in the frame of its scan file.

    Attributes:
        name: name of the thing.
        vertices: (V, 3) float32, metres, with the origin and the axes of the scan file.
        faces: (F, 3) int32, indices of the vertices.
        error: standard deviation of the surface, metres.
    """

    name: str
    vertices: Float32
    faces: NDArray[np.int32]
    error: float = SCAN_ERROR

    @classmethod
    def from_mesh(cls, mesh: Mesh, name: str) -> "Surface":
        """Convert a mesh of known unit.

        Args:
            mesh: mesh in the object frame; its ``centre`` and ``radius`` lead back to the frame of
                its file.
            name: name of the thing.

        Returns:
            The surface in metres, in the frame of the mesh file.

        Raises:
            MeshError: the unit of the mesh is not known.
        """
        if mesh.unit is None:
            raise MeshError(
                f"{mesh.name}: the unit of length is not known; give {option('unit')}"
            )

        vertices = (mesh.vertices * mesh.radius + mesh.centre).astype(np.float32)
        return cls(name, vertices, np.ascontiguousarray(mesh.faces, np.int32))

    @cached_property
    def centre(self) -> Float32:
        """Centre of the bounding box, (3,) float32, metres, in the frame of the scan file."""
        return (self.vertices.min(0) + self.vertices.max(0)) / 2

    @cached_property
    def hull(self) -> Float32:
        """Vertices of the convex hull, (N, 3) float32, metres; all vertices of a flat surface."""
        try:
            return self.vertices[ConvexHull(self.vertices).vertices]
        except QhullError:
            return self.vertices

    @cached_property
    def radius(self) -> float:
        """Distance of the farthest vertex from the centre, metres."""
        return float(np.linalg.norm(self.vertices - self.centre, axis=1).max())

    @cached_property
    def centroid(self) -> Float:
        """Centroid of the surface area, (3,) float64, metres, in the frame of the scan file.

        It lies on every axis of symmetry, and a small part hardly moves it.
        """
        corners = self.vertices[self.faces].astype(np.float64)
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.linalg.norm(across, axis=1)
        return np.asarray(areas @ corners.mean(1) / areas.sum(), np.float64)

    @cached_property
    def diameter(self) -> float:
        """Largest distance between two points of the surface, metres."""
        try:
            corners = self.vertices[ConvexHull(self.vertices).vertices]
        except QhullError:  # a flat surface has no hull
            corners = self.vertices
        if len(corners) > SURFACE_SAMPLES:
            corners = corners[:: len(corners) // SURFACE_SAMPLES + 1]
        return float(pdist(corners).max())

    def simplified(self, error: float = FINEST_ERROR) -> "Surface":
        """Reduce the number of triangles within the resolution of a depth camera.

        Quadric error simplification (``fast_simplification``) halves the triangles repeatedly. It
        stops before more than 5 % of the points on the original exceed ``error``, or one of them is
        far from the simplified surface.

        Args:
            error: tolerated error of the surface, metres.

        Returns:
            A surface in the same frame, with at most as many triangles.
        """
        with extras():
            from fast_simplification import simplify

        kept = self
        count = len(self.faces) // 2
        while count >= FEWEST_FACES:
            vertices, faces = simplify(self.vertices, self.faces, target_count=count)
            smaller = Surface(
                self.name,
                vertices.astype(np.float32),
                np.ascontiguousarray(faces, np.int32),
            )
            if not len(faces) or not _near_enough(self, smaller, error):
                break
            kept = smaller
            count //= 2
        return kept

    @cached_property
    def _areas(self) -> Float:
        """Area of each triangle, (F,), square metres."""
        corners = self.vertices[self.faces].astype(np.float64)
        edges = corners[:, 1:] - corners[:, :1]
        return np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2

    @property
    def area(self) -> float:
        """Area, square metres."""
        return float(self._areas.sum())

    def triangles_by_area(self, count: int, rng: np.random.Generator) -> Index:
        """Draw triangles with probabilities proportional to their areas.

        Args:
            count: number of triangles.
            rng: source of all random numbers.

        Returns:
            Indices of the triangles, (count,) int64.
        """
        return rng.choice(len(self._areas), count, p=self._areas / self._areas.sum())

    def sample(self, count: int, rng: np.random.Generator) -> Float:
        """Draw points uniformly on the surface.

        Args:
            count: number of points.
            rng: source of all random numbers.

        Returns:
            Points in the frame of the scan file, (count, 3) float64, metres.
        """
        corners = self.vertices[self.faces].astype(np.float64)
        edges = corners[:, 1:] - corners[:, :1]
        chosen = self.triangles_by_area(count, rng)

        shares = rng.random((count, 2))
        # points in the other half of the parallelogram are reflected
        outside = shares.sum(1) > 1
        shares[outside] = 1 - shares[outside]
        return corners[chosen, 0] + (shares[:, :, None] * edges[chosen]).sum(1)


def _near_enough(surface: Surface, simplified: Surface, error: float) -> bool:
    """Whether a simplified surface stays close to its original.

    Half of the sample points are uniform over the area of the original, half over its triangles,
    which are most numerous where there is detail. 95 % of each half must lie within the error along
    their normals. All must lie within LARGEST_ERROR errors, along their normals or in any
    direction, so that no small part such as a knob is lost.
    """
    rng = np.random.default_rng(0)
    evenly = surface.triangles_by_area(SURFACE_SAMPLES, rng)
    anywhere = rng.integers(len(surface.faces), size=SURFACE_SAMPLES)
    corners = surface.vertices[surface.faces[np.concatenate([evenly, anywhere])]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.maximum(lengths, 1e-30)
    points = (rng.dirichlet(np.ones(3), len(corners))[..., None] * corners).sum(1)

    scene = embree_scene([(simplified.vertices, simplified.faces)])
    distances = []
    for direction in (normals, -normals):
        start = np.ascontiguousarray(points - 1e-6 * direction, np.float32)
        hits = scene.run(start, np.ascontiguousarray(direction, np.float32), output=1)
        distances.append(np.where(hits["primID"] >= 0, hits["tfar"], np.inf))
    along = np.where(lengths[:, 0] > 0, np.minimum(*distances), 0)
    for half in (along[:SURFACE_SAMPLES], along[SURFACE_SAMPLES:]):
        if np.quantile(half, 0.95, method="lower") > error:
            return False

    # The ray along the normal of a point at a crease may miss the surface beside it.
    far = along > LARGEST_ERROR * error
    if not far.any():
        return True
    nearby = simplified.sample(NEARBY_SAMPLES, rng)
    spacing = float(np.sqrt(simplified.area / NEARBY_SAMPLES))
    beside = np.asarray(cKDTree(nearby).query(points[far])[0])
    return bool(beside.max() <= LARGEST_ERROR * error + spacing)


class SurfaceCaster:
    """Casts rays at many surfaces in one call.

    The Embree scene of a surface is built on first use: of a thousand things, few become likely.

    Attributes:
        surfaces: the surfaces, by their number.
        centres: centre of each, in its own frame, (T, 3) float32, metres.
        radii: radius of each, (T,) float32, metres.
        errors: standard deviation of each from the thing, (T,) float64, metres.
    """

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        """Store the surfaces.

        Args:
            surfaces: at least one.
        """
        self.surfaces = tuple(surfaces)
        self.centres = np.stack([surface.centre for surface in self.surfaces])
        self.radii = np.array([surface.radius for surface in self.surfaces], np.float32)
        self.errors = np.array([surface.error for surface in self.surfaces])
        self._scenes: dict[int, Any] = {}

    def __reduce__(self) -> tuple[type["SurfaceCaster"], tuple[tuple[Surface, ...]]]:
        """Pickle the surfaces only: Embree scenes are rebuilt."""
        return SurfaceCaster, (self.surfaces,)

    def __deepcopy__(self, memo: dict[int, object]) -> "SurfaceCaster":
        """The same object: it is immutable."""
        return self

    def _scene(self, thing: int) -> Any:
        """The Embree scene of the surface with this number."""
        if thing not in self._scenes:
            surface = self.surfaces[thing]
            self._scenes[thing] = embree_scene([(surface.vertices, surface.faces)])
        return self._scenes[thing]

    def from_all_sides(
        self, thing: int, origins: Float32, directions: Float32
    ) -> tuple[Float32, Float32]:
        """Cast P rays from each of N origins at one surface, in one call.

        Args:
            thing: number of the surface.
            origins: origins in the frame of the surface, (N, 3) float32, metres.
            directions: directions of the rays, of any length, (N, P, 3) float32.

        Returns:
            As ``cast``: distances, (N, P) float32, and unit normals, (N, P, 3) float32.
        """
        rays = np.ascontiguousarray(directions.reshape(-1, 3))
        starts = np.ascontiguousarray(np.repeat(origins, directions.shape[1], 0))
        hits = self._scene(thing).run(starts, rays, output=1)
        met = np.flatnonzero(hits["primID"] >= 0)
        depth = np.full(len(rays), MISSED)
        depth[met] = hits["tfar"][met]
        across = hits["Ng"][met]
        length = np.sqrt(np.einsum("ni,ni->n", across, across)) + 1e-30
        away = np.einsum("ni,ni->n", across, rays[met])
        normals = np.zeros(rays.shape, np.float32)
        normals[met] = across * (-np.sign(away) / length)[:, None]
        shape = directions.shape
        return depth.reshape(shape[:2]), normals.reshape(shape)

    def cast(
        self,
        things: NDArray[np.integer],
        origins: Float32,
        directions: Float32,
    ) -> tuple[Float32, Float32]:
        """Cast P rays at each of H surfaces.

        Args:
            things: number of the surface of each row of rays, (H,) int.
            origins: origin of each row, in the frame of its surface, (H, 3) float32, metres.
            directions: directions of the rays, of any length, (H, P, 3) float32.

        Returns:
            Distance to the first hit, in lengths of the ray, (H, P) float32, infinity for a miss;
            and the unit normal towards the origin, (H, P, 3) float32, in the frame of the surface,
            zero for a miss.
        """
        things = np.asarray(things)
        depth = np.empty(directions.shape[:2], np.float32)
        normals = np.empty(directions.shape, np.float32)
        starts = np.asarray(origins, np.float32)
        for thing in np.unique(things).tolist():
            rows = np.flatnonzero(things == thing)
            depth[rows], normals[rows] = self.from_all_sides(
                thing, starts[rows], np.asarray(directions[rows], np.float32)
            )
        return depth, normals
