"""Boxes that stand around an object and hide parts of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview.mesh import Mesh

GAP = (0.02, 0.3)
"""Between the object's outline, as a circle, and a box, object radii."""
FOOTPRINT = (0.3, 0.9)
"""Sides of a box, object radii."""
HEIGHT = (0.6, 2.6)
"""Object radii."""
_CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
_FACES = np.reshape(
    [0, 2, 1, 1, 2, 3, 4, 5, 6, 5, 7, 6, 0, 1, 4, 1, 5, 4, 2, 6, 3, 3, 6, 7, 0, 4, 2, 2, 4, 6, 1, 3, 5, 3, 7, 5],
    (-1, 3),
)


def boxes_around(vertices: NDArray[np.float64], count: int, rng: np.random.Generator) -> Mesh:
    """Upright boxes on the ground on which an object stands, turned in any way, none of them in its outline's circle.

    Args:
        vertices: of the object, object frame, (V, 3).
        count: how many boxes, at least 1; they may run into each other.
        rng: draws them.

    Returns:
        All of them as one mesh, in the object's frame and radii, not normalised.
    """
    floor, reach = vertices[:, 2].min(), np.hypot(vertices[:, 0], vertices[:, 1]).max()
    size = np.concatenate([rng.uniform(*FOOTPRINT, (count, 2)), rng.uniform(*HEIGHT, (count, 1))], 1)
    turn, towards = rng.uniform(0, 2 * np.pi, (2, count))
    away = reach + np.hypot(size[:, 0], size[:, 1]) / 2 + rng.uniform(*GAP, count)
    at = away[:, None] * np.stack([np.cos(towards), np.sin(towards)], 1)
    return upright_boxes(size, turn, at, float(floor))


def upright_boxes(size: NDArray[np.float64], turn: NDArray[np.float64], at: NDArray[np.float64], floor: float) -> Mesh:
    """Boxes that stand on the ground.

    Args:
        size: width, depth and height of each, (N, 3).
        turn: of each about the vertical, radians, (N,).
        at: where its middle stands, (N, 2).
        floor: height of the ground.

    Returns:
        All of them as one mesh, not normalised: 8 vertices and 12 faces each, in order.
    """
    corners = _CORNERS * size[:, None]
    c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
    x = c * corners[..., 0] - s * corners[..., 1] + at[:, :1]
    y = s * corners[..., 0] + c * corners[..., 1] + at[:, 1:]
    places = np.stack([x, y, corners[..., 2] + floor], -1).reshape(-1, 3)
    faces = (_FACES + 8 * np.arange(len(size))[:, None, None]).reshape(-1, 3)
    return Mesh(places, faces.astype(np.int32), np.zeros(3), 1.0, "boxes")
