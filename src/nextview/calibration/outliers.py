"""Made-up objects of no class, to learn what known ones are not (outlier exposure, Hendrycks et al., ICLR 2019).

Each family strays from real objects in a way of its own: primitives in a heap, an object turned over, stretched or cut,
parts of two objects joined.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview.mesh import Mesh, make_mesh

Float = NDArray[np.float64]

FAMILIES = ("primitives", "turned", "stretched", "cut", "joined")
"""Ways of making up an object. The first needs no object to begin with."""
_ROUND, _MAX_STRETCH, _MAX_PRIMITIVES = 24, 6.0, 6


def make_up(family: str, one: Mesh, other: Mesh, rng: np.random.Generator) -> Mesh:
    """An object of no class.

    Args:
        family: one of FAMILIES.
        one: an object to begin with.
        other: another one, of which a part is joined to the first.
        rng: draws everything.

    Raises:
        MeshError: what is left has no area.
    """
    if family == "primitives":
        vertices, faces = _joined([_primitive(rng) for _ in range(rng.integers(1, _MAX_PRIMITIVES + 1))])
    elif family == "turned":
        vertices, faces = one.vertices @ rotation(rng).T, one.faces
    elif family == "stretched":
        vertices, faces = one.vertices * _stretch(rng), one.faces
    elif family == "cut":
        vertices, faces = one.vertices, _beyond(one, rng)
    elif family == "joined":
        shifted = other.vertices * rng.uniform(0.5, 1) + rng.uniform(-0.5, 0.5, 3)
        vertices, faces = _joined([(one.vertices, _beyond(one, rng)), (shifted, _beyond(other, rng))])
    else:
        raise ValueError(f"no family of made-up objects is called {family!r}")
    return make_mesh(vertices, faces, f"a made-up object ({family})")


def rotation(rng: np.random.Generator) -> Float:
    """A rotation, all equally likely, (3, 3): a unit quaternion from four Gaussians (Muller, 1959)."""
    q = rng.normal(size=4)
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _stretch(rng: np.random.Generator) -> Float:
    """Factors along the axes, (3,): one or two of them 2 to 6 or its inverse."""
    factors = np.ones(3)
    axes = rng.permutation(3)[: rng.integers(1, 3)]
    factors[axes] = np.exp(rng.uniform(np.log(2), np.log(_MAX_STRETCH)) * rng.choice([-1, 1]))
    return factors


def _beyond(mesh: Mesh, rng: np.random.Generator) -> NDArray[np.int32]:
    """The faces on one side of a random plane, a quarter of them at least and three quarters at most."""
    normal = rng.normal(size=3)
    along = mesh.vertices[mesh.faces].mean(1) @ normal
    kept: NDArray[np.int32] = mesh.faces[along >= np.quantile(along, rng.uniform(0.25, 0.75))]
    return kept


def _primitive(rng: np.random.Generator) -> tuple[Float, NDArray[np.int32]]:
    """A box, an ellipsoid, a cylinder or a cone of some size at some place, upright in half of the cases."""
    kind = rng.integers(4)
    if kind == 0:
        profile, sides = np.array([(0, -1), (1, -1), (1, 1), (0, 1)], float), 4
    elif kind == 1:
        angle = np.linspace(-np.pi / 2, np.pi / 2, _ROUND // 2)
        profile, sides = np.stack([np.cos(angle), np.sin(angle)], 1), _ROUND
    else:
        top = 1.0 if kind == 2 else rng.uniform(0, 0.6)
        profile, sides = np.array([(0, -1), (1, -1), (top, 1), (0, 1)]), _ROUND
    vertices, faces = turned_on_a_lathe(profile, sides)
    vertices = vertices * np.exp(rng.uniform(np.log(0.1), np.log(1), 3))
    if rng.random() < 0.5:
        vertices = vertices @ rotation(rng).T
    return vertices + rng.uniform(-0.6, 0.6, 3), faces


def turned_on_a_lathe(profile: Float, sides: int) -> tuple[Float, NDArray[np.int32]]:
    """A solid of revolution about z.

    Args:
        profile: radius and height, from the bottom up, (P, 2).
        sides: around.

    Returns:
        Vertices (P * sides, 3) and faces.
    """
    angle = 2 * np.pi * np.arange(sides) / sides
    radius, height = profile[:, 0, None], np.broadcast_to(profile[:, 1, None], (len(profile), sides))
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1).reshape(-1, 3)
    low = (np.arange(len(profile) - 1)[:, None] * sides + np.arange(sides)).ravel()
    after = (np.arange(len(profile) - 1)[:, None] * sides + (np.arange(sides) + 1) % sides).ravel()
    faces = np.concatenate(
        [np.stack([low, after, after + sides], 1), np.stack([low, after + sides, low + sides], 1)]
    ).astype(np.int32)
    return vertices, faces


def _joined(parts: list[tuple[Float, NDArray[np.int32]]]) -> tuple[Float, NDArray[np.int32]]:
    """Several meshes as one."""
    begin = np.cumsum([0, *[len(vertices) for vertices, _ in parts[:-1]]])
    faces = np.concatenate([faces + first for (_, faces), first in zip(parts, begin, strict=True)])
    return np.concatenate([vertices for vertices, _ in parts]), faces.astype(np.int32)
