"""How much that is unseen would be seen from elsewhere: volume, and surface, by a z-buffer of voxels.

Only where the cameras stand counts: they are taken to have the whole region in their picture.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import of_kind, places
from nextview.errors import UsageError
from nextview.occupancy.voxel_grid import FREE, OCCLUDER, UNSEEN, Occupancy, region_of

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
        UsageError: a camera stands within the region, or these are no cameras and no region.
    """
    of_kind(occupancy, Occupancy, "what is known is an Occupancy")
    positions = places(positions, "the positions of cameras")
    grid, cells = occupancy.grid, occupancy.cells.reshape(-1)
    counts = (cells == UNSEEN) & region_of(grid, region).reshape(-1)
    asked, blockers = grid.middles[:, counts], grid.middles[:, cells >= OCCLUDER]
    found = np.zeros(len(positions))
    for at, eye in enumerate(_eyes(asked, positions, grid.pitch)):
        u, v, z = eye.project(asked)
        corner, shape = _frame(u, v)
        buffer = eye.z_buffer(blockers, corner, shape)
        pixel = (v - corner[1]).astype(np.int32) * np.int32(shape[1]) + (u - corner[0]).astype(np.int32)
        found[at] = np.count_nonzero(z <= buffer.take(pixel) + np.float32(grid.pitch))
    return found * grid.pitch**3


def new_surface(
    occupancy: Occupancy, positions: NDArray[np.floating], region: NDArray[np.bool_] | None = None
) -> NDArray[np.float64]:
    """Area of the picture in which the border of unseen space shows, where new surface may come to light.

    What is unseen is taken to be solid, the opposite of ``new_volume``: the object is at most what no view has seen
    to be free. Its border that is unseen counts where nothing hides it, as large as it appears: surface that is seen
    at a low angle says less.

    Args:
        occupancy: what is known.
        positions: of the cameras, in the grid's frame and unit, (V, 3).
        region: voxels where the object can be, (n, n, n) bool; by default those in the ball that the grid holds.

    Returns:
        (V,) float64, squares of the grid's unit at the distance of the border's middle.

    Raises:
        UsageError: a camera stands within the region.
    """
    of_kind(occupancy, Occupancy, "what is known is an Occupancy")
    positions = places(positions, "the positions of cameras")
    grid, cells = occupancy.grid, occupancy.cells
    solid = (cells != FREE) & region_of(grid, region) | (cells >= OCCLUDER)
    border = (solid & ~_enclosed(solid)).reshape(-1)
    unseen = border & (cells.reshape(-1) == UNSEEN)
    asked, blockers = grid.middles[:, unseen], grid.middles[:, border & ~unseen]
    found = np.zeros(len(positions))
    for at, eye in enumerate(_eyes(asked, positions, grid.pitch)):
        corner, shape = _frame(*eye.project(asked)[:2])
        nearest = eye.z_buffer(asked, corner, shape)
        found[at] = np.count_nonzero(np.isfinite(nearest) & (nearest < eye.z_buffer(blockers, corner, shape)))
    return found * grid.pitch**2


def _enclosed(solid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Solid voxels all of whose six neighbours are solid; nothing is outside of the grid."""
    padded, inner = np.pad(solid, 1), slice(1, -1)
    sides = [padded[:-2, inner, inner], padded[2:, inner, inner], padded[inner, :-2, inner], padded[inner, 2:, inner]]
    return np.logical_and.reduce([*sides, padded[inner, inner, :-2], padded[inner, inner, 2:]])


@dataclass(frozen=True)
class _Eye:
    """A camera that looks at the middle of what it is asked about; there a pixel is as wide as a voxel.

    Attributes:
        position: (3,).
        axes: right, down and ahead as rows, the first two in pixels, (3, 3).
        distance: to that middle.
        pitch: side of a voxel.
    """

    position: Float
    axes: Float
    distance: float
    pitch: float

    def project(self, points: Float) -> tuple[Float, Float, Float]:
        """Pixel coordinates and depth of points that lie ahead, (3, P), each (P,)."""
        x, y, z = self.axes @ points - (self.axes @ self.position)[:, None]
        if z.min(initial=np.inf) < self.pitch / 2:
            raise UsageError("a camera stands among the voxels that it is asked about")
        return x / z, y / z, z

    def z_buffer(self, blockers: Float, corner: tuple[float, float], shape: tuple[int, int]) -> Float:
        """Depth of the nearest voxel at each pixel, infinity for none.

        Each is drawn over the four pixels around its middle, so that walls have no holes: the middles of the voxels of
        a wall are at most sqrt(2) sides apart, and these are less than two pixels. Nearer ones, which are farther apart
        in the picture, are drawn in pixels of twice the width, or four times, and so on.

        Args:
            blockers: middles of voxels, (3, Q); those that do not lie ahead are left out.
            corner: pixel coordinates of the picture's corner.
            shape: of the picture, rows and columns.
        """
        found = np.full(shape, np.inf, np.float32)
        ahead = self.axes[2] @ blockers > self.axes[2] @ self.position + np.float32(self.pitch)
        u, v, z = self.project(blockers[:, ahead])
        level = np.ceil(np.log2(np.maximum(np.sqrt(0.5) * self.distance / z, 1))).astype(np.int64)
        for coarse in range(int(level.max(initial=0)) + 1):
            here, width = level == coarse, 2**coarse
            rows, columns = (side // width + 3 for side in shape)
            # Row i of ``nearest`` stands for the line between the pixels i - 1 and i.
            i, j = ((c[here] - corner[k]) / width + np.float32(0.5) for k, c in ((1, v), (0, u)))
            inside = (i >= 0) & (i < rows - 1) & (j >= 0) & (j < columns - 1)
            nearest = np.full((rows, columns), np.inf, np.float32)
            pixel = i[inside].astype(np.int32) * np.int32(columns) + j[inside].astype(np.int32)
            np.minimum.at(nearest.reshape(-1), pixel, z[here][inside])
            nearest = np.minimum(nearest[:-1], nearest[1:])
            nearest = np.minimum(nearest[:, :-1], nearest[:, 1:])
            if coarse:
                nearest = nearest.repeat(width, 0).repeat(width, 1)
            np.minimum(found, nearest[: shape[0], : shape[1]], out=found)
        return found


def _eyes(asked: Float, positions: NDArray[np.floating], pitch: float) -> Iterator[_Eye]:
    """Cameras at some positions, (V, 3), that look at the middle of points, (3, P); none if there are no points."""
    if asked.size == 0:
        return
    eyes = np.asarray(positions, np.float32)
    towards = (asked.min(1) + asked.max(1)) / 2 - eyes
    distances = np.maximum(np.linalg.norm(towards, axis=1), np.float32(pitch))
    ahead = towards / distances[:, None]
    right = np.cross(ahead, np.eye(3, dtype=np.float32)[np.abs(ahead).argmin(1)])
    right /= np.maximum(np.linalg.norm(right, axis=1, keepdims=True), np.float32(1e-9))
    for eye, x, y, z, distance in zip(eyes, right, np.cross(ahead, right), ahead, distances, strict=True):
        pixels = distance / np.float32(pitch)
        yield _Eye(eye, np.stack([x * pixels, y * pixels, z]), float(distance), pitch)


def _frame(u: Float, v: Float) -> tuple[tuple[float, float], tuple[int, int]]:
    """Corner and shape of a picture that holds points at these pixel coordinates, and a pixel beside them."""
    corner = u.min() - 1, v.min() - 1
    return corner, (int(v.max() - corner[1]) + 2, int(u.max() - corner[0]) + 2)
