"""A world as geometry: meshes in the target's object frame, what they hide, and where a camera can be."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import of_kind, places, regular_file, takes_paths, whole
from nextview.cameras.sensors.boxes_around import upright_boxes
from nextview.errors import DatasetError, MeshError
from nextview.mesh import Mesh, load_mesh
from nextview.mesh_format import MAX_FACES
from nextview.worlds.footprint import Float, distances, footprint, separation
from nextview.worlds.world import Block, Placement, World

TABLE = 3.4
"""Half the side of the square table, object radii: what stands around the target stands on it."""
CLEARANCE = 0.2
"""What a camera needs to each side, object radii."""


@dataclass(frozen=True)
class Item:
    """One thing beside the target.

    Attributes:
        vertices: object frame of the target, (V, 3).
        faces: (F, 3) int32.
        footprint: counter-clockwise, (K, 2).
        wall: see ``Block``.
    """

    vertices: Float
    faces: NDArray[np.int32]
    footprint: Float
    wall: bool = False

    @property
    def top(self) -> float:
        """Height of its highest point, z."""
        return float(self.vertices[:, 2].max())


@dataclass(frozen=True)
class Scene:
    """What stands on the table of a world.

    Attributes:
        target: the object that is meant.
        items: the others.
    """

    target: Mesh
    items: tuple[Item, ...] = ()

    @property
    def floor(self) -> float:
        """Height of the table, z, object radii."""
        return float(self.target.vertices[:, 2].min())

    @cached_property
    def around(self) -> Mesh | None:
        """All items as one mesh, in the target's frame and radii, not normalised; None if there is none."""
        if not self.items:
            return None
        first = np.cumsum([0, *(len(item.vertices) for item in self.items)])
        faces = np.concatenate([item.faces + at for item, at in zip(self.items, first[:-1], strict=True)])
        vertices = np.concatenate([item.vertices for item in self.items])
        return Mesh(vertices, faces.astype(np.int32), np.zeros(3), 1.0, "items")

    @cached_property
    def table(self) -> Mesh:
        """Its top, a square."""
        square = np.array([[-TABLE, -TABLE], [TABLE, -TABLE], [TABLE, TABLE], [-TABLE, TABLE]])
        square = np.column_stack([square, np.full(4, self.floor)])
        return Mesh(square, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.zeros(3), 1.0, "table")

    def clearance(self, positions: Float) -> Float:
        """Distance of cameras from the nearest item, as upright as its footprint and as high as its top, or the table.

        Args:
            positions: object frame, object radii, (V, 3).

        Returns:
            (V,) float64, object radii; 0 inside of an item, negative below the table.

        Raises:
            UsageError: these are no positions.
        """
        positions = places(positions, "the positions of cameras")
        found = positions[:, 2] - self.floor
        for item in self.items:
            above = np.maximum(positions[:, 2] - item.top, 0)
            found = np.minimum(found, np.hypot(distances(item.footprint, positions[:, :2]), above))
        return found

    def reachable(self, positions: Float) -> NDArray[np.bool_]:
        """Whether a camera can be brought to each position, (V, 3), object frame, object radii; (V,) bool.

        Not into an item or below the table, or nearer than CLEARANCE; nor to where, seen from above, a wall stands
        between it and the target, however low that is.
        """
        positions = places(positions, "the positions of cameras")
        free = self.clearance(positions) >= CLEARANCE
        for wall in (item.footprint for item in self.items if item.wall):
            free &= [separation(np.array([p, (0.0, 0.0)]), wall) > 0 for p in positions[:, :2]]
        return free


def build_scene(world: World, meshes: str | Path, max_faces: int = MAX_FACES) -> Scene:
    """Everything in a world as geometry.

    Args:
        world: in words.
        meshes: the folder below which its mesh files are.
        max_faces: of all meshes together, each as often as it stands there; see ``load_mesh``.

    Raises:
        DatasetError: a mesh file is not the one that the world was made with.
        MeshError: it cannot be used, or there are too many faces.
    """
    of_kind(world, World, "a scene is built of a World", DatasetError)
    of_kind(meshes, str | Path, "meshes are a folder", DatasetError)
    whole(max_faces, "the largest number of faces", 1)
    loaded: list[Mesh] = []
    for placed in (world.target, *world.objects):
        loaded.append(_load(Path(meshes), placed, max_faces))
        faces = sum(len(mesh.faces) for mesh in loaded)
        if faces > max_faces:
            most = f"more than {max_faces:,}; --max-faces (max_faces) allows more"
            raise MeshError(f"world {world.name}: its meshes have {faces:,} triangles, {most}")
    target, *others = loaded
    floor = float(target.vertices[:, 2].min())
    objects = [place(mesh, at, floor) for mesh, at in zip(others, world.objects, strict=True)]
    return Scene(target, (*objects, *(block_item(block, floor) for block in world.blocks)))


def place(mesh: Mesh, at: Placement, floor: float) -> Item:
    """A mesh, in its own frame and radii, turned, scaled and stood on the table."""
    c, s = np.cos(at.turn), np.sin(at.turn)
    vertices = at.radius * mesh.vertices @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
    vertices += (at.x, at.y, floor - vertices[:, 2].min())
    return Item(vertices, mesh.faces, footprint(vertices))


def block_item(block: Block, floor: float) -> Item:
    """A box on the table."""
    size, middle = np.array([[block.width, block.depth, block.height]]), np.array([[block.x, block.y]])
    mesh = upright_boxes(size, np.array([block.turn]), middle, floor)
    return Item(mesh.vertices, mesh.faces, footprint(mesh.vertices), block.wall)


def _load(meshes: Path, placed: Placement, max_faces: int) -> Mesh:
    path = meshes / placed.mesh
    if mesh_hash(path) != placed.sha256:
        raise DatasetError(f"{path}: is not the mesh that this world was made with")
    return cached_mesh(path, max_faces)


@lru_cache(maxsize=64)
def cached_mesh(path: Path, max_faces: int = MAX_FACES) -> Mesh:
    """A mesh, read once: the same ones stand in many worlds. See ``load_mesh``."""
    return load_mesh(path, max_faces=max_faces)


@takes_paths("path")
@lru_cache(maxsize=4096)
def mesh_hash(path: Path) -> str:
    """SHA-256 of a mesh file in hexadecimal.

    Raises:
        DatasetError: it cannot be read.
    """
    regular_file(path, "a mesh file", DatasetError)
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except (OSError, ValueError) as error:  # a zero byte in the name
        reason = getattr(error, "strerror", error)
        raise DatasetError(f"{path}: cannot be read ({reason}); is it the folder of the meshes?") from None
