"""Policies that climb a predicted local map (thesis, section 4.2.3)."""

from dataclasses import dataclass

import numpy as np

from nextview.errors import PolicyError
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.base import EpisodeState, best_in_window, best_view, in_window
from nextview.types import Float, Floats, Index, Mask


def local_peaks(maps: Floats) -> Mask:
    """Return the cells of maps, (B, rows, columns), that no neighbour exceeds.

    Neighbours are 3x3, and there are none beyond the border.
    """
    # Like SciPy's maximum_filter, without importing SciPy, to keep the start-up short.
    padded = np.pad(maps, ((0, 0), (1, 1), (1, 1)), constant_values=-np.inf)
    return np.asarray(maps) >= np.lib.stride_tricks.sliding_window_view(
        padded,
        (3, 3),
        axis=(1, 2),
    ).max((-2, -1))


def peaks_first(maps: Floats) -> Float:
    """Return scores that put peaks before all other cells, each group by value."""
    maps = np.asarray(maps, np.float64)
    return maps + (np.ptp(maps, axis=(1, 2), keepdims=True) + 1.0) * local_peaks(maps)


def sphere_peaks(values: Floats) -> Float:
    """Return scores that put peaks first for maps of the whole sphere, (B, rings, azimuths).

    The last azimuth is next to the first.
    """
    values = np.asarray(values, np.float64)
    round_once = np.concatenate([values[..., -1:], values, values[..., :1]], 2)
    return (
        values
        + (np.ptp(values, axis=(1, 2), keepdims=True) + 1)
        * local_peaks(round_once)[..., 1:-1]
    )


@dataclass(frozen=True)
class MapPeak:
    """The highest unvisited peak of a predicted map, or its deepest valley.

    Attributes:
        sphere: of the views.
        map_name: in the evidence, (B, rings, 3).
        valley_classes: if the most likely class is one of these, the lowest valley is chosen.
    """

    sphere: ViewSphere
    map_name: str
    valley_classes: tuple[int, ...] = ()

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.map_name,)

    def view_values(self, state: EpisodeState) -> Float:
        """Return the predicted map on the sphere, (B, V); NaN outside the window."""
        return in_window(
            self.sphere,
            state,
            np.asarray(state.evidence.maps[self.map_name]),
        )

    travel_weight = 0.0

    def scores(self, state: EpisodeState) -> Float:
        """Return scores that put peaks, or valleys, first; see ``ScoresViews``."""
        return in_window(self.sphere, state, self._climbed(state))

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the highest peak, or the deepest valley, of the predicted local map.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        return best_in_window(self.sphere, state, self._climbed(state))

    def _climbed(self, state: EpisodeState) -> Float:
        """Return the map, negated for classes that use valleys, (B, rings, 3)."""
        maps = np.asarray(state.evidence.maps[self.map_name], np.float64)
        if maps.shape[1:] != (self.sphere.rings, 3):
            there = f"the sphere has {self.sphere.rings} rings"
            raise PolicyError(
                f"the map {self.map_name!r} is {maps.shape[1:]}, but {there}"
            )
        return peaks_first(
            np.where(
                np.isin(state.belief.argmax(1), self.valley_classes)[:, None, None],
                -maps,
                maps,
            )
        )


@dataclass(frozen=True)
class SpherePeak:
    """The highest unvisited peak of a predicted map of the sphere, then the highest view.

    As in Parisotto, Mukherjee and Kasaei, "MORE: simultaneous multi-view 3D object recognition and
    pose estimation" (Intelligent Service Robotics 16, 2023), except that the map is predicted again
    from each view, on the network's grid.

    Attributes:
        sphere: of the views.
        map_name: in the evidence, (B, rings, azimuths), columns once around from the view.
    """

    sphere: ViewSphere
    map_name: str
    travel_weight = 0.0

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.map_name,)

    def view_values(self, state: EpisodeState) -> Float:
        """Return the predicted map on the sphere, (B, V)."""
        return self._on_sphere(
            state,
            np.asarray(state.evidence.maps[self.map_name], np.float64),
        )

    def scores(self, state: EpisodeState) -> Float:
        """Return scores that put peaks first; see ``ScoresViews``."""
        return self._on_sphere(state, sphere_peaks(state.evidence.maps[self.map_name]))

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the highest peak of the predicted map of the whole sphere.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        return best_view(self.sphere, state, self.scores(state))

    def _on_sphere(self, state: EpisodeState, maps: Float) -> Float:
        n = self.sphere.azimuths
        if maps.shape[1:] != (self.sphere.rings, n):
            raise PolicyError(
                f"the map {self.map_name!r} is {maps.shape[1:]}, but the sphere"
                f" {self.sphere.rings, n}"
            )
        columns = (np.arange(n) - self.sphere.azimuth_index[state.current][:, None]) % n
        return np.take_along_axis(maps, columns[:, None], 2).reshape(len(maps), -1)
