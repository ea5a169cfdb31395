"""Use a policy of one grid of views with any views and any camera position.

The state of a policy on a grid contains azimuths relative to the camera. The grid is therefore
rotated until one of its columns passes through the camera; the policy values the rotated grid, and
its values are interpolated between the grid views.
"""

from dataclasses import dataclass, replace

import numpy as np

from nextview.geometry.viewsphere import (
    Viewpoints,
    ViewSphere,
    angle_between,
    azimuth_of,
    elevation_of,
)
from nextview.policies.base import (
    EpisodeState,
    Policy,
    ScoresViews,
    ValuesViews,
    travel_from,
)
from nextview.types import Float, Index


def anywhere(policy: Policy, sphere: Viewpoints) -> Policy:
    """Adapt a policy to any viewpoints, and to cameras between them.

    Args:
        policy: of a grid of views, or one for any views.
        sphere: the candidate views.

    Returns:
        The policy itself if it already suits them, else an adapter.
    """
    grid = getattr(policy, "sphere", None)
    if not isinstance(grid, ViewSphere):
        return policy
    same = isinstance(sphere, ViewSphere) and sphere.same_grid(grid)
    return (
        policy
        if same and not isinstance(policy, ScoresViews)
        else OffGrid(policy, grid, sphere)
    )


@dataclass(frozen=True)
class OffGrid:
    """A grid policy adapted to any views. It is exact for views and cameras on the grid.

    The scores of a policy that scores views are interpolated between the four views of the rotated
    grid around each candidate. A candidate is considered only if all four are; if none is, the
    nearest free view is taken. Any other policy chooses among the cells with a free view, and the
    view nearest to the chosen cell is taken.

    Attributes:
        policy: that decides on the grid.
        grid: of the policy.
        sphere: the candidates, with any positions.
    """

    policy: Policy
    grid: ViewSphere
    sphere: Viewpoints

    @property
    def needs(self) -> tuple[str, ...]:
        return self.policy.needs

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Ask the policy on its own grid and interpolate between its cells.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        if self._on_grid(state):
            return self.policy.next_views(state, rng)

        turned, ahead = self._turned(state)
        if not isinstance(self.policy, ScoresViews):
            return self._nearest_to(self.policy.next_views(turned, rng), state)
        scores = self._between(self.policy.scores(turned), ahead)
        scores -= self.policy.travel_weight * travel_from(self.sphere, state)
        free = state.free
        considered = free & np.isfinite(scores)
        near = np.where(free, travel_from(self.sphere, state), np.inf)
        return np.where(
            considered.any(1),
            np.where(considered, scores, -np.inf).argmax(1),
            near.argmin(1),
        )

    def view_values(self, state: EpisodeState) -> Float:
        """Return the interpolated value of each view, (B, V); all NaN without values."""
        if not isinstance(self.policy, ValuesViews):
            return np.full(state.visited.shape, np.nan)
        if self._on_grid(state):
            return self.policy.view_values(state)
        turned, ahead = self._turned(state)
        if not isinstance(self.policy, ScoresViews):
            return self._between(self.policy.view_values(turned), ahead)
        # Travel is measured to the views, not to the grid.
        values = self._between(
            self.policy.view_values(
                replace(turned, travel=np.zeros(turned.visited.shape))
            ),
            ahead,
        )
        return values - self.policy.travel_weight * travel_from(self.sphere, state)

    def _on_grid(self, state: EpisodeState) -> bool:
        if not isinstance(self.sphere, ViewSphere) or not self.sphere.same_grid(
            self.grid
        ):
            return False
        return state.places is None or np.array_equal(
            state.places[:, -1],
            self.sphere.directions[state.current],
        )

    def _turned(self, state: EpisodeState) -> tuple[EpisodeState, Float]:
        """Return the state on the rotated grid, and the steps from camera to view, (B, V)."""
        n = self.grid.azimuths
        rows = np.arange(len(state.current))[:, None]
        here = self._here(state)
        ahead = (
            (self.sphere.azimuth[None] - azimuth_of(here)[:, None])
            / (2 * np.pi)
            * n
            % n
        )
        ring = np.abs(
            np.radians(self.grid.elevations) - elevation_of(here)[:, None]
        ).argmin(1)
        ring_of = np.abs(
            np.radians(self.grid.elevations) - self.sphere.elevation[:, None]
        ).argmin(1)
        cell = ring_of * n + np.floor(ahead + 0.5).astype(np.int64) % n
        visited = np.zeros((len(rows), len(self.grid)), bool)
        reachable = visited.copy()
        views = np.nonzero(state.visited)
        cells = np.nonzero(state.free)
        visited[views[0], cell[views]] = True
        reachable[cells[0], cell[cells]] = True
        visited &= ~reachable  # a cell is free if any of its views is
        current = ring * n
        visited[rows[:, 0], current] = True
        # the only free view is in the camera's own cell
        lost = ~(reachable & ~visited).any(1)
        reachable[lost] = True
        visibility = state.visibility
        if visibility is not None:  # visibility of the view nearest to each cell
            near = self._grid_directions(state) @ self.sphere.directions.T
            visibility = np.take_along_axis(visibility, near.argmax(2), 1)
        turned = replace(
            state,
            current=current,
            visited=visited,
            reachable=reachable,
            visibility=visibility,
        )

        return replace(turned, travel=None, places=None), ahead

    def _grid_directions(self, state: EpisodeState) -> Float:
        """Return unit vectors towards the views of the rotated grid, (B, grid, 3)."""
        azimuth = azimuth_of(self._here(state))[:, None] + self.grid.azimuth
        elevation = np.broadcast_to(
            np.radians(self.grid.elevations)[self.grid.ring],
            azimuth.shape,
        )
        flat = np.cos(elevation)
        return np.stack(
            [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)],
            2,
        )

    def _nearest_to(self, cells: Index, state: EpisodeState) -> Index:
        """Return the free view nearest to a cell of the rotated grid, (B,)."""
        towards = self._grid_directions(state)[np.arange(len(cells)), cells]
        return np.where(
            state.free,
            angle_between(towards[:, None], self.sphere.directions[None]),
            np.inf,
        ).argmin(1)

    def _here(self, state: EpisodeState) -> Float:
        """Return unit vectors towards the cameras, (B, 3)."""
        return (
            self.sphere.directions[state.current]
            if state.places is None
            else state.places[:, -1]
        )

    def _between(self, values: Float, ahead: Float) -> Float:
        """Interpolate values of the rotated grid, (B, grid), at the views, (B, V).

        The result is NaN next to a NaN.
        """
        n = self.grid.azimuths
        order = np.argsort(self.grid.elevations, kind="stable")
        heights = np.radians(self.grid.elevations)[order]

        # the rows of the grid below and above each view
        row = np.interp(self.sphere.elevation, heights, np.arange(len(heights)))
        low = np.minimum(np.floor(row + 1e-9).astype(np.int64), len(heights) - 1)
        up = np.maximum(row - low, 0.0)

        # the columns to the left and to the right
        left = np.floor(ahead + 1e-9).astype(np.int64)
        right = np.maximum(ahead - left, 0.0)

        rows = np.arange(len(values))[:, None]
        found = np.zeros(ahead.shape)
        for ring, of_ring in (
            (low, 1 - up),
            (np.minimum(low + 1, len(heights) - 1), up),
        ):
            for step, of_step in ((left, 1 - right), (left + 1, right)):
                share = of_ring * of_step
                found += np.where(
                    share > 1e-6,
                    share * values[rows, order[ring] * n + step % n],
                    0.0,
                )
        return found
