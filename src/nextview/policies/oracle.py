"""Policies that see the truth: the ceiling of what can be gained, and the thesis's own choice, named for what it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.belief import PLAIN_SUM, Calibration, of_true_class
from nextview.policies.base import EpisodeState, Scope, best_in_window
from nextview.policies.maps import peaks_first, sphere_peaks
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
    map_name: str

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
class OracleMeasure:
    """The unvisited view with the highest true value of a measure, or the highest peak of its map of the sphere.

    It has seen every view beforehand. With viewpoint entropy this is the choice of Shui et al. (thesis, section 3.5),
    who rank all views of an object and keep the best k; from a first view that is drawn, so that it can be paired with
    other policies. With the fused descriptor it is that of Ding et al., without their regression, which only predicts
    it. With peaks of the depth-entropy it is that of Parisotto et al. with a perfect map, see ``maps.SpherePeak``.

    Attributes:
        sphere: the viewpoints.
        values: of each view in each episode, (E, V).
        peaks: go to the peaks of the map first.
    """

    sphere: ViewSphere
    values: NDArray[np.floating]
    peaks: bool = False
    needs: tuple[str, ...] = ()

    def view_values(self, state: EpisodeState) -> NDArray[np.float64]:
        """The true values, (B, V)."""
        return np.asarray(self.values[state.episodes], np.float64)

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """See ``Policy.next_views``."""
        values = self.view_values(state)
        if self.peaks:
            values = sphere_peaks(values.reshape(-1, self.sphere.rings, self.sphere.azimuths)).reshape(values.shape)
        return np.where(state.free, values, -np.inf).argmax(1)


@dataclass(frozen=True)
class OracleGain:
    """The view after which the true class is believed most: the ceiling of choosing one view ahead.

    Attributes:
        sphere: the viewpoints.
        log_evidence: by the recogniser of every view of every object, so that it adds up, (N, V, D); see
            ``log_evidence_of``.
        classes: how many.
        labels: true class of each object, (N,) int64.
        objects: the object of each episode, (E,) int64.
        scope: choose in the local window, or among all unvisited views ("global").
        calibration: of the belief in the episodes.
    """

    sphere: ViewSphere
    log_evidence: NDArray[np.floating]
    classes: int
    labels: NDArray[np.int64]
    objects: NDArray[np.int64]
    scope: Scope = "local"
    calibration: Calibration = PLAIN_SUM
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """See ``Policy.next_views``."""
        b = len(state.current)
        parts = np.split(np.arange(b), range(500, b, 500))  # all at once would fill the memory
        gain = np.concatenate([self._gains(state, rows) for rows in parts])
        if self.scope == "global":
            return np.where(state.free, gain, -np.inf).argmax(1)
        return best_in_window(self.sphere, state, gain.reshape(b, -1, 3))

    def _gains(self, state: EpisodeState, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Logarithm of the belief in the truth after a view of each view, or each of the window, in some episodes."""
        objects, current = self.objects[state.episodes[rows]], state.current[rows]
        log_evidence = self.log_evidence[objects].astype(np.float64)
        so_far = np.matmul(state.visited[rows, None].astype(np.float64), log_evidence)[:, 0]
        if self.scope == "local":
            log_evidence = log_evidence[
                np.arange(len(rows))[:, None], self.sphere.windows[current].reshape(len(rows), -1)
            ]
        logs = self.calibration.log_belief(so_far[:, None] + log_evidence, state.step + 1, self.classes)
        return of_true_class(logs, self.labels[objects])
