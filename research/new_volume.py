"""How much that is unseen would be seen from elsewhere: volume, and surface, by a z-buffer of
voxels.

Only where the cameras stand counts: they are taken to have the whole region in their picture.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.errors import UsageError
from nextview.sensing.expected_visibility import (
    FREE,
    OCCLUDER,
    UNSEEN,
    Occupancy,
    VoxelGrid,
)

Float = NDArray[np.float32]
TOGETHER = 100_000
"""Voxels that are drawn at once, in the pictures of several cameras."""


def new_volume(
    occupancy: Occupancy,
    positions: NDArray[np.floating],
    region: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64]:
    """Unseen volume that no occupied voxel hides from each position: the volumetric information
    gain.

    What is unseen is taken to be transparent, so this is the most that can come into view; the
    count of unseen voxels along the rays up to the first occupied one of Delmerico et al., "A
    comparison of volumetric information gain metrics for active 3D object reconstruction"
    (Autonomous Robots 42, 2018), but in volume instead of per ray.

    Args:
        occupancy: what is known.
        positions: of the cameras, in the grid's frame and unit, (V, 3).
        region: voxels that count, (n, n, n) bool; by default those in the ball that the grid holds.

    Returns:
        (V,) float64, cubes of the grid's unit.

    Raises:
        UsageError: a camera stands within the region, or these are no cameras and no region.
    """
    grid = occupancy.grid
    cells = occupancy.cells.reshape(-1)
    counts = (cells == UNSEEN) & region_of(grid, region).reshape(-1)
    asked = _middles(grid, counts)
    blockers = _middles(grid, cells >= OCCLUDER)
    found: list[int] = []
    for eyes in _eyes(asked, blockers, positions, grid.pitch):
        u, v, z = eyes.project(asked)
        frame = _Frame.around(u, v)
        reach = eyes.hidden(blockers, frame) + np.float32(grid.pitch)
        pixels = _pixels(
            v - frame.top,
            u - frame.left,
            np.arange(len(u))[:, None],
            frame.shape,
        )
        found += map(np.count_nonzero, z <= reach.take(pixels))
    return np.array(found or [0] * len(positions)) * grid.pitch**3


def new_surface(
    occupancy: Occupancy,
    positions: NDArray[np.floating],
    region: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64]:
    """Area of the picture in which the border of unseen space shows, where new surface may come to
    light.

    What is unseen is taken to be solid, the opposite of ``new_volume``: the object is at most what
    no view has seen to be free. Its border that is unseen counts where nothing hides it, as large
    as it appears: surface that is seen at a low angle says less.

    Args:
        occupancy: what is known.
        positions: of the cameras, in the grid's frame and unit, (V, 3).
        region: voxels where the object can be, (n, n, n) bool; by default those in the ball that
            the grid holds.

    Returns:
        (V,) float64, squares of the grid's unit at the distance of the border's middle.

    Raises:
        UsageError: a camera stands within the region.
    """
    grid = occupancy.grid
    cells = occupancy.cells
    solid = (cells != FREE) & region_of(grid, region) | (cells >= OCCLUDER)
    border = (solid & ~_enclosed(solid)).reshape(-1)
    unseen = border & (cells.reshape(-1) == UNSEEN)
    asked = _middles(grid, unseen)
    blockers = _middles(grid, border & ~unseen)
    found: list[int] = []
    for eyes in _eyes(asked, blockers, positions, grid.pitch):
        u, v, z = eyes.project(asked)
        frame = _Frame.around(u, v)
        nearest = eyes.z_buffer(u, v, z, frame)
        hidden = eyes.hidden(blockers, frame)
        shows = np.isfinite(nearest) & (nearest < hidden) & frame.inside
        found += map(np.count_nonzero, shows)
    return np.array(found or [0] * len(positions)) * grid.pitch**2


def region_of(grid: VoxelGrid, region: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """Voxels that count, (n, n, n) bool: those of a region, or of the ball that the grid holds."""
    if region is None:
        return grid.within(grid.half)
    if region.shape != (grid.n,) * 3 or region.dtype != bool:
        raise UsageError(
            f"a region is an array of {(grid.n,) * 3} truths, one for each voxel"
        )
    return region


def _middles(grid: VoxelGrid, cells: NDArray[np.bool_]) -> Float:
    """Of some voxels, (n^3,) bool, (3, P)."""
    return grid.middles.take(np.flatnonzero(cells), axis=1)


def _enclosed(solid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Solid voxels all of whose six neighbours are solid; nothing is outside of the grid."""
    padded = np.pad(solid, 1)
    inner = slice(1, -1)
    sides = [
        padded[:-2, inner, inner],
        padded[2:, inner, inner],
        padded[inner, :-2, inner],
        padded[inner, 2:, inner],
    ]
    return np.logical_and.reduce(
        [*sides, padded[inner, inner, :-2], padded[inner, inner, 2:]]
    )


