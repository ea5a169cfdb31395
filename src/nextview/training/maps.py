"""Train a map network: a PointNet that predicts the local map around a view from its partial cloud."""

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

from nextview.models.cloud_input import cloud_input
from nextview.training.fit import fit
from nextview.training.networks import PointNet, orthogonality
from nextview.training.recipes import MapRecipe


class Clouds(IterableDataset):
    """Batches of (cloud (B, P, 3), map (B, rings, 3)); in half of them left and right are exchanged in both."""

    def __init__(
        self,
        points: NDArray[np.int16],
        maps: NDArray[np.float32],
        poses: NDArray[np.float64],
        objects: NDArray[np.int64],
        recipe: MapRecipe,
        training: bool,
    ) -> None:
        self.points, self.maps, self.poses, self.objects = points, maps, poses, objects
        self.recipe, self.training, self.epoch = recipe, training, 0

    def __len__(self) -> int:
        return len(self.objects) * self.recipe.views // self.recipe.batch

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor]]:
        rng = np.random.default_rng([self.recipe.seed, self.epoch])
        n, v, b = len(self) * self.recipe.batch, len(self.poses), self.recipe.batch
        if self.training:
            objects = np.concatenate([rng.permutation(self.objects) for _ in range(self.recipe.views)])[:n]
            views = rng.integers(v, size=n)
        else:  # the same spread of views every time
            objects = np.repeat(self.objects, self.recipe.views)[:n]
            views = (np.arange(n) * 7) % v
        for start in range(0, n, b):
            o, w = objects[start : start + b], views[start : start + b]
            cloud = self.points[o, w].astype(np.float32)
            if self.training:
                cloud = cloud[:, rng.permutation(cloud.shape[1])[: self.recipe.points]]
            cloud = cloud_input(cloud, self.poses[w])
            target = self.maps[o, w]
            if self.training and rng.random() < 0.5:
                # y runs to the left of the camera; mirroring it about the cloud's own middle exchanges the columns.
                y = cloud[..., 1]
                cloud[..., 1] = y.max(1, keepdims=True) + y.min(1, keepdims=True) - y
                target = target[..., ::-1].copy()
            yield torch.from_numpy(cloud), torch.from_numpy(target)


class MapModule(L.LightningModule):
    """One-cycle Adam on the squared error plus the transforms' regulariser (thesis, section 2.2.3)."""

    def __init__(self, recipe: MapRecipe, rings: int, steps: int) -> None:
        super().__init__()
        self.recipe, self.steps = recipe, steps
        self.net = PointNet(rings)

    def training_step(self, batch: tuple[Tensor, Tensor], _: int) -> Tensor:
        predicted, a, b = self.net(batch[0])
        error = F.mse_loss(predicted.float(), batch[1])
        self.log("mse", error, prog_bar=True, on_step=False, on_epoch=True)
        return error + self.recipe.regular * (orthogonality(a.float()) + orthogonality(b.float()))

    def validation_step(self, batch: tuple[Tensor, Tensor], _: int) -> None:
        predicted = self.net(batch[0])[0].float()
        self.log("validation_mse", F.mse_loss(predicted, batch[1]), prog_bar=True, batch_size=len(predicted))

    def configure_optimizers(self) -> dict[str, Any]:
        optimizer = torch.optim.Adam(self.parameters(), lr=self.recipe.rate)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, self.recipe.rate, self.steps, pct_start=0.2)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def train(
    points: NDArray[np.int16],
    maps: NDArray[np.float32],
    poses: NDArray[np.float64],
    training: NDArray[np.int64],
    validation: NDArray[np.int64],
    recipe: MapRecipe,
    out: Path,
) -> nn.Module:
    """Train and return the network; checkpoints in ``out``, from which a second call resumes.

    Args:
        points: clouds of all views, (N, V, 1024, 3), any scale.
        maps: local maps around every view, (N, V, rings, 3), 0 .. 1.
        poses: of the views, (V, 4, 4).
        training: objects that train.
        validation: objects that validate.
        recipe: how.
        out: folder for checkpoints and logs.
    """
    train_clouds = Clouds(points, maps, poses, training, recipe, training=True)
    validation_clouds = Clouds(points, maps, poses, validation, recipe, training=False)
    L.seed_everything(recipe.seed, verbose=False)
    module = MapModule(recipe, maps.shape[2], recipe.epochs * len(train_clouds))
    return fit(module, train_clouds, validation_clouds, recipe.epochs, out).net.eval()
