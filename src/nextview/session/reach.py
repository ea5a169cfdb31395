"""Reachability and travel cost of a robot's camera."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nextview.checks import number, one_line, plugin_errors
from nextview.errors import UsageError
from nextview.geometry.viewsphere import Viewpoints
from nextview.policies.base import EpisodeState, travel_from
from nextview.types import Float, Index, Mask

Reachable = Mask | Callable[[Float], bool]
"""Candidate views that the camera can reach: (V,) bool, or a function of a pose of
``Session.poses``. Masked entries of a masked array cannot be reached."""
TravelCost = Float | Callable[[Float, Float], float]
"""Cost of moving from one view to another, in any unit: (V, V), from row to column; or a function
of two poses in the frame of ``Session.poses``, the first being the current camera pose. Infinite
or masked costs mean that there is no path."""
# returns the candidate poses, (V, 4, 4); called only if a function needs them
Poses = Callable[[], Float]


@dataclass(frozen=True)
class Reach:
    """Views that the camera can reach, and the cost of moving there.

    Attributes:
        failed: viewpoints that the camera failed to reach, (V,).
        reachable: reachable views or a function of a pose; None if all can be reached.
        cost: cost of each move; None for the distance on the view sphere.
    """

    failed: Mask
    reachable: Reachable | None = None
    cost: TravelCost | None = None

    def can_reach(self, views: Index, poses: Poses) -> Mask:
        """Return which views have not failed and can be reached.

        Args:
            views: indices of the views, (N,) int64.
            poses: returns the poses of all views; called only if reachability is a callable.

        Returns:
            Whether each can be reached, (N,) bool.
        """
        there = ~self.failed[views]
        if callable(self.reachable):
            at = poses()
            for k in np.flatnonzero(there):
                with plugin_errors(_failed("whether a view can be reached")):
                    answer = self.reachable(at[views[k]])
                there[k] = truth_of(answer)
        elif self.reachable is not None:
            there &= self.reachable[views]
        return there

    def moves(
        self,
        views: Index,
        start: int,
        here: Float,
        poses: Poses,
    ) -> tuple[Index, Float | None]:
        """Return which views can be reached, and the cost of moving there.

        Args:
            views: indices of the views, (N,) int64.
            start: view nearest to the camera.
            here: pose of the camera, (4, 4).
            poses: returns the poses of all views; called only if a function needs them.

        Returns:
            Indices of the M views that can be reached, (M,) int64; and the finite cost of each,
            (M,), None without a cost.
        """
        views = views[self.can_reach(views, poses)]
        if self.cost is None:
            return views, None
        if callable(self.cost):
            cost = np.zeros(len(views))
            for row, pose in enumerate(poses()[views]):
                with plugin_errors(_failed("what a move costs")):
                    answer = self.cost(here, pose)
                cost[row] = cost_of(answer)
        else:
            cost = self.cost[start, views]
        return views[cost < np.inf], cost[cost < np.inf]

    def constrain(
        self,
        state: EpisodeState,
        sphere: Viewpoints,
        here: Float,
        poses: Poses,
    ) -> EpisodeState:
        """Add reachability and travel cost to the state of one episode.

        Args:
            state: the state.
            sphere: the candidate views.
            here: pose of the camera, (4, 4).
            poses: returns the poses of all views.

        Returns:
            The constrained state.
        """
        views, cost = self.moves(
            np.flatnonzero(state.free[0]), int(state.current[0]), here, poses
        )
        if cost is not None:
            mean = cost.mean() if len(cost) else 0.0
            unit = (
                travel_from(sphere, state)[0, views].mean() / mean if mean > 0 else 0.0
            )
            cells = np.full(len(sphere), np.nan)
            cells[views] = unit * cost
            state = replace(state, travel=cells[None])

        reachable = np.zeros(len(sphere), bool)
        reachable[views] = True
        if reachable[state.free[0]].all() and cost is None:
            return state
        return replace(state, reachable=reachable[None])


def _failed(asked: str) -> Callable[[str], UsageError]:
    """What makes the error of a user's function that raises."""
    return lambda said: UsageError(f"asked {asked}, the function raised {said}")


def cost_of(answer: Any) -> float:
    """Check a cost returned by a user's function; infinity is allowed."""
    try:
        cost = float(answer)
    except (TypeError, ValueError):
        cost = np.nan
    if not cost >= 0:
        raise UsageError(
            f"a travel cost is a number from 0 on, not {one_line(repr(answer))}"
        )
    return cost


def truth_of(answer: Any) -> bool:
    """Check the answer of a user's function for a pose.

    None is rejected: it is returned by a function without a return statement.
    """
    if not isinstance(answer, bool | np.bool_ | int):
        raise UsageError(
            f"whether a view can be reached is true or false, not {one_line(repr(answer))}"
        )
    return bool(answer)


def as_distance(given: float | None) -> float | None:
    """Return the distance of a camera passed in by a user, metres, above 0; or None.

    Raises:
        UsageError: it is neither.
    """
    return None if given is None else number(given, "the distance, in metres,", above=0)


def as_reachable(
    given: ArrayLike | Callable[[Float], bool] | None,
    views: int,
) -> Reachable | None:
    """Check the reachability passed in by a user.

    Args:
        given: mask of the views, (V,) bool, a callable on poses, or None.
        views: number of views, V.

    Returns:
        The mask or the callable; None for all views.

    Raises:
        UsageError: it is none of these.
    """
    if given is None or callable(given):
        return given
    mask = np.asarray(given)
    if np.ma.isMaskedArray(given):  # masked views are not known to be reachable
        mask = np.ma.filled(given, False)
    if mask.shape != (views,) or mask.dtype != bool:
        wanted = f"reachable is a mask, ({views},) bool, or a callable on poses"
        raise UsageError(f"{wanted}, not {mask.dtype} {mask.shape}")
    return mask


def as_travel_cost(
    given: ArrayLike | Callable[[Float, Float], float] | None,
    views: int,
) -> TravelCost | None:
    """Check the travel cost passed in by a user.

    Args:
        given: cost from view to view, (V, V), a callable on two poses, or None.
        views: number of views, V.

    Returns:
        The matrix or the callable; None for the travel of the viewpoints.

    Raises:
        UsageError: it is none of these, or a cost is negative.
    """
    if given is None or callable(given):
        return given
    costs = np.asarray(given)
    # masked moves have no known cost
    if np.ma.isMaskedArray(given) and costs.dtype.kind in "fiu":
        costs = np.ma.filled(np.ma.asarray(given, np.float64), np.inf)
    if (
        costs.dtype.kind not in "fiu"
        or costs.shape != (views, views)
        or not (costs >= 0).all()
    ):
        raise UsageError(
            f"a travel cost is a matrix, ({views}, {views}) of numbers from 0 on, or a callable on"
            " poses"
        )
    return costs.astype(np.float64)
