"""Learn to choose views by reinforcement: from predictions to a policy card, and its network as
ONNX beside it.

    python -m research.train_agent ppo validation.npz agents/ppo.json [--steps 1000000 ...]
    python -m research.train_agent mvselect validation.npz agents/mvselect.json

The card is one of a gain policy: the network takes and gives what that of ``Gain`` does, so it is
read and run in the same way (``nextview-lab benchmark classes test.npz --policies
agents/ppo.json``). But its scores are the action values of Q-learning, or the logits of a policy
gradient's actor, and the highest free view wins.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from research.extras import require

require("rl")

import numpy as np
import torch
import tyro
from numpy.typing import NDArray

from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import console, track
from nextview.data.progress import TrackProgress, silently
from nextview.errors import UsageError
from nextview.files import check_new, command, sha256_of
from nextview.policies.gain import Gain, features
from nextview.policies.policy_card import LearnedFrom, PolicyCard
from nextview_lab.benchmark.environments import Rules, TaskVectorEnv, replayed
from nextview_lab.data.predictions import Predictions
from nextview_lab.training.fitting_set import for_fitting, hold_out
from nextview_lab.training.gain_training import Perceptrons, Score, write_gain
from nextview_lab.training.rollout import ReplayTable, Value, judge, rollout
from research.stable_baselines import MVSELECT, AgentRecipe, Layers, learn, learner


@dataclass(frozen=True)
class TrainedAgent:
    """An agent that was trained and written.

    Attributes:
        card: its card (.json); the network is the .onnx beside it.
        objects: from how many it learned.
        held_out: how many judged it.
        value: the mean objective after 2, 3, ... views on those, and the travel there.
        steps: after which it was the best.
    """

    card: Path
    objects: int
    held_out: int
    value: Value
    steps: int


def train_agent(
    predictions: Path,
    card: Path,
    recipe: AgentRecipe = AgentRecipe(),
    *,
    track: TrackProgress = silently,
) -> TrainedAgent:
    """Train an agent on predictions of objects that the recogniser was not trained on.

    One part of the objects is held out; the agent is judged on these from time to time, as it will
    be used, and the one with the best objective less prices is kept.

    Args:
        predictions: of such objects of the training split.
        card: the card to write (.json); the network is written beside it (.onnx).
        recipe: how to train.
        track: follows the training.

    Raises:
        UsageError: the card is not called NAME.json.
        ResultsError: it cannot be written.
        PredictionsError: the predictions lack what the recipe takes, or hold no objects of the
            training split.
        DatasetError: the objects cannot be divided.
        ModelError: the ONNX file does not answer as the network does; nothing is written then.
    """
    if card.suffix != ".json":
        raise UsageError(f"{card}: the card of a policy is called NAME.json")
    for path in (card, card.with_suffix(".onnx")):
        check_new(path)
    table = Predictions.load(predictions).of_split("train").deduplicate()
    judging = hold_out(table.labels, table.depth_entropy, recipe.holdout, recipe.seed)[
        0
    ]
    learning = np.setdiff1d(np.arange(len(table)), judging)
    rules = Rules(
        recipe.inputs,
        recipe.frame,
        recipe.objective,
        recipe.max_views,
        view_price=recipe.view_price,
        travel_price=recipe.travel_price,
    )
    env = TaskVectorEnv(
        replayed(table.of_objects(learning), "train", True, rules),
        recipe.envs,
    )
    judges = ReplayTable(for_fitting(table).of_objects(judging))
    steps, policy, value = _best(env, judges, recipe, track)
    about = PolicyCard(
        "gain",
        "global",
        table.sphere.elevations,
        table.sphere.azimuths,
        table.classes,
        {},
        f"{len(learning)} objects of the training split, classes drawn evenly, by"
        f" {recipe.algorithm.upper()}; {steps} steps chosen on {len(judging)} others",
        (LearnedFrom(sha256_of(predictions), table.models),),
        ((table.calibration.temperature, table.calibration.correlation),),
        asdict(recipe),
        (*table.commands, command()),
    )
    card.parent.mkdir(parents=True, exist_ok=True)
    write_gain(card, policy, about, _states(judges, policy, recipe))
    return TrainedAgent(card, len(learning), len(judging), value, steps)


def _best(
    env: TaskVectorEnv,
    judges: ReplayTable,
    recipe: AgentRecipe,
    track: TrackProgress,
) -> tuple[int, Gain, Value]:
    """The agent that was best on the objects held out, after how many steps, and what it
    reaches.
    """
    found: list[tuple[float, int, Gain, Value]] = []
    model = learner(env, recipe)

    def parts() -> Iterator[int]:
        for k, layers in enumerate(learn(model, recipe), 1):
            agent = _agent(env, layers, recipe)
            rng = np.random.default_rng([recipe.seed, 2])
            value = judge(
                judges,
                agent,
                recipe.max_views,
                recipe.objective,
                rng,
                rounds=4,
            )
            score = float(value.mean.mean() - recipe.travel_price * value.travel[-1])
            if not found or score > found[-1][0]:
                found.append((score, model.num_timesteps, agent, value))
            yield k

    track(parts(), recipe.evaluations, "learning")
    return found[-1][1:]


def _agent(env: TaskVectorEnv, layers: Layers, recipe: AgentRecipe) -> Gain:
    task = env.task
    width = len(layers[0][0])
    v = len(task.sphere)
    # A mirror that leaves everything in its place: reinforcement has not learned what is alike.
    weights, biases = (
        [torch.from_numpy(part)[None].float() for part in parts]
        for parts in zip(*layers, strict=True)
    )
    score = Score(
        Perceptrons(
            weights,
            [bias[None] for bias in biases],
            np.arange(width),
            np.arange(v),
        )
    )
    return Gain(
        task.sphere,
        len(task.classes),
        score,
        recipe.inputs,
        frame=recipe.frame,
    )


def _states(
    judges: ReplayTable,
    agent: Gain,
    recipe: AgentRecipe,
) -> NDArray[np.float32]:
    """States that the agent meets, to compare its file with."""
    met = rollout(
        judges,
        agent,
        recipe.max_views - 1,
        np.random.default_rng([recipe.seed, 3]),
    )
    seen = [
        features(agent.sphere, moment.state, agent.inputs, agent.frame)
        for moment in met
    ]
    return np.concatenate(seen).astype(np.float32)


def main(
    predictions: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    /,
    recipe: tyro.conf.OmitArgPrefixes[AgentRecipe] = AgentRecipe(),
) -> None:
    """Train an agent of Stable-Baselines3 on predictions of objects that the recogniser was not
    trained on.

    Args:
        predictions: of objects of the training split: those that validated the recogniser, or
            out-of-fold predictions (nextview-lab predict --held-out).
        out: card of the policy (.json), the network beside it (.onnx).
        recipe: how to train.
    """
    made = train_agent(predictions, out, recipe, track=track)
    console.print(
        f"learned from {made.objects} objects; on {made.held_out} others the {recipe.objective}"
        f" after 2, 3, ... views is {', '.join(f'{x:.4f}' for x in made.value.mean)} for"
        f" {made.value.travel[-1]:.2f} cells of travel; best after {made.steps} steps: {out}"
    )


def mvselect(
    predictions: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    /,
    recipe: tyro.conf.OmitArgPrefixes[AgentRecipe] = MVSELECT,
) -> None:
    """Train an agent after MVSelect (Hou, Gould and Zheng). Arguments as for ppo."""
    main(predictions, out, recipe)


if __name__ == "__main__":
    with orderly_end("run the same command again"):
        tyro.extras.subcommand_cli_from_dict(
            {"ppo": main, "mvselect": mvselect},
            description=__doc__,
        )
