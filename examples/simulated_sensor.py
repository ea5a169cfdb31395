"""A depth camera over simulated things, for the examples.

With a real camera nothing of this is needed.
"""

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

INTRINSICS = np.array([[520.0, 0, 319.5], [0, 520.0, 239.5], [0, 0, 1]])
SHAPE = 480, 640


def look(things, pose, rng):
    """Depth in metres, (480, 640), noise of 1 mm and 3 % holes, of things: pairs of vertices
    (metres) and faces.
    """
    scene = EmbreeScene()
    for vertices, faces in things:
        TriangleMesh(
            scene,
            np.asarray(vertices, np.float32),
            np.ascontiguousarray(faces, np.int32),
        )
    row, column = np.indices(SHAPE)
    x = (column - INTRINSICS[0, 2]) / INTRINSICS[0, 0]
    y = (row - INTRINSICS[1, 2]) / INTRINSICS[1, 1]
    rays = np.stack([x, y, np.ones(SHAPE)], -1).reshape(-1, 3) @ pose[:3, :3].T
    origins = np.tile(pose[:3, 3], (len(rays), 1))
    hits = scene.run(origins.astype(np.float32), rays.astype(np.float32), output=1)
    depth = np.where(hits["primID"] >= 0, hits["tfar"], np.nan).reshape(SHAPE)
    depth += rng.normal(0, 0.001, SHAPE)
    depth[rng.random(SHAPE) < 0.03] = np.nan
    return depth


def square(half, height=0.0):
    """A level square about the z axis."""
    corners = np.array(
        [
            [-half, -half, height],
            [half, -half, height],
            [half, half, height],
            [-half, half, height],
        ]
    )
    return corners, np.array([[0, 1, 2], [0, 2, 3]])


def disc(radius, height=0.0):
    """A level disc about the z axis."""
    around = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    rim = np.stack(
        [radius * np.cos(around), radius * np.sin(around), np.full(360, height)],
        1,
    )
    k = np.arange(360)
    return np.vstack([[[0, 0, height]], rim]), np.stack(
        [0 * k, 1 + k, 1 + (k + 1) % 360],
        1,
    )
