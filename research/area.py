"""Area measures: how much of the object is seen, and how evenly over its faces (thesis, section
3.4.1).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview_lab.data.measures import MeasuredView
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


def bits(shares: NDArray[np.floating]) -> float:
    """Shannon entropy of shares that add up to 1, bits (thesis, equation 3); 0 of none."""
    shares = shares[shares > 0]
    return float(-(shares * np.log2(shares)).sum()) if len(shares) else 0.0


def view_area(view: MeasuredView) -> float:
    """Share of the image that shows the object: its projected area.

    Dutagaci et al. 2010 ("view area"), Secord et al. 2011 ("projected area"); thesis, section
    3.4.1.

    Returns:
        Between 0 and 1; the sphere around the object fills pi/4 of the image.
    """
    return len(view.depths) / view.depth.size


def visible_area_ratio(view: MeshView) -> float:
    """Area of the surface that is seen, over the area of the whole surface; what is hidden of a
    face does not count.

    Plemenos and Benayada 1996, Polonsky et al. 2005 ("visibility ratio"), Dutagaci et al. 2010
    ("ratio of visible area"); thesis, section 3.4.1.

    Returns:
        Between 0 and 1: of a sphere from distance d, (1 - 1/d) / 2.
    """
    return min(float(seen_area(view).sum() / view.surface.areas.sum()), 1.0)


def surface_visibility(view: MeshView) -> float:
    """Area of the faces of which anything is seen, over the area of all faces: the ratio of visible
    area by faces.

    Secord et al. 2011 ("surface visibility"), Dutagaci et al. 2010; thesis, section 3.4.1, by "the
    mesh area visible from a viewpoint". Large faces that are nearly hidden count whole, so it
    depends on how the mesh is cut.

    Returns:
        Between 0 and 1: 1/2 of a cube of which three sides are seen.
    """
    return float(view.surface.areas[view.pixels[0]].sum() / view.surface.areas.sum())


def viewpoint_entropy(view: MeshView) -> float:
    """Shannon entropy of the shares that the faces have in the object's projected area.

    Vázquez et al. 2001, without their background; Dutagaci et al. 2010 ("surface area entropy");
    thesis, section 3.4.1 and equation 3. It counts faces as they are cut: cut each into four and it
    is 2 bits more, from everywhere.

    Returns:
        Bits; 0 where one face is seen or none.
    """
    pixels = view.pixels[1]
    return bits(pixels / pixels.sum()) if len(pixels) else 0.0
