"""``nextview/Recognise-v0``, vectorised: thousands of episodes in one numpy batch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from nextview.arguments import whole
from nextview.data.predictions import Predictions
from nextview.envs.cohort import Cohort, Seen
from nextview.envs.replayed import replayed
from nextview.envs.task import Rules, Split, Task, rows
from nextview.errors import SessionError

Rows = NDArray[np.int64]
MOST_ENVS = 1_000_000


class TaskVectorEnv(VectorEnv[NDArray[np.float32], Any, NDArray[Any]]):
    """Many episodes of a task at once; as many cohorts as there are numbers of views are under way at most.

    Where an episode ends, another one begins in the same step: the observation is that of its first view, and the last
    of the one before stands in the info as "final_obs", with the rest of its info under "final_info". Options of
    ``reset`` are those of the single environment, each (num_envs,).

    Args:
        task: see ``Task``.
        num_envs: episodes side by side.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, task: Task, num_envs: int) -> None:
        self.task, self.num_envs = task, whole(num_envs, "the number of environments", 1, MOST_ENVS)
        self.single_observation_space, self.single_action_space = task.observation_space, task.action_space
        self.observation_space = batch_space(task.observation_space, num_envs)
        self.action_space = batch_space(task.action_space, num_envs)
        self._cohorts: list[tuple[Cohort, Rows]] = []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """See ``gymnasium.vector.VectorEnv.reset``."""
        super().reset(seed=seed)
        cohort = Cohort(self.task, *self.task.begin(options, self.num_envs, self.np_random))
        self._cohorts = [(cohort, np.arange(self.num_envs))]
        return cohort.first.observation, cohort.first.info

    def step(
        self, actions: Any
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """See ``gymnasium.vector.VectorEnv.step``.

        Raises:
            SessionError: ``reset`` was never called.
            UsageError: there are no such actions.
        """
        seen, info = self._go(actions)
        observation, still = seen.observation, np.zeros(self.num_envs, bool)
        return observation, seen.change - seen.price, seen.ended, still, info

    def _go(self, actions: Any) -> tuple[Seen, dict[str, Any]]:
        """What is seen in each episode; where one ended, the observation and the info are those of the next."""
        if not self._cohorts:
            raise SessionError("no episode is under way; call reset")
        actions = rows(actions, self.num_envs, len(self.task.sphere), "actions")
        parts = []
        for cohort, members in self._cohorts:
            where = members[cohort.running]
            parts.append((where, cohort.step(actions[where])))
        seen = _merged(parts, self.num_envs)
        self._cohorts = [(cohort, members) for cohort, members in self._cohorts if len(cohort.running)]
        over = np.flatnonzero(seen.ended)
        if len(over) == 0:
            return seen, seen.info
        last, info = seen.observation.copy(), {name: values.copy() for name, values in seen.info.items()}
        fresh = Cohort(self.task, *self.task.draw(len(over), self.np_random))
        self._cohorts.append((fresh, over))
        seen.observation[over] = fresh.first.observation
        for name, values in fresh.first.info.items():
            info[name][over] = values
        ended = {"final_obs": last, "_final_obs": seen.ended, "final_info": seen.info, "_final_info": seen.ended}
        return seen, info | ended


def _merged(parts: list[tuple[Rows, Seen]], n: int) -> Seen:
    """What is seen in all episodes, by their rows."""
    order = np.empty(n, np.int64)
    order[np.concatenate([rows for rows, _ in parts])] = np.arange(n)
    seen = [part for _, part in parts]
    observation, change, price, ended = (
        np.concatenate([getattr(part, name) for part in seen])[order]
        for name in ("observation", "change", "price", "ended")
    )
    info = {name: np.concatenate([part.info[name] for part in seen])[order] for name in seen[0].info}
    return Seen(observation, change, price, ended, info)


class RecogniseVectorEnv(TaskVectorEnv):
    """See ``RecogniseEnv``, of which this runs ``num_envs`` side by side."""

    def __init__(
        self,
        num_envs: int,
        predictions: str | Path | Predictions,
        split: Split | None = "train",
        balanced: bool = False,
        **rules: Any,
    ) -> None:
        super().__init__(replayed(predictions, split, balanced, Rules(**rules)), num_envs)
