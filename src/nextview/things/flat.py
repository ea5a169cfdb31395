"""Flat pieces of what no model is known of: a wall, a table, the side of a bin.

A plane explains its pixels as well as a thing does, wherever it continues. Where it ends with a
drop behind it, something ends that has a size, and a plane pays for that.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import ndimage

from nextview.sensing.frame import within
from nextview.sensing.view import View
from nextview.things.score import (
    FARTHEST,
    LEFT_OVER,
    OUTLIER,
    PIXEL_GAIN,
    Score,
    evened,
)
from nextview.things.surface import SCAN_ERROR
from nextview.types import Float, Float32, Floats, Mask

TRIPLES = 48  # planes through three pixels that are tried in each segment
LEAST_FLAT = 0.25  # share of a segment that a plane explains, at least
SHADOW = 12  # pixels of the widest shadow beside an edge


def planes(view: View) -> tuple[Score, ...]:
    """Return what planes explain in a view, each with the pixels that it continues in."""
    grid = view.grid()
    x, y = np.broadcast_arrays(grid.x, grid.y[:, None])
    slopes = np.stack([x, y, np.ones_like(x)], -1)
    measured = grid.depth > 0
    stride = view.stride
    found: list[Score] = []
    held = np.zeros(grid.depth.shape, bool)

    for labels in (view.labels, view.pieces):
        small = np.where(measured, labels[::stride, ::stride], 0)
        counts = np.bincount(small.ravel())
        for number in np.flatnonzero(counts[1:] >= view.fewest) + 1:
            own = small == number
            if np.count_nonzero(own & held) > (1 - LEAST_FLAT) * counts[number]:
                continue
            for one, cells in _of_segment(grid.depth, grid.sigma, slopes, own):
                found.append(one)
                held |= cells
    return tuple(found)


def _of_segment(
    depth: Float32, sigma: Float32, slopes: Float, own: Mask
) -> Iterator[tuple[Score, Mask]]:
    """Return the planes of a segment, and the pixels that they continue in."""
    rng = np.random.default_rng(0)
    left = own
    while True:
        cells = np.flatnonzero(left)
        if len(cells) < 12 or len(cells) < LEAST_FLAT * np.count_nonzero(own):
            return
        normal = _fitted(
            slopes.reshape(-1, 3)[cells],
            depth.ravel()[cells],
            sigma.ravel()[cells],
            rng,
        )
        away = slopes[0, :, 0] * normal[0] + (slopes[:, :1, 1] * normal[1] + normal[2])
        z = 1 / np.maximum(away, 1e-3)
        margin = FARTHEST * sigma
        off = depth - z
        near = (depth > 0) & (np.abs(off) < margin)
        if np.count_nonzero(near & left) < LEAST_FLAT * np.count_nonzero(own):
            return
        parts = ndimage.label(near)[0]
        region = parts == np.bincount(parts[near & left]).argmax()
        # of neighbouring pixels, as for a thing: a steep surface is less certain
        part = within(region, 1)
        down, aside = np.gradient(z[part])
        steep = np.maximum(np.abs(down), np.abs(aside))[region[part]]
        variance = sigma[region] ** 2 + SCAN_ERROR**2 + (steep / 2) ** 2
        gain = np.log(np.exp(-(off[region] ** 2) / 2 / variance) + np.exp(OUTLIER))
        count = float(np.count_nonzero(region))
        cells = np.flatnonzero(region)
        every = np.ones(len(cells), bool)
        yield (
            Score(
                cells.astype(np.int32),
                evened(gain + PIXEL_GAIN, cells, every, depth.shape[1]),
                LEFT_OVER * _drops(region, off, depth, margin),
                count,
                0.0,
                0.0,
            ),
            region,
        )
        left = left & ~near


def _drops(region: Mask, off: Floats, depth: Float32, margin: Floats) -> int:
    """Count the pixels around a plane behind which something is measured, or beyond a shadow."""
    rows, columns = within(region, SHADOW)
    region = region[rows, columns]
    ring = ndimage.binary_dilation(region, iterations=2) & ~region
    outside = (depth[rows, columns] > 0) & ~region
    if not outside.any():
        return 0
    distance, nearest = ndimage.distance_transform_edt(~outside, return_indices=True)
    drop = (off > margin)[rows, columns]
    return int(np.count_nonzero(ring & (distance < SHADOW) & drop[tuple(nearest)]))


def _fitted(
    slopes: Float, depth: Float32, sigma: Float32, rng: np.random.Generator
) -> Float:
    """Return the plane n of most pixels, n . (x, y, 1) = 1 / depth, (3,) float64."""
    few = rng.permutation(len(depth))[:400]
    rays = slopes[few]
    z = depth[few].astype(np.float64)
    error = sigma[few]

    # planes through three points each, and one that faces the camera
    triples = rng.integers(0, len(few), (TRIPLES, 3))
    corners = rays[triples]
    usable = np.abs(np.linalg.det(corners)) > 1e-9
    normals = np.linalg.solve(corners[usable], (1 / z[triples[usable]])[..., None])[
        ..., 0
    ]
    normals = np.concatenate([normals, [[0.0, 0.0, 1 / np.median(z)]]])
    off = np.abs(1 / np.maximum(normals @ rays.T, 1e-3) - z)
    normal = normals[np.count_nonzero(off < 2 * error, axis=1).argmax()]

    # the best one, drawn to the points near it
    for _ in range(3):
        off = np.abs(1 / np.maximum(rays @ normal, 1e-3) - z)
        weight = np.where(off < 3 * error, z**2 / error, 0)
        normal = np.linalg.lstsq(rays * weight[:, None], weight / z, rcond=None)[0]
    return np.asarray(normal)
