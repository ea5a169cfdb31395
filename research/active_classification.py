"""``nextview/ActiveRecognise-v0``: the replay as an active classification environment of ap_gym.

    gymnasium.make("research.active_classification:nextview/ActiveRecognise-v0",
    predictions="test.npz")

ap_gym (Schneider et al., "Active Perception Gym") asks an agent for an action and a prediction in
every step: ``{"action": view, "prediction": logits}``. The reward is a base reward less the loss of
the prediction. The base reward is the price of the view and of the way there with a minus; the loss
is ap_gym's, the cross-entropy over that of a guess. The truth stands in the info as
``info["prediction"]["target"]``. What the recogniser believes is in the observation, and
``Rules.objective`` counts for nothing.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview_lab.benchmark.environments import (
    EnvironmentSplit,
    RecogniseEnv,
    RecogniseVectorEnv,
    info_of,
)
from nextview_lab.data.predictions import Predictions
from research.extras import extras

with extras():
    import ap_gym
    import gymnasium
    from gymnasium.vector import AutoresetMode

gymnasium.register(
    "nextview/ActiveRecognise-v0",
    entry_point="research.active_classification:ActiveRecogniseEnv",
    vector_entry_point="research.active_classification:ActiveRecogniseVectorEnv",
)


class ActiveRecogniseEnv(ap_gym.ActiveClassificationEnv):
    """One episode at a time; arguments as for ``RecogniseEnv``."""

    metadata = RecogniseEnv.metadata

    def __init__(
        self,
        predictions: str | Path | Predictions,
        split: EnvironmentSplit | None = "train",
        balanced: bool = False,
        **rules: Any,
    ) -> None:
        self._env = RecogniseEnv(predictions, split, balanced, **rules)
        super().__init__(len(self._env.task.classes), self._env.action_space)
        self.observation_space = self._env.observation_space

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """See ``gymnasium.Env.reset``."""
        super().reset(seed=seed)
        self._env.np_random = self.np_random
        return self._env.reset(options=options)

    def _step(
        self,
        action: Any,
        prediction: NDArray[np.floating],
    ) -> tuple[Any, float, bool, bool, dict, Any]:
        seen = self._env.go(action)
        info = info_of(seen)
        ended = bool(seen.ended[0])
        target = info["prediction_target"]
        return seen.observation[0], -float(seen.price[0]), ended, False, info, target


class ActiveRecogniseVectorEnv(ap_gym.ActiveClassificationVectorEnv):
    """Many episodes at once; arguments as for ``RecogniseVectorEnv``."""

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": [],
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        num_envs: int,
        predictions: str | Path | Predictions,
        split: EnvironmentSplit | None = "train",
        balanced: bool = False,
        **rules: Any,
    ) -> None:
        self._env = RecogniseVectorEnv(num_envs, predictions, split, balanced, **rules)
        super().__init__(
            num_envs,
            len(self._env.task.classes),
            self._env.single_action_space,
        )
        self.single_observation_space = self._env.single_observation_space
        self.observation_space = self._env.observation_space

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """See ``gymnasium.vector.VectorEnv.reset``."""
        super().reset(seed=seed)
        self._env.np_random = self.np_random
        return self._env.reset(options=options)

    def _step(
        self,
        action: Any,
        prediction: NDArray[np.floating],
    ) -> tuple[Any, Any, Any, Any, dict, Any]:
        seen, info = self._env.go(action)
        target = (
            info["final_info"]["prediction_target"]
            if "final_info" in info
            else info["prediction_target"]
        )
        return (
            seen.observation,
            -seen.price,
            seen.ended,
            np.zeros(self.num_envs, bool),
            info,
            target,
        )
