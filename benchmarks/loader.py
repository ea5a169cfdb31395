"""Whether training waits for its data: steps with real batches against the same steps with one batch in memory.

    python benchmarks/loader.py modelnet10.zarr [--steps 50] [--preset thesis]

Both run the same module on the same device, augmentations included, in turns, so that what else the machine does falls
on both alike. Real batches come as in training: drawn at random from the packed inputs of the training objects (which
nextview train recogniser makes), and made in the background. The aim is a ratio of at least 0.9. The first round may
read from the disk; where the inputs fit into memory, the later ones do not.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain, count, repeat
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from torch import Tensor

from nextview.data.splits import split_training
from nextview.data.store import ViewStore
from nextview.training.ahead import Ahead
from nextview.training.inputs import load_inputs
from nextview.training.recipes import THESIS_RECOGNISER, RecogniserRecipe
from nextview.training.recogniser import RecogniserModule, Source, Views

RECIPES = {"default": RecogniserRecipe(), "thesis": THESIS_RECOGNISER}


def epochs(views: Views) -> Iterator[tuple[Tensor, Tensor]]:
    """Batch after batch without end, as Lightning asks for them."""

    def one(epoch: int) -> Iterator[tuple[Tensor, Tensor]]:
        views.epoch = epoch
        return iter(Ahead(views))

    return chain.from_iterable(map(one, count()))


def learn(
    module: RecogniserModule, optimizer: torch.optim.Optimizer, batches: Iterator[tuple[Tensor, Tensor]], steps: int
) -> float:
    """Seconds that so many training steps take, data and transfer included."""
    device = next(module.parameters()).device
    began = time.perf_counter()
    for _ in range(steps):
        images, labels = next(batches)
        with torch.autocast(device.type, torch.bfloat16):
            loss = module.training_step((images.to(device), labels.to(device)), 0)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
    if device.type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - began


def main(
    store: tyro.conf.Positional[Path],
    steps: int = 50,
    rounds: int = 5,
    preset: Literal["default", "thesis"] = "default",
    depth: Literal[18, 34, 50, 101, 152] | None = None,
    batch: int | None = None,
    size: int | None = None,
    blocks: Literal[1, 2, 4] | None = None,
) -> None:
    """Print samples a second of both, the ratio of every round, and the median ratio.

    Args:
        store: the views; their inputs must have been prepared.
        steps: of training in a round, for each of the two.
        rounds: pairs of them, after one to warm up.
        preset: the recipe.
        depth: of the ResNet, if not the recipe's.
        batch: views a step, if not the recipe's.
        size: side of the input, pixels, if not the recipe's.
        blocks: of pixels that become channels, if not the recipe's.
    """
    chosen = {"depth": depth, "batch": batch, "size": size, "blocks": blocks}
    recipe = replace(RECIPES[preset], **{name: value for name, value in chosen.items() if value is not None})
    views = ViewStore.open(store)
    training, _ = split_training(views, recipe.validation, recipe.seed)
    inputs = load_inputs(store, recipe.size, recipe.input)
    real = Views([Source(inputs, np.arange(len(views)))], training, views.labels, recipe)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    module = RecogniserModule(recipe, len(views.classes), recipe.epochs * len(real)).to(device).train()
    module.log = lambda *_, **__: None  # there is no trainer to log to
    # Lightning asks the trainer for the epoch; the first it is.
    type(module).current_epoch = property(lambda _: 0)
    optimizer = module.configure_optimizers()["optimizer"]
    from_store, in_memory = epochs(real), repeat(next(iter(real)))
    torch.set_flush_denormal(True)
    learn(module, optimizer, in_memory, max(2, steps // 10))
    learn(module, optimizer, from_store, max(2, steps // 10))
    where = torch.cuda.get_device_name() if device == "cuda" else f"CPU, {torch.get_num_threads()} threads"
    sees = f"{recipe.input} of {recipe.size} px" + (f" in blocks of {recipe.blocks}" if recipe.blocks > 1 else "")
    print(f"ResNet-{recipe.depth}, {sees}, batches of {recipe.batch}, {where}")
    ratios = []
    for k in range(rounds):
        memory, data = (learn(module, optimizer, batches, steps) for batches in (in_memory, from_store))
        ratios.append(memory / data)
        samples = steps * recipe.batch
        speeds = f"in memory {samples / memory:.0f}/s, real data {samples / data:.0f}/s"
        print(f"round {k + 1}: {speeds}, ratio {ratios[-1]:.3f}")
    real.epoch = 1_000  # draws that nothing has read before
    began = time.perf_counter()
    made = sum(len(labels) for _, (_, labels) in zip(range(steps), real, strict=False))
    alone = made / (time.perf_counter() - began)
    print(f"the loader alone: {alone:.0f} samples/s; median ratio {np.median(ratios):.3f}, aim 0.9")


if __name__ == "__main__":
    tyro.cli(main)
