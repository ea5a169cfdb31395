"""Remove outlier facets: flying pixels, and fragments of the background.

A single outlier would determine the object's radius. The two filters are those of the Point Cloud
Library (Rusu and Cousins 2011): points with few neighbours in space, and small isolated clusters.
Neighbours in space are searched among the neighbours in the image.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from nextview.sensing.facets import Facets, Noise, count_beside
from nextview.types import Float, Index, Mask

# half the side of the window in which neighbours are searched, pixels
NEIGHBOUR_WINDOW = 2
# of 24: as many as at the tip of an object that is two pixels wide
FEWEST_NEIGHBOURS = 5
STEEPEST_SLOPE = 4.0  # of a surface towards the ray, between neighbours
NOISE_GAP = 4.0  # largest depth difference of neighbours, in standard deviations
# least share of all points in an isolated cluster that is kept
SMALLEST_GROUP = 0.01
GAP_PIXELS = 6  # pixels between isolated clusters
# trimmed share of the nearest and the farthest points, per noise relative to the size
TRIMMED_BY_NOISE = 0.1
MOST_OUTLIERS = 0.01


def without_outliers(facets: Facets, noise: Noise, coarse: int) -> Facets:
    """Return the facets that lie on a surface of some extent.

    Args:
        facets: of an object, one per square of ``coarse`` pixels.
        noise: of the frame.
        coarse: pixels.

    Returns:
        The remaining facets; all of them if none would remain.
    """
    rows = facets.rows // coarse
    columns = facets.columns // coarse
    points = facets.points
    depth = points[:, 2]

    # spacing of neighbouring points on a surface that faces the camera
    spacing = float(facets.pitch.mean()) * depth
    error = NOISE_GAP * noise.at(depth) * depth**2 / coarse
    kept = np.flatnonzero(
        _enough_neighbours(rows, columns, depth, STEEPEST_SLOPE * spacing, error)
    )
    if not len(kept):
        return facets

    step = GAP_PIXELS * float(facets.pitch.mean()) + float(
        np.median(error[kept] / depth[kept])
    )
    layer = (np.log(depth[kept] / depth[kept].min()) / step).astype(np.int64)
    group = _groups(rows[kept] // GAP_PIXELS, columns[kept] // GAP_PIXELS, layer)
    share = np.bincount(group) / len(kept)
    kept = kept[share[group] >= SMALLEST_GROUP]
    kept = kept[_within_its_depths(facets.points[kept], error[kept] / NOISE_GAP)]
    return facets.some(kept) if 0 < len(kept) < len(depth) else facets


def _within_its_depths(points: Float, error: Float) -> Mask:
    """Trim the nearest and the farthest points, (N, 3), in depth; returns (N,) bool.

    If the noise is large relative to the object, neighbours cannot separate flying pixels, which
    lie in front of or behind the object, from noise. The trimmed share therefore grows with the
    relative noise.
    """
    if not len(points):
        return np.zeros(0, bool)
    depth = points[:, 2]
    size = float(max(np.ptp(points[:, 0]), np.ptp(points[:, 1])))
    share = min(
        MOST_OUTLIERS,
        TRIMMED_BY_NOISE * float(np.median(error)) / max(size, 1e-9),
    )
    nearest, farthest = np.quantile(depth, [share, 1 - share])
    return np.asarray((depth >= nearest) & (depth <= farthest))


def _enough_neighbours(
    rows: Index,
    columns: Index,
    depth: Float,
    slope: Float,
    error: Float,
) -> Mask:
    """Return which pixels, (N,), have FEWEST_NEIGHBOURS neighbours at a similar depth.

    Depths may differ by a slope per pixel and an error. Most pixels pass with their eight direct
    neighbours; the larger window is tested only for the others.
    """
    picture = np.full(
        (
            int(np.ptp(rows)) + 1 + 2 * NEIGHBOUR_WINDOW,
            int(np.ptp(columns)) + 1 + 2 * NEIGHBOUR_WINDOW,
        ),
        np.nan,
        np.float32,
    )
    at = (
        (rows - rows.min() + NEIGHBOUR_WINDOW) * picture.shape[1]
        + columns
        - columns.min()
        + NEIGHBOUR_WINDOW
    )
    picture.ravel()[at] = depth
    limit = np.zeros_like(picture)
    limit.ravel()[at] = slope + error

    enough = count_beside(picture, limit).ravel()[at] >= FEWEST_NEIGHBOURS
    left = np.flatnonzero(~enough)
    here = at[left]
    many = np.zeros(len(left), np.int64)
    steps = range(-NEIGHBOUR_WINDOW, NEIGHBOUR_WINDOW + 1)
    for down in steps:
        for right in steps:
            if down == right == 0:
                continue
            there = picture.ravel()[here + down * picture.shape[1] + right]
            far = max(abs(down), abs(right))
            many += np.abs(there - depth[left]) < slope[left] * far + error[left]
    enough[left] = many >= FEWEST_NEIGHBOURS
    return enough


def _groups(rows: Index, columns: Index, layers: Index) -> Index:
    """Return the cluster of each point, (N,): touching cells of the view form one cluster."""
    at = (rows - rows.min(), columns - columns.min(), layers)
    size = [int(index.max()) + 1 for index in at]
    cells = np.zeros(size, bool)
    cells[at] = True
    return np.asarray(ndimage.label(cells, np.ones((3, 3, 3)))[0][at])
