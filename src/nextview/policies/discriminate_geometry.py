"""Policy for things with known geometry: choose the view with the most expected information."""

from dataclasses import dataclass, replace

import numpy as np

from nextview.errors import PolicyError
from nextview.geometry.viewsphere import Viewpoints
from nextview.policies.base import (
    EpisodeState,
    best_view,
    check_weight,
    nearer_first,
    travel_from,
)
from nextview.types import Float, Index, Mask
from nextview.views.expected_views import Goal, Outlook

LEAST_INFORMATION = 1e-3  # nats; views with less are considered uninformative


@dataclass(frozen=True, eq=False)
class DiscriminateGeometry:
    """Chooses the view with the most expected information about the object's identity.

    The leading hypotheses are rendered from each candidate view, see ``views.expected_views``.
    Among views of similar value, the one with the shortest travel is taken. As far as the object is
    probably none of the hypotheses, and if no view is informative, a view is worth its distance
    from all visited ones times the pixels of the object that it is expected to show.

    Attributes:
        viewpoints: the candidates, with any positions.
        goal: "thing" for information about the identity, "pose" for identity and pose.
        travel_weight: of a grid cell of travel, nats.
        needs: required inputs, see ``Policy.needs``.
    """

    viewpoints: Viewpoints
    goal: Goal = "thing"
    travel_weight: float = 0.0
    needs: tuple[str, ...] = ("outlook",)

    def __post_init__(self) -> None:
        check_weight(self.travel_weight)

    def seeking(self, goal: Goal) -> "DiscriminateGeometry":
        """Return the policy with the goal "thing" or "pose"."""
        return replace(self, goal=goal)

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the free view with the highest value; ties are broken at random.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        values = self.view_values(state)
        values = np.where(np.isnan(values), -np.inf, values)
        return best_view(
            self.viewpoints,
            state,
            values + 1e-9 * rng.random(values.shape),
        )

    def view_values(self, state: EpisodeState) -> Float:
        """Return the expected information of each free view minus weighted travel, nats, (B, V)."""
        if state.outlook is None:
            raise PolicyError(
                "this policy needs things of known geometry: a memory that was taught from scans"
            )
        travel = travel_from(self.viewpoints, state)
        rows = zip(state.outlook, state.free, state.visited, travel, strict=True)
        return np.stack([self._values(*row) for row in rows])

    def _values(
        self,
        outlook: Outlook | None,
        free: Mask,
        visited: Mask,
        travel: Float,
    ) -> Float:
        """Return the values of the views of one episode, (V,); NaN for views that are not free."""
        values = np.full(len(free), np.nan)
        some = np.flatnonzero(free)
        if not len(some):
            return values

        # how much a view is expected to show that no visited one has shown
        new = self._apart(some, visited)
        information = np.zeros(len(some))
        if outlook is not None:
            cameras = outlook.cameras(self.viewpoints.directions[some])
            expected = outlook.expect(cameras, self.goal)
            new = new * expected.pixels / max(expected.pixels.max(), 1.0)
            # views that show little of it are worse than is foreseen
            known = expected.found * expected.worth(self.goal)
            information = (1 - outlook.unknown) * known + outlook.unknown * new
        best = information.max()
        if best < LEAST_INFORMATION:
            information = LEAST_INFORMATION * new
            best = LEAST_INFORMATION
        way = travel[some]
        nearer = nearer_first(information, way, best)
        values[some] = nearer - self.travel_weight * way
        return values

    def _apart(self, views: Index, visited: Mask) -> Float:
        """Return the distance from the nearest visited view, (N,), half turns."""
        if not visited.any():
            return np.zeros(len(views))
        return self.viewpoints.arc[views][:, visited].min(1) / np.pi
