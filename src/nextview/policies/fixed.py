"""Views settled beforehand, without regard to what is seen: full orbits, and the first k of some ranking."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.errors import PolicyError
from nextview.policies.base import EpisodeState
from nextview.viewsphere import ViewSphere


def orbit(sphere: ViewSphere, starts: NDArray[np.int64], k: int) -> NDArray[np.int64]:
    """The next k views round the ring of each start, then round the ring above, and so on; the lowest follows the top.

    Args:
        sphere: the viewpoints.
        starts: first views, (E,).
        k: views, at most all of them: ``sphere.azimuths`` for one ring.

    Returns:
        (E, k) int64.
    """
    n, step = sphere.azimuths, np.arange(k)
    ring = (sphere.ring[starts][:, None] + step // n) % sphere.rings
    return ring * n + (sphere.azimuth_index[starts][:, None] + step) % n


def ranked(values: NDArray[np.floating], k: int) -> NDArray[np.int64]:
    """The k views with the highest values, highest first, equal ones in their order.

    Args:
        values: one for each view, (E, V).
        k: views, at most V.

    Returns:
        (E, k) int64.
    """
    return np.argsort(-values, axis=1, kind="stable")[:, :k]


@dataclass(frozen=True)
class ViewList:
    """Goes where a list says.

    Attributes:
        views: of each episode in order, (E, k) int64; the first of them are the first views.
    """

    views: NDArray[np.int64]
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """See ``Policy.next_views``."""
        if state.step >= self.views.shape[1]:
            raise PolicyError(f"only {self.views.shape[1]} views are listed")
        return self.views[state.episodes, state.step]
