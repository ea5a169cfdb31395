"""Objects that float above the support plane as they were named: their names are wrong."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import Delaunay, QhullError

from nextview.scene.tracks import Track
from nextview.sensing.planes import Plane
from nextview.types import Float, Mask

# metres from the plane to the lowest point of a thing that stands on it
FLOATING_HEIGHT = 0.02


def floating(tracks: Sequence[Track], planes: Sequence[Plane]) -> list[bool]:
    """Find the objects whose scans stand neither on their plane nor on another object.

    The top of a toy table may look like a sponge. But a sponge does not float.

    Args:
        tracks: all objects, judged.
        planes: that each of them stands on.

    Returns:
        Whether each floats; never one that has no scan.
    """
    found = []
    for track, plane in zip(tracks, planes, strict=True):
        axes = np.linalg.svd(plane.normal[None])[2][1:]
        others = [other for other in tracks if other is not track]
        found.append(_floats(track, others, plane, axes))
    return found


def _floats(track: Track, others: Sequence[Track], plane: Plane, axes: Float) -> bool:
    """Whether an object floats.

    Args:
        track: the object.
        others: all other objects.
        plane: that they stand on.
        axes: two directions along the plane, (2, 3).
    """
    posed = track.posed
    if posed is None or posed.vertices is None:
        return False

    scan = posed.vertices @ posed.pose[:3, :3].T + posed.pose[:3, 3]
    lowest = float(plane.height(scan).min())
    if lowest < FLOATING_HEIGHT:
        return False

    below = scan @ axes.T
    for other in others:
        seen = np.concatenate([one.hull for one in other.thing.sightings])
        seen = seen[plane.height(seen) < lowest + FLOATING_HEIGHT] @ axes.T
        middle = below.mean(0, keepdims=True)
        if _inside(seen, below).any() or _inside(middle, seen).any():
            return False
    return True


def _inside(points: Float, corners: Float) -> Mask:
    """Which points, (N, 2), are in the convex hull of others, (M, 2), as seen from above, (N,)."""
    try:
        triangles = Delaunay(corners)
    except (QhullError, ValueError):  # too few corners, or all of them on a line
        return np.zeros(len(points), bool)
    return np.asarray(triangles.find_simplex(points) >= 0)
