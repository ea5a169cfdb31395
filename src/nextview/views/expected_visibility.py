"""Occupancy grid around an object from depth frames, and its expected visibility."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from nextview.checks import number, whole
from nextview.geometry.depth import FARTHEST_SURFACE
from nextview.sensing.observation import Observation
from nextview.types import Float, Float32, Floats, Index, Mask

# states of a voxel; the maximum over all frames counts
UNSEEN, FREE, OCCLUDER, OBJECT = np.arange(4, dtype=np.uint8)


@dataclass(frozen=True)
class VoxelGrid:
    """A cube of n x n x n voxels.

    Attributes:
        n: voxels along each side.
        half: half the side, object radii.
        centre: of the cube, object frame, (3,).
    """

    n: int = 64
    half: float = 1.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        whole(self.n, "the number of voxels along a side of a voxel grid", 2, 1024)
        number(self.half, "half the side of a voxel grid", 1e-6, 1e6)

    @property
    def pitch(self) -> float:
        """Side of a voxel."""
        return 2 * self.half / self.n

    @cached_property
    def axes(self) -> Float32:
        """Coordinates of the voxel centres along x, y and z, (3, n)."""
        steps = (np.arange(self.n) + 0.5) * self.pitch - self.half
        return (np.array(self.centre)[:, None] + steps).astype(np.float32)

    @cached_property
    def middles(self) -> Float32:
        """Centres of the voxels in the order of ``cells.ravel()``, (3, n^3)."""
        return np.stack(np.meshgrid(*self.axes, indexing="ij")).reshape(3, -1)

    def within(self, radius: float) -> Mask:
        """Return the voxels within a radius of the grid's centre, (n, n, n) bool."""
        x, y, z = (
            (axis - middle) ** 2
            for axis, middle in zip(self.axes, self.centre, strict=True)
        )
        return x[:, None, None] + y[:, None] + z <= radius**2

    def cell_of(self, points: Floats) -> tuple[Index, Mask]:
        """Return the voxel index of each point, (P, 3), and whether it is inside the grid."""
        at = np.floor((points - np.array(self.centre) + self.half) / self.pitch).astype(
            np.int64
        )
        inside = ((at >= 0) & (at < self.n)).all(1)
        at = np.where(inside[:, None], at, 0)
        return (at[:, 0] * self.n + at[:, 1]) * self.n + at[:, 2], inside


@dataclass(frozen=True)
class Occupancy:
    """State of each voxel of a grid. Immutable: ``seen`` returns a new one.

    An occupied voxel stays occupied: a chair leg is thinner than a voxel, so the centre of its
    voxel may be observed as free.

    Attributes:
        grid: the voxels.
        cells: UNSEEN, FREE, OCCLUDER or OBJECT, (n, n, n), axes x, y, z.
    """

    grid: VoxelGrid
    cells: NDArray[np.uint8]

    @classmethod
    def unseen(cls, grid: VoxelGrid) -> "Occupancy":
        """Return the occupancy before the first frame.

        Args:
            grid: the voxels.

        Returns:
            The occupancy.
        """
        return cls(grid, np.full((grid.n,) * 3, UNSEEN))

    def seen(
        self,
        depth: Floats,
        pose: Floats,
        intrinsics: Floats,
        object_mask: Mask | None = None,
        background_free: bool = True,
    ) -> "Occupancy":
        """Return the occupancy after one more depth frame.

        Voxels that contain points of the frame are occupied. Voxels are free if their centre is in
        front of the depth of its pixel. Pixels must therefore be finer than voxels, or surfaces get
        holes.

        Args:
            depth: (H, W), in the unit of the grid; 0 without valid depth.
            pose: camera-to-world, (4, 4), in the frame of the grid.
            intrinsics: pinhole matrix, (3, 3), pixels.
            object_mask: pixels of the object, (H, W) bool; None for all.
            background_free: whether pixels without depth show free space, as in renders.

        Returns:
            The occupancy.
        """
        depth = np.asarray(depth).astype(np.float32, copy=False)
        grid = self.grid
        cells = self.cells.copy().reshape(-1)
        # free voxels stay free and need no test
        unseen = np.flatnonzero(cells == UNSEEN)
        reach = np.where(
            depth > 0,
            depth,
            FARTHEST_SURFACE if background_free else 0,
        ).astype(np.float32)
        cells[unseen[_in_front(grid.middles[:, unseen], reach, pose, intrinsics)]] = (
            FREE
        )
        rows, columns = np.nonzero(depth)
        k = intrinsics
        z = depth[rows, columns]
        x = (columns + np.float32(0.5 - k[0, 2])) * (z / np.float32(k[0, 0]))
        y = (rows + np.float32(0.5 - k[1, 2])) * (z / np.float32(k[1, 1]))
        points = (
            np.stack([x, y, z], 1).astype(np.float32)
            @ pose[:3, :3].T.astype(np.float32)
            + pose[:3, 3]
        )
        at, inside = grid.cell_of(points)
        mine = (
            np.ones(len(at), bool)
            if object_mask is None
            else object_mask[rows, columns]
        )
        for what in (OCCLUDER, OBJECT):
            hit = at[inside & (mine == (what == OBJECT))]
            cells[hit] = np.maximum(cells[hit], what)
        return Occupancy(grid, cells.reshape(self.cells.shape))


