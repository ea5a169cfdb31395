"""The policy that tells things of known geometry apart: it looks where a view tells most."""

from dataclasses import dataclass, replace

import numpy as np

from nextview.errors import PolicyError
from nextview.geometry.viewsphere import Viewpoints
from nextview.policies.base import EpisodeState, best_view, check_weight, travel_from
from nextview.things.expected_views import Goal, Outlook
from nextview.types import Float, Index, Mask

NEAR_TIE = 0.05  # of the best value: among views that are worth so nearly the same, travel decides
LEAST_INFORMATION = 1e-3  # nats, below which no view is expected to tell anything


@dataclass(frozen=True, eq=False)
class DiscriminateGeometry:
    """Goes where the view is expected to tell most of which thing it is.

    The leading hypotheses are rendered from each candidate view, see ``things.expected_views``.
    Among views that are worth nearly the same, that with the shortest way is taken. If no view is
    expected to tell anything, the camera goes to the view farthest from all others, where the
    belief is tested hardest; so it does where nothing can be foreseen.

    Attributes:
        viewpoints: the candidates, anywhere.
        goal: what is to be told: which "thing" it is, or its "pose" too.
        travel_weight: of a grid cell of travel, nats.
        needs: what it asks of the state of an episode, see ``Policy.needs``.
    """

    viewpoints: Viewpoints
    goal: Goal = "thing"
    travel_weight: float = 0.0
    needs: tuple[str, ...] = ("outlook",)

    def __post_init__(self) -> None:
        check_weight(self.travel_weight)

    def seeking(self, goal: Goal) -> "DiscriminateGeometry":
        """The same policy for the thing, or for the thing and its pose."""
        return replace(self, goal=goal)

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the free view with the highest value; ties are drawn.

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
        """Expected information of each free view, nats, less what its way counts, (B, V)."""
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
        """Values of the views of one episode, (V,); NaN for those that are not free."""
        values = np.full(len(free), np.nan)
        some = np.flatnonzero(free)
        if not len(some):
            return values

        information = np.zeros(len(some))
        found = np.ones(len(some))
        if outlook is not None:
            cameras = outlook.cameras(self.viewpoints.directions[some])
            expected = outlook.expect(cameras, self.goal)
            information = expected.worth(self.goal)
            found = expected.found
        best = information.max()
        if best < LEAST_INFORMATION:
            information = found * self._apart(some, visited)
            best = LEAST_INFORMATION
        way = travel[some]
        share = way / max(way.max(), 1e-12)
        values[some] = information - NEAR_TIE * best * share - self.travel_weight * way
        return values

    def _apart(self, views: Index, visited: Mask) -> Float:
        """Values below LEAST_INFORMATION, by the distance from all visited views, (N,)."""
        if not visited.any():
            return np.zeros(len(views))
        nearest = self.viewpoints.arc[views][:, visited].min(1)
        return LEAST_INFORMATION * nearest / np.pi
