"""A policy that reinforcement learning made: the network of an agent, run without the library that trained it."""

from __future__ import annotations

from dataclasses import dataclass

from nextview.policies.gain import Gain


@dataclass(frozen=True)
class Agent(Gain):
    """The free view that an agent's network scores highest.

    The network takes and gives what that of ``Gain`` does, so it is read and run in the same way; but its scores are
    the action values of Q-learning, or the logits of a policy gradient's actor, and were learned from rewards
    (``nextview train agent``, ``training.agent``). An agent chooses among all actions while it learns; here only free
    views count, and the highest score wins: nothing is drawn.

    ``inputs`` and ``frame`` are those of the environment (``envs.task.Rules``) that it was trained in. What travel
    costs it has learned from its reward; ``travel_weight``, in the unit of its scores, is 0.
    """
