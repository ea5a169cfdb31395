"""Semantic measures: what people like to see of an object, and what not (thesis, section 3.4.5)."""

from __future__ import annotations

import numpy as np

from nextview_lab.data.measures import MeasuredView
from research.mesh_view import MeshView

LIKED = 22.5
SPREAD = 45.0
"""Elevation that people like best, and the width of their liking, degrees (Secord et al. 2011,
after Blanz et al.).
"""
BASE = 0.05
DOWN = 0.7
"""What belongs to the base: the lowest part of the object's height, of surfaces that face down at
least so far: the cosine of 45 degrees."""


def above_preference(view: MeasuredView) -> float:
    """How near the view is to the elevation that people choose: a normal curve about 22.5 degrees
    above the horizon.

    Secord et al. 2011 ("above preference": mean 3/8 pi from the pole, standard deviation pi/4);
    thesis, section 3.4.5. It knows nothing of the object, but where nothing is seen there is
    nothing to like.

    Returns:
        1 at that elevation, less above and below; 0 where nothing is seen.
    """
    if len(view.depths) == 0:
        return 0.0
    up = view.pose[2, 3] / np.linalg.norm(view.pose[:3, 3])
    elevation = np.degrees(np.arcsin(np.clip(up, -1, 1)))
    return float(np.exp(-(((elevation - LIKED) / SPREAD) ** 2) / 2))


def base_avoidance(view: MeshView) -> float:
    """Share of the visible pixels that do not show the object's base: the underside of its lowest
    part.

    Secord et al. 2011 ("base"), turned round so that more is better; thesis, section 3.4.5. The
    base is seen from below the horizon only: from the 40 views this is 1 always, or nearly.

    Returns:
        Between 0 and 1; 0 where nothing is seen.
    """
    surface, (faces, pixels) = view.surface, view.pixels
    if len(faces) == 0:
        return 0.0
    normals = surface.normals[faces]
    # A face's own normal may point either way; what counts is the side that the camera is on.
    towards = (
        (view.pose[:3, 3] - surface.vertices[surface.faces[faces]].mean(1)) * normals
    ).sum(1)
    down = -normals[:, 2] * np.sign(towards)
    heights = surface.vertices[:, 2]
    low = heights.min()
    high = heights.max()
    base = (down > DOWN) & (
        heights[surface.faces[faces]].max(1) < low + BASE * (high - low)
    )
    return float(1 - pixels[base].sum() / pixels.sum())
