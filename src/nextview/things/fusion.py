"""The surface of a thing from depth frames of it, fused in a volume.

Each cell of the volume averages the signed distance to the surface that the frames measured, cut
off at some cells before and behind it (a TSDF: Curless and Levoy, "A volumetric method for building
complex models from range images", SIGGRAPH 1996). Marching cubes make it a mesh. Where no frame saw
anything there is no surface.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nextview.sensing.object_frame import ObjectFrame
from nextview.sensing.observed_object import Sighting
from nextview.things.surface import Surface

Float32 = NDArray[np.float32]

FINEST_CELL = 0.001  # metres: less than depth cameras tell apart
MOST_CELLS = 120  # along each axis
BEYOND = 1.1  # how far the volume reaches, object radii
CUT_OFF = 2.0  # cells, or deviations of the noise, at which distances are cut off
MOST_FRAMES = 80  # an even choice of more is taken
OFTEN = 2  # frames that have to have seen a cell, where there are many
MANY_FRAMES = 8
SMALL_PIECE = 0.02  # share of the faces below which a piece of the surface is an error


def fuse(sightings: Sequence[Sighting], frame: ObjectFrame, name: str) -> Surface | None:
    """Fuse what frames show of a thing.

    Args:
        sightings: of the thing, all in one world.
        frame: where it is.
        name: what it is called.

    Returns:
        Its surface, in the frame of the world, metres; None if too little was measured.
    """
    some = sightings
    if len(sightings) > MOST_FRAMES:
        some = [sightings[k * len(sightings) // MOST_FRAMES] for k in range(MOST_FRAMES)]

    cell = max(FINEST_CELL, 2 * BEYOND * frame.radius / MOST_CELLS)
    side = int(np.ceil(2 * BEYOND * frame.radius / cell))
    corner = frame.centre - cell * (side - 1) / 2
    total = np.zeros(side**3, np.float32)
    weight = np.zeros(side**3, np.float32)
    for sighting in some:
        _add(total, weight, sighting, corner, cell, side)

    seen = weight >= (OFTEN if len(some) >= MANY_FRAMES else 1)
    distance = np.where(seen, total / np.maximum(weight, 1), 1).reshape(side, side, side)
    return _surface(distance, seen.reshape(side, side, side), corner, cell, name)


def _add(
    total: Float32,
    weight: Float32,
    sighting: Sighting,
    corner: NDArray[np.float64],
    cell: float,
    side: int,
) -> None:
    """Add to the sum of distances in each cell, and to how often it was seen, what one frame says.

    Distances are in the distance at which they are cut off.
    """
    frame = sighting.frame
    height, width = frame.shape
    pose = frame.camera_to_world
    start = pose[:3, :3].T @ (corner - pose[:3, 3])
    steps = (np.arange(side) * cell).astype(np.float32)
    x, y, z = (_along(steps, pose[:3, axis], start[axis]) for axis in range(3))

    before = z > 0
    depth = np.where(before, z, 1)
    column = np.floor(frame.intrinsics[0, 0] * x / depth + frame.intrinsics[0, 2]).astype(np.int32)
    row = np.floor(frame.intrinsics[1, 1] * y / depth + frame.intrinsics[1, 2]).astype(np.int32)
    inside = before & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    cells = np.flatnonzero(inside)
    row = row[cells]
    column = column[cells]

    measured = frame.depth[row, column]
    thing = sighting.mask[row, column]
    gap = measured - z[cells]
    noise = sighting.noise.at(measured) * measured**2
    cut_off = np.maximum(CUT_OFF * cell, CUT_OFF * noise)
    on_surface = thing & (gap > -cut_off)
    empty = ~thing & (gap > 0)
    said = (measured > 0) & (on_surface | empty)

    distance = np.where(on_surface, np.minimum(gap / cut_off, 1), 1)
    total[cells[said]] += distance[said]
    weight[cells[said]] += 1


def _along(steps: Float32, direction: NDArray[np.float64], start: float) -> Float32:
    """Positions of all cells along one axis of the camera: linear in each of their indices."""
    a, b, c = direction.astype(np.float32)
    positions = (np.float32(start) + a * steps)[:, None, None] + (b * steps)[:, None] + c * steps
    return positions.ravel()


def _surface(
    distance: Float32, seen: NDArray[np.bool_], corner: NDArray[np.float64], cell: float, name: str
) -> Surface | None:
    """The surface where the distance changes its sign, without small pieces; None if there is none."""
    from skimage.measure import marching_cubes

    if not (distance[seen] < 0).any():
        return None
    try:
        vertices, faces, _, _ = marching_cubes(distance, 0.0, mask=seen)
    except (ValueError, RuntimeError):  # the level is not reached, or nowhere among cells that were seen
        return None

    faces = _without_small_pieces(faces, len(vertices))
    used, renumbered = np.unique(faces, return_inverse=True)
    positions = corner + cell * vertices[used]
    return Surface(
        name, positions.astype(np.float32), renumbered.reshape(-1, 3).astype(np.int32)
    )


def _without_small_pieces(faces: NDArray[np.integer], count: int) -> NDArray[np.integer]:
    """The faces of connected pieces that are no errors of single pixels."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    piece = connected_components(graph, directed=False)[1][faces[:, 0]]
    sizes = np.bincount(piece)
    return faces[sizes[piece] >= SMALL_PIECE * len(faces)]
