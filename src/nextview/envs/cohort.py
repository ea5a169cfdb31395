"""Episodes of an environment that began together, driven by actions instead of a policy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.calibration.rollout import value_of
from nextview.envs.task import Task
from nextview.episode import Episodes
from nextview.policies.base import EpisodeState
from nextview.policies.gain import features, origin
from nextview.policies.learned_tables import cells_from
from nextview.viewsphere import ViewSphere


@dataclass
class _Asked:
    """The policy of a cohort: goes where the actions want, or as near to there as a view is free.

    Attributes:
        sphere: the viewpoints.
        views: that are wanted in each episode, (B,).
    """

    sphere: ViewSphere
    views: NDArray[np.int64]
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """See ``Policy.next_views``."""
        return np.where(state.free, self.sphere.travel[self.views[state.episodes]], np.inf).argmin(1)


@dataclass(frozen=True)
class Seen:
    """What the agent is handed after a view in A episodes.

    Attributes:
        observation: (A, D) float32.
        change: of the objective by this view, (A,) float64; 0 at the first.
        price: of this view and of the way there, (A,) float64; 0 at the first.
        ended: which episodes ended with it, (A,) bool.
        info: for each episode: "object", "view", "n_views", "travel" (cells so far), "answer", its "confidence",
            "prediction_target" and "action_mask", the actions that lead to a view not taken yet, (A, V) int8.
    """

    observation: NDArray[np.float32]
    change: NDArray[np.float64]
    price: NDArray[np.float64]
    ended: NDArray[np.bool_]
    info: dict[str, NDArray[Any]]


class Cohort:
    """B episodes side by side, all at the same view. ``first`` is what is seen before any action.

    Args:
        task: the objects and the rules.
        objects: of the episodes, rows of the task, (B,).
        starts: their first views, (B,).
    """

    def __init__(self, task: Task, objects: NDArray[np.int64], starts: NDArray[np.int64]) -> None:
        self.task, self.objects = task, objects
        self._asked = _Asked(task.sphere, np.array(starts))
        # The generator is for policies that draw; this one does not.
        rng, stopping = np.random.default_rng(0), task.rules.stopping(task.calibration)
        self._episodes = Episodes(task.sphere, self._asked, starts, stopping, rng, task.calibration)
        self._visited = np.zeros((len(objects), len(task.sphere)), bool)
        self._value, self._travel = np.zeros(len(objects)), np.zeros(len(objects))
        self.first = self._look(np.zeros(len(objects)))

    @property
    def running(self) -> NDArray[np.int64]:
        """The episodes that have not ended, (A,) int64."""
        return self._episodes.running

    def step(self, actions: NDArray[np.int64]) -> Seen:
        """Go on in each running episode; where the view was taken before, to the one not taken that is nearest to it.

        Args:
            actions: (A,), see ``Task.action_space``.
        """
        sphere, running = self.task.sphere, self.running
        before = self._episodes.steps[-1].views[~self._episodes.steps[-1].stopped]  # ``current`` is what comes next
        self._asked.views[running] = self._reached[np.arange(len(running)), actions]
        self._episodes.choose_again()
        way = sphere.travel[before, self._episodes.current[running]]
        self._travel[running] += way
        rules = self.task.rules
        return self._look(rules.view_price + rules.travel_price * way)

    def _look(self, price: NDArray[np.float64]) -> Seen:
        task, running, k = self.task, self.running, len(self._episodes.steps) + 1
        sphere, calibration, classes = task.sphere, task.calibration, len(task.classes)
        objects, views = self.objects[running], self._episodes.current[running]
        step = self._episodes.update(task.observe(objects, views))
        n_seen = np.maximum(step.seen, 1)
        self._visited[running, views] = True
        visited, labels = self._visited[running], task.labels[objects]
        azimuth_bins = calibration.azimuth_bins(step.total, n_seen, classes, sphere.turn[views])
        state = EpisodeState(views, visited, step.belief, step.evidence, k, running, azimuth_bins)
        value = value_of(calibration.log_belief(step.total, n_seen, classes), labels, task.rules.objective)
        change = value - self._value[running] if k > 1 else np.zeros(len(running))
        self._value[running] = value
        reached = cells_from(sphere)[origin(sphere, state, task.rules.frame)]
        self._reached = reached[~step.stopped]
        info = {
            "object": objects,
            "view": views,
            "n_views": np.full(len(running), k),
            "travel": self._travel[running],
            "answer": step.belief.argmax(1),
            "confidence": step.belief.max(1),
            "prediction_target": labels,
            "action_mask": ~np.take_along_axis(visited, reached, 1),
        }
        info["action_mask"] = info["action_mask"].astype(np.int8)
        seen = features(sphere, state, task.rules.inputs, task.rules.frame).astype(np.float32)
        return Seen(seen, change, price, step.stopped, info)
