"""Stable-Baselines3 on the vectorised environment, and the network that it has learned."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from nextview.errors import ModelError
from nextview_lab.benchmark.environments import TaskVectorEnv
from research.extras import extras

with extras():
    from stable_baselines3 import DQN, PPO
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv
    from torch import nn

Layers = Sequence[tuple[NDArray[np.floating], NDArray[np.floating]]]
"""Weights (in, out) and biases (out,) of one perceptron, ReLU between them."""


@dataclass(frozen=True)
class AgentRecipe:
    """How an agent learns by reinforcement, in the environment over predictions.

    Attributes:
        algorithm: of Stable-Baselines3: PPO (Schulman et al., 2017) or DQN (Mnih et al., Nature
            518, 2015).
        inputs: what the agent sees: belief, view, place, azimuth_bin and any maps of the
            predictions, see ``policies.gain.INPUTS``.
        frame: from where the azimuths of actions and observations are counted, see ``GainRecipe``.
        objective: what is paid: the change of "right" (1 if the most believed class is the true
            one), of the "belief" in the true class or of its "log-belief".
        max_views: views of an episode, the first included.
        view_price: taken from the reward for each view.
        travel_price: taken from it for each grid cell of travel.
        hidden: width of the two hidden layers.
        steps: views that are chosen in training, in all episodes together.
        envs: episodes side by side.
        rollout: PPO: views in each of these between two updates. DQN: the same between two rounds
            of updates.
        batch: decisions in a gradient step.
        updates: PPO: passes over what was gathered. DQN: gradient steps a round.
        lr: Adam's learning rate.
        discount: of rewards to come.
        entropy: PPO: weight of the entropy bonus.
        exploration: DQN: share of random views, from the first number down to the second over the
            first half of the steps.
        evaluations: so often the agent is judged on objects held out, and the best one kept.
        holdout: one of so many parts of the objects is held out for that.
        seed: of everything random.
    """

    algorithm: Literal["ppo", "dqn"] = "ppo"
    inputs: tuple[str, ...] = ("belief", "view", "place", "lem-sphere", "azimuth_bin")
    frame: Literal["camera", "object"] = "object"
    objective: Literal["belief", "log-belief", "right"] = "log-belief"
    max_views: int = 5
    view_price: float = 0.0
    travel_price: float = 0.0
    hidden: int = 64
    steps: int = 1_000_000
    envs: int = 512
    rollout: int = 8
    batch: int = 1024
    updates: int = 5
    lr: float = 1e-3
    discount: float = 1.0
    entropy: float = 0.01
    exploration: tuple[float, float] = (0.9, 0.05)
    evaluations: int = 20
    holdout: int = 5
    seed: int = 0


MVSELECT = AgentRecipe(
    algorithm="dqn",
    inputs=("belief", "place"),
    frame="camera",
    objective="right",
    rollout=1,
    updates=4,
    discount=0.99,
)
"""After MVSelect (Hou, Gould and Zheng, "Learning to select camera views: efficient multiview
understanding at few glances", arXiv 2303.06145, 2023; "Learning to select views for efficient
multi-view understanding", CVPR 2024): deep Q-learning over what all views say together and which
views these were, paid for the right answer; discount 0.99, exploration from 0.9 to 0.05 and a
slowly moving target network as in the authors' code.

What differs from it: the fused input is the belief over all views instead of the maximum of their
512 features, so the recogniser is not trained along with the agent. Views are counted from the
camera, not by the number of a fixed camera. One perceptron of two layers stands for the sum of a
feature branch and a camera branch. It learns from a replay memory instead of every first camera of
every batch. The authors' published code pays the fall of the task's loss; being paid for the right
answer is the other form that it holds. Episodes have five views, not two or three."""


class BatchedVecEnv(VecEnv):
    """A ``TaskVectorEnv`` in the form that Stable-Baselines3 asks for."""

    def __init__(self, env: TaskVectorEnv) -> None:
        self._env = env
        self._actions = np.zeros(0, np.int64)
        super().__init__(
            env.num_envs,
            env.single_observation_space,
            env.single_action_space,
        )

    def reset(self) -> NDArray[np.float32]:
        """First observations, (envs, D)."""
        observation, _ = self._env.reset(seed=self._seeds[0])
        self._reset_seeds()
        return observation

    def step_async(self, actions: NDArray[np.int64]) -> None:
        """Note the actions, (envs,)."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[
        NDArray[np.float32],
        NDArray[np.float32],
        NDArray[np.bool_],
        list[dict[str, Any]],
    ]:
        """Observations, rewards, ends and infos."""
        observation, reward, ended, _, info = self._env.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(ended):
            infos[row] = {
                "terminal_observation": info["final_obs"][row],
                "TimeLimit.truncated": False,
            }
        return observation, reward.astype(np.float32), ended, infos

    def close(self) -> None:
        """Nothing is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the environment, for each."""
        return [getattr(self._env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the environment."""
        setattr(self._env, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *args: Any,
        indices: Any = None,
        **options: Any,
    ) -> list[Any]:
        """Call a method of the environment, for each."""
        return [getattr(self._env, method_name)(*args, **options)] * len(
            list(self._get_indices(indices))
        )

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """It is not."""
        return [False] * len(list(self._get_indices(indices)))


def learner(env: TaskVectorEnv, recipe: AgentRecipe) -> BaseAlgorithm:
    """The algorithm of a recipe before its first step."""
    net = {"net_arch": [recipe.hidden, recipe.hidden], "activation_fn": nn.ReLU}
    shared: dict[str, Any] = {
        "policy_kwargs": net,
        "seed": recipe.seed,
        "device": "cpu",
        "gamma": recipe.discount,
    }
    shared |= {"learning_rate": recipe.lr, "batch_size": recipe.batch}
    if recipe.algorithm == "ppo":
        return PPO(
            "MlpPolicy",
            BatchedVecEnv(env),
            n_steps=recipe.rollout,
            n_epochs=recipe.updates,
            ent_coef=recipe.entropy,
            **shared,
        )
    first, last = recipe.exploration
    model = DQN(
        "MlpPolicy",
        BatchedVecEnv(env),
        train_freq=recipe.rollout,
        gradient_steps=recipe.updates,
        tau=0.05,
        target_update_interval=recipe.envs,
        buffer_size=200_000,
        learning_starts=4 * recipe.batch,
        **shared,
    )
    # The algorithm's own begins anew with each call of ``learn``.
    model.exploration_schedule = lambda _: float(
        np.interp(2 * model.num_timesteps, [0, recipe.steps], [first, last])
    )
    return model


def learn(model: BaseAlgorithm, recipe: AgentRecipe) -> Iterator[Layers]:
    """Go on learning; after each of ``recipe.evaluations`` parts, the network as it then is.

    Raises:
        ModelError: its numbers grew beyond all bounds.
    """
    for k in range(1, recipe.evaluations + 1):
        missing = recipe.steps * k // recipe.evaluations - model.num_timesteps
        try:
            if missing > 0:
                model.learn(missing, reset_num_timesteps=False)
        except ValueError as error:  # torch draws no action from what is not a number
            _refuse_infinite(model, error)
            raise
        _refuse_infinite(model)
        yield layers_of(model)


def _refuse_infinite(model: BaseAlgorithm, cause: Exception | None = None) -> None:
    if not all(bool(numbers.isfinite().all()) for numbers in model.policy.parameters()):
        raise ModelError(
            "the numbers of the agent's network grew beyond all bounds: take a smaller --lr"
        ) from cause


def layers_of(model: BaseAlgorithm) -> Layers:
    """From observations to the logits of the actions (PPO's actor), or to their values (DQN)."""
    policy: Any = model.policy
    parts = (
        [*policy.mlp_extractor.policy_net, policy.action_net]
        if isinstance(model, PPO)
        else [*policy.q_net.q_net]
    )
    linear = [
        [p.detach().numpy().copy() for p in part.parameters()]
        for part in parts
        if isinstance(part, nn.Linear)
    ]
    return tuple((weights.T, bias) for weights, bias in linear)
