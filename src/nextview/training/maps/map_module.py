"""Train a map network: it predicts the local map around a view from the view, or from its partial cloud."""

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

from nextview.errors import ModelError
from nextview.models.cloud_input import cloud_input
from nextview.models.model_card import find_card
from nextview.training.architectures import map_columns, map_network, orthogonality
from nextview.training.checkpoints import load_exported
from nextview.training.hardware import Hardware
from nextview.training.loop import fit
from nextview.training.packed import AHEAD, PackedViews, ask_for
from nextview.training.recipes import MapRecipe
from nextview.viewsphere import ViewSphere


class Windows(IterableDataset):
    """Batches of (what the network sees, map (B, rings, columns)), new draws each epoch.

    Mirrored, left and right are exchanged in both, in half of the views.
    """

    def __init__(
        self,
        seen: NDArray[Any] | PackedViews,
        values: NDArray[np.float32],
        sphere: ViewSphere,
        objects: NDArray[np.int64],
        recipe: MapRecipe,
        training: bool,
    ) -> None:
        self.seen, self.values, self.poses, self.objects = seen, values, sphere.poses, objects
        steps, n = np.array(map_columns(recipe, sphere)), sphere.azimuths
        azimuths = (sphere.azimuth_index[:, None] + steps) % n
        self.around = np.arange(sphere.rings)[None, :, None] * n + azimuths[:, None, :]  # (V, rings, columns)
        self.mirror = [list(steps % n).index(-step % n) for step in steps]
        self.recipe, self.training, self.epoch, self.share = recipe, training, 0, slice(None)
        self.batch = min(recipe.batch, len(objects) * recipe.views)

    def __len__(self) -> int:
        return len(self.objects) * self.recipe.views // self.batch

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor]]:
        rng = np.random.default_rng([self.recipe.seed, self.epoch])
        n, v, batch = len(self) * self.batch, len(self.poses), self.batch
        if self.training:  # every object as often as any other, and each of its views before one comes again
            turns = np.argsort(rng.random((v, len(self.objects))), axis=0)
            views = np.resize(turns, (self.recipe.views, len(self.objects))).flatten()
            objects, order = np.tile(self.objects, self.recipe.views), rng.permutation(len(views))[:n]
            objects, views = objects[order], views[order]
        else:  # the same spread of views every time
            objects, views = np.repeat(self.objects, self.recipe.views)[:n], (np.arange(n) * 7) % v
        mirrored = rng.random(n) < 0.5 * (self.training and self.recipe.mirror)
        batches = np.arange(n).reshape(-1, batch)[:, self.share]
        for step, here in enumerate(batches):
            coming = batches[step + AHEAD if step else 0 : step + AHEAD + 1].flatten()
            ask_for(self.seen, zip(objects[coming], views[coming], strict=True))
            points = rng.permutation(1024)[: self.recipe.points] if self.training else np.arange(1024)
            o, w, m = objects[here], views[here], mirrored[here]
            seen: NDArray[Any] = np.stack([self.seen[i, k] for i, k in zip(o, w, strict=True)])
            target = self.values[o[:, None, None], self.around[w]]
            if self.recipe.input == "cloud":
                seen = cloud_input(seen[:, points].astype(np.float32), self.poses[w])
                # y runs to the left of the camera; the mirror stands in the cloud's own middle.
                y = seen[m][..., 1]
                seen[m, :, 1] = y.max(1, keepdims=True) + y.min(1, keepdims=True) - y
            else:
                seen[m] = seen[m][..., ::-1]
            target[m] = target[m][..., self.mirror]
            yield torch.from_numpy(seen), torch.from_numpy(target)


def peak_loss(logits: Tensor, goal: Tensor, reach: int) -> Tensor:
    """Mean negative log-likelihood that a cell drawn by its logit lies within ``reach`` cells of the highest.

    Args:
        logits: (B, rings, columns).
        goal: the map whose highest cell is meant, the same shape.
        reach: 0 for that cell alone.
    """
    _, rings, columns = goal.shape
    ring, column = torch.meshgrid(torch.arange(rings), torch.arange(columns), indexing="ij")
    ring, column = ring.flatten().to(goal.device), column.flatten().to(goal.device)
    highest = goal.flatten(1).argmax(1)
    away = torch.hypot((ring - ring[highest, None]).float(), (column - column[highest, None]).float())
    likely = logits.flatten(1).log_softmax(1)
    return -likely.masked_fill(away > reach, -torch.inf).logsumexp(1).mean()


