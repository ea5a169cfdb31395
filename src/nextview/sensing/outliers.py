"""Facets that belong to no surface of the object: flying pixels, and scraps of what is behind it.

One of them would set the object's radius. Two filters, as in the Point Cloud Library (Rusu and Cousins 2011): a point
with few neighbours in space is an outlier, and so is a small group of points away from all others. Neighbours in space
are looked for among the neighbours in the picture.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from nextview.sensing.facets import Facets, Noise

Float = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

WINDOW = 2  # pixels to each side among which the neighbours of a point are looked for
FEWEST_NEIGHBOURS = 5  # of 24: at the tip of a thing that is two pixels thin there are as many
STEEPEST_SLOPE = 4.0  # of a surface towards the ray, between neighbours
NOISE_GAP = 4.0  # standard deviations of depth that neighbours may differ by
SMALLEST_GROUP = 0.01  # share of all points that a group away from the others has at least
GAP_PIXELS = 6  # pixels that two groups are apart


def without_outliers(facets: Facets, noise: Noise, coarse: int) -> Facets:
    """The facets that lie on a surface of some size.

    Args:
        facets: of an object, one for each square of ``coarse`` pixels.
        noise: of the frame.
        coarse: pixels.

    Returns:
        Those that are left; all of them where none would be.
    """
    rows = facets.rows // coarse
    columns = facets.columns // coarse
    points = facets.points
    depth = points[:, 2]

    spacing = float(facets.pitch.mean()) * depth  # between neighbouring points of a surface that faces the camera
    error = NOISE_GAP * noise.at(depth) * depth**2 / coarse
    many = _neighbours(rows, columns, depth, STEEPEST_SLOPE * spacing, error)
    kept = np.flatnonzero(many >= FEWEST_NEIGHBOURS)
    if not len(kept):
        return facets

    side = GAP_PIXELS * float(np.median(spacing[kept])) + float(np.median(error[kept]))
    group = _groups(points[kept], side)
    share = np.bincount(group) / len(kept)
    kept = kept[share[group] >= SMALLEST_GROUP]
    chosen = np.zeros(len(depth), bool)
    chosen[kept] = True
    return facets.some(chosen) if chosen.any() else facets


def _neighbours(rows: Index, columns: Index, depth: Float, slope: Float, error: Float) -> Index:
    """How many of the pixels around each, (N,), are as deep, up to a slope for each pixel between, and an error."""
    height, width = int(rows.max()) + 1, int(columns.max()) + 1
    top, left = int(rows.min()), int(columns.min())
    picture = np.full((height - top + 2 * WINDOW, width - left + 2 * WINDOW), np.nan)
    at = rows - top + WINDOW, columns - left + WINDOW
    picture[at] = depth

    many = np.zeros(len(depth), np.int64)
    steps = range(-WINDOW, WINDOW + 1)
    for down in steps:
        for right in steps:
            if down == right == 0:
                continue
            there = picture[at[0] + down, at[1] + right]
            many += np.abs(there - depth) < slope * max(abs(down), abs(right)) + error
    return many


def _groups(points: Float, side: float) -> Index:
    """The group of each point, (N,): voxels of a side, metres, that touch are of one group."""
    voxel = np.floor((points - points.min(0)) / side).astype(np.int64) + 1
    size = voxel.max(0) + 2
    place = np.ravel_multi_index(tuple(voxel.T), tuple(size))
    used, which = np.unique(place, return_inverse=True)

    links = []
    for step in _half_of_the_steps(size):
        found = np.searchsorted(used, used + step)
        found[found == len(used)] = 0
        there = used[found] == used + step
        links.append(np.stack([np.flatnonzero(there), found[there]]))
    one, other = np.concatenate(links, 1)
    graph = coo_array((np.ones(len(one), bool), (one, other)), shape=(len(used), len(used)))
    group = connected_components(graph, directed=False)[1].astype(np.int64)
    return np.asarray(group[which])


def _half_of_the_steps(size: Index) -> Index:
    """Steps in a raveled grid to half of the 26 cells around one: the others are the same links backwards."""
    across = np.array(np.meshgrid(*3 * [[-1, 0, 1]], indexing="ij")).reshape(3, -1)
    steps = (across[0] * size[1] + across[1]) * size[2] + across[2]
    return steps[steps > 0]