def _in_front(
    points: Float32,
    reach: Float32,
    pose: Floats,
    intrinsics: Floats,
) -> Mask:
    """Return which points, (3, P), project to a pixel and are in front of its depth, (H, W)."""
    height, width = reach.shape
    to_image = (intrinsics @ pose[:3, :3].T).astype(np.float32)
    x, y, z = to_image @ points - (to_image @ pose[:3, 3].astype(np.float32))[:, None]
    x /= np.maximum(z, np.float32(1e-6))
    y /= np.maximum(z, np.float32(1e-6))
    inside = (z > 1e-6) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    pixel = np.where(inside, y, 0).astype(np.int32) * np.int32(width) + np.where(
        inside,
        x,
        0,
    ).astype(np.int32)
    return inside & (z < reach.reshape(-1).take(pixel))


# around the object, in object radii, with room for its neighbours
VISIBILITY_GRID = VoxelGrid(64, 2.0)
BLOCK = 4  # voxels along the side of the blocks that represent parts of the object
UNSEEN_PART = 0.01
"""Weight of an unseen voxel in the object's unit ball, where an object voxel has weight 1. Before
the object is visible, only unseen voxels contribute."""
# density of occluders in unseen space, per object radius
DENSITY = 0.2
SOLID = 1e3  # density of an opaque voxel
LINES_TOGETHER = 400  # lines of sight that are processed at once
# largest share of a frame's points below the table, due to noise
LOW_POINTS = 0.02


