"""What pages and recordings of a scene draw: shapes and colours of objects, points of frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from nextview.geometry.ray_caster import Triangles
from nextview.scene.figure import OBJECT_COLOURS
from nextview.scene.objects import UNKNOWN_NAME, SceneObject
from nextview.scene.scene import Scene
from nextview.session.style import GREY

MOST_POINTS = 12_000  # of a frame or of an object that are drawn


def placed_shape(thing: SceneObject) -> Triangles | None:
    """The scan of an object where it was found; of an unknown one the hull of what was seen.

    Args:
        thing: the object.

    Returns:
        Vertices, (V, 3) float64, world, metres, and faces, (F, 3) int32; None where what was seen
        has no volume.
    """
    posed = thing.candidates[0] if thing.pose is not None else None
    if posed is not None and posed.vertices is not None and posed.faces is not None:
        return posed.vertices @ posed.pose[:3, :3].T + posed.pose[:3, 3], posed.faces
    try:
        hull = ConvexHull(thing.seen_points)
    except QhullError:  # all in a plane
        return None
    row_of = np.full(len(thing.seen_points), -1)
    row_of[hull.vertices] = np.arange(len(hull.vertices))
    return thing.seen_points[hull.vertices], row_of[hull.simplices].astype(np.int32)


def seen_points(scene: Scene, number: int) -> NDArray[np.float32]:
    """Points above the plane that a frame shows, (N, 3), world, metres; not all of many.

    Args:
        scene: with the frame.
        number: of the frame.
    """
    rows, columns = np.nonzero(scene.tops[number].above)
    few = slice(None, None, max(1, -(-len(rows) // MOST_POINTS)))
    return scene.frames[number].positions(rows[few], columns[few]).astype(np.float32)


def points_of(scene: Scene, thing: SceneObject) -> NDArray[np.float32]:
    """Points that the frames show of an object, (N, 3), world, metres; not all of many.

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
    """The colour of an object, the same in all frames: grey for an unknown one."""
    return (
        GREY
        if thing.name == UNKNOWN_NAME
        else OBJECT_COLOURS[(thing.number - 1) % len(OBJECT_COLOURS)]
    )


def named(thing: SceneObject) -> str:
    """The name of an object, with a question mark where it is not confident."""
    doubt = "" if thing.confident or thing.name == UNKNOWN_NAME else "?"
    return thing.name.replace("_", " ") + doubt
