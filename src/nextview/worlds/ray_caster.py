"""Several meshes in one Embree scene: how far rays go, and which mesh they end on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nextview.mesh import Mesh


class RayCaster:
    """Casts rays at some meshes of one frame.

    Args:
        meshes: at least one.
    """

    def __init__(self, meshes: Sequence[Mesh]) -> None:
        from embreex.mesh_construction import TriangleMesh  # only who simulates a camera pays for the import
        from embreex.rtcore_scene import EmbreeScene

        self._scene = EmbreeScene()
        for mesh in meshes:
            faces = np.ascontiguousarray(mesh.faces, dtype=np.int32)
            TriangleMesh(self._scene, mesh.vertices.astype(np.float32), faces)

    def cast(
        self, origins: NDArray[np.float32], rays: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Where rays end first.

        Args:
            origins: (N, 3), or (3,) for all.
            rays: (N, 3), of any length.

        Returns:
            How many times its length each ray goes, (N,), infinity if it ends nowhere; and on which mesh, -1 for none.
        """
        origins = np.ascontiguousarray(np.broadcast_to(np.asarray(origins, np.float32), rays.shape))
        hits = self._scene.run(origins, np.ascontiguousarray(rays, np.float32), output=1)
        hit = hits["primID"] >= 0
        return np.where(hit, hits["tfar"], np.float32(np.inf)), np.where(hit, hits["geomID"].astype(np.int64), -1)


def pixel_rays(intrinsics: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float32]:
    """Rays through the pixels of a pinhole camera, camera frame, (H, W, 3), z = 1: their lengths are depths."""
    across, down = (
        (np.arange(side) + 0.5 - intrinsics[axis, 2]) / intrinsics[axis, axis] for axis, side in enumerate(shape[::-1])
    )
    x, y = np.meshgrid(across, down)
    return np.stack([x, y, np.ones_like(x)], -1).astype(np.float32)