@dataclass(frozen=True)
class _Frame:
    """The part of its picture that each of E cameras is asked about.

    Attributes:
        left, top: pixel coordinates of its corner, (E, 1) each.
        rows, columns: of each, (E, 1) int64 each.
        shape: rows and columns of pictures that hold them all.
    """

    left: Float
    top: Float
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    shape: tuple[int, int]

    @classmethod
    def around(cls, u: Float, v: Float) -> _Frame:
        """Those that hold points at some pixel coordinates, (E, P) each, and a pixel beside
        them.
        """
        left, top = (c.min(1, keepdims=True) - 1 for c in (u, v))
        rows, columns = (
            (c.max(1, keepdims=True) - c0).astype(np.int64) + 2
            for c, c0 in ((v, top), (u, left))
        )
        return cls(left, top, rows, columns, (int(rows.max()), int(columns.max())))

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Pixels of pictures of that shape that belong to each, (E, rows, columns)."""
        rows, columns = (
            np.arange(side) < own
            for side, own in zip(self.shape, (self.rows, self.columns), strict=True)
        )
        return rows[:, :, None] & columns[:, None]


@dataclass(frozen=True)
class _Eyes:
    """E cameras that look at the middle of what they are asked about; there a pixel is as wide as a
    voxel.

    Attributes:
        positions: (E, 3).
        axes: right, down and ahead as rows, the first two in pixels, (E, 3, 3).
        distances: to that middle, (E,).
        pitch: side of a voxel.
    """

    positions: Float
    axes: Float
    distances: Float
    pitch: float

    def project(self, points: Float) -> tuple[Float, Float, Float]:
        """Pixel coordinates and depth of points that lie ahead, (3, P), each (E, P).

        Raises:
            UsageError: one does not lie ahead.
        """
        x, y, z = self._turned(points)
        if z.min(initial=np.inf) < self.pitch / 2:
            raise UsageError("a camera stands among the voxels that it is asked about")
        return np.divide(x, z, out=x), np.divide(y, z, out=y), z

    def hidden(self, blockers: Float, frame: _Frame) -> Float:
        """Depth of the nearest of some voxels, (3, Q), at each pixel; those that do not lie
        ahead are left out.
        """
        x, y, z = self._turned(blockers)
        z[z <= np.float32(self.pitch)] = np.inf
        return self.z_buffer(np.divide(x, z, out=x), np.divide(y, z, out=y), z, frame)

    def z_buffer(self, u: Float, v: Float, z: Float, frame: _Frame) -> Float:
        """Depth of the nearest of voxels that were projected at each pixel, infinity for none, (E,
        rows, columns).

        Each is drawn over the four pixels around its middle, so that walls have no holes: the
        middles of the voxels of a wall are at most sqrt(2) sides apart, and these are less than two
        pixels. Nearer ones, which are farther apart in the picture, are drawn in pixels of twice
        the width, or four times, and so on.
        """
        u, v, picture = u - frame.left, v - frame.top, np.arange(len(u))[:, None]
        shape = (len(u), *frame.shape)
        # what is nearer is drawn wider
        wide = np.sqrt(0.5) * self.distances.astype(np.float64)[:, None]
        widest = (wide[:, 0] / z.min(1, initial=np.inf)).max()
        if widest <= 1:
            return _drawn(u, v, z, picture, shape, 1)
        near = z < wide
        found = _drawn(u, v, np.where(near, np.float32(np.inf), z), picture, shape, 1)
        at = np.nonzero(near)
        u = u[at]
        v = v[at]
        z = z[at]
        wide = wide[at[0], 0]
        picture = at[0]
        width = 2
        while width < 2 * widest:
            here = (width * z >= wide) & (width * z < 2 * wide)
            i = v[here] / np.float32(width)
            j = u[here] / np.float32(width)
            np.minimum(
                found,
                _drawn(j, i, z[here], picture[here], shape, width),
                out=found,
            )
            width *= 2
        return found

    def _turned(self, points: Float) -> tuple[Float, Float, Float]:
        """Points, (3, P), along right, down and ahead from each camera, each (E, P)."""
        found = (self.axes.reshape(-1, 3) @ points).reshape(len(self.axes), 3, -1)
        found -= self.axes @ self.positions[:, :, None]
        return found[:, 0], found[:, 1], found[:, 2]


def _drawn(
    u: Float,
    v: Float,
    z: Float,
    picture: NDArray[np.int64],
    shape: tuple[int, int, int],
    width: int,
) -> Float:
    """Pictures of the nearest depths of points, (E, rows, columns), drawn in pixels of some width.

    Args:
        u, v: where they are drawn, in pixels of that width, counted from the corner of their
            picture.
        z: their depth.
        picture: which it is.
        shape: pictures, and rows and columns of each in pixels of width 1.
        width: in these.
    """
    # Row i of ``nearest`` stands for the line between the pixels i - 1 and i.
    i = v + np.float32(0.5)
    j = u + np.float32(0.5)
    rows, columns = (side // width + 3 for side in shape[1:])
    inside = (i >= 0) & (i < rows - 1) & (j >= 0) & (j < columns - 1)
    nearest = np.full((shape[0], rows, columns), np.inf, np.float32)
    np.minimum.at(
        nearest.reshape(-1),
        _pixels(i, j, picture, (rows, columns))[inside],
        z[inside],
    )
    nearest = np.minimum(nearest[:, :-1], nearest[:, 1:])
    nearest = np.minimum(nearest[:, :, :-1], nearest[:, :, 1:])
    if width > 1:
        nearest = nearest.repeat(width, 1).repeat(width, 2)
    return nearest[:, : shape[1], : shape[2]]


def _pixels(
    i: Float,
    j: Float,
    picture: NDArray[np.int64],
    shape: tuple[int, int],
) -> NDArray[np.int64]:
    """Indices of rows and columns of pictures of a shape that lie in memory one after the other."""
    rows, columns = shape
    pixels = i.astype(np.int64)
    pixels *= columns
    pixels += j.astype(np.int32)
    pixels += picture * (rows * columns)
    return pixels


def _eyes(
    asked: Float,
    blockers: Float,
    positions: NDArray[np.floating],
    pitch: float,
) -> Iterator[_Eyes]:
    """Cameras at some positions, (V, 3), that look at the middle of points, (3, P); none if there
    are no points.

    They come in groups, the larger the fewer points there are.
    """
    if asked.size == 0:
        return
    eyes = np.asarray(positions, np.float32)
    towards = (asked.min(1) + asked.max(1)) / 2 - eyes
    distances = np.maximum(np.linalg.norm(towards, axis=1), np.float32(pitch))
    ahead = towards / distances[:, None]
    right = _cross(ahead, np.eye(3, dtype=np.float32)[np.abs(ahead).argmin(1)])
    right /= np.maximum(np.linalg.norm(right, axis=1, keepdims=True), np.float32(1e-9))
    pixels = (distances / np.float32(pitch))[:, None]
    axes = np.stack([right * pixels, _cross(ahead, right) * pixels, ahead], 1)
    together = max(TOGETHER // max(asked.shape[1], blockers.shape[1]), 1)
    for at in range(0, len(eyes), together):
        some = slice(at, at + together)
        yield _Eyes(eyes[some], axes[some], distances[some], pitch)


def _cross(a: Float, b: Float) -> Float:
    """Cross products of rows, (V, 3): np.cross takes longer for few than all else here."""
    ahead = [1, 2, 0]
    behind = [2, 0, 1]
    return a[:, ahead] * b[:, behind] - a[:, behind] * b[:, ahead]
