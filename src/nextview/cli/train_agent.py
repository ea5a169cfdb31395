"""``nextview train agent``: learn to choose views by reinforcement."""

from __future__ import annotations

from pathlib import Path

import tyro

from nextview.training.recipes import AgentRecipe


def train_agent(
    predictions: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    /,
    recipe: tyro.conf.OmitArgPrefixes[AgentRecipe] = AgentRecipe(),
) -> None:
    """Train an agent of Stable-Baselines3 on predictions of objects that the recogniser was not trained on.

    It learns in the environment nextview/Recognise-v0, is judged on objects held out as it learns, and the best is
    kept. Takes a few minutes.

    Args:
        predictions: of such objects of the training split: those that validated the recogniser, or out-of-fold
            predictions (nextview predict --held-out).
        out: card of the policy (.json), the network beside it (.onnx); run it with --policy OUT, and compare it with
            nextview benchmark --policies OUT.
        recipe: how to train.
    """
    from nextview.cli.progress import console, track
    from nextview.training.agent import agent_training as stage

    made = stage.train_agent(predictions, out, recipe, track=track)
    console.print(
        f"learned from {made.objects} objects; on {made.held_out} others the {recipe.objective} after 2, 3, ... views "
        f"is {', '.join(f'{x:.4f}' for x in made.value.mean)} for {made.value.travel[-1]:.2f} cells of travel; best "
        f"after {made.steps} steps: {out}"
    )
