"""A grid of voxels around an object, and what depth frames say of each."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import as_line, number, of_kind, places, whole
from nextview.depth import FARTHEST
from nextview.errors import ObservationError, UsageError
from nextview.observation import array_of, checked_intrinsics, numbers

UNSEEN, FREE, OCCLUDER, OBJECT = np.arange(4, dtype=np.uint8)
"""What a voxel can be. Of what several frames say of it the largest counts, in whatever order they come."""
MOST = 1024
"""Voxels along a side."""
LEAST, LARGEST = 1e-6, 1e6
"""Of half a side, in the grid's unit."""


@dataclass(frozen=True)
class VoxelGrid:
    """A cube of n x n x n voxels, in any unit of length: object radii or metres, as poses and depth are.

    Attributes:
        n: voxels along each side.
        half: half the side of the cube.
        centre: of the cube.

    Raises:
        UsageError: there is no such cube.

    >>> grid = VoxelGrid(64)
    >>> grid.pitch, grid.ball.mean().round(3)  # a ball fills pi / 6 of its cube
    (0.03125, 0.524)
    """

    n: int = 64
    half: float = 1.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        whole(self.n, "the number of voxels along a side of a voxel grid", 2, MOST)
        if not LEAST <= number(self.half, "half the side of a voxel grid") <= LARGEST:
            raise UsageError(f"half the side of a voxel grid is from {LEAST:g} to {LARGEST:g}, not {self.half}")
        try:
            places([self.centre], "centres")
        except UsageError:
            where = as_line(self.centre)
            raise UsageError(f"the centre of a voxel grid is three finite numbers, not {where}") from None

    @property
    def pitch(self) -> float:
        """Side of a voxel."""
        return 2 * self.half / self.n

    @cached_property
    def axes(self) -> NDArray[np.float32]:
        """Where the middles of the voxels lie along x, y and z, (3, n)."""
        steps = (np.arange(self.n) + 0.5) * self.pitch - self.half
        return (np.array(self.centre)[:, None] + steps).astype(np.float32)

    @cached_property
    def middles(self) -> NDArray[np.float32]:
        """Of the voxels, in the order of ``cells.ravel()``, (3, n^3): contiguous along each axis, which is fast."""
        return np.stack(np.meshgrid(*self.axes, indexing="ij")).reshape(3, -1)

    @cached_property
    def ball(self) -> NDArray[np.bool_]:
        """Voxels in the ball that the cube holds: in object radii, all where the object can be. (n, n, n)."""
        return self.within(self.half)

    def within(self, radius: float) -> NDArray[np.bool_]:
        """Voxels whose middle is no farther than this from that of the cube, (n, n, n) bool."""
        x, y, z = ((axis - middle) ** 2 for axis, middle in zip(self.axes, self.centre, strict=True))
        return x[:, None, None] + y[:, None] + z <= radius**2

    def cell_of(self, points: NDArray[np.floating]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """The voxel of each point, (P, 3), as an index into ``cells.ravel()``, and whether there is one, each (P,)."""
        at = np.floor((points - np.array(self.centre) + self.half) / self.pitch).astype(np.int64)
        inside = ((at >= 0) & (at < self.n)).all(1)
        at = np.where(inside[:, None], at, 0)
        return (at[:, 0] * self.n + at[:, 1]) * self.n + at[:, 2], inside


@dataclass(frozen=True)
class Occupancy:
    """What is known of each voxel of a grid. Nothing changes in place: ``seen`` gives another one.

    An occupied voxel stays occupied: a leg is thinner than a voxel, so that its middle may be free though it is there.

    Attributes:
        grid: the voxels.
        cells: UNSEEN, FREE, OCCLUDER or OBJECT, (n, n, n) uint8, axes x, y, z.

    >>> occupancy = Occupancy.unseen(VoxelGrid(64))
    >>> for view in views:                                                      # doctest: +SKIP
    ...     occupancy = occupancy.seen(view.depth, view.pose, view.intrinsics)
    """

    grid: VoxelGrid
    cells: NDArray[np.uint8]

    @classmethod
    def unseen(cls, grid: VoxelGrid, region: NDArray[np.bool_] | None = None) -> Occupancy:
        """Before the first frame; outside of a region, (n, n, n) bool, if one is given, all is known to be free."""
        of_kind(grid, VoxelGrid, "voxels are those of a VoxelGrid")
        if region is None:
            return cls(grid, np.full((grid.n,) * 3, UNSEEN))
        return cls(grid, np.where(region_of(grid, region), UNSEEN, FREE))

    def seen(
        self,
        depth: NDArray[np.floating],
        pose: NDArray[np.floating],
        intrinsics: NDArray[np.floating],
        object_mask: NDArray[np.bool_] | None = None,
        background_free: bool = True,
    ) -> Occupancy:
        """With what one more depth frame says.

        The voxels that its points lie in are occupied. A voxel is free if its middle lies in front of what the pixel
        that it falls on shows. So pixels have to be finer than voxels, or surfaces get holes.

        Args:
            depth: along the optical axis, (H, W), in the grid's unit, 0 where nothing was measured.
            pose: camera-to-world, (4, 4), OpenCV axes.
            intrinsics: pinhole matrix, (3, 3), pixels, the first pixel's centre at 0.5.
            object_mask: pixels that show the object, (H, W) bool; by default all that show anything. Others show
                occluders.
            background_free: whether nothing is there where nothing was measured, as in renders and in segmented views
                of an object without occluders. False for a sensor that measures nothing on what is black or shiny.

        Raises:
            ObservationError: depth and mask are no images of one shape, or pose and intrinsics none of a camera.
        """
        depth = numbers(depth, "the depth").astype(np.float32, copy=False)
        object_mask = None if object_mask is None else array_of(object_mask, "the mask")
        shape = depth.shape if object_mask is None else object_mask.shape
        if depth.ndim != 2 or shape != depth.shape:
            raise ObservationError(f"depth and mask are images of one shape, not {depth.shape} and {shape}")
        pose = numbers(pose, "the pose")
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise ObservationError(f"the pose is a camera-to-world matrix, (4, 4) finite numbers, not {as_line(pose)}")
        checked_intrinsics(intrinsics, depth.shape)
        grid, cells = self.grid, self.cells.copy().reshape(-1)
        unseen = np.flatnonzero(cells == UNSEEN)  # what was free before is so without being looked at again
        reach = np.where(depth > 0, depth, FARTHEST if background_free else 0).astype(np.float32)
        cells[unseen[_in_front(grid.middles[:, unseen], reach, pose, intrinsics)]] = FREE
        rows, columns = np.nonzero(depth)
        at, inside = grid.cell_of(_unproject(depth[rows, columns], rows, columns, pose, intrinsics))
        mine = np.ones(len(at), bool) if object_mask is None else object_mask[rows, columns]
        for what in (OCCLUDER, OBJECT):
            hit = at[inside & (mine == (what == OBJECT))]
            cells[hit] = np.maximum(cells[hit], what)
        return Occupancy(grid, cells.reshape(self.cells.shape))

    def and_also(self, other: Occupancy) -> Occupancy:
        """What both say together, of one grid."""
        return Occupancy(self.grid, np.maximum(self.cells, other.cells))


def region_of(grid: VoxelGrid, region: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """Voxels that count, (n, n, n) bool: those of a region, or of the ball that the grid holds.

    Raises:
        UsageError: there is no such region.
    """
    if region is None:
        return grid.ball
    of_kind(region, np.ndarray, "a region of voxels is an array")
    if region.shape != (grid.n,) * 3 or region.dtype != bool:
        raise UsageError(f"a region is {(grid.n,) * 3} truths, one for each voxel, not {region.shape} {region.dtype}")
    return region


def _unproject(
    depth: NDArray[np.float32],
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    pose: NDArray[np.floating],
    intrinsics: NDArray[np.floating],
) -> NDArray[np.float32]:
    """Points that pixels show, world, (P, 3)."""
    x = (columns + np.float32(0.5 - intrinsics[0, 2])) * (depth / np.float32(intrinsics[0, 0]))
    y = (rows + np.float32(0.5 - intrinsics[1, 2])) * (depth / np.float32(intrinsics[1, 1]))
    return np.stack([x, y, depth], 1).astype(np.float32) @ pose[:3, :3].T.astype(np.float32) + pose[:3, 3]


def _in_front(
    points: NDArray[np.float32],
    reach: NDArray[np.float32],
    pose: NDArray[np.floating],
    intrinsics: NDArray[np.floating],
) -> NDArray[np.bool_]:
    """Which points, (3, P), fall on a pixel and are nearer than its reach, (H, W)."""
    height, width = reach.shape
    to_image = (intrinsics @ pose[:3, :3].T).astype(np.float32)
    x, y, z = to_image @ points - (to_image @ pose[:3, 3].astype(np.float32))[:, None]
    x /= np.maximum(z, np.float32(1e-6))
    y /= np.maximum(z, np.float32(1e-6))
    inside = (z > 1e-6) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    pixel = np.where(inside, y, 0).astype(np.int32) * np.int32(width) + np.where(inside, x, 0).astype(np.int32)
    return inside & (z < reach.reshape(-1).take(pixel))
