"""Geometry of a scene: objects on a table or in a room, and reachable camera positions."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from nextview.checks import points
from nextview.errors import DatasetError, MeshError, option
from nextview.files import regular_file, sha256_of
from nextview.geometry.mesh import MAX_FACES, Mesh, load_mesh
from nextview.geometry.resting import rotated
from nextview.geometry.viewsphere import rotation_z
from nextview.simulation.boxes import upright_boxes
from nextview.types import Float, Mask
from nextview_lab.worlds.scene_layout import (
    SCENE_TABLE,
    UPRIGHT,
    Block,
    Placement,
    SceneLayout,
)

SCENE_CLEARANCE = 0.2  # clearance around a camera, object radii
# margin of every footprint, object radii, so that thin sheets have an area
FOOTPRINT_EDGE = 1e-3
_AROUND = FOOTPRINT_EDGE * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


@dataclass(frozen=True)
class Item:
    """An object next to the target.

    Attributes:
        vertices: (V, 3), object radii of the target.
        faces: (F, 3) vertex indices.
        footprint: outline in the top view, (K, 2).
        wall: whether the camera cannot be behind it.
    """

    vertices: Float
    faces: NDArray[np.int32]
    footprint: Float
    wall: bool = False


@dataclass(frozen=True)
class TargetScene:
    """A target, and the other objects on its table or in its room.

    Attributes:
        target: the object to recognise.
        items: the other objects.
        half: half the side of the table or floor, object radii.
        metres: object radius of the target; None if not known.
    """

    target: Mesh
    items: tuple[Item, ...] = ()
    half: float = SCENE_TABLE
    metres: float | None = None

    @property
    def floor(self) -> float:
        """Height of the table, z, object radii."""
        return float(self.target.vertices[:, 2].min())

    @cached_property
    def around(self) -> Mesh | None:
        """All items as one mesh in the target's frame, not normalised; None without items."""
        if not self.items:
            return None
        first = np.cumsum([0, *(len(item.vertices) for item in self.items)])
        faces = np.concatenate(
            [item.faces + at for item, at in zip(self.items, first, strict=False)]
        )
        vertices = np.concatenate([item.vertices for item in self.items])
        return Mesh(vertices, faces.astype(np.int32), np.zeros(3), 1.0, "items")

    @cached_property
    def table(self) -> Mesh:
        """Table top or floor, a square."""
        return Mesh(*square(self.half, self.floor), np.zeros(3), 1.0, "table")

    def clearance(self, positions: Float) -> Float:
        """Return the distance of cameras, (V, 3), from the nearest item or the table, (V,).

        It is 0 inside an item, and negative below the table.
        """
        found = positions[:, 2] - self.floor
        height = positions[:, 2]
        for item in self.items:
            low = item.vertices[:, 2].min()
            high = item.vertices[:, 2].max()
            aside = np.maximum(np.maximum(height - high, low - height), 0)
            found = np.minimum(
                found,
                np.hypot(distances(item.footprint, positions[:, :2]), aside),
            )
        return found

    def reachable(self, positions: Float) -> Mask:
        """Return whether a camera can be at each position, (V, 3), object radii; (V,) bool.

        It must be at least SCENE_CLEARANCE from items and the table, and not behind a wall as seen
        from the target in the top view.
        """
        positions = points(positions, "the positions of cameras")
        free = self.clearance(positions) >= SCENE_CLEARANCE
        for wall in (item.footprint for item in self.items if item.wall):
            free &= [
                separation(np.array([p, (0.0, 0.0)]), wall) > 0
                for p in positions[:, :2]
            ]
        return free


def build_scene(
    layout: SceneLayout,
    meshes: str | Path,
    max_faces: int = MAX_FACES,
) -> TargetScene:
    """Build a scene from the mesh files of a folder.

    Args:
        layout: of the scene.
        meshes: the folder.
        max_faces: largest number of triangles of all meshes together.

    Returns:
        The scene.

    Raises:
        MeshError: the meshes have more triangles.
        DatasetError: a file differs from the one with which the scene was created.
    """
    loaded: list[Mesh] = []
    for placed in (layout.target, *layout.objects):
        path = Path(meshes) / placed.mesh
        if mesh_hash(path) != placed.sha256:
            raise DatasetError(f"{path}: is not the mesh that this scene was made with")
        loaded.append(cached_mesh(path, max_faces))
        if (faces := sum(len(mesh.faces) for mesh in loaded)) > max_faces:
            most = f"more than {max_faces:,}; {option('max_faces')} allows more"
            raise MeshError(
                f"scene {layout.name}: its meshes have {faces:,} triangles, {most}"
            )

    target, *others = loaded
    if layout.target.rotation != UPRIGHT:
        target = rotated(target, np.reshape(layout.target.rotation, (3, 3)))
    floor = float(target.vertices[:, 2].min())
    objects = [
        place(mesh, at, floor) for mesh, at in zip(others, layout.objects, strict=True)
    ]
    return TargetScene(
        target,
        (*objects, *(block_item(block, floor) for block in layout.blocks)),
        layout.table,
        layout.metres,
    )


