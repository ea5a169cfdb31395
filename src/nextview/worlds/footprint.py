"""Footprints: what things cover of the table, as convex polygons, and how far these are from one another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

Float = NDArray[np.float64]

EDGE = 1e-3
"""Every footprint is wider by this on each side, object radii: so the thinnest sheet has one too."""
_CORNERS = EDGE * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


def footprint(vertices: Float) -> Float:
    """Convex hull of what lies under some points, counter-clockwise, (K, 2).

    Args:
        vertices: (V, 3) or (V, 2).
    """
    around = (vertices[:, None, :2] + _CORNERS).reshape(-1, 2)
    return around[ConvexHull(around).vertices]


def separation(a: Float, b: Float) -> float:
    """How far apart two convex polygons are along the edge normal that parts them most; negative if they overlap.

    The separating axis theorem: two convex polygons are apart if and only if a normal of one of their edges parts them.
    Corner to corner they are farther apart than this, never nearer.

    Args:
        a: counter-clockwise, (K, 2); two points are a line.
        b: the same, (L, 2).
    """
    return max(_gap(a, b), _gap(b, a))


def _gap(a: Float, b: Float) -> float:
    edges = np.roll(a, -1, axis=0) - a
    outward = np.stack([edges[:, 1], -edges[:, 0]], 1) / np.maximum(np.linalg.norm(edges, axis=1), 1e-12)[:, None]
    return float(((b @ outward.T).min(0) - (a * outward).sum(1)).max())


def distances(polygon: Float, points: Float) -> Float:
    """Distance of points, (N, 2), from a convex polygon, counter-clockwise, (K, 2); 0 inside. (N,) float64."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    towards = points[:, None] - polygon
    along = np.clip((towards * edges).sum(-1) / (edges**2).sum(-1), 0, 1)
    off = np.linalg.norm(towards - along[..., None] * edges, axis=-1).min(1)
    inside = (edges[:, 0] * towards[..., 1] - edges[:, 1] * towards[..., 0] >= 0).all(1)
    return np.where(inside, 0.0, off)