class MapModule(L.LightningModule):
    """AdamW on the squared error, plus the regulariser of the PointNet's transforms (thesis, section 2.2.3).

    Without weight decay AdamW is Adam, the published optimiser.
    """

    def __init__(self, recipe: MapRecipe, sphere: ViewSphere, steps: int) -> None:
        super().__init__()
        self.recipe, self.steps = recipe, steps
        self.net = map_network(recipe, sphere)
        columns = [step % sphere.azimuths for step in map_columns(recipe, sphere)]
        self.window = [columns.index(step % sphere.azimuths) for step in (-1, 0, 1)]

    def forward(self, seen: Tensor) -> tuple[Tensor, ...]:
        if self.recipe.input == "cloud":
            return self.net(seen)
        return self.net((seen.float() / 255).to(memory_format=torch.channels_last))

    def training_step(self, batch: tuple[Tensor, Tensor], _: int) -> Tensor:
        predicted, *transforms = self(batch[0])
        predicted, true = predicted.float(), batch[1]
        near, goal = predicted[..., self.window], true[..., self.window]
        error = F.mse_loss(near, goal)
        self.log("mse", error, prog_bar=True, on_step=False, on_epoch=True, sync_dist=True)
        if self.recipe.output == "sphere":
            error = (error + F.mse_loss(predicted, true)) / 2
        if self.recipe.peak:
            lost = peak_loss(near / self.recipe.sharpness, goal, self.recipe.reach)
            error = error + self.recipe.peak * lost
        return error + self.recipe.regular * sum(orthogonality(t.float()) for t in transforms)

    def validation_step(self, batch: tuple[Tensor, Tensor], _: int) -> None:
        error = F.mse_loss(self(batch[0])[0].float()[..., self.window], batch[1][..., self.window])
        self.log("validation_mse", error, prog_bar=True, batch_size=len(batch[1]), sync_dist=True)

    def configure_optimizers(self) -> dict[str, Any]:
        r = self.recipe
        optimizer = torch.optim.AdamW(self.parameters(), lr=r.lr, weight_decay=r.weight_decay)
        if r.schedule == "tenth":
            tenth = torch.optim.lr_scheduler.StepLR(optimizer, step_size=5, gamma=0.1)
            return {"optimizer": optimizer, "lr_scheduler": {"scheduler": tenth, "interval": "epoch"}}
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, r.lr, self.steps, pct_start=0.2)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def fit_map(
    seen: NDArray[Any] | PackedViews,
    values: NDArray[np.float32],
    sphere: ViewSphere,
    training: NDArray[np.int64],
    validation: NDArray[np.int64],
    recipe: MapRecipe,
    out: Path,
    hardware: Hardware = Hardware(),
    weights: Path | None = None,
) -> nn.Module:
    """Train and return the network of the best epoch; checkpoints in ``out``, from which a second call resumes.

    The score is the squared error in the local window, whatever else the network predicts.

    Args:
        seen: what the recipe's network sees of every view: inputs (N, V, C, S, S) uint8, or clouds (N, V, 1024, 3) of
            any scale.
        values: of every view, (N, V), 0 .. 1: what the maps are made of.
        sphere: the views.
        training: objects that train.
        validation: objects that validate.
        recipe: how.
        out: folder for checkpoints and logs.
        hardware: on what.
        weights: card from which a ResNet starts: of an exported recogniser, where its last layer is new, or of a map
            network, with which it goes on.

    Raises:
        ModelError: a checkpoint in ``out`` cannot be used, or the weights are not of this network.
    """
    windows = Windows(seen, values, sphere, training, recipe, training=True)
    validation_windows = Windows(seen, values, sphere, validation, recipe, training=False)
    L.seed_everything(recipe.seed, verbose=False)
    module = MapModule(recipe, sphere, recipe.epochs * len(windows))
    if weights:
        if recipe.input == "cloud":
            raise ModelError(f"{weights}: a PointNet cannot start from a ResNet")
        views, start = next(iter(windows))[0].float() / 255, find_card(weights)
        load_exported(module.net.resnet, weights, views, last=not start.is_recogniser, kinds=(start.kind,))
    score = "validation_mse"
    return fit(
        module, windows, validation_windows, recipe.epochs, out, score, "min", recipe.patience, hardware
    ).net.eval()