@dataclass(frozen=True)
class SeenScene:
    """Occupancy around a target after some frames, in the object frame and object radii.

    The table and other objects are occluders.

    Attributes:
        occupancy: state of each voxel.
        floor: height below which nothing belongs to the target; infinity at first.
    """

    occupancy: Occupancy
    floor: float = np.inf

    @classmethod
    def unseen(cls, grid: VoxelGrid = VISIBILITY_GRID) -> Self:
        """Return the scene before the first frame."""
        return cls(Occupancy.unseen(grid))

    def seen(self, view: Observation) -> Self:
        """Return the scene after one more frame."""
        depth, pose, k = view.whole_frame
        target = depth > 0 if view.sighting is None else view.sighting.mask
        # pixels of half a voxel are fine enough
        away = max(float(np.linalg.norm(pose[:3, 3])), 1.0)
        focal = min(k[0, 0], k[1, 1])
        step = max(1, int(self.occupancy.grid.pitch / 2 * focal / away))
        few = (slice(step // 2, None, step),) * 2
        depth = depth[few]
        k = k.copy()
        k[:2] /= step
        k[:2, 2] += 0.5 - (step // 2 + 0.5) / step
        occupancy = self.occupancy.seen(
            depth, pose, k, target[few], background_free=False
        )

        rows, columns = np.nonzero(depth[::2, ::2])
        ahead = np.stack([2 * columns + 0.5, 2 * rows + 0.5, np.ones(len(rows))])
        heights = (
            pose[2, :3] @ np.linalg.inv(k) @ ahead * depth[::2, ::2][rows, columns]
            + pose[2, 3]
        )
        near = heights[np.abs(heights) <= 1.2]
        return type(self)(
            occupancy,
            min(
                self.floor,
                float(np.quantile(near, LOW_POINTS)) if len(near) else np.inf,
            ),
        )


def expected_visibility(
    seen: SeenScene,
    positions: Floats,
) -> Float:
    """Return the expected visible share of the object from each position.

    The object consists of its observed voxels and, with a lower weight, the unseen voxels of its
    unit ball above the table. It does not occlude itself. Elsewhere, a line of sight passes through
    a length s of unseen space with probability exp(-DENSITY * s).

    Args:
        seen: the scene so far.
        positions: of the cameras, (V, 3), object frame, object radii.

    Returns:
        Share of the object with a free line of sight, (V,) float64.
    """
    lines = sight_lines(
        seen.occupancy.grid,
        np.asarray(positions, np.float64).tobytes(),
    )
    return lines.visibility(seen)


@lru_cache(maxsize=64)
def sight_lines(grid: VoxelGrid, positions: bytes) -> "SightLines":
    """Return lines of sight, cached because they are used repeatedly.

    Args:
        grid: the voxels.
        positions: bytes of the camera positions, (V, 3) float64.

    Returns:
        The lines of sight.
    """
    return SightLines(grid, np.frombuffer(positions).reshape(-1, 3))


@dataclass(frozen=True)
class SightLines:
    """The voxels between the parts of an object and the cameras, computed once.

    Attributes:
        grid: the voxels.
        positions: of the cameras, object frame, (V, 3).
    """

    grid: VoxelGrid
    positions: Float

    @cached_property
    def own(self) -> Mask:
        """Voxels that may belong to the object, (n, n, n)."""
        return self.grid.within(1.0)

    @cached_property
    def blocks(self) -> Index:
        """Block index of each of these voxels, (Q,)."""
        m = self.grid.n // BLOCK
        return np.ravel_multi_index(
            tuple(np.stack(self.own.nonzero()) // BLOCK),
            (m, m, m),
        )

    @cached_property
    def parts(self) -> Index:
        """Blocks that may contain a part of the object, (P,)."""
        return np.unique(self.blocks)

    @cached_property
    def passed(self) -> csr_array:
        """Unit steps of the line from each part to each camera in each voxel, (P * V, n^3)."""
        grid = self.grid
        m = self.grid.n // BLOCK
        block = np.stack(np.unravel_index(self.parts, (m, m, m)), 1)
        start = (block + 0.5) * BLOCK  # in voxels from the grid's corner
        eyes = (self.positions - np.array(grid.centre) + grid.half) / grid.pitch
        towards = eyes[None] - start[:, None]
        length = np.linalg.norm(towards, axis=2)
        along = np.arange(0.5, np.sqrt(3) * grid.n)
        voxels = []
        steps = []
        for some in np.array_split(
            np.arange(len(start)),
            -(-len(start) * len(eyes) // LINES_TOGETHER),
        ):
            ahead = (towards[some] / length[some, :, None])[:, :, None]
            at = np.floor(start[some, None, None] + along[:, None] * ahead)
            inside = (along < length[some, :, None]) & ((at >= 0) & (at < grid.n)).all(
                3
            )
            x, y, z = at[inside].astype(np.int32).T
            voxels.append((x * grid.n + y) * grid.n + z)
            steps.append(inside.sum(2).reshape(-1))
        found = np.concatenate(voxels)
        ends = np.concatenate([[0], *steps]).cumsum()
        return csr_array(
            (np.ones(len(found), np.float32), found, ends),
            shape=(len(ends) - 1, grid.n**3),
        )

    def visibility(self, seen: SeenScene) -> Float:
        """Return the expected visibility; see ``expected_visibility``.

        Args:
            seen: the scene so far.

        Returns:
            The visible share from each position, (V,) float64.
        """
        cells = seen.occupancy.cells
        own = self.own
        above = self.grid.middles[2][own.reshape(-1)] > seen.floor
        mine = cells[own]
        most = self.parts[-1] + 1
        known, maybe = (
            np.bincount(self.blocks[above & (mine == what)], minlength=most)
            for what in (OBJECT, UNSEEN)
        )
        # expected share of the object in each part
        weights = (known + UNSEEN_PART * maybe)[self.parts]
        if not weights.any():
            return np.ones(len(self.positions))
        cost = ((cells == UNSEEN) & ~own).astype(np.float32)
        cost[cells == OCCLUDER] = SOLID
        # multiples of SOLID come from occluders, the remainder from unseen space
        passed = (self.passed @ cost.reshape(-1)).reshape(len(weights), -1)
        free = passed < SOLID
        share = weights / weights.sum()
        veil = np.exp(-DENSITY * self.grid.pitch * np.where(free, passed, 0)) * free
        return np.asarray(share @ veil, np.float64)
