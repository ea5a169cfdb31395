"""Policies that use the ground truth: upper bounds, and the choice of the thesis."""

from dataclasses import dataclass

import numpy as np

from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.base import EpisodeState, Scope, best_in_window, best_view
from nextview.policies.maps import peaks_first, sphere_peaks
from nextview.recognition.belief import PLAIN_SUM, Calibration, of_true_class
from nextview.types import Float, Floats, Index


@dataclass(frozen=True)
class OracleValley:
    """The map's peak, or its valley if the *true* class uses valleys (section 4.2.3).

    Attributes:
        sphere: of the views.
        labels: of each episode, (E,).
        valley_classes: classes for which the lowest valley is chosen.
        map_name: in the evidence.
    """

    sphere: ViewSphere
    labels: Index
    valley_classes: tuple[int, ...]
    map_name: str

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.map_name,)

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the valley of the map if the true class uses valleys, else the peak.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        maps = np.asarray(state.evidence.maps[self.map_name], np.float64)
        valley = np.isin(self.labels[state.episodes], self.valley_classes)
        return best_in_window(
            self.sphere,
            state,
            peaks_first(np.where(valley[:, None, None], -maps, maps)),
        )


@dataclass(frozen=True)
class OracleMeasure:
    """The unvisited view with the highest true value, or true peak, of a measure.

    With viewpoint entropy this is the choice of Shui et al. (thesis, section 3.5), from a random
    first view; with the fused descriptor that of Ding et al.; with peaks of the depth entropy that
    of Parisotto et al.

    Attributes:
        sphere: of the views.
        values: of each view in each episode, (E, V).
        peaks: whether only peaks of the values are considered.
        needs: required inputs, see ``Policy.needs``.
    """

    sphere: ViewSphere
    values: Floats
    peaks: bool = False
    needs: tuple[str, ...] = ()

    def view_values(self, state: EpisodeState) -> Float:
        """Return the true values, (B, V)."""
        return np.asarray(self.values[state.episodes], np.float64)

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the highest value, or the highest peak, of the true measure.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        values = self.view_values(state)
        if self.peaks:
            values = sphere_peaks(
                values.reshape(-1, self.sphere.rings, self.sphere.azimuths)
            ).reshape(values.shape)
        return best_view(self.sphere, state, values)


@dataclass(frozen=True)
class OracleGain:
    """The view after which the belief in the true class is highest, one step ahead.

    Attributes:
        sphere: of the views.
        log_evidence: additive log-evidence of every view of every object, (N, V, D).
        classes: number of classes.
        labels: (N,).
        objects: of each episode, (E,).
        scope: views that may be chosen.
        calibration: from summed evidence to the belief.
        needs: required inputs, see ``Policy.needs``.
    """

    sphere: ViewSphere
    log_evidence: Floats
    classes: int
    labels: Index
    objects: Index
    scope: Scope = "local"
    calibration: Calibration = PLAIN_SUM
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the view that raises the belief in the true class most.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        b = len(state.current)
        # in parts, to limit the memory
        parts = np.split(np.arange(b), range(500, b, 500))
        gain = np.concatenate([self._gains(state, rows) for rows in parts])
        if self.scope == "global":
            return best_view(self.sphere, state, gain)
        return best_in_window(self.sphere, state, gain.reshape(b, -1, 3))

    def _gains(self, state: EpisodeState, rows: Index) -> Float:
        """Return the log-belief in the true class after each view, or each view of the window."""
        objects = self.objects[state.episodes[rows]]
        current = state.current[rows]
        log_evidence = self.log_evidence[objects].astype(np.float64)
        so_far = np.matmul(state.visited[rows, None].astype(np.float64), log_evidence)[
            :,
            0,
        ]
        if self.scope == "local":
            window = self.sphere.windows[current].reshape(len(rows), -1)
            log_evidence = log_evidence[np.arange(len(rows))[:, None], window]
        logs = self.calibration.log_belief(
            so_far[:, None] + log_evidence,
            state.step + 1,
            self.classes,
        )

        return of_true_class(logs, self.labels[objects])
