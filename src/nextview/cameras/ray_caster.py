"""Several things in one Embree scene: how far rays go, and which thing they end on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Triangles = tuple[NDArray[np.float64], NDArray[np.int32]]
"""Vertices, (N, 3), and faces, (F, 3)."""


class RayCaster:
    """Casts rays at some things of one frame.

    Args:
        things: at least one.
    """

    def __init__(self, things: Sequence[Triangles]) -> None:
        from embreex.mesh_construction import TriangleMesh  # only who simulates a camera pays for the import
        from embreex.rtcore_scene import EmbreeScene

        self._scene = EmbreeScene()
        for vertices, faces in things:
            TriangleMesh(self._scene, vertices.astype(np.float32), np.ascontiguousarray(faces, np.int32))

    def hits(self, origins: NDArray[np.floating], rays: NDArray[np.floating]) -> dict[str, NDArray]:
        """What rays, (N, 3), from one point or (N, 3) points hit: Embree's arrays, "geomID" the index of the thing."""
        origins = np.ascontiguousarray(np.broadcast_to(origins, rays.shape), np.float32)
        return self._scene.run(origins, np.ascontiguousarray(rays, np.float32), output=1)

    def cast(
        self, origins: NDArray[np.floating], rays: NDArray[np.floating]
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Where rays end first.

        Args:
            origins: (N, 3), or (3,) for all.
            rays: (N, 3), of any length.

        Returns:
            How many times its length each ray goes, (N,), infinity if it ends nowhere; and on which thing, -1 for none.
        """
        hits = self.hits(origins, rays)
        hit = hits["primID"] >= 0
        return np.where(hit, hits["tfar"], np.float32(np.inf)), np.where(hit, hits["geomID"].astype(np.int64), -1)


def pixel_rays(intrinsics: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float32]:
    """Rays through the pixels of a pinhole camera, camera frame, (H, W, 3), z = 1: their lengths are depths."""
    across, down = (
        (np.arange(side) + 0.5 - intrinsics[axis, 2]) / intrinsics[axis, axis] for axis, side in enumerate(shape[::-1])
    )
    x, y = np.meshgrid(across, down)
    return np.stack([x, y, np.ones_like(x)], -1).astype(np.float32)
