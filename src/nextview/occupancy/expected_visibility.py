"""How much of an object that stands among others will show from elsewhere, by what depth frames have shown so far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import number, of_kind, places
from nextview.errors import UsageError
from nextview.observation import SceneView
from nextview.occupancy.voxel_grid import OBJECT, OCCLUDER, UNSEEN, Occupancy, VoxelGrid

if TYPE_CHECKING:
    from scipy.sparse import csr_array

GRID = VoxelGrid(64, 2.0)
"""Around the object, in object radii: what stands beside it has a place there."""
BLOCK = 4
"""Voxels along the side of the blocks that stand for parts of the object."""
UNSEEN_PART = 0.01
"""What an unseen voxel of the object's unit ball counts for as a part of it, where one that was seen counts for 1: next
to nothing, but before anything of the object was seen they are all there is."""
HIDDEN_PART = 0.1
"""The same where a frame is asked how much of the object it shows: what it does not show counts there."""
DENSITY = 0.2
"""How often unseen space is filled, per object radius: between the two bounds."""
SOLID = 1e3
"""A density, per voxel, through which nothing is seen."""
TOGETHER = 400
"""Lines that are drawn at once."""
LOWEST = 0.02
"""Share of a frame's points that may lie below the height of the table: noise."""


@dataclass(frozen=True)
class SeenScene:
    """What frames of a scene say of the space around its target, in the object frame and object radii.

    Attributes:
        occupancy: the target as the object, table and other things as occluders.
        floor: height below which nothing of the target is; infinity before anything was seen.

    >>> seen = SeenScene.of(observation.scene for observation in observations)  # doctest: +SKIP
    >>> expected_visibility(seen, sphere.poses[:, :3, 3]).expected              # doctest: +SKIP
    """

    occupancy: Occupancy
    floor: float = np.inf

    @classmethod
    def unseen(cls, grid: VoxelGrid = GRID) -> Self:
        """Before the first frame."""
        return cls(Occupancy.unseen(grid))

    @classmethod
    def of(cls, views: Sequence[SceneView], grid: VoxelGrid = GRID) -> Self:
        """After some frames."""
        found = cls.unseen(grid)
        for view in views:
            found = found.seen(view)
        return found

    def seen(self, view: SceneView) -> Self:
        """With what one more frame says."""
        occupancy = self.occupancy.seen(view.depth, view.pose, view.intrinsics, view.target, view.background_free)
        return type(self)(occupancy, min(self.floor, _lowest(view)))

    def and_also(self, other: SeenScene) -> Self:
        """What both say together, of one grid: as if all frames of both had been seen."""
        return type(self)(self.occupancy.and_also(other.occupancy), min(self.floor, other.floor))


def _lowest(view: SceneView) -> float:
    """Height of the lowest that a frame shows near the target, but for noise."""
    rows, columns = np.nonzero(view.depth[::2, ::2])
    depth = view.depth[::2, ::2][rows, columns]
    ahead = np.stack([2 * columns + 0.5, 2 * rows + 0.5, np.ones(len(rows))])
    rays = view.pose[2, :3] @ np.linalg.inv(view.intrinsics) @ ahead
    heights = rays * depth + view.pose[2, 3]
    near = np.abs(heights) <= 1.2
    return float(np.quantile(heights[near], LOWEST)) if near.any() else np.inf


@dataclass(frozen=True)
class Visibility:
    """Share of an object that shows from V positions: as much as is known of it.

    Attributes:
        least: if all unseen space were solid, (V,) float64, 0 to 1.
        expected: if it is filled as often as it is on the average.
        most: if all of it were free.
    """

    least: NDArray[np.float64]
    expected: NDArray[np.float64]
    most: NDArray[np.float64]


def expected_visibility(
    seen: SeenScene, positions: NDArray[np.floating], density: float = DENSITY, unseen_part: float = UNSEEN_PART
) -> Visibility:
    """Share of the object to which the line of sight will be clear of other things, from each position.

    The object is what was seen of it, and what may be it: unseen voxels of its unit ball above the table, which count
    for less. It does not hide itself. What is unseen elsewhere lets a sight of length s through with probability
    exp(-density * s).

    Args:
        seen: what is known, on a grid whose blocks fit.
        positions: of the cameras, (V, 3), object frame, object radii.
        density: how often unseen space is filled, per object radius.
        unseen_part: what an unseen voxel counts for as a part of the object.

    Returns:
        Of each position; 1 where nothing is known of the object at all.

    Raises:
        UsageError: no scene, no positions, or numbers below 0.
    """
    of_kind(seen, SeenScene, "what is known is a SeenScene")
    positions = places(positions, "the positions of cameras")
    for share, what in ((density, "how often unseen space is filled"), (unseen_part, "what unseen voxels count for")):
        if not 0 <= number(share, what) <= SOLID:
            raise UsageError(f"{what} is a number from 0 to {SOLID:g}, not {share}")
    lines = sight_lines(seen.occupancy.grid, np.asarray(positions, np.float64).tobytes())
    return lines.visibility(seen, density, unseen_part)


