"""Which pixels show the object: what stands on the support plane, in clusters of their footprint seen from above.

Seen from above the parts of one object lie together even where it hides itself, such as the far legs of a table under
its top; things that stand side by side lie apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from nextview.sensing.frame import Frame
from nextview.sensing.noise import Noise
from nextview.sensing.object_frame import Box
from nextview.sensing.support_plane import Plane

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

CELL = 0.01
"""Side of a cell of the footprint, in distances of the camera from the object. Gaps of up to two cells are bridged."""
CROWD = 3
"""Pixels that make a cell occupied."""
REACH, FAR = 250, 1000
"""Cells to each side of the middle of what is seen above the plane; farther things are left out. And
cells from those of the first frame beyond which nothing can be a part of the same object: a wrong pose."""


def inside_box(frame: Frame, box: Box) -> Mask:
    """Pixels whose position lies in an upright box, (H, W) bool."""
    inside = frame.depth > 0
    for axis, low, high in zip(box.axes, box.low, box.high, strict=True):
        position = frame.along(axis)
        inside &= (position >= low) & (position <= high)
    return inside


def inside_sphere(frame: Frame, centre: Float, radius: float) -> Mask:
    """Pixels whose position lies in a sphere, (H, W) bool."""
    x, y, z = (frame.along(axis, float(-at)) for axis, at in zip(np.eye(3), centre, strict=True))
    return (frame.depth > 0) & (x * x + y * y + z * z < radius**2)


def above_plane(frame: Frame, plane: Plane, noise: Noise) -> Mask:
    """Pixels that are higher above a plane than noise explains, (H, W) bool.

    Args:
        frame: the frame.
        plane: the support plane.
        noise: of the frame.
    """
    height = frame.along(plane.normal, plane.offset)
    high = height > np.float32(0.003) * frame.depth
    high &= frame.depth > 0
    rows, columns = np.divmod(np.flatnonzero(high), high.shape[1])
    # Noise moves a point along its ray: it rises by so much as the ray does.
    a, b, c = (frame.camera_to_world[:3, :3].T @ plane.normal).astype(np.float32)
    (x, y), z = frame.rays, frame.depth[rows, columns]
    rise = np.abs((a * x)[columns] + (b * y + c)[rows])
    high[rows, columns] = height[rows, columns] > z * (4 * noise.at(z) * z * rise + 0.003)
    return high


@dataclass(frozen=True)
class Footprint:
    """The cells, seen from above, over which a frame shows something above the plane.

    Attributes:
        cells: index along the two horizontal axes, (K, 2) int64, each once.
        area: of the surface seen over each, square metres (facing the camera), (K,) float64.
        pixels: how many pixels show something over each, (K,) int64.
        cell_of: the cell of each pixel of the frame, -1 for none, (H, W) int32.
    """

    cells: NDArray[np.int64]
    area: Float
    pixels: NDArray[np.int64]
    cell_of: NDArray[np.int32]

    def pixels_over(self, chosen: Mask) -> Mask:
        """Pixels that show something over the chosen cells, (H, W) bool."""
        return np.append(chosen, False)[self.cell_of]  # the last is that of -1


def footprint(frame: Frame, above: Mask, axes: Float, cell: float) -> Footprint:
    """The footprint of the pixels ``above``.

    Args:
        frame: the frame.
        above: its pixels above the plane, (H, W) bool.
        axes: upright axes, rows, (3, 3).
        cell: side of a cell, metres.
    """
    rows, columns = np.divmod(np.flatnonzero(above), above.shape[1])
    z = frame.depth[rows, columns]
    pose, (x, y) = frame.camera_to_world, frame.rays
    ij = []
    for axis in axes[:2]:
        a, b, c = (pose[:3, :3].T @ axis / cell).astype(np.float32)
        position = z * (a * x[columns] + b * y[rows] + c) + np.float32(axis @ pose[:3, 3] / cell)
        ij.append(np.floor(position).astype(np.int64))
    low = np.array([np.median(v[::50]) if len(v) else 0 for v in ij]).astype(np.int64) - REACH
    side = 2 * REACH + 1
    i, j = ij[0] - low[0], ij[1] - low[1]
    within = (i >= 0) & (i < side) & (j >= 0) & (j < side)
    rows, columns, z, keys = rows[within], columns[within], z[within], (i * side + j)[within]
    pixels = np.bincount(keys, minlength=side**2)
    used = np.flatnonzero(pixels)
    area = np.bincount(keys, z * z, side**2)[used] / (frame.intrinsics[0, 0] * frame.intrinsics[1, 1])
    number = np.zeros(side**2, np.int32)
    number[used] = np.arange(len(used))
    cell_of = np.full(frame.shape, -1, np.int32)
    cell_of[rows, columns] = number[keys]
    return Footprint(np.stack(np.divmod(used, side), 1) + low, area, pixels[used], cell_of)


def clusters(footprints: Sequence[Footprint]) -> list[NDArray[np.int64]]:
    """Label of each cell in each footprint, (K,) int64 each: 1, 2, ... for the clusters of all taken together, 0 for
    cells that too few pixels saw, or that lie far from all that the first footprint shows.
    """
    cells = np.concatenate([f.cells for f in footprints])
    if len(cells) == 0:
        return [np.zeros(0, np.int64) for _ in footprints]
    near = [np.abs(f.cells - cells[0]).max(1) <= FAR for f in footprints]
    kept = cells[np.concatenate(near)]
    low = kept.min(0) - 1
    grid = np.zeros(np.ptp(kept, axis=0) + 3, np.int64)
    np.add.at(grid, tuple((kept - low).T), np.concatenate([f.pixels[n] for f, n in zip(footprints, near, strict=True)]))
    occupied = grid >= CROWD
    labels, _ = ndimage.label(ndimage.binary_dilation(occupied, np.ones((3, 3), bool)), np.ones((3, 3)))
    labels = np.where(occupied, labels, 0)
    return [
        np.where(n, labels[tuple((np.where(n[:, None], f.cells, low) - low).T)], 0)
        for f, n in zip(footprints, near, strict=True)
    ]


def on_ground(points: Float, plane: Float) -> Mask:
    """Which points, seen from above, lie over what was seen of the plane, (N,) bool.

    Args:
        points: (N, 2).
        plane: points of the support plane, (M, 2): what stands within their hull stands on it.
    """
    if len(plane) < 3:
        return np.ones(len(points), bool)
    try:
        sides = ConvexHull(plane).equations
    except QhullError:  # a plane of which only a line is seen
        return np.ones(len(points), bool)
    return np.asarray((points @ sides[:, :2].T + sides[:, 2] <= 0).all(1))


def largest(foot: Footprint, labels: NDArray[np.int64], plane: Float) -> int:
    """The cluster with most surface in view among those that stand on what was seen of the plane; 0 if there is none.

    Args:
        foot: of one frame.
        labels: of its cells.
        plane: points of the support plane, in cells, (M, 2).
    """
    if not labels.any():
        return 0
    area = np.bincount(labels, foot.area)
    middles = np.stack([np.bincount(labels, foot.area * x) for x in foot.cells.T], 1) / np.maximum(area, 1e-30)[:, None]
    area[~on_ground(middles, plane)] = 0
    area[0] = 0
    return int(area.argmax()) if area.max() > 0 else 0


def nearest(foot: Footprint, labels: NDArray[np.int64], point: Float) -> int:
    """The cluster nearest to a point, in cells, (2,), seen from above; 0 if there is none."""
    if not labels.any():
        return 0
    distance = np.where(labels > 0, np.linalg.norm(foot.cells + 0.5 - point, axis=1), np.inf)
    return int(labels[distance.argmin()])
