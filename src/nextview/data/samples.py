"""Sample objects of our own, made of boxes: something to look at before any dataset is there."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from nextview.errors import UsageError
from nextview.geometry.mesh import Mesh, make_mesh

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Two opposite corners, centimetres, z up."""


def chair(seat: float = 45, width: float = 44, depth: float = 42, back: float = 48, leg: float = 4) -> list[Box]:
    """A chair with four legs and a slatted back; it faces +x."""
    x, y = depth / 2, width / 2
    legs: list[Box] = [
        ((sx * x, sy * y, 0), (sx * (x - leg), sy * (y - leg), seat)) for sx in (-1, 1) for sy in (-1, 1)
    ]
    posts: list[Box] = [((-x, s * y, seat), (-x + leg, s * (y - leg), seat + back)) for s in (-1, 1)]
    slats: list[Box] = [((-x, -y, seat + h * back), (-x + 2, y, seat + (h + 0.16) * back)) for h in (0.3, 0.56, 0.84)]
    return [((-x, -y, seat), (x, y, seat + 4)), *legs, *posts, *slats]


def table(length: float = 140, width: float = 80, height: float = 72, leg: float = 7) -> list[Box]:
    """A table with four legs."""
    x, y = length / 2, width / 2
    legs: list[Box] = [
        ((sx * x, sy * y, 0), (sx * (x - leg), sy * (y - leg), height)) for sx in (-1, 1) for sy in (-1, 1)
    ]
    return [((-x, -y, height), (x, y, height + 3)), *legs]


def monitor(width: float = 60, height: float = 36, neck: float = 12) -> list[Box]:
    """A flat screen on a foot; it faces +x."""
    return [
        ((-2, -width / 2, neck), (2, width / 2, neck + height)),
        ((-4, -4, 1), (-1, 4, neck + height / 2)),
        ((-10, -14, 0), (10, 14, 1.5)),
    ]


SAMPLES: dict[str, Callable[[], list[Box]]] = {"chair": chair, "table": table, "monitor": monitor}


def sample_mesh(name: str) -> Mesh:
    """A sample object by name."""
    if name not in SAMPLES:
        raise UsageError(f"no sample is called {name!r}; there are {', '.join(SAMPLES)}")
    return boxes_mesh(SAMPLES[name](), name)


def boxes_mesh(boxes: list[Box], name: str) -> Mesh:
    """A mesh of axis-aligned boxes, each closed by twelve triangles."""
    corner = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
    sides = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
    triangles = np.concatenate([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]])
    spans: NDArray[np.float64] = np.sort(np.array(boxes, float), axis=1)  # (boxes, low and high, xyz)
    vertices = np.where(corner[None], spans[:, 1:2], spans[:, 0:1])
    faces = triangles[None] + 8 * np.arange(len(boxes))[:, None, None]
    return make_mesh(vertices.reshape(-1, 3), faces.reshape(-1, 3), name)
