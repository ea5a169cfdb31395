"""How much of an object that stands among others shows from elsewhere, by rays through the voxels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import number, of_kind, places
from nextview.errors import UsageError
from nextview.occupancy.voxel_grid import OCCLUDER, UNSEEN, Occupancy, region_of


def visible_share(
    occupancy: Occupancy,
    points: NDArray[np.floating],
    positions: NDArray[np.floating],
    density: float = 0.0,
    own: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64]:
    """Share of an object's known points to which the line of sight is clear of occluders, from each position.

    The object does not hide itself here: half of its points lie on its far side from anywhere. What is unseen lets a
    sight of length s through with probability exp(-density * s). So 0, which takes unseen space for free, gives the
    largest share there can be, and infinity, which takes it for solid, the least: between them lies the truth.

    Args:
        occupancy: what is known, with occluders; what lies beyond its grid hides nothing.
        points: on the object, (P, 3), in the grid's frame and unit; a few hundred are enough.
        positions: of the cameras, (V, 3), in the grid's frame and unit.
        density: how often unseen space is filled, per unit of length.
        own: voxels where the object itself can be, (n, n, n) bool: unseen ones among them hide nothing.

    Returns:
        (V,) float64, 0 to 1; NaN if there are no points.

    Raises:
        UsageError: these are no points, no positions, no density or no region.
    """
    of_kind(occupancy, Occupancy, "what is known is an Occupancy")
    points, positions = places(points, "what is looked at"), places(positions, "the positions of cameras")
    if not number(density, "how often unseen space is filled") >= 0:
        raise UsageError(f"how often unseen space is filled is a number from 0 on, not {density}")
    own = None if own is None else region_of(occupancy.grid, own)
    grid, cells = occupancy.grid, occupancy.cells.reshape(-1)
    # What a step through a voxel takes off the logarithm of the chance to be seen. None outside of the grid: the last.
    cost = np.zeros(len(cells) + 1, np.float32)
    veil = (cells == UNSEEN) if own is None else (cells == UNSEEN) & ~own.reshape(-1)
    cost[:-1][veil] = min(density * grid.pitch, OPAQUE)
    cost[:-1][cells == OCCLUDER] = OPAQUE
    points = np.asarray(points, np.float32)
    if len(points) == 0:
        return np.full(len(positions), np.nan)
    return np.array([_chance(cost, occupancy, points, eye) for eye in np.asarray(positions, np.float32)])


OPAQUE = 1e3
"""Of which the negative exponential is 0."""


def _chance(cost: NDArray[np.float32], occupancy: Occupancy, points: NDArray[np.float32], eye: NDArray) -> float:
    """Mean chance of the points to be seen from an eye: rays in steps of a voxel's side, from the points on."""
    grid = occupancy.grid
    towards = eye - points
    length = np.linalg.norm(towards, axis=1) / grid.pitch
    start = (points - np.array(grid.centre, np.float32) + np.float32(grid.half)) / np.float32(grid.pitch)
    step = towards / np.maximum(length, 1e-6)[:, None] / np.float32(grid.pitch)
    longest = min(float(length.max()), np.sqrt(3) * grid.n)  # then every ray has reached the eye or left the grid
    along = np.arange(0.5, longest, dtype=np.float32)[:, None]
    x, y, z = (start[:, k] + along * step[:, k] for k in range(3))
    n = np.float32(grid.n)
    inside = (along < length) & (x >= 0) & (x < n) & (y >= 0) & (y < n) & (z >= 0) & (z < n)
    i, j, k = (np.where(inside, c, 0).astype(np.int32) for c in (x, y, z))
    passed = np.where(inside, (i * grid.n + j) * grid.n + k, len(cost) - 1)
    return float(np.exp(-cost[passed].sum(0)).mean())
