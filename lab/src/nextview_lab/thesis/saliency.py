"""Mesh saliency: where a surface bends otherwise than around (Lee et al. 2005; thesis, section
3.4.4).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview_lab.thesis.surfaces import Surface

UNIT = 0.006
"""Of the scales, object radii: Lee's 0.003 diagonals of a bounding box whose corners the object's
sphere goes through, but the same however the object lies in it."""
SCALES = (2, 3, 4, 5, 6)
"""Standard deviations of the finer of two averages, in units; the coarser one's is twice as
large.
"""
LONGEST = 0.07
"""Edges are cut until none is longer, object radii: a large flat face has no vertices to average
over.
"""
CELL = 0.02
"""Vertices in one cube of this side, object radii, are taken together where there are many."""
MANY = 30_000
BLOCK = 1000
"""Points whose neighbours are looked at in one go."""


def saliency_of(surface: Surface) -> NDArray[np.float64]:
    """Mean saliency of each face, (F,) float64; computed once a surface."""
    if "saliency" not in surface.__dict__:
        surface.__dict__["saliency"] = _saliency(surface)
    return surface.__dict__["saliency"]


def _saliency(surface: Surface) -> NDArray[np.float64]:
    fine, parent = _cut(surface)
    places = int(fine.corners.max()) + 1
    around = np.bincount(fine.corners.ravel(), np.repeat(fine.areas, 3), places) / 3
    # Half of each edge's curvature to each of its ends; each edge stands in two faces.
    at_ends = (fine.lengths * fine.bends) / 8
    bend = np.bincount(
        fine.corners.ravel(),
        (at_ends + np.roll(at_ends, 1, 1)).ravel(),
        places,
    )
    position = np.zeros((places, 3))
    position[fine.corners.ravel()] = fine.vertices[fine.faces.ravel()]
    group = _groups(position)
    area = np.asarray(np.bincount(group, around), np.float64)
    middle = np.stack(
        [np.bincount(group, around * position[:, k]) for k in range(3)],
        1,
    )
    middle = np.where(
        area[:, None] > 0,
        middle / np.maximum(area, 1e-30)[:, None],
        10 + np.arange(len(area))[:, None],
    )
    curvature = np.asarray(
        np.where(area > 0, np.bincount(group, bend) / np.maximum(area, 1e-30), 0),
        np.float64,
    )
    salient = _salient(np.asarray(middle, np.float64), area, curvature)
    of_fine = salient[group][fine.corners].mean(1)
    total = np.bincount(parent, fine.areas, len(surface.faces))
    mean = np.bincount(parent, fine.areas * of_fine, len(surface.faces))
    return np.divide(mean, total, out=np.zeros_like(mean), where=total > 0)


def _salient(
    points: NDArray[np.float64],
    area: NDArray[np.float64],
    curvature: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Saliency of points, (n,): over all scales, how the averages of their curvature at two widths
    differ.

    Lee scales each scale's map to a maximum of 1 first. Here it stays a curvature: the rounding of
    a sphere is none. Lee suppresses scales at which much is as salient as the maximum by the mean
    of the local maxima; here it is the mean over the surface, for how many maxima there are depends
    on how the faces are cut.
    """
    averages = _averages(points, area, curvature)
    found = np.zeros(len(points))
    for scale in SCALES:
        salient = np.abs(averages[scale] - averages[2 * scale])
        if salient.max() <= 0:
            continue
        others = (salient * area).sum() / area.sum() / salient.max()
        found += salient * (1 - others) ** 2
    return found


def _averages(
    points: NDArray[np.float64],
    area: NDArray[np.float64],
    curvature: NDArray[np.float64],
) -> dict[int, NDArray[np.float64]]:
    """Average curvature around each point, weighted by area and a Gaussian, (n,), by the
    Gaussian's width in units.
    """
    from scipy.spatial import cKDTree

    widths = sorted({*SCALES, *(2 * scale for scale in SCALES)}, reverse=True)
    found = {width: np.zeros(len(points)) for width in widths}
    tree = cKDTree(points)
    # points near each other: less to remember
    for block in np.array_split(tree.indices, -(-len(points) // BLOCK)):
        pairs = cKDTree(points[block]).sparse_distance_matrix(
            tree,
            2 * widths[0] * UNIT,
            output_type="coo_matrix",
        )
        # the pairs of a point with itself are among them
        i = pairs.row
        j = pairs.col
        square = pairs.data**2
        own = area[j]
        bend = curvature[j]
        for width in widths:
            sigma = width * UNIT
            near = np.flatnonzero(square <= (2 * sigma) ** 2)
            i = i[near]
            square = square[near]
            own = own[near]
            bend = bend[near]
            # Down to 0 at its end, so that no rounding decides about whole rows of points that lie
            # just there.
            weight = (np.exp(square * (-1 / (2 * sigma**2))) - np.exp(-2)) * own
            total = np.bincount(i, weight, len(block))
            whole = np.bincount(i, weight * bend, len(block))
            found[width][block] = np.divide(
                whole,
                total,
                out=np.zeros(len(block)),
                where=total > 0,
            )
    return found


def _cut(surface: Surface) -> tuple[Surface, NDArray[np.int64]]:
    """The surface with its edges cut in half until none is too long, and of which face each new one
    is a part.

    Each face cuts its longest edge first. Two faces cut the edge between them at the same places,
    so the parts fit.
    """
    corners = surface.vertices[surface.faces]
    parent = np.arange(len(surface.faces))
    done = []
    done_parent = []
    while len(corners):
        square = ((np.roll(corners, -1, 1) - corners) ** 2).sum(2)
        longest = square.argmax(1)
        keep = square[np.arange(len(corners)), longest] <= LONGEST**2
        done.append(corners[keep])
        done_parent.append(parent[keep])
        a, b, c = (corners[~keep, (longest[~keep] + k) % 3] for k in range(3))
        half = (a + b) / 2
        corners = np.concatenate([np.stack([a, half, c], 1), np.stack([half, b, c], 1)])
        parent = np.tile(parent[~keep], 2)
    vertices = np.concatenate(done).reshape(-1, 3)
    parent = np.concatenate(done_parent)
    loose = Surface(vertices, np.arange(len(vertices)).reshape(-1, 3))
    # Corners in one place are one, but not of parts that only touch: their cuts meet by chance.
    key = loose.places.ravel() * (int(surface.parts.max()) + 1) + np.repeat(
        surface.parts[parent],
        3,
    )
    _, first, index = np.unique(key, return_index=True, return_inverse=True)
    return Surface(vertices[first], index.reshape(-1, 3)), parent


def _groups(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Which of some groups each point belongs to: one each, or where there are many those of its
    cube.
    """
    if len(points) <= MANY:
        return np.arange(len(points))
    return np.unique(np.floor(points / CELL), axis=0, return_inverse=True)[1].reshape(
        -1
    )
