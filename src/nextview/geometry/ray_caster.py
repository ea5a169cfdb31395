"""Several things in one Embree scene: how far rays go, and which thing they end on."""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.types import Float32, Floats, Index

Triangles = tuple[Floats, NDArray[np.int32]]  # vertices, (N, 3), and faces, (F, 3)


def embree_scene(things: Sequence[Triangles]) -> Any:
    """An Embree scene of some things, each with its number."""
    from embreex.mesh_construction import (
        TriangleMesh,
    )  # only who casts rays pays for the import
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene(_device())
    for vertices, faces in things:
        TriangleMesh(
            scene,
            vertices.astype(np.float32),
            np.ascontiguousarray(faces, np.int32),
        )
    return scene


@cache
def _device() -> Any:
    """The one Embree device of this process: embreex does not notice if another one fails."""
    from embreex.rtcore import EmbreeDevice

    return EmbreeDevice()


class RayCaster:
    """Casts rays at some things of one frame, at least one."""

    def __init__(self, things: Sequence[Triangles]) -> None:
        self._scene = embree_scene(things)

    def cast(self, origins: Floats, rays: Floats) -> tuple[Float32, Index]:
        """Find where rays first meet a surface.

        Args:
            origins: starts of the rays, (N, 3), or one for all, (3,).
            rays: directions, (N, 3), of any length.

        Returns:
            Distance along each ray as a multiple of its length, (N,) float32, infinity if it meets
            nothing; and the index of the thing that it meets, (N,) int64, -1 for none.
        """
        origins = np.ascontiguousarray(np.broadcast_to(origins, rays.shape), np.float32)
        hits = self._scene.run(
            origins,
            np.ascontiguousarray(rays, np.float32),
            output=1,
        )
        hit = hits["primID"] >= 0
        return np.where(hit, hits["tfar"], np.float32(np.inf)), np.where(
            hit,
            hits["geomID"].astype(np.int64),
            -1,
        )
