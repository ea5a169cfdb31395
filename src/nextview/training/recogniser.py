"""Train the recogniser: a ResNet that names the object in one view."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.data import IterableDataset

from nextview.models.geometry_input import CHANNELS
from nextview.training.fit import fit
from nextview.training.networks import ResNet
from nextview.training.recipes import RecogniserRecipe


class Views(IterableDataset):
    """Batches of (input (B, 4, S, S) uint8, label (B,)), new draws each epoch.

    Objects are drawn with weight 1/sqrt(objects of their class), so that rare classes are seen more often; the views of
    an object come from its own store or, with chance ``recipe.deformed_share``, from its deformed twin.
    """

    def __init__(
        self,
        sources: list[tuple[NDArray[np.uint8], NDArray[np.int64]]],
        objects: NDArray[np.int64],
        labels: NDArray[np.int64],
        recipe: RecogniserRecipe,
    ) -> None:
        self.sources, self.objects, self.labels, self.recipe = sources, objects, labels, recipe
        count = np.bincount(labels[objects])[labels[objects]]
        self.weights = count**-0.5 / (count**-0.5).sum()
        self.epoch = 0

    def __len__(self) -> int:
        return len(self.objects) * self.recipe.views // self.recipe.batch

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor]]:
        rng = np.random.default_rng([self.recipe.seed, self.epoch])
        n = len(self) * self.recipe.batch
        objects = rng.choice(self.objects, n, p=self.weights)
        deformed = (rng.random(n) < self.recipe.deformed_share) & (len(self.sources) > 1)
        views = rng.random(n)
        for start in range(0, n, self.recipe.batch):
            part = slice(start, start + self.recipe.batch)
            batch = []
            for o, d, v in zip(objects[part], deformed[part].astype(int), views[part], strict=True):
                inputs, row = self.sources[d]
                batch.append(inputs[row[o], int(v * inputs.shape[1])])
            yield torch.from_numpy(np.stack(batch)), torch.from_numpy(self.labels[objects[part]])


def augment(x: Tensor, s: int) -> Tensor:
    """Vary inputs (B, C, S, S) in 0 .. 1: mirror, shift, scale and stretch, roll a little, hide a rectangle, add noise.

    A mirrored object is of the same class, and none of the channels changes its sign under the mirror. The result is
    (B, C, s, s).
    """
    b, channels = x.shape[:2]
    scale = torch.empty(b, 2).uniform_(0.8, 1.25)
    scale[:, 0] *= torch.randint(0, 2, (b,)) * 2 - 1
    roll = torch.empty(b).normal_(0, 0.05)
    theta = torch.zeros(b, 2, 3)
    theta[:, 0, 0], theta[:, 0, 1] = scale[:, 0] * roll.cos(), -scale[:, 0] * roll.sin()
    theta[:, 1, 0], theta[:, 1, 1] = scale[:, 1] * roll.sin(), scale[:, 1] * roll.cos()
    theta[:, :, 2] = torch.empty(b, 2).uniform_(-0.1, 0.1)
    x = F.grid_sample(x, F.affine_grid(theta, [b, channels, s, s], align_corners=False), align_corners=False)
    # A rectangle of background, in half of the images, as if something stood in front.
    side = torch.empty(b, 2).uniform_(0.1, 0.4)
    corner = torch.rand(b, 2) * (1 - side)
    grid = (torch.arange(s) + 0.5) / s
    rows = (grid > corner[:, :1]) & (grid < corner[:, :1] + side[:, :1])
    columns = (grid > corner[:, 1:]) & (grid < corner[:, 1:] + side[:, 1:])
    hidden = (rows[:, :, None] & columns[:, None, :] & (torch.rand(b, 1, 1) < 0.5))[:, None]
    seen = (x > 0) & ~hidden
    return torch.where(seen, x + 0.02 * torch.randn_like(x), 0.0)


class RecogniserModule(L.LightningModule):
    """One-cycle AdamW on cross-entropy; validates on the class mean of single-view accuracy."""

    def __init__(self, recipe: RecogniserRecipe, classes: int, steps: int) -> None:
        super().__init__()
        self.recipe, self.steps = recipe, steps
        self.net = ResNet(recipe.depth, classes, len(CHANNELS)).to(memory_format=torch.channels_last)
        self.hits = torch.zeros(classes)
        self.seen = torch.zeros(classes)

    def training_step(self, batch: tuple[Tensor, Tensor], _: int) -> Tensor:
        size = self.recipe.small if self.current_epoch < self.recipe.small_epochs else self.recipe.size
        x = augment(batch[0].float() / 255, size).to(memory_format=torch.channels_last)
        loss = F.cross_entropy(self.net(x)[0].float(), batch[1], label_smoothing=self.recipe.smoothing)
        self.log("loss", loss, prog_bar=True, on_step=False, on_epoch=True)
        return loss

    def validation_step(self, batch: tuple[Tensor, Tensor], _: int) -> None:
        x = (batch[0].float() / 255).to(memory_format=torch.channels_last)
        right = (self.net(x)[0].argmax(1) == batch[1]).float()
        self.hits.scatter_add_(0, batch[1], right)
        self.seen.scatter_add_(0, batch[1], torch.ones_like(right))

    def on_validation_epoch_end(self) -> None:
        there = self.seen > 0
        self.log("class_accuracy", (self.hits[there] / self.seen[there]).mean(), prog_bar=True)
        self.hits.zero_()
        self.seen.zero_()

    def configure_optimizers(self) -> dict[str, Any]:
        decayed = [p for p in self.net.parameters() if p.ndim > 1]
        plain = [p for p in self.net.parameters() if p.ndim <= 1]
        optimizer = torch.optim.AdamW(
            [{"params": decayed, "weight_decay": self.recipe.decay}, {"params": plain, "weight_decay": 0.0}],
            lr=self.recipe.rate,
        )
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, self.recipe.rate, self.steps, pct_start=0.2)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


class ValidationViews(IterableDataset):
    """Every fifth view of the validation objects, shifted by one from object to object: all views get their turn."""

    def __init__(self, inputs: NDArray[np.uint8], objects: NDArray[np.int64], labels: NDArray[np.int64]) -> None:
        self.inputs, self.objects, self.labels = inputs, objects, labels

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor]]:
        for k, i in enumerate(self.objects):
            views = self.inputs[i, k % 5 :: 5]
            yield torch.from_numpy(np.ascontiguousarray(views)), torch.full((len(views),), int(self.labels[i]))


def train(
    sources: list[tuple[NDArray[np.uint8], NDArray[np.int64]]],
    labels: NDArray[np.int64],
    training: NDArray[np.int64],
    validation: NDArray[np.int64],
    recipe: RecogniserRecipe,
    out: Path,
) -> nn.Module:
    """Train and return the network; checkpoints in ``out``, from which a second call resumes.

    Args:
        sources: inputs (rows, V, 4, S, S) uint8 and each object's row in them (N,); the store's own, whose rows are the
            objects, and maybe those of its deformed twin.
        labels: class of each object, (N,).
        training: objects that train.
        validation: objects that validate.
        recipe: how.
        out: folder for checkpoints and logs.
    """
    L.seed_everything(recipe.seed, verbose=False)
    views = Views(sources, training, labels, recipe)
    module = RecogniserModule(recipe, int(labels.max()) + 1, recipe.epochs * len(views))
    validation_views = ValidationViews(sources[0][0], validation, labels)
    return fit(module, views, validation_views, recipe.epochs, out).net.eval()
