"""Policies with tables learned from predictions, which know the ring, but not the azimuth.

A position is therefore a *cell*: its ring, and its number of azimuth steps ahead of the camera,
``cell = ring * azimuths + steps``. If a table has no entry, the view farthest from all visited ones
is chosen.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nextview.errors import PolicyError
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.base import EpisodeState, Scope, best_view, considered
from nextview.policies.baselines import Spread
from nextview.types import Float, Index


def cells_from(sphere: ViewSphere) -> Index:
    """Return the view in each cell, relative to each view, (V, V) int64: ``[view, cell]``."""
    n = sphere.azimuths
    return (
        sphere.ring[None] * n
        + (sphere.azimuth_index[:, None] + sphere.azimuth_index[None]) % n
    )


def cells_to(sphere: ViewSphere) -> Index:
    """Return the cell of each view, relative to each view, (V, V) int64: ``[view, other]``."""
    n = sphere.azimuths
    return (
        sphere.ring[None] * n
        + (sphere.azimuth_index[None] - sphere.azimuth_index[:, None]) % n
    )


@dataclass(frozen=True)
class FixedSequence:
    """The same moves for every object: a list of cells for each first ring.

    A cell is relative to the previous view.

    Attributes:
        sphere: of the views.
        moves: cells, (rings, K).
        scope: views that may be chosen.
        needs: required inputs, see ``Policy.needs``.
    """

    sphere: ViewSphere
    moves: Index
    scope: Scope = "global"
    needs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        on_it = (self.moves >= 0) & (self.moves < len(self.sphere))
        if (
            self.moves.ndim != 2
            or len(self.moves) != self.sphere.rings
            or not on_it.all()
        ):
            raise PolicyError(
                f"a sequence needs moves over the sphere from each of its {self.sphere.rings} rings"
            )

    @cached_property
    def paths(self) -> Index:
        """Views of the whole sequence from each start, (V, K + 1) int64."""
        views = [np.arange(len(self.sphere))]
        for move in self.moves[self.sphere.ring].T:
            views.append(cells_from(self.sphere)[views[-1], move])
        return np.stack(views, 1)

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Follow the path of the first view; if that is not possible, choose like ``Spread``.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        chosen = Spread(self.sphere, self.scope).next_views(state, rng)
        if state.step >= self.paths.shape[1]:
            return chosen
        # The first view is not part of the state; it is inferred from the visited views.
        so_far = self.paths[:, : state.step]
        deduplicated = (np.diff(np.sort(so_far, axis=1)) > 0).all(1)
        led_here = (
            deduplicated
            & state.visited[:, so_far].all(2)
            & (so_far[:, -1] == state.current[:, None])
        )
        following = self.paths[led_here.argmax(1), state.step]
        free = state.free[np.arange(len(chosen)), following]
        return np.where(
            led_here.any(1) & (state.visited.sum(1) == state.step) & free,
            following,
            chosen,
        )


@dataclass(frozen=True)
class FixedRing:
    """Moves straight to one ring, then around it by a fixed number of azimuth steps.

    Attributes:
        sphere: of the views.
        ring: target ring.
        steps: azimuth steps from view to view.
        needs: required inputs, see ``Policy.needs``.
    """

    sphere: ViewSphere
    ring: int
    steps: int = 1
    needs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if (
            not 0 <= self.ring < self.sphere.rings
            or not 1 <= self.steps < self.sphere.azimuths
        ):
            raise PolicyError(
                f"there is no ring {self.ring} to be walked in steps of {self.steps}"
            )

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the next free view of the ring; like ``Spread`` once the ring is complete.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        n = self.sphere.azimuths
        rows = np.arange(len(state.current))
        order = np.concatenate([[0], np.arange(1, n) * self.steps, np.arange(1, n)])
        ahead = (
            self.ring * n
            + (self.sphere.azimuth_index[state.current][:, None] + order) % n
        )
        free = state.free[rows[:, None], ahead]
        return np.where(
            free.any(1),
            ahead[rows, free.argmax(1)],
            Spread(self.sphere).next_views(state, rng),
        )


@dataclass(frozen=True)
class ClassTable:
    """The unvisited cell with the highest value for the most likely class and the current ring.

    Attributes:
        sphere: of the views.
        values: by class, current ring and cell, (classes, rings, V).
        scope: views that may be chosen.
        needs: required inputs, see ``Policy.needs``.
    """

    sphere: ViewSphere
    values: Float
    scope: Scope = "global"
    needs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        wanted = (self.sphere.rings, len(self.sphere))
        if (
            self.values.ndim != 3
            or self.values.shape[1:] != wanted
            or not np.isfinite(self.values).all()
        ):
            raise PolicyError(
                f"the table has to hold finite numbers of the shape (classes, {wanted[0]},"
                f" {wanted[1]})"
            )

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the view with the highest value for the believed classes.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        return best_view(self.sphere, state, self._looked_up(state), self.scope)

    travel_weight = 0.0

    def scores(self, state: EpisodeState) -> Float:
        """Return the table in scope; see ``ScoresViews``."""
        return considered(self.sphere, state, self._looked_up(state), self.scope)

    def _looked_up(self, state: EpisodeState) -> Float:
        values = self.values[state.belief.argmax(1), self.sphere.ring[state.current]]
        return values[
            np.arange(len(values))[:, None],
            cells_to(self.sphere)[state.current],
        ]
