"""Train a map network, which predicts the value of every view, from a view store."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.data.progress import TrackProgress, silently
from nextview.errors import ModelError, UsageError
from nextview.geometry.viewsphere import ViewSphere
from nextview.recognition.map_names import CONFIDENCE
from nextview.recognition.network_input import cloud_input
from nextview_lab.data.measures import confidence_maps, normalise_per_object
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.splits import check_any, deduplicate, split_training
from nextview_lab.data.store import ViewStore
from nextview_lab.errors import PredictionsError
from nextview_lab.extras import extras
from nextview_lab.training.architectures import map_columns, map_network, orthogonality
from nextview_lab.training.inputs import PackedViews, ready_inputs
from nextview_lab.training.recipes import Hardware, MapRecipe
from nextview_lab.training.runs import (
    OwnBatches,
    fit,
    new_run,
    optimiser,
    read_run,
    start_from,
    train_once,
)

with extras():
    import lightning as L
    import torch
    from torch import Tensor, nn
    from torch.nn import functional as F

# network inputs of N objects from V views
NetworkViews = NDArray[Any] | PackedViews


class Windows(OwnBatches):
    """Batches of inputs and maps, (B, rings, columns), taken from values, (N, V)."""

    def __init__(
        self,
        seen: NetworkViews,
        values: NDArray,
        sphere: ViewSphere,
        objects: NDArray,
        recipe: MapRecipe,
        training: bool,
    ) -> None:
        self.seen = seen
        self.values = values
        self.poses = sphere.poses
        self.objects = objects
        steps = np.array(map_columns(recipe, sphere))
        n = sphere.azimuths
        azimuths = (sphere.azimuth_index[:, None] + steps) % n
        # (V, rings, columns)
        self.around = np.arange(sphere.rings)[None, :, None] * n + azimuths[:, None, :]
        self.mirror = [list(steps % n).index(-step % n) for step in steps]
        self.recipe = recipe
        self.training = training
        self.batch = min(recipe.batch, len(objects) * recipe.views_per_object)

    def __len__(self) -> int:
        return len(self.objects) * self.recipe.views_per_object // self.batch

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor]]:
        rng = np.random.default_rng([self.recipe.seed, self.epoch])
        n = len(self) * self.batch
        v = len(self.poses)
        batch = self.batch
        # all objects equally often, and each of their views once before any is repeated
        if self.training:
            turns = np.argsort(rng.random((v, len(self.objects))), axis=0)
            views = np.resize(
                turns,
                (self.recipe.views_per_object, len(self.objects)),
            ).flatten()
            objects = np.tile(self.objects, self.recipe.views_per_object)
            order = rng.permutation(len(views))[:n]
            objects = objects[order]
            views = views[order]
        else:  # the same evenly spread views every time
            objects = np.repeat(self.objects, self.recipe.views_per_object)[:n]
            views = (np.arange(n) * 7) % v
        mirrored = rng.random(n) < 0.5 * (self.training and self.recipe.mirror)
        for here in np.arange(n).reshape(-1, batch):
            points = (
                rng.permutation(1024)[: self.recipe.points]
                if self.training
                else np.arange(1024)
            )
            o = objects[here]
            w = views[here]
            m = mirrored[here]
            seen: NDArray[Any] = np.stack(
                [self.seen[i, k] for i, k in zip(o, w, strict=True)]
            )
            target = self.values[o[:, None, None], self.around[w]]
            if self.recipe.input == "cloud":
                seen = cloud_input(seen[:, points].astype(np.float32), self.poses[w])
                # y points to the left of the camera; the cloud is mirrored about its centre.
                y = seen[m][..., 1]
                seen[m, :, 1] = y.max(1, keepdims=True) + y.min(1, keepdims=True) - y
            else:
                seen[m] = seen[m][..., ::-1]
            target[m] = target[m][..., self.mirror]
            yield torch.from_numpy(seen), torch.from_numpy(target)


def peak_loss(logits: Tensor, goal: Tensor, reach: int) -> Tensor:
    """Return the loss of the predicted peak.

    It is the mean negative log-likelihood that a cell sampled by its logit is near the true peak.

    Args:
        logits: of the cells, (B, rings, columns).
        goal: the true map, (B, rings, columns).
        reach: largest accepted distance from the true peak, cells.

    Returns:
        The loss, a scalar.
    """
    cells = torch.cartesian_prod(
        *(torch.arange(float(n), device=goal.device) for n in goal.shape[1:])
    )
    away = (cells - cells[goal.flatten(1).argmax(1), None]).norm(dim=2)
    likely = logits.flatten(1).log_softmax(1)
    return -likely.masked_fill(away > reach, -torch.inf).logsumexp(1).mean()


class MapModule(L.LightningModule):
    """AdamW on the squared error, plus the PointNet's regulariser (thesis, section 2.2.3)."""

    def __init__(self, recipe: MapRecipe, sphere: ViewSphere, steps: int) -> None:
        super().__init__()
        self.recipe = recipe
        self.steps = steps
        self.net = map_network(recipe, sphere)
        columns = [step % sphere.azimuths for step in map_columns(recipe, sphere)]
        self.window = [columns.index(step % sphere.azimuths) for step in (-1, 0, 1)]

    def forward(self, seen: Tensor) -> tuple[Tensor, ...]:
        if self.recipe.input == "cloud":
            return self.net(seen)
        return self.net((seen.float() / 255).to(memory_format=torch.channels_last))

    def training_step(self, batch: tuple[Tensor, Tensor], _: int) -> Tensor:
        """Compute the loss of a batch; see Lightning.

        Args:
            batch: inputs, (B, ...), and true maps, (B, rings, columns).
            _: number of the batch.

        Returns:
            The loss, a scalar.
        """
        predicted, *transforms = self(batch[0])
        predicted = predicted.float()
        true = batch[1]

        near = predicted[..., self.window]
        goal = true[..., self.window]
        error = F.mse_loss(near, goal)
        self.log(
            "mse",
            error,
            prog_bar=True,
            on_step=False,
            on_epoch=True,
        )

        if self.recipe.extent == "sphere":
            error = (error + F.mse_loss(predicted, true)) / 2
        if self.recipe.peak_weight:
            lost = peak_loss(
                near / self.recipe.peak_sharpness,
                goal,
                self.recipe.peak_reach,
            )
            error = error + self.recipe.peak_weight * lost

        return error + self.recipe.orthogonality_weight * sum(
            orthogonality(t.float()) for t in transforms
        )

    def validation_step(self, batch: tuple[Tensor, Tensor], _: int) -> None:
        """Log the squared error of a batch; see Lightning.

        Args:
            batch: inputs, (B, ...), and true maps, (B, rings, columns).
            _: number of the batch.
        """
        error = F.mse_loss(
            self(batch[0])[0].float()[..., self.window],
            batch[1][..., self.window],
        )
        self.log(
            "validation_mse",
            error,
            prog_bar=True,
            batch_size=len(batch[1]),
        )

    def configure_optimizers(self) -> dict[str, Any]:
        return optimiser(self.parameters(), self.recipe, self.steps, 0.1)


