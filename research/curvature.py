"""Curvature measures: how much the visible surface bends, and how variously (thesis, sections
3.4.2 and 3.4.4).
"""

from __future__ import annotations

import numpy as np

from research.area import bits, seen_area, seen_share
from research.bending import bent
from research.mesh_view import MeshView

LEVELS = 32
"""Steps of the arc tangent of a curvature from 0 to infinity, half as wide at both ends: a flat
surface, whose deficits are rounding, is one level and no border of two."""


def curvature_entropy(view: MeshView) -> float:
    """Shannon entropy of the distribution of Gaussian curvature over the visible surface.

    The curvature of a vertex is its angle deficit over a third of the area around it (thesis,
    equation 4, and ``BentSurface.gaussian``); each visible face gives a third of its visible area
    to each corner. A surface bends from not at all to beyond all bounds, so the histogram is of its
    arc tangent. Page et al. 2003, Polonsky et al. 2005 ("curvature entropy"). On smooth surfaces it
    depends little on how the mesh is cut; where faces are flat and edges sharp, a finer mesh has
    more flat vertices, and it falls.

    Returns:
        Bits; 0 on a sphere, and where nothing is seen.
    """
    surface, (faces, _) = bent(view.surface), view.pixels
    curvature = surface.gaussian[surface.corners[faces]]
    level = (
        np.rint(np.arctan(curvature) * (2 * LEVELS / np.pi)).astype(np.int64) + LEVELS
    )
    weight = np.bincount(level.ravel(), np.repeat(seen_area(view), 3))
    return bits(weight / weight.sum()) if weight.sum() > 0 else 0.0


def mean_curvature(view: MeshView) -> float:
    """Mean curvature, unsigned, integrated over the visible surface: how much it bends at its
    edges.

    Secord et al. 2011 ("mean curvature"); thesis, section 3.4.4; see ``BentSurface.mean_of_faces``.
    Concave and convex bends add up. A face that is half hidden has half of what its edges give it.

    Returns:
        Object radii: of a sphere of radius 1 from distance d, 2 pi (1 - 1/d).
    """
    return float(
        (bent(view.surface).mean_of_faces[view.pixels[0]] * seen_share(view)).sum()
    )


def gaussian_curvature(view: MeshView) -> float:
    """Gaussian curvature, unsigned, integrated over the visible surface: how much it bends at its
    corners.

    Secord et al. 2011 ("Gaussian curvature"); thesis, section 3.4.4; see
    ``BentSurface.gaussian_of_faces``.

    Returns:
        Radians squared: of a sphere from distance d, 2 pi (1 - 1/d).
    """
    return float(
        (bent(view.surface).gaussian_of_faces[view.pixels[0]] * seen_share(view)).sum()
    )
