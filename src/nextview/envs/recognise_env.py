"""``nextview/Recognise-v0``: one episode at a time over predictions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from nextview.data.predictions import Predictions
from nextview.envs.cohort import Cohort, Seen
from nextview.envs.replayed import replayed
from nextview.envs.task import Rules, Split, Task, rows
from nextview.errors import SessionError


class TaskEnv(gymnasium.Env[Any, Any]):
    """One episode at a time of any task.

    ``reset`` shows the first view; its options may name the "object" (row) and the "start" (view). The reward of a step
    is what the view changed, less its price and that of the way. An episode that reaches its last view is terminated,
    never truncated: the answer is due then.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # Gymnasium's own form

    def __init__(self, task: Task) -> None:
        self.task = task
        self.observation_space, self.action_space = task.observation_space, task.action_space
        self._cohort: Cohort | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See ``gymnasium.Env.reset``."""
        super().reset(seed=seed)
        self._cohort = Cohort(self.task, *self.task.begin(options, 1, self.np_random))
        return self._observed(self._cohort.first)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See ``gymnasium.Env.step``.

        Raises:
            SessionError: no episode is under way.
            UsageError: there is no such action.
        """
        seen = self._go(action)
        observation, info = self._observed(seen)
        return observation, float((seen.change - seen.price)[0]), bool(seen.ended[0]), False, info

    def _go(self, action: Any) -> Seen:
        if self._cohort is None or len(self._cohort.running) == 0:
            raise SessionError("no episode is under way; call reset")
        return self._cohort.step(rows(action, 1, len(self.task.sphere), "action"))

    def _observed(self, seen: Seen) -> tuple[NDArray[np.float32], dict[str, Any]]:
        return seen.observation[0], info_of(seen)


def info_of(seen: Seen) -> dict[str, Any]:
    """The info of a single episode."""
    return {name: values[0] for name, values in seen.info.items()}


class RecogniseEnv(TaskEnv):
    """Recognise an object by few views; what the models see in them is looked up in predictions.

    Args:
        predictions, split, balanced: see ``replayed``.
        rules: options of ``Rules``, by name.

    >>> env = gymnasium.make("nextview/Recognise-v0", predictions="validation.npz")    # doctest: +SKIP
    """

    def __init__(
        self,
        predictions: str | Path | Predictions,
        split: Split | None = "train",
        balanced: bool = False,
        **rules: Any,
    ) -> None:
        super().__init__(replayed(predictions, split, balanced, Rules(**rules)))
