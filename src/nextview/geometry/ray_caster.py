"""Several things in one Embree scene: how far rays go, and which thing they end on."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
Triangles = tuple[Floats, NDArray[np.int32]]  # vertices, (N, 3), and faces, (F, 3)


def embree_scene(things: Sequence[Triangles]) -> Any:
    """An Embree scene of some things, each with its number."""
    from embreex.mesh_construction import TriangleMesh  # only who casts rays pays for the import
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    for vertices, faces in things:
        TriangleMesh(scene, vertices.astype(np.float32), np.ascontiguousarray(faces, np.int32))
    return scene


class RayCaster:
    """Casts rays at some things of one frame, at least one."""

    def __init__(self, things: Sequence[Triangles]) -> None:
        self._scene = embree_scene(things)

    def cast(self, origins: Floats, rays: Floats) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Where rays, (N, 3), of any length, end first, from (N, 3) points or one for all, (3,).

        How many times its length each goes, (N,), infinity if it ends nowhere; and on which thing,
        -1 for none.
        """
        origins = np.ascontiguousarray(np.broadcast_to(origins, rays.shape), np.float32)
        hits = self._scene.run(origins, np.ascontiguousarray(rays, np.float32), output=1)
        hit = hits["primID"] >= 0
        return np.where(hit, hits["tfar"], np.float32(np.inf)), np.where(
            hit, hits["geomID"].astype(np.int64), -1
        )


def pixel_rays(intrinsics: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float32]:
    """Rays through the pixels of a pinhole camera, camera frame, (H, W, 3), z = 1: their lengths
    are depths.
    """
    (height, width), (fx, _, cx), (_, fy, cy) = shape, *intrinsics[:2]
    x, y = np.meshgrid((np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy)
    return np.stack([x, y, np.ones_like(x)], -1).astype(np.float32)
