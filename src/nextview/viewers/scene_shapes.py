"""Shapes and colours of objects, and points of frames, for pages and recordings of scenes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from nextview.figures.style import GREY
from nextview.geometry.ray_caster import Triangles
from nextview.scene.figure import OBJECT_COLOURS
from nextview.scene.objects import UNKNOWN_NAME, SceneObject
from nextview.scene.scene import Scene

MOST_POINTS = 12_000  # largest number of drawn points of a frame or an object


def placed_shape(thing: SceneObject) -> Triangles | None:
    """Return the scan of an object in its pose; for an unknown object, the hull of its points.

    Args:
        thing: the object.

    Returns:
        Vertices, (V, 3) float64, world, metres, and faces, (F, 3) int32, those of a hull
        counter-clockwise from outside; None if the points have no volume.
    """
    posed = thing.candidates[0] if thing.pose is not None else None
    if posed is not None and posed.vertices is not None and posed.faces is not None:
        return posed.vertices @ posed.pose[:3, :3].T + posed.pose[:3, 3], posed.faces
    try:
        hull = ConvexHull(thing.seen_points)
    except QhullError:  # coplanar points
        return None
    first, second, third = thing.seen_points[hull.simplices].transpose(1, 0, 2)
    normals = np.cross(second - first, third - first)
    inward = (normals * hull.equations[:, :3]).sum(1) < 0
    simplices = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)

    row_of = np.full(len(thing.seen_points), -1)
    row_of[hull.vertices] = np.arange(len(hull.vertices))
    return thing.seen_points[hull.vertices], row_of[simplices].astype(np.int32)


def seen_points(scene: Scene, number: int) -> NDArray[np.float32]:
    """Sample points of a frame above the plane, (N, 3), world, metres.

    Args:
        scene: with the frame.
        number: of the frame.
    """
    rows, columns = np.nonzero(scene.tops[number].above)
    few = slice(None, None, max(1, -(-len(rows) // MOST_POINTS)))
    return scene.frames[number].positions(rows[few], columns[few]).astype(np.float32)


def points_of(scene: Scene, thing: SceneObject) -> NDArray[np.float32]:
    """Sample points of an object in all frames, (N, 3), world, metres.

    Args:
        scene: with the object.
        thing: the object.
    """
    found = []
    for number, mask in thing.pixels.items():
        rows, columns = np.nonzero(mask)
        found.append(scene.frames[number].positions(rows, columns))
    points = np.concatenate(found)
    return points[:: max(1, -(-len(points) // MOST_POINTS))].astype(np.float32)


def colour_of(thing: SceneObject) -> str:
    """Return the colour of an object, the same in all frames; grey for an unknown one."""
    return (
        GREY
        if thing.name == UNKNOWN_NAME
        else OBJECT_COLOURS[(thing.number - 1) % len(OBJECT_COLOURS)]
    )


def name_of(thing: SceneObject) -> str:
    """Return the name of an object, with a question mark if it is not confident."""
    doubt = "" if thing.confident or thing.name == UNKNOWN_NAME else "?"
    return thing.name.replace("_", " ") + doubt