def place(mesh: Mesh, at: Placement, floor: float) -> Item:
    """Rotate and scale a mesh and place it on the table.

    Args:
        mesh: the mesh.
        at: its placement.
        floor: height of the table.

    Returns:
        The item.
    """
    turn = rotation_z(at.azimuth) @ np.reshape(at.rotation, (3, 3))
    vertices = at.radius * mesh.vertices @ turn.T
    vertices += (at.x, at.y, floor - vertices[:, 2].min())
    return Item(vertices, mesh.faces, footprint(vertices))


def block_item(block: Block, floor: float) -> Item:
    """Place a box on the table.

    Args:
        block: the box and its placement.
        floor: height of the table.

    Returns:
        The item.
    """
    size = np.array([[block.width, block.depth, block.height]])
    middle = np.array([[block.x, block.y]])
    mesh = upright_boxes(size, np.array([block.azimuth]), middle, floor + block.z)
    return Item(mesh.vertices, mesh.faces, footprint(mesh.vertices), block.wall)


@lru_cache(maxsize=64)
def cached_mesh(
    path: Path, max_faces: int = MAX_FACES, unit: str | None = None
) -> Mesh:
    """Load a mesh with a cache, as meshes are shared between scenes; see ``load_mesh``.

    Args:
        path: of the file.
        max_faces: largest number of triangles.
        unit: of its lengths; None if not known.

    Returns:
        The mesh.
    """
    return load_mesh(path, unit=unit, max_faces=max_faces)


@lru_cache(maxsize=4096)
def mesh_hash(path: Path) -> str:
    """SHA-256 of a mesh file in hexadecimal."""
    regular_file(path, "a mesh", DatasetError)
    return sha256_of(path)


def square(half: float, height: float) -> tuple[Float, NDArray[np.int32]]:
    """Return a level square.

    Args:
        half: half of its side.
        height: of the square.

    Returns:
        Vertices, (4, 3), and faces, (2, 3) int32.
    """
    corners = np.array(
        [
            [-half, -half, height],
            [half, -half, height],
            [half, half, height],
            [-half, half, height],
        ]
    )
    return corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def footprint(vertices: Float) -> Float:
    """Return the convex hull of points in the top view, counter-clockwise, (K, 2).

    Points are (V, 3) or (V, 2).
    """
    around = (vertices[:, None, :2] + _AROUND).reshape(-1, 2)
    return around[ConvexHull(around).vertices]


def separation(a: Float, b: Float) -> float:
    """Return the distance of two convex polygons along the best separating edge normal.

    It is a lower bound of the distance between corners, and negative if the polygons overlap.

    Args:
        a: corners, counter-clockwise, (K, 2); two points are a line.
        b: corners, counter-clockwise, (L, 2).

    Returns:
        The distance.
    """
    return max(_gap(a, b), _gap(b, a))


def _gap(a: Float, b: Float) -> float:
    edges = np.roll(a, -1, axis=0) - a
    outward = (
        np.stack([edges[:, 1], -edges[:, 0]], 1)
        / np.maximum(np.linalg.norm(edges, axis=1), 1e-12)[:, None]
    )
    return float(((b @ outward.T).min(0) - (a * outward).sum(1)).max())


def distances(polygon: Float, points: Float) -> Float:
    """Return the distance of points from a convex polygon.

    Args:
        polygon: corners, counter-clockwise, (K, 2).
        points: (N, 2).

    Returns:
        Distances, (N,) float64; 0 inside.
    """
    edges = np.roll(polygon, -1, axis=0) - polygon
    towards = points[:, None] - polygon
    along = np.clip((towards * edges).sum(-1) / (edges**2).sum(-1), 0, 1)
    off = np.linalg.norm(towards - along[..., None] * edges, axis=-1).min(1)
    inside = (edges[:, 0] * towards[..., 1] - edges[:, 1] * towards[..., 0] >= 0).all(1)
    return np.where(inside, 0.0, off)
