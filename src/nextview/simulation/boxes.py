"""Upright boxes around an object."""

import numpy as np

from nextview.geometry.mesh import Mesh
from nextview.types import Float

# ranges for a box: distance from the object's circle, sides, height
BLOCK_GAP = (0.02, 0.3)
FOOTPRINT = (0.3, 0.9)
BLOCK_HEIGHT = (0.6, 2.6)
_CORNERS = np.array(
    [[x, y, z] for z in (0, 1) for y in (-0.5, 0.5) for x in (-0.5, 0.5)]
)
_FACES = np.reshape([int(i) for i in "021123456576014154263367042246135375"], (-1, 3))


def boxes_around(vertices: Float, count: int, rng: np.random.Generator) -> Mesh:
    """Draw upright boxes on the ground around an object; they may overlap.

    Args:
        vertices: of the object, (V, 3).
        count: number of boxes.
        rng: source of all random numbers.

    Returns:
        The boxes as one mesh, outside the object's circle.
    """
    floor = vertices[:, 2].min()
    reach = np.hypot(vertices[:, 0], vertices[:, 1]).max()
    size = np.concatenate(
        [rng.uniform(*FOOTPRINT, (count, 2)), rng.uniform(*BLOCK_HEIGHT, (count, 1))],
        1,
    )
    azimuth, towards = rng.uniform(0, 2 * np.pi, (2, count))
    away = reach + np.hypot(size[:, 0], size[:, 1]) / 2 + rng.uniform(*BLOCK_GAP, count)
    at = away[:, None] * np.stack([np.cos(towards), np.sin(towards)], 1)
    return upright_boxes(size, azimuth, at, float(floor))


def upright_boxes(size: Float, azimuth: Float, at: Float, floor: float) -> Mesh:
    """Return boxes on the ground as one mesh, not normalised.

    Args:
        size: width, depth and height, (N, 3).
        azimuth: about the vertical, radians, (N,).
        at: centres on the ground, (N, 2).
        floor: height of the ground.

    Returns:
        The mesh.
    """
    corners = _CORNERS * size[:, None]
    c = np.cos(azimuth)[:, None]
    s = np.sin(azimuth)[:, None]
    x = c * corners[..., 0] - s * corners[..., 1] + at[:, :1]
    y = s * corners[..., 0] + c * corners[..., 1] + at[:, 1:]
    places = np.stack([x, y, corners[..., 2] + floor], -1).reshape(-1, 3)
    faces = (_FACES + 8 * np.arange(len(size))[:, None, None]).reshape(-1, 3)
    return Mesh(places, faces.astype(np.int32), np.zeros(3), 1.0, "boxes")
