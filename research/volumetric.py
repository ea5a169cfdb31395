"""Policies that look where most is still unseen, by the voxels that the depth seen so far leaves
unseen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, reduce

import numpy as np
from numpy.typing import NDArray

from nextview.errors import PolicyError
from nextview.geometry.observation import Observation
from nextview.geometry.viewsphere import Viewpoints
from nextview.policies.base import EpisodeState, travel_from
from nextview.sensing.expected_visibility import Occupancy, SeenScene, VoxelGrid
from research.new_volume import new_surface, new_volume

Gain = Callable[
    [Occupancy, NDArray[np.floating], NDArray[np.bool_]],
    NDArray[np.float64],
]
"""What each of some positions, (V, 3), would bring into view of a region, (n, n, n) bool: (V,)."""
GRID = VoxelGrid(64)
"""Around the object's unit sphere."""
SCENE_SIZE = 2.0
"""So many times as wide is the grid, of as many voxels, where other things stand around the
object.
"""


def occupancy_of(observations: Sequence[Observation], grid: VoxelGrid) -> Occupancy:
    """What is known of the space around an object after some views of it, object frame, object
    radii.

    Observations without their scene show the object alone: what is no object in them is taken to be
    free, as is all beyond its radius. With their scene everything beside the object is an occluder,
    and unseen before it was seen.
    """
    scenes = [seen for seen in observations if seen.scene is not None]
    if scenes:
        observations = scenes
        grid = replace(grid, half=SCENE_SIZE * grid.half)
    told = [_told(seen, grid) for seen in observations]
    return (
        reduce(Occupancy.and_also, told)
        if told
        else Occupancy.unseen(grid, _ball(grid, grid.half))
    )


@lru_cache(maxsize=64)
def _told(seen: Observation, grid: VoxelGrid) -> Occupancy:
    """What one view tells.

    Kept, because what it tells does not depend on the others, and it is asked at each step.
    """
    if seen.scene is not None:
        return SeenScene.unseen(grid).seen(seen.scene).occupancy
    return Occupancy.unseen(grid, _ball(grid, grid.half)).seen(
        seen.depth,
        seen.pose,
        seen.intrinsics,
    )


@lru_cache(maxsize=4)
def _ball(grid: VoxelGrid, radius: float) -> NDArray[np.bool_]:
    """Voxels within the radius, (n, n, n)."""
    return grid.within(radius)


@dataclass(frozen=True)
class Volumetric:
    """The free view from which most that is unseen comes into view; of equal ones that with the
    shortest travel.

    With ``new_volume``, the volumetric information gain of active grasping (Breyer et al.,
    "Closed-loop next-best-view planning for target-driven grasping", IROS 2022, the system
    active_grasp) and the model analysis of McGreavy, Kunze and Hawes, "Next best view planning for
    object recognition in mobile robotics" (PlanSIG 2016). Simplified: the unseen space around the
    object stands in for McGreavy's known 3D model, and their environment analysis, which views are
    in reach, is ``EpisodeState.free``.

    With ``new_surface`` (``coverage``), the aim of Mendoza et al., "Supervised learning of the
    next-best-view for 3D object reconstruction" (Pattern Recognition Letters 133, 2020): the view
    that adds most surface. Simplified: they train a 3D-CNN on a probabilistic grid to name that
    view; here the border of unseen space on such a grid stands for the surface that is behind it,
    and the overlap that they need for registration is not asked for, as poses are known.

    Attributes:
        sphere: the viewpoints.
        gain: what counts, of an occupancy in the object frame and object radii.
        grid: the voxels, which hold the object's unit sphere.
    """

    sphere: Viewpoints
    gain: Gain = new_volume
    grid: VoxelGrid = GRID
    needs: tuple[str, ...] = ("observations",)

    def view_values(self, state: EpisodeState) -> NDArray[np.float64]:
        """Unseen volume or surface that comes into view, cubes or squares of the object radius,
        (B, V).
        """
        if state.observations is None:
            raise PolicyError("this policy needs the depth that was seen")
        positions = self.sphere.poses[:, :3, 3]
        found = dict[frozenset[int], NDArray[np.float64]]()
        # their order makes no difference
        sets = [frozenset(map(id, views)) for views in state.observations]
        for key, views in zip(sets, state.observations, strict=True):
            if key not in found:
                known = occupancy_of(views, self.grid)
                found[key] = self.gain(
                    known,
                    positions,
                    _ball(known.grid, self.grid.half),
                )
        return np.stack([found[key] for key in sets])

    def next_views(
        self,
        state: EpisodeState,
        rng: np.random.Generator,
    ) -> NDArray[np.int64]:
        """See ``Policy.next_views``."""
        values = self.view_values(state) - 1e-9 * travel_from(self.sphere, state)
        return np.where(state.free, values, -np.inf).argmax(1)


def coverage(sphere: Viewpoints) -> Volumetric:
    """The policy that looks for new surface."""
    return Volumetric(sphere, new_surface)
