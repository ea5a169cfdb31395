"""Train the recogniser: a network that names the object in one view."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.data import IterableDataset

from nextview.training.architectures import recogniser_network
from nextview.training.checkpoints import load_checkpoint, load_exported
from nextview.training.hardware import Hardware
from nextview.training.loop import fit
from nextview.training.packed import AHEAD, PackedViews, ask_for
from nextview.training.recipes import RecogniserRecipe
from nextview.training.recogniser.azimuth_bins import side_loss


@dataclass(frozen=True)
class Source:
    """Where views of the training objects come from: their own store or one of deformed copies.

    Attributes:
        inputs: (rows, V, C, S, S) uint8.
        row: of each object in them, (N,), -1 for none.
        azimuth_bins: that each view sees of its object, (rows, V), see ``azimuth_bins.azimuth_bins``; None if they are
            not to be learned.
    """

    inputs: NDArray[np.uint8] | PackedViews
    row: NDArray[np.int64]
    azimuth_bins: NDArray[np.float32] | None = None


class Views(IterableDataset):
    """Batches of (input (B, C, S, S) uint8, label (B,), and side (B,) where sources have it), new draws each epoch.

    Balanced, objects are drawn with weight 1/sqrt(objects of their class), so that rare classes are seen more often,
    and views at random. Otherwise every view comes at most once an epoch, and once exactly if ``recipe.views`` takes
    all of them. The views of an object come from its own store or, with chance ``recipe.deformed_share``, from one of
    its deformed copies, which may have other views; always its own where it is not among those that are drawn from.
    """

    def __init__(
        self,
        sources: list[Source],
        objects: NDArray[np.int64],
        labels: NDArray[np.int64],
        recipe: RecogniserRecipe,
    ) -> None:
        self.sources, self.objects, self.labels, self.recipe = sources, objects, labels, recipe
        count = np.bincount(labels[objects])[labels[objects]]
        self.weights = count**-0.5 / (count**-0.5).sum()
        self.epoch, self.share = 0, slice(None)
        views = recipe.views if recipe.balanced else min(recipe.views, sources[0].inputs.shape[1])
        self.drawn = len(objects) * views
        self.batch = min(recipe.batch, self.drawn)

    def __len__(self) -> int:
        return self.drawn // self.batch

    def __iter__(self) -> Iterator[tuple[Tensor, ...]]:
        rng = np.random.default_rng([self.recipe.seed, self.epoch, self.recipe.ensemble_seed])
        n, v = len(self) * self.batch, self.sources[0].inputs.shape[1]
        if self.recipe.balanced:
            objects = rng.choice(self.objects, n, p=self.weights)
            turn = rng.random(n)  # of the view, as a part of all views
        else:
            objects, views = np.divmod(rng.permutation(len(self.objects) * v)[:n], v)
            objects, turn = self.objects[objects], (views + 0.5) / v
        deformed = (rng.random(n) < self.recipe.deformed_share) & (len(self.sources) > 1)
        source = np.where(deformed, rng.integers(1, max(2, len(self.sources)), n), 0)
        rows = np.stack([own.row for own in self.sources])
        source[rows[source, objects] < 0] = 0
        row = rows[source, objects]
        view = (turn * np.array([own.inputs.shape[1] for own in self.sources])[source]).astype(int)
        batches = np.arange(n).reshape(-1, self.batch)[:, self.share]
        for step, batch in enumerate(batches):
            coming = batches[step + AHEAD if step else 0 : step + AHEAD + 1]
            for s, own in enumerate(self.sources):
                k = coming[source[coming] == s]
                ask_for(own.inputs, zip(row[k], view[k], strict=True))
            images = [self.sources[source[k]].inputs[row[k], view[k]] for k in batch]
            known_bins = [self.sources[source[k]].azimuth_bins for k in batch]
            azimuth_bins = [
                known[row[k], view[k]] for k, known in zip(batch, known_bins, strict=True) if known is not None
            ]
            drawn = [np.stack(images), self.labels[objects[batch]], *([np.array(azimuth_bins)] if azimuth_bins else [])]
            yield tuple(map(torch.from_numpy, drawn))


def augment(x: Tensor) -> tuple[Tensor, Tensor]:
    """Vary inputs (B, C, S, S) in 0 .. 1: mirror, shift, scale and stretch, roll a little, hide a rectangle, add noise.

    A mirrored object is of the same class, and none of the channels changes its sign under the mirror. The result has
    the same shape; with it comes which of the inputs are mirrored, (B,) bool.
    """
    (b, _, _, s), on = x.shape, {"device": x.device}
    scale = torch.empty(b, 2, **on).uniform_(0.8, 1.25)
    mirrored = torch.randint(0, 2, (b,), **on) == 0
    scale[:, 0] *= torch.where(mirrored, -1.0, 1.0)
    roll = torch.empty(b, **on).normal_(0, 0.05)
    theta = torch.zeros(b, 2, 3, **on)
    theta[:, 0, 0], theta[:, 0, 1] = scale[:, 0] * roll.cos(), -scale[:, 0] * roll.sin()
    theta[:, 1, 0], theta[:, 1, 1] = scale[:, 1] * roll.sin(), scale[:, 1] * roll.cos()
    theta[:, :, 2] = torch.empty(b, 2, **on).uniform_(-0.1, 0.1)
    x = F.grid_sample(x, F.affine_grid(theta, list(x.shape), align_corners=False), align_corners=False)
    # A rectangle of background, in half of the images, as if something stood in front.
    side = torch.empty(b, 2, **on).uniform_(0.1, 0.4)
    corner = torch.rand(b, 2, **on) * (1 - side)
    grid = (torch.arange(s, **on) + 0.5) / s
    rows = (grid > corner[:, :1]) & (grid < corner[:, :1] + side[:, :1])
    columns = (grid > corner[:, 1:]) & (grid < corner[:, 1:] + side[:, 1:])
    hidden = (rows[:, :, None] & columns[:, None, :] & (torch.rand(b, 1, 1, **on) < 0.5))[:, None]
    seen = (x > 0) & ~hidden
    return torch.where(seen, x + 0.02 * torch.randn_like(x), 0.0), mirrored


class RecogniserModule(L.LightningModule):
    """AdamW on cross-entropy; validates on the class mean of single-view accuracy.

    Without weight decay AdamW is Adam, the published optimiser.
    """

    def __init__(self, recipe: RecogniserRecipe, classes: int, steps: int, azimuths: int = 0) -> None:
        super().__init__()
        self.recipe, self.steps = recipe, steps
        self.net = recogniser_network(recipe, classes, azimuths).to(memory_format=torch.channels_last)
        for name in ("hits", "seen", "lost"):  # of each class in validation
            self.register_buffer(name, torch.zeros(classes), persistent=False)

    def training_step(self, batch: tuple[Tensor, ...], _: int) -> Tensor:
        x, label = batch[0].float() / 255, batch[1]
        mirrored = torch.zeros_like(label, dtype=torch.bool)
        if self.recipe.augment:
            x, mirrored = augment(x)
        x = x.to(memory_format=torch.channels_last)
        logits, *likely = self.net(x)
        loss = F.cross_entropy(logits.float(), label, label_smoothing=self.recipe.smoothing)
        if likely:
            side = torch.where(mirrored, -batch[2] % likely[0].shape[2], batch[2])
            lost = side_loss(likely[0].float(), label, side)
            self.log("side_loss", lost, on_step=False, on_epoch=True, sync_dist=True, batch_size=len(x))
            loss = loss + self.recipe.azimuth_bins_weight * lost
        self.log("loss", loss, prog_bar=True, on_step=False, on_epoch=True, sync_dist=True, batch_size=len(x))
        return loss

    def validation_step(self, batch: tuple[Tensor, Tensor], _: int) -> None:
        x = (batch[0].float() / 255).to(memory_format=torch.channels_last)
        logits, label = self.net(x)[0].float(), batch[1]
        right = (logits.argmax(1) == label).float()
        self.hits.scatter_add_(0, label, right)
        self.seen.scatter_add_(0, label, torch.ones_like(right))
        self.lost.scatter_add_(0, label, F.cross_entropy(logits, label, reduction="none"))

    def on_validation_epoch_end(self) -> None:
        hits, seen, lost = (self.trainer.strategy.reduce(x, reduce_op="sum") for x in (self.hits, self.seen, self.lost))
        there = seen > 0
        self.log("class_accuracy", (hits[there] / seen[there]).mean(), prog_bar=True)
        self.log("validation_loss", lost.sum() / seen.sum())
        for total in (self.hits, self.seen, self.lost):
            total.zero_()

    def configure_optimizers(self) -> dict[str, Any]:
        decayed = [p for p in self.net.parameters() if p.ndim > 1]
        plain = [p for p in self.net.parameters() if p.ndim <= 1]
        optimizer = torch.optim.AdamW(
            [{"params": decayed, "weight_decay": self.recipe.weight_decay}, {"params": plain, "weight_decay": 0.0}],
            lr=self.recipe.lr,
        )
        if self.recipe.schedule == "halving":
            schedule = torch.optim.lr_scheduler.StepLR(optimizer, step_size=5, gamma=0.5)
            return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "epoch"}}
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, self.recipe.lr, self.steps, pct_start=0.2)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


class ValidationViews(IterableDataset):
    """Every fifth view of the validation objects, shifted by one from object to object: all views get their turn."""

    def __init__(
        self, inputs: NDArray[np.uint8] | PackedViews, objects: NDArray[np.int64], labels: NDArray[np.int64]
    ) -> None:
        self.inputs, self.objects, self.labels, self.share = inputs, objects, labels, slice(None)

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor]]:
        mine = list(enumerate(self.objects))[self.share]
        for at, (k, i) in enumerate(mine):
            ask_for(self.inputs, [(later,) for _, later in mine[at + 1 : at + 2]])
            views = self.inputs[i, k % 5 :: 5]
            yield torch.from_numpy(views), torch.full((len(views),), int(self.labels[i]))


def fit_recogniser(
    sources: list[Source],
    labels: NDArray[np.int64],
    training: NDArray[np.int64],
    validation: NDArray[np.int64],
    recipe: RecogniserRecipe,
    out: Path,
    weights: Path | None = None,
    hardware: Hardware = Hardware(),
    azimuths: int = 0,
) -> nn.Module:
    """Train and return the network of the best epoch; checkpoints in ``out``, from which a second call resumes.

    Args:
        sources: the store's own, whose rows are the objects, and maybe those of deformed copies.
        labels: class of each object, (N,).
        training: objects that train.
        validation: objects that validate.
        recipe: how.
        out: folder for checkpoints and logs.
        weights: a published checkpoint, or the card of an exported recogniser, to start from.
        hardware: on what.
        azimuths: azimuth bins of the object that the network learns to tell apart, 0 for none.

    Raises:
        ModelError: the weights or a checkpoint in ``out`` cannot be used.
    """
    own = np.random.SeedSequence([recipe.seed, recipe.ensemble_seed])
    L.seed_everything(int(own.generate_state(1)[0]), verbose=False)
    views = Views(sources, training, labels, recipe)
    module = RecogniserModule(recipe, int(labels.max()) + 1, recipe.epochs * len(views), azimuths)
    if weights and weights.suffix == ".json":
        sample = next(iter(Views(sources[:1], training, labels, recipe)))[0].float() / 255
        load_exported(module.net, weights, augment(sample)[0] if recipe.augment else sample)
    elif weights:
        load_checkpoint(module.net, weights)
    start = {name: values.clone() for name, values in module.net.state_dict().items()}
    validation_views = ValidationViews(sources[0].inputs, validation, labels)
    best = fit(module, views, validation_views, recipe.epochs, out, "class_accuracy", "max", recipe.patience, hardware)
    best.net.load_state_dict(part_way(start, best.net.state_dict(), recipe.way))
    return best.net.eval()


def part_way(start: dict[str, Tensor], end: dict[str, Tensor], way: float) -> dict[str, Tensor]:
    """Parameters a part of the way between two states of one network; counters are those of the end."""
    return {
        name: torch.lerp(start[name].to(values), values, way) if values.is_floating_point() else values
        for name, values in end.items()
    }
