"""How many views a second the environments give, one episode at a time and many in one batch.

    python benchmarks/environment_steps.py [--predictions validation.npz] [--seconds 5]

Actions are drawn at random. Seconds are of the processor (one thread), so that what runs beside does not count.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from nextview.cli.extra import require

require("envs")

import gymnasium
import tyro
from replay import made_up

import nextview.envs  # noqa: F401
from nextview.cli.ending import orderly_end
from nextview.data.predictions import Predictions

BELIEF = ("belief", "view", "place")


def rate(step: Callable[[], int], seconds: float) -> float:
    """Views a second of processor time."""
    step()
    began, views = time.process_time(), 0
    while time.process_time() - began < seconds:
        views += step()
    return views / (time.process_time() - began)


def single(env: gymnasium.Env) -> Callable[[], int]:
    """One episode."""

    def step() -> int:
        env.reset()
        views, ended = 0, False
        while not ended:
            ended = env.step(env.action_space.sample())[2]
            views += 1
        return views

    return step


def many(envs: gymnasium.vector.VectorEnv) -> Callable[[], int]:
    """One view in each episode."""
    envs.reset()

    def step() -> int:
        envs.step(envs.action_space.sample())
        return envs.num_envs

    return step


def main(predictions: Path | None = None, seconds: float = 5.0) -> None:
    """Print the table.

    Args:
        predictions: to be replayed; made-up ones of 899 objects of 10 classes by default.
        seconds: of processor time for each row.
    """
    table = made_up(899) if predictions is None else Predictions.load(predictions)
    inputs = {"belief": BELIEF, "belief and local map": (*BELIEF, "lem")}
    print("| environment | observation | episodes side by side | views a second |")
    print("|---|---|---|---|")
    for what, names in inputs.items():
        options = {"predictions": table, "split": None, "inputs": names}
        found = rate(single(gymnasium.make("nextview/Recognise-v0", **options)), seconds)
        print(f"| Recognise-v0 | {what} | 1 | {found:,.0f} |", flush=True)
        for n in (64, 1024, 4096):
            found = rate(many(gymnasium.make_vec("nextview/Recognise-v0", num_envs=n, **options)), seconds)
            print(f"| Recognise-v0 | {what} | {n:,} | {found:,.0f} |", flush=True)
    for depth in (False, True):
        found = rate(single(gymnasium.make("nextview/RecogniseMesh-v0", depth=depth)), seconds)
        print(f"| RecogniseMesh-v0 | belief{' and depth image' * depth} | 1 | {found:,.0f} |", flush=True)


if __name__ == "__main__":
    with orderly_end("run it again"):
        tyro.cli(main)
