"""An agent that learns where to look next at taught things: how much a view may cost in travel.

    python examples/agent_on_things.py SCANS MODELS [--rounds 6] [--episodes 20]

SCANS holds the scans, in metres, of the things that MODELS knows (``nextview learn SCANS MODELS
--unit m``). The agent is two weights: of what a view is expected to tell, and of the way there. The
cross-entropy method (Rubinstein 1999) draws some pairs of weights, keeps the best third, and draws
anew around these. It needs ``pip install 'nextview-lab[envs]'``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro

from nextview.checks import extras

if TYPE_CHECKING:
    import gymnasium

DRAWN = 9  # agents of each round
KEPT = 3  # the best of them


@dataclass(frozen=True)
class Agent:
    """Goes where the expected information, less the way there, is highest.

    Attributes:
        of_information: weight of a nat.
        of_travel: weight of a grid cell.
    """

    of_information: float
    of_travel: float

    def action(self, observation: dict[str, Any], info: dict[str, Any]) -> int:
        """The free action with the highest value."""
        worth = self.of_information * observation["information"]
        value = worth - self.of_travel * info["travel_to"]
        return int(np.where(observation["visited"], -np.inf, value).argmax())


def paid(env: gymnasium.Env, agent: Agent, episodes: int, seed: int) -> float:
    """Mean reward of some episodes, the same for all agents with one seed."""
    total = 0.0
    for number in range(episodes):
        observation, info = env.reset(seed=1000 * seed + number)
        over = False
        while not over:
            observation, reward, over, _, info = env.step(
                agent.action(observation, info)
            )
            total += float(reward)
    return total / episodes


def learn(env: gymnasium.Env, rounds: int, episodes: int, seed: int = 0) -> Agent:
    """Find good weights.

    Args:
        env: the environment.
        rounds: of drawing agents.
        episodes: that each agent is judged by.
        seed: of all draws.

    Returns:
        The mean of the best agents of the last round.
    """
    rng = np.random.default_rng(seed)
    mean = np.array([0.5, 0.1])
    deviation = np.array([0.5, 0.1])
    for turn in range(rounds):
        weights = np.abs(rng.normal(mean, deviation, (DRAWN, 2)))
        rewards = [paid(env, Agent(*pair), episodes, turn) for pair in weights.tolist()]
        best = weights[np.argsort(rewards)[-KEPT:]]
        mean = best.mean(0)
        deviation = best.std(0) + 0.02
        print(
            f"round {turn + 1}: reward {np.sort(rewards)[-KEPT:].mean():.3f}, weights {mean}"
        )
    return Agent(*mean.tolist())


def main(
    scans: tyro.conf.Positional[Path],
    models: tyro.conf.Positional[str],
    rounds: int = 6,
    episodes: int = 20,
    seed: int = 0,
) -> None:
    """Learn weights, and judge them on other episodes.

    Args:
        scans: folder of the scans, in metres.
        models: name or folder of the memory that knows them.
        rounds: of drawing agents.
        episodes: that each agent is judged by.
        seed: of all draws.
    """
    with extras():
        import gymnasium

        import nextview_lab.benchmark.environments  # noqa: F401  # registers the environment

    name = "nextview/RecogniseThings-v0"
    options = {"objective": "belief", "max_views": 3, "travel_price": 0.02}
    env = gymnasium.make(name, scans=scans, models=models, seed=seed, **options)
    agent = learn(env, rounds, episodes, seed)
    judge = gymnasium.make(name, scans=scans, models=models, seed=seed + 1, **options)
    near = Agent(0.0, 1.0)
    print(f"learned: {agent}")
    print(f"reward on other episodes: {paid(judge, agent, episodes, 999):.3f}")
    print(f"that of the nearest view: {paid(judge, near, episodes, 999):.3f}")


if __name__ == "__main__":
    tyro.cli(main)
