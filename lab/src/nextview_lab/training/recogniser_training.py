"""Train a recogniser from a view store."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.data.progress import TrackProgress, silently
from nextview.errors import DatasetError
from nextview.types import Float, Float32, Index
from nextview_lab.data.rendering import rotations
from nextview_lab.data.splits import check_any, deduplicate, split_training
from nextview_lab.data.store import ViewStore
from nextview_lab.extras import extras
from nextview_lab.training.architectures import recogniser_network
from nextview_lab.training.inputs import PackedViews, ready_inputs
from nextview_lab.training.recipes import Hardware, RecogniserRecipe
from nextview_lab.training.runs import (
    OwnBatches,
    fit,
    interpolate,
    new_run,
    optimiser,
    start_from,
    train_once,
)

with extras():
    import lightning as L
    import torch
    from torch import Tensor, nn
    from torch.nn import functional as F


@dataclass(frozen=True)
class StoredInputs:
    """Inputs of training objects, from their own store or from one of deformed copies.

    Attributes:
        inputs: (rows, V, C, S, S).
        row: row of each object in the inputs, -1 for none.
        azimuth_bins: (rows, V).
    """

    inputs: NDArray[np.uint8] | PackedViews
    row: Index
    azimuth_bins: Float32 | None = None


class Views(OwnBatches):
    """Batches of input, (B, C, S, S) uint8, label and azimuth bin, drawn anew in each epoch."""

    def __init__(
        self,
        sources: list[StoredInputs],
        objects: Index,
        labels: Index,
        recipe: RecogniserRecipe,
    ) -> None:
        self.sources = sources
        self.objects = objects
        self.labels = labels
        self.recipe = recipe
        count = np.bincount(labels[objects])[labels[objects]]
        self.weights = count**-0.5 / (count**-0.5).sum()
        views = (
            recipe.views_per_object
            if recipe.balanced
            else min(recipe.views_per_object, sources[0].inputs.shape[1])
        )
        self.drawn = len(objects) * views
        self.batch = min(recipe.batch, self.drawn)

    def __len__(self) -> int:
        return self.drawn // self.batch

    def __iter__(self) -> Iterator[tuple[Tensor, ...]]:
        rng = np.random.default_rng(
            [self.recipe.seed, self.epoch, self.recipe.ensemble_seed]
        )
        n = len(self) * self.batch
        v = self.sources[0].inputs.shape[1]
        if self.recipe.balanced:
            objects = rng.choice(self.objects, n, p=self.weights)
            turn = rng.random(n)  # selects the view, as a share of all views
        else:
            objects, views = np.divmod(rng.permutation(len(self.objects) * v)[:n], v)
            objects = self.objects[objects]
            turn = (views + 0.5) / v
        deformed = (rng.random(n) < self.recipe.deformed_share) & (
            len(self.sources) > 1
        )
        source = np.where(deformed, rng.integers(1, max(2, len(self.sources)), n), 0)
        rows = np.stack([own.row for own in self.sources])
        source[rows[source, objects] < 0] = 0
        row = rows[source, objects]
        view = (
            turn * np.array([own.inputs.shape[1] for own in self.sources])[source]
        ).astype(int)

        for batch in np.arange(n).reshape(-1, self.batch):
            images = [self.sources[source[k]].inputs[row[k], view[k]] for k in batch]
            drawn = [np.stack(images), self.labels[objects[batch]]]
            if self.sources[0].azimuth_bins is not None:
                drawn.append(
                    np.array(
                        [
                            self.sources[source[k]].azimuth_bins[row[k], view[k]]
                            for k in batch
                        ]
                    )
                )
            yield tuple(map(torch.from_numpy, drawn))


def augment(x: Tensor) -> tuple[Tensor, Tensor]:
    """Mirror, shift, stretch, roll, hide and add noise to inputs, (B, C, S, S) in 0 to 1.

    Also returns which inputs were mirrored.
    """
    b, _, _, s = x.shape
    on = {"device": x.device}
    scale = torch.empty(b, 2, **on).uniform_(0.8, 1.25)
    mirrored = torch.randint(0, 2, (b,), **on) == 0
    scale[:, 0] *= torch.where(mirrored, -1.0, 1.0)
    roll = torch.empty(b, **on).normal_(0, 0.05)
    theta = torch.zeros(b, 2, 3, **on)
    theta[:, 0, 0] = scale[:, 0] * roll.cos()
    theta[:, 0, 1] = -scale[:, 0] * roll.sin()
    theta[:, 1, 0] = scale[:, 1] * roll.sin()
    theta[:, 1, 1] = scale[:, 1] * roll.cos()
    theta[:, :, 2] = torch.empty(b, 2, **on).uniform_(-0.1, 0.1)
    x = F.grid_sample(
        x,
        F.affine_grid(theta, list(x.shape), align_corners=False),
        align_corners=False,
    )
    # A rectangle of background in half of the images, to simulate occlusion.
    side = torch.empty(b, 2, **on).uniform_(0.1, 0.4)
    corner = torch.rand(b, 2, **on) * (1 - side)
    grid = (torch.arange(s, **on) + 0.5) / s
    rows = (grid > corner[:, :1]) & (grid < corner[:, :1] + side[:, :1])
    columns = (grid > corner[:, 1:]) & (grid < corner[:, 1:] + side[:, 1:])
    hidden = (
        rows[:, :, None] & columns[:, None, :] & (torch.rand(b, 1, 1, **on) < 0.5)
    )[:, None]
    seen = (x > 0) & ~hidden
    return torch.where(seen, x + 0.02 * torch.randn_like(x), 0.0), mirrored


class RecogniserModule(L.LightningModule):
    """AdamW on cross-entropy; validates on the class mean of single-view accuracy."""

    def __init__(
        self,
        recipe: RecogniserRecipe,
        classes: int,
        steps: int,
        azimuths: int = 0,
    ) -> None:
        super().__init__()
        self.recipe = recipe
        self.steps = steps
        self.net = recogniser_network(recipe, classes, azimuths).to(
            memory_format=torch.channels_last
        )
        for name in ("hits", "seen", "lost"):  # per class in validation
            self.register_buffer(name, torch.zeros(classes), persistent=False)

    def training_step(self, batch: tuple[Tensor, ...], _: int) -> Tensor:
        """Compute the loss of a batch; see Lightning.

        Args:
            batch: inputs, (B, C, S, S) uint8, classes, (B,), and azimuth bins, (B,), if they are
                learned.
            _: number of the batch.

        Returns:
            The loss, a scalar.
        """
        x = batch[0].float() / 255
        label = batch[1]
        mirrored = torch.zeros_like(label, dtype=torch.bool)

        if self.recipe.augment:
            x, mirrored = augment(x)
        x = x.to(memory_format=torch.channels_last)
        logits, *likely = self.net(x)

        loss = F.cross_entropy(
            logits.float(),
            label,
            label_smoothing=self.recipe.smoothing,
        )
        if likely:
            lost = side_loss(
                likely[0].float(),
                label,
                torch.where(mirrored, -batch[2] % likely[0].shape[2], batch[2]),
            )
            self.log(
                "side_loss",
                lost,
                on_step=False,
                on_epoch=True,
                batch_size=len(x),
            )
            loss = loss + self.recipe.azimuth_bins_weight * lost

        self.log(
            "loss",
            loss,
            prog_bar=True,
            on_step=False,
            on_epoch=True,
            batch_size=len(x),
        )
        return loss

    def validation_step(self, batch: tuple[Tensor, Tensor], _: int) -> None:
        """Count the right answers and the loss of a batch; see Lightning.

        Args:
            batch: inputs, (B, C, S, S) uint8, and classes, (B,).
            _: number of the batch.
        """
        x = (batch[0].float() / 255).to(memory_format=torch.channels_last)
        logits = self.net(x)[0].float()
        label = batch[1]
        right = (logits.argmax(1) == label).float()
        self.hits.scatter_add_(0, label, right)
        self.seen.scatter_add_(0, label, torch.ones_like(right))
        self.lost.scatter_add_(
            0,
            label,
            F.cross_entropy(logits, label, reduction="none"),
        )

    def on_validation_epoch_end(self) -> None:
        shares = (self.hits / self.seen)[self.seen > 0]
        self.log("class_accuracy", shares.mean(), prog_bar=True)
        self.log("validation_loss", self.lost.sum() / self.seen.sum())
        for total in (self.hits, self.seen, self.lost):
            total.zero_()

    def configure_optimizers(self) -> dict[str, Any]:
        plain = [p for p in self.net.parameters() if p.ndim <= 1]
        groups = [
            {"params": [p for p in self.net.parameters() if p.ndim > 1]},
            {"params": plain, "weight_decay": 0.0},
        ]
        return optimiser(groups, self.recipe, self.steps, 0.5)


class ValidationViews(OwnBatches):
    """Every fifth view of the validation objects, with an offset of one from object to object."""

    def __init__(
        self,
        inputs: NDArray[np.uint8] | PackedViews,
        objects: Index,
        labels: Index,
    ) -> None:
        self.inputs = inputs
        self.objects = objects
        self.labels = labels

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor]]:
        for k, i in enumerate(self.objects):
            views = self.inputs[i, k % 5 :: 5]
            yield (
                torch.from_numpy(views),
                torch.full((len(views),), int(self.labels[i])),
            )


def fit_recogniser(
    sources: list[StoredInputs],
    labels: Index,
    parts: tuple[Index, Index],
    recipe: RecogniserRecipe,
    out: Path,
    weights: Path | None = None,
    hardware: Hardware = Hardware(),
    azimuths: int = 0,
) -> nn.Module:
    """Train a recogniser and return the network of its best epoch.

    Checkpoints are kept in ``out``, from which a second call resumes.

    Args:
        sources: inputs of the store, and of deformed stores of the same objects.
        labels: class of each object, (N,) int64.
        parts: rows of the training and of the validation objects.
        recipe: of the training.
        out: folder of the run.
        weights: file or run with the initial weights; None for random ones.
        hardware: device and precision.
        azimuths: number of azimuth bins; 0 for none.

    Returns:
        The network.
    """
    own = np.random.SeedSequence([recipe.seed, recipe.ensemble_seed])
    L.seed_everything(int(own.generate_state(1)[0]), verbose=False)
    views = Views(sources, parts[0], labels, recipe)
    module = RecogniserModule(
        recipe,
        int(labels.max()) + 1,
        recipe.epochs * len(views),
        azimuths,
    )
    if weights:
        start_from(module.net, weights)
    start = {name: values.clone() for name, values in module.net.state_dict().items()}
    validation = ValidationViews(sources[0].inputs, parts[1], labels)
    best = fit(module, views, validation, out, "class_accuracy", "max", hardware)
    interpolate(best.net, start, recipe.interpolation)

    return best.net.eval()


def mirror_planes(store: ViewStore, objects: Index) -> Float:
    """Find the plane of symmetry of each class.

    Args:
        store: the view store.
        objects: rows of the objects to use.

    Returns:
        Azimuth of each plane in steps of the store's viewpoints, (classes,) float64.
    """
    n = store.sphere.azimuths
    measured = store.measure()[objects].reshape(len(objects), -1, n).astype(np.float64)
    measured -= measured.mean((1, 2), keepdims=True)
    # the plane through a view also contains the opposite view
    planes = range(max(1, n // 2))
    mirrored = [measured[:, :, (2 * plane - np.arange(n)) % n] for plane in planes]
    symmetry = np.stack([(measured * image).sum((1, 2)) for image in mirrored], 1)
    of_class = [
        symmetry[store.labels[objects] == c].sum(0) for c in range(len(store.classes))
    ]
    return np.argmax(of_class, 1).astype(np.float64)


def azimuth_bins(store: ViewStore, azimuths: int, planes: Float) -> Float32:
    """Return the azimuth bin of each view of each object.

    Args:
        store: the view store.
        azimuths: number of bins.
        planes: of the classes, see ``mirror_planes``.

    Returns:
        Bins, (N, V) float32, from 0 to below ``azimuths``; fractions lie between two bins.
    """
    sphere = store.sphere
    steps = sphere.azimuth_index * (azimuths / sphere.azimuths)
    rotated = rotations(store) * azimuths / (2 * np.pi) + planes[store.labels]
    return ((steps - rotated[:, None]) % azimuths).astype(np.float32)


def side_loss(likely: Tensor, label: Tensor, side: Tensor) -> Tensor:
    """Return the mean cross-entropy of the azimuth bin, given the true class.

    Azimuths between two bins are weighted linearly.

    Args:
        likely: log-probabilities of the bins, (B, classes, bins).
        label: true classes, (B,).
        side: true bins, (B,), with fractions.

    Returns:
        The loss, a scalar.
    """
    own = likely[torch.arange(len(label), device=label.device), label]
    low = side.floor().long()[:, None]
    n = own.shape[1]
    share = side[:, None] - low
    return -(
        (1 - share) * own.gather(1, low % n) + share * own.gather(1, (low + 1) % n)
    ).mean()


def train_recogniser(
    store: Path,
    out: Path,
    deformed: tuple[Path, ...] = (),
    weights: Path | None = None,
    recipe: RecogniserRecipe = RecogniserRecipe(),
    hardware: Hardware = Hardware(),
    track: TrackProgress = silently,
) -> list[Path]:
    """Train the recogniser on the training split of a store.

    An interrupted run resumes.

    Args:
        store: view store made by nextview-lab render.
        out: folder for checkpoints, logs and network.pt, the network of the epoch with the best
            class mean.
        deformed: stores of the same objects or some of them, stretched and rotated (nextview-lab
            render --stretch .25 --rotated --seed 1 and so on) or through sensors (--sensor mix);
            they may have other viewpoints.
        weights: published checkpoint that initialises the network (torchvision's of the same depth,
            or EfficientNet-Lite0's), or folder of a run to continue, on other data or for longer.

    Raises:
        DatasetError: a store cannot be used, or another process trains in the same folder.
        ModelError: the weights cannot be used, or were trained on validation objects; or ``out``
            contains another run.
    """
    views = ViewStore.open(store)
    training, validation = split_training(views, recipe.validation_share, recipe.seed)
    check_any(views, training, validation)
    validating = deduplicate(views, validation)  # copies of one mesh count once
    azimuths = 0
    planes = None
    if recipe.azimuth_bins_weight:
        azimuths = views.sphere.azimuths
        planes = mirror_planes(views, training)
    stores = [views, *map(ViewStore.open, deformed)]
    run = new_run(recipe, weights, [views.names[i] for i in validation], stores)
    sources = [_source(each, views, training, recipe, planes, track) for each in stores]
    fitted = (
        sources,
        views.labels,
        (training, validating),
        recipe,
        out,
        weights,
        hardware,
        azimuths,
    )
    train_once(out, run, partial(fit_recogniser, *fitted))

    return [out]


def _source(
    store: ViewStore,
    views: ViewStore,
    needed: Index,
    recipe: RecogniserRecipe,
    planes: Float | None,
    track: TrackProgress,
) -> StoredInputs:
    """Return the inputs of a store, and the row of each object of ``views``, -1 for none."""
    rows = store.rows_of(views.names)
    if (rows[needed] < 0).all():
        raise DatasetError(f"{store.path}: holds none of the training objects")
    inputs = ready_inputs(store.path, recipe.size, recipe.input, track)
    return StoredInputs(
        inputs,
        rows,
        None if planes is None else azimuth_bins(store, views.sphere.azimuths, planes),
    )
