"""Facets that belong to no surface of the object: flying pixels, and scraps of what is behind it.

One of them would set the object's radius. Two filters, as in the Point Cloud Library (Rusu and
Cousins 2011): a point with few neighbours in space is an outlier, and so is a small group of points
away from all others. Neighbours in space are looked for among the neighbours in the picture.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from nextview.sensing.facets import Facets, Noise, count_beside
from nextview.types import Float, Index, Mask

# pixels to each side among which the neighbours of a point are looked for
NEIGHBOUR_WINDOW = 2
# of 24: at the tip of a thing that is two pixels thin there are as many
FEWEST_NEIGHBOURS = 5
STEEPEST_SLOPE = 4.0  # of a surface towards the ray, between neighbours
NOISE_GAP = 4.0  # standard deviations of depth that neighbours may differ by
# share of all points that a group away from the others has at least
SMALLEST_GROUP = 0.01
GAP_PIXELS = 6  # pixels that two groups are apart
# share of the nearest and the farthest points left out, by the noise as a part of the size
TRIMMED_BY_NOISE = 0.1
MOST_OUTLIERS = 0.01


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

    # between neighbouring points of a surface that faces the camera
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
    """Which points, (N, 3), are not the nearest or the farthest few, (N,) bool.

    Where the noise is a large part of an object's size no neighbour tells a flying pixel, which
    lies before or behind the object, from noise. So the more noise there is for its size, the more
    of its outermost depths are left out.
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
    """Which pixels, (N,), have FEWEST_NEIGHBOURS around them that are as deep.

    Depths may differ by a slope for each pixel between, and an error. Most pixels have so many
    among the eight beside them; the wider window is looked at for the others only.
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
    """Return the group of each point, (N,): touching cells of the view are one group."""
    at = (rows - rows.min(), columns - columns.min(), layers)
    size = [int(index.max()) + 1 for index in at]
    cells = np.zeros(size, bool)
    cells[at] = True
    return np.asarray(ndimage.label(cells, np.ones((3, 3, 3)))[0][at])
