"""How much that is unseen would be seen from elsewhere: volume, and surface, by a z-buffer of voxels.

Only where the cameras stand counts: they are taken to have the whole region in their picture.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview.errors import UsageError
from nextview.occupancy.voxel_grid import FREE, OCCLUDER, UNSEEN, Occupancy

Float = NDArray[np.float32]


def new_volume(
    occupancy: Occupancy, positions: NDArray[np.floating], region: NDArray[np.bool_] | None = None
) -> NDArray[np.float64]:
    """Unseen volume that no occupied voxel hides from each position: the volumetric information gain.

    What is unseen is taken to be transparent, so this is the most that can come into view; the count of unseen voxels
    along the rays up to the first occupied one of Delmerico et al., "A comparison of volumetric information gain
    metrics for active 3D object reconstruction" (Autonomous Robots 42, 2018), but in volume instead of per ray.

    Args:
        occupancy: what is known.
        positions: of the cameras, in the grid's frame and unit, (V, 3).
        region: voxels that count, (n, n, n) bool; by default those in the ball that the grid holds.

    Returns:
        (V,) float64, cubes of the grid's unit.

    Raises:
        UsageError: a camera stands within the region.
    """
    grid, cells = occupancy.grid, occupancy.cells.reshape(-1)
    counts = (cells == UNSEEN) & (grid.ball if region is None else region).reshape(-1)
    blockers, asked = grid.middles[:, cells >= OCCLUDER], grid.middles[:, counts]
    return _shown(asked, blockers, positions, grid.pitch, grid.pitch) * grid.pitch**3


def new_surface(
    occupancy: Occupancy, positions: NDArray[np.floating], region: NDArray[np.bool_] | None = None
) -> NDArray[np.float64]:
    """Area of the border of unseen space that shows from each position: where new surface may come to light.

    What is unseen is taken to be solid, the opposite of ``new_volume``: the object is at most what no view has seen
    to be free. The border is that of this largest object, and its unseen part counts where nothing hides it.

    Args:
        occupancy: what is known.
        positions: of the cameras, in the grid's frame and unit, (V, 3).
        region: voxels where the object can be, (n, n, n) bool; by default those in the ball that the grid holds.

    Returns:
        (V,) float64, squares of the grid's unit: a voxel of the border counts as one square of its side.

    Raises:
        UsageError: a camera stands within the region.
    """
    grid, cells = occupancy.grid, occupancy.cells
    solid = (cells != FREE) & (grid.ball if region is None else region) | (cells >= OCCLUDER)
    border = (solid & ~_enclosed(solid)).reshape(-1)
    middles, unseen = grid.middles[:, border], cells.reshape(-1)[border] == UNSEEN
    return _shown(middles[:, unseen], middles, positions, grid.pitch, 2 * grid.pitch) * grid.pitch**2


def _enclosed(solid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Solid voxels all of whose six neighbours are solid; nothing is outside of the grid."""
    padded = np.pad(solid, 1)
    x, y, z = slice(1, -1), slice(1, -1), slice(1, -1)
    sides = [padded[:-2, y, z], padded[2:, y, z], padded[x, :-2, z], padded[x, 2:, z], padded[x, y, :-2]]
    return np.logical_and.reduce([*sides, padded[x, y, 2:]])


def _shown(
    asked: Float, blockers: Float, positions: NDArray[np.floating], pitch: float, tolerance: float
) -> NDArray[np.float64]:
    """How many points no blocking voxel hides, from each position, (V,).

    Args:
        asked: the points, (3, P).
        blockers: middles of voxels, (3, Q).
        positions: of the cameras, (V, 3).
        pitch: side of a voxel.
        tolerance: a point this little behind a blocker still shows.
    """
    eyes = np.asarray(positions, np.float32)
    if asked.size == 0:
        return np.zeros(len(eyes))
    towards = (asked.min(1) + asked.max(1)) / 2 - eyes
    distances = np.linalg.norm(towards, axis=1)
    counts = np.zeros(len(eyes))
    for at, (eye, axes, distance) in enumerate(zip(eyes, _axes(towards), distances, strict=True)):
        axes[:2] *= distance / np.float32(pitch)  # a pixel is as wide as a voxel at that distance
        u, v, z = _project(asked, eye, axes, pitch)
        low = u.min() - 1, v.min() - 1
        width, height = int(u.max() - low[0]) + 2, int(v.max() - low[1]) + 2
        ahead = blockers[:, axes[2] @ blockers > axes[2] @ eye + np.float32(pitch)]
        buffer = _z_buffer(*_project(ahead, eye, axes, pitch), low, (height, width), float(distance))
        pixel = (v - low[1]).astype(np.int32) * np.int32(width) + (u - low[0]).astype(np.int32)
        counts[at] = np.count_nonzero(z <= buffer.take(pixel) + np.float32(tolerance))
    return counts


def _axes(towards: Float) -> Float:
    """Two axes across each direction, (V, 3), and its own, as the rows of rotations, (V, 3, 3)."""
    ahead = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9)
    across = np.cross(ahead, np.eye(3, dtype=np.float32)[np.abs(ahead).argmin(1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([across, np.cross(ahead, across), ahead], 1)


def _project(points: Float, eye: Float, axes: Float, nearest: float) -> tuple[Float, Float, Float]:
    """Pixel coordinates and depth of points that lie ahead, (3, P), each (P,)."""
    x, y, z = axes @ points - (axes @ eye)[:, None]
    if z.min(initial=np.inf) < nearest / 2:
        raise UsageError("a camera stands among the voxels that it is asked about")
    return x / z, y / z, z


def _z_buffer(
    u: Float, v: Float, z: Float, low: tuple[float, float], shape: tuple[int, int], distance: float
) -> Float:
    """Depth of the nearest blocker at each pixel, infinity for none.

    Each is drawn over the four pixels around it, so that walls have no holes: they are nowhere farther apart than two
    pixels, as the middles of voxels of a wall are at most sqrt(2) sides apart. Nearer ones, which are farther apart in
    the picture, are drawn in pixels of twice the width, or four times, and so on.
    """
    found = np.full(shape, np.inf, np.float32)
    coarse = np.ceil(np.log2(np.maximum(np.sqrt(0.5) * distance / z, 1))).astype(np.int64)
    for level in range(int(coarse.max(initial=0)) + 1):
        wide, here = 2**level, coarse == level
        rows, columns = (side // wide + 3 for side in shape)
        i, j = ((c[here] - low[k]) / wide + np.float32(0.5) for k, c in ((1, v), (0, u)))  # one pixel of margin
        inside = (i >= 0) & (i < rows - 1) & (j >= 0) & (j < columns - 1)
        corner = np.full((rows, columns), np.inf, np.float32)
        at = i[inside].astype(np.int32) * np.int32(columns) + j[inside].astype(np.int32)
        np.minimum.at(corner.reshape(-1), at, z[here][inside])
        # Margin 1: the corner at index k covers the pixels k - 1 and k.
        filled = np.minimum(
            np.minimum(corner[:-1, :-1], corner[1:, :-1]), np.minimum(corner[:-1, 1:], corner[1:, 1:])
        )
        large = filled.repeat(wide, 0).repeat(wide, 1) if level else filled
        np.minimum(found, large[: shape[0], : shape[1]], out=found)
    return found