def train_map(
    store: Path,
    out: Path,
    predictions: Path | None = None,
    weights: Path | None = None,
    recipe: MapRecipe = MapRecipe(),
    hardware: Hardware = Hardware(),
    track: TrackProgress = silently,
) -> list[Path]:
    """Train a network that predicts a measure of the surrounding views from one view.

    An interrupted run resumes.

    Args:
        store: view store made by nextview-lab render, with the 40 views and the measure
            (nextview-lab measure).
        out: folder for checkpoints, logs and network.pt, the network of the epoch with the lowest
            squared error.
        predictions: for --measure confidence: predictions of the store's training split by the
            recogniser whose confidence is to be predicted.
        weights: folder of a finished run whose weights initialise a ResNet of the same depth and
            input: that of a recogniser, or that of a map network to continue.

    Raises:
        DatasetError: the store lacks required data, or another process trains in the same folder.
        ModelError, PredictionsError: weights or predictions cannot be used; or ``out`` contains
            another run.
    """
    views = ViewStore.open(store)
    predicted = None if predictions is None else Predictions.load(predictions)
    values, there = target_of(recipe.measure, views, predicted)
    aside = split_training(views, recipe.validation_share, recipe.seed)
    training, validation = (part[there[part]] for part in aside)
    check_any(
        views,
        training,
        validation,
        "" if there.all() else ": of the others no map is known",
    )
    held_out = [views.names[i] for i in aside[1]]  # including objects without values
    run = new_run(
        recipe,
        weights,
        held_out,
        [views] if predicted is None else [views, predicted],
    )
    parts = training, deduplicate(views, validation)  # copies of one mesh count once

    def fitted() -> nn.Module:
        cloud = recipe.input == "cloud"
        seen = (
            views.rows("points")
            if cloud
            else ready_inputs(store, recipe.size, recipe.input, track)
        )

        windows, judging = (
            Windows(seen, values, views.sphere, part, recipe, part is training)
            for part in parts
        )

        L.seed_everything(recipe.seed, verbose=False)
        module = MapModule(recipe, views.sphere, recipe.epochs * len(windows))
        if weights and cloud:
            raise ModelError(f"{weights}: a PointNet cannot start from a ResNet")
        if weights:
            start_from(
                module.net.resnet,
                weights,
                head=weights.is_dir() and "measure" in read_run(weights).recipe,
            )

        return fit(
            module,
            windows,
            judging,
            out,
            "validation_mse",
            "min",
            hardware,
        ).net.eval()

    train_once(out, run, fitted)
    return [out]


def target_of(
    measure: str,
    store: ViewStore,
    predictions: Predictions | None = None,
) -> tuple[NDArray, NDArray]:
    """Return the target values of a map network.

    Args:
        measure: name of the measure, or "confidence".
        store: the view store.
        predictions: of its objects; for the confidence only.

    Returns:
        Values of all views, (N, V), scaled to 0 to 1 over each object's views (the confidence is
        not scaled); and the objects that have values, (N,) bool.

    Raises:
        UsageError: there are no predictions for the confidence, or predictions for another measure.
    """
    if (measure == CONFIDENCE) != (predictions is not None):
        alone = (
            f"a map of {measure} is learned from the store alone: predictions are for a map of the"
            f" {CONFIDENCE}"
        )
        of_them = (
            "a map of the confidence is learned from predictions: "
            "give those of the recogniser"
        )
        raise UsageError(of_them if predictions is None else alone)

    if predictions is None:
        return normalise_per_object(store.measure(measure)), store.done

    here = store.rows_of(predictions.names)
    if (here < 0).all() or predictions.sphere != store.sphere:
        raise PredictionsError(
            f"these predictions are not of the views of {store.path}"
        )

    values = np.zeros((len(store), len(store.sphere)), np.float32)
    values[here[here >= 0]] = confidence_maps(predictions.logits, predictions.labels)[
        here >= 0
    ]
    return values, values.any(1) & store.done
