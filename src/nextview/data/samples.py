"""Sample objects made of boxes, for use without any dataset."""

from collections.abc import Callable

import numpy as np

from nextview.errors import UsageError
from nextview.geometry.mesh import Mesh, make_mesh

# opposite corners, centimetres, z up
BoxCorners = tuple[tuple[float, float, float], tuple[float, float, float]]


def _legs(x: float, y: float, thick: float, height: float) -> list[BoxCorners]:
    return [
        ((i * x, j * y, 0), (i * (x - thick), j * (y - thick), height))
        for i in (-1, 1)
        for j in (-1, 1)
    ]


def chair() -> list[BoxCorners]:
    """A chair with four legs and a slatted back; it faces +x."""
    x = 21.0
    y = 22.0
    seat = 45.0
    back = 48.0
    leg = 4.0
    posts: list[BoxCorners] = [
        ((-x, s * y, seat), (-x + leg, s * (y - leg), seat + back)) for s in (-1, 1)
    ]
    slats: list[BoxCorners] = [
        ((-x, -y, seat + h * back), (-x + 2, y, seat + (h + 0.16) * back))
        for h in (0.3, 0.56, 0.84)
    ]
    return [((-x, -y, seat), (x, y, seat + 4)), *_legs(x, y, leg, seat), *posts, *slats]


def table() -> list[BoxCorners]:
    """A table with four legs."""
    return [((-70, -40, 72), (70, 40, 75)), *_legs(70, 40, 7, 72)]


def monitor() -> list[BoxCorners]:
    """A flat screen on a stand; it faces +x."""
    return [
        ((-2, -30, 12), (2, 30, 48)),
        ((-4, -4, 1), (-1, 4, 30)),
        ((-10, -14, 0), (10, 14, 1.5)),
    ]


SAMPLE_MESHES: dict[str, Callable[[], list[BoxCorners]]] = {
    "chair": chair,
    "table": table,
    "monitor": monitor,
}


def sample_mesh(name: str) -> Mesh:
    """Return a sample object by name."""
    if name not in SAMPLE_MESHES:
        raise UsageError(
            f"no sample is called {name!r}; there are {', '.join(SAMPLE_MESHES)}"
        )
    return boxes_mesh(SAMPLE_MESHES[name](), name)


def boxes_mesh(boxes: list[BoxCorners], name: str) -> Mesh:
    """Create a mesh of axis-aligned boxes, each closed by twelve triangles.

    Args:
        boxes: two opposite corners of each box.
        name: of the mesh.

    Returns:
        The mesh.
    """
    corner = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
    sides = np.array(
        [
            (0, 1, 3, 2),
            (4, 6, 7, 5),
            (0, 4, 5, 1),
            (2, 3, 7, 6),
            (0, 2, 6, 4),
            (1, 5, 7, 3),
        ]
    )
    triangles = np.concatenate([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]])
    spans = np.sort(np.array(boxes, float), axis=1)  # (boxes, low and high, xyz)
    vertices = np.where(corner[None], spans[:, 1:2], spans[:, 0:1])
    faces = triangles[None] + 8 * np.arange(len(boxes))[:, None, None]
    return make_mesh(vertices.reshape(-1, 3), faces.reshape(-1, 3), name)
