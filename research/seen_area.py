"""How much of each face a view shows, from its pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from research.mesh_view import MeshView

GRAZING = 0.05
"""Where a surface turns farther from the camera than this cosine, it counts as turned so far: one
row of pixels more or less on a plane that is seen from its edge would else decide over as much area
as all the rest."""


def seen_area(view: MeshView) -> NDArray[np.float64]:
    """How much is seen of each of the faces in ``view.pixels``, (k,), square object radii; computed
    once for a view.

    A pixel shows z^2 / (fx fy |n . r|) of a face: z is its depth, n the face's unit normal, r the
    pixel's ray whose z is 1. z |n . r| is how far the camera is from the face's plane. Pixels are
    samples: of a face smaller than one, more may be counted than there is, and of others none; over
    many it evens out.
    """
    if "seen_area" not in view.__dict__:
        faces = view.pixels[0]
        hits = view.faces >= 0
        ids = view.faces[hits]
        z = view.depths[hits]
        corners = view.surface.vertices[view.surface.faces[faces, 0]]
        apart = np.zeros(int(faces[-1]) + 1 if len(faces) else 0)
        apart[faces] = np.abs(
            ((corners - view.pose[:3, 3]) * view.surface.normals[faces]).sum(1)
        )
        focal = view.intrinsics[0, 0] * view.intrinsics[1, 1]
        patches = z**2 / (focal * np.maximum(apart[ids] / z, GRAZING))
        view.__dict__["seen_area"] = np.asarray(
            np.bincount(ids, patches)[faces],
            np.float64,
        )
    return view.__dict__["seen_area"]


def seen_share(view: MeshView) -> NDArray[np.float64]:
    """Which share is seen of each of these faces, (k,), about 0 .. 1; 0 of a face without area."""
    areas = view.surface.areas[view.pixels[0]]
    return np.divide(seen_area(view), areas, out=np.zeros(len(areas)), where=areas > 0)
