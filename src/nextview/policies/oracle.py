"""Policies that see the truth: the ceiling of what can be gained, and the thesis's own choice, named for what it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.policies.base import EpisodeState, best_in_window
from nextview.policies.maps import peaks_first
from nextview.recognition import PLAIN_SUM, Calibration
from nextview.viewsphere import ViewSphere


@dataclass(frozen=True)
class OracleValley:
    """The map's peak, or its valley where the *true* class asks for it, as the thesis did (section 4.2.3).

    Attributes:
        sphere: the viewpoints.
        labels: true class of the object of each episode, (E,) int64.
        valley_classes: classes (indices) for which the lowest valley is the better view.
        map_name: the map in the evidence.
    """

    sphere: ViewSphere
    labels: NDArray[np.int64]
    valley_classes: tuple[int, ...]
    map_name: str = "lem"

    @property
    def needs(self) -> tuple[str, ...]:
        """The map."""
        return (self.map_name,)

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """See ``Policy.next_views``."""
        maps = np.asarray(state.evidence.maps[self.map_name], np.float64)
        valley = np.isin(self.labels[state.episodes], self.valley_classes)
        return best_in_window(self.sphere, state, peaks_first(np.where(valley[:, None, None], -maps, maps)))


@dataclass(frozen=True)
class OracleGain:
    """The view after which the true class is believed most: the ceiling of choosing one look ahead.

    Attributes:
        sphere: the viewpoints.
        logits: of every view of every object, (N, V, classes).
        labels: true class of each object, (N,) int64.
        objects: the object of each episode, (E,) int64.
        anywhere: choose among all unvisited views instead of the local window.
        calibration: of the belief in the episodes.
    """

    sphere: ViewSphere
    logits: NDArray[np.floating]
    labels: NDArray[np.int64]
    objects: NDArray[np.int64]
    anywhere: bool = False
    calibration: Calibration = PLAIN_SUM
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """See ``Policy.next_views``."""
        b = len(state.current)
        objects = self.objects[state.episodes]
        # Belief is the softmax of the sum so far over its temperature: its logarithm is that sum up to a constant.
        now, then = self.calibration.temperature(state.step), self.calibration.temperature(state.step + 1)
        so_far = now * np.log(np.maximum(state.belief, np.finfo(np.float64).tiny))[:, None]
        views = (
            np.arange(len(self.sphere))[None] if self.anywhere else self.sphere.windows[state.current].reshape(b, -1)
        )
        total = (so_far + self.logits[objects[:, None], views]) / then
        of_truth = np.take_along_axis(total, self.labels[objects][:, None, None], 2)[..., 0]
        top = total.max(2)
        gain = of_truth - top - np.log(np.exp(total - top[..., None]).sum(2))
        if self.anywhere:
            return np.where(state.visited, -np.inf, gain).argmax(1)
        return best_in_window(self.sphere, state, gain.reshape(b, -1, 3))