def shown_share(view: SceneView) -> float:
    """Share of the object that shows in a frame, as far as that frame alone can tell."""
    return shown_in(SeenScene.unseen().seen(view), view.pose[:3, 3])


def shown_in(seen: SeenScene, position: NDArray[np.floating]) -> float:
    """The same, of what the frame says, and of where its camera stood, (3,)."""
    eye = np.asarray(position, np.float64)[None]
    return float(expected_visibility(seen, eye, unseen_part=HIDDEN_PART).expected[0])


@lru_cache(maxsize=64)
def sight_lines(grid: VoxelGrid, positions: bytes) -> SightLines:
    """Those from positions, the bytes of (V, 3) float64: the same ones are asked for again and again."""
    return SightLines(grid, np.frombuffer(positions).reshape(-1, 3))


@dataclass(frozen=True)
class SightLines:
    """The voxels between the parts of an object and some cameras, found once for all scenes.

    Attributes:
        grid: of voxels, around the object's unit ball.
        positions: of the cameras, (V, 3).
    """

    grid: VoxelGrid
    positions: NDArray[np.float64]

    @cached_property
    def own(self) -> NDArray[np.bool_]:
        """Voxels where the object can be, (n, n, n)."""
        return self.grid.within(1.0)

    @cached_property
    def held(self) -> NDArray[np.int64]:
        """The same as indices into ``cells.ravel()``, (Q,)."""
        return np.flatnonzero(self.own)

    @cached_property
    def blocks(self) -> NDArray[np.int64]:
        """The block of each of these, as an index of all blocks, (Q,)."""
        m = self.grid.n // BLOCK
        return np.ravel_multi_index(tuple(np.stack(self.own.nonzero()) // BLOCK), (m, m, m))

    @cached_property
    def parts(self) -> NDArray[np.int64]:
        """The blocks that the object can have a part in, (P,)."""
        return np.unique(self.blocks)

    @cached_property
    def passed(self) -> csr_array:
        """How often the line from each part to each camera, in steps of a voxel, is in each voxel, (P * V, n^3)."""
        from scipy.sparse import csr_array  # slow to import, and few sessions are about scenes

        grid, m = self.grid, self.grid.n // BLOCK
        block = np.stack(np.unravel_index(self.parts, (m, m, m)), 1)
        start = (block + 0.5) * BLOCK  # in voxels from the grid's corner
        eyes = (self.positions - np.array(grid.centre) + grid.half) / grid.pitch
        towards = eyes[None] - start[:, None]
        length = np.linalg.norm(towards, axis=2)
        along = np.arange(0.5, np.sqrt(3) * grid.n)
        voxels, steps = [], []
        for some in np.array_split(np.arange(len(start)), -(-len(start) * len(eyes) // TOGETHER)):
            ahead = (towards[some] / length[some, :, None])[:, :, None]
            at = np.floor(start[some, None, None] + along[:, None] * ahead)
            inside = (along < length[some, :, None]) & ((at >= 0) & (at < grid.n)).all(3)
            x, y, z = at[inside].astype(np.int32).T
            voxels.append((x * grid.n + y) * grid.n + z)
            steps.append(inside.sum(2).reshape(-1))
        found, ends = np.concatenate(voxels), np.concatenate([[0], *steps]).cumsum()
        return csr_array((np.ones(len(found), np.float32), found, ends), shape=(len(ends) - 1, grid.n**3))

    @cached_property
    def asked(self) -> NDArray[np.bool_]:
        """The voxels that the answer depends on, (n, n, n): frames need not be asked about others."""
        found = self.own.copy()
        found.reshape(-1)[self.passed.indices] = True
        return found

    def visibility(self, seen: SeenScene, density: float, unseen_part: float) -> Visibility:
        """See ``expected_visibility``."""
        cells, own = seen.occupancy.cells, self.own
        weights = self._weights(seen, unseen_part)
        if not weights.any():
            return Visibility(*np.ones((3, len(self.positions))))
        cost = ((cells == UNSEEN) & ~own).astype(np.float32)
        cost[cells == OCCLUDER] = SOLID
        passed = (self.passed @ cost.reshape(-1)).reshape(len(weights), -1)  # thousands are occluders, else unseen
        free = passed < SOLID
        share = weights / weights.sum()
        veil = np.exp(-density * self.grid.pitch * np.where(free, passed, 0)) * free
        return Visibility(share @ (passed == 0), share @ veil, share @ free)

    def _weights(self, seen: SeenScene, unseen_part: float) -> NDArray[np.float64]:
        """How much of the object each part is expected to hold, (P,)."""
        cells, most = seen.occupancy.cells.reshape(-1).take(self.held), self.parts[-1] + 1
        above = self.grid.middles[2].take(self.held) > seen.floor
        known, maybe = (np.bincount(self.blocks[above & (cells == what)], minlength=most) for what in (OBJECT, UNSEEN))
        return (known + unseen_part * maybe)[self.parts]
