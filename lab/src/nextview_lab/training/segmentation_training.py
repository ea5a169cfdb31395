"""Train the segmentation network on simulated frames with labels."""

import math
from collections.abc import Iterator, Sequence
from copy import deepcopy
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from nextview.data.progress import TrackProgress, silently
from nextview.errors import ModelError
from nextview.segmentation.network import (
    AFFINITY_OUTPUTS,
    OUTPUT_CLASSES,
    SegmentationNetwork,
    load_network,
)
from nextview_lab.data.labelled_frames import (
    UNKNOWN_CLASS,
    Example,
    FrameFile,
    LabelledFrames,
    WorldMeshes,
    draw_frames,
    frame_files,
)
from nextview_lab.extras import extras
from nextview_lab.training.architectures import SegmentationNet
from nextview_lab.training.recipes import Hardware, SegmentationRecipe
from nextview_lab.training.runs import OwnBatches, fit, interpolate, new_run, train_once

with extras():
    import lightning as L
    import onnx
    import torch
    from torch import Tensor, nn
    from torch.nn import functional as F

FILES_AT_ONCE = 6  # files in memory, whose frames are shuffled together
WARM_UP = 200  # steps of the warm-up, at most a tenth of all
LAST_RATE = 0.01  # last learning rate, relative to the peak
CLASS_WEIGHT = 2.0  # of the class loss, relative to that of pairs
BORDER_WEIGHT = 4.0  # of pairs of different objects, which are rare
LARGEST_GRADIENT = 5.0
BATCHES_NORMED = 16  # whose statistics the batch norms of an exported network get


class LabelledBatches(OwnBatches):
    """Batches of frames: shuffled, mirrored and with a random up direction, or unchanged."""

    def __init__(
        self,
        files: Sequence[FrameFile],
        recipe: SegmentationRecipe,
        vary: bool,
    ) -> None:
        self.files = files
        self.recipe = recipe
        self.vary = vary

    def __iter__(self) -> Iterator[tuple[Tensor, ...]]:
        rng = np.random.default_rng([self.recipe.seed, 3, self.epoch])
        order = list(range(len(self.files)))
        if self.vary:
            order = rng.permutation(order).tolist()
        for start in range(0, len(order), FILES_AT_ONCE):
            some = [self.files[k].path for k in order[start : start + FILES_AT_ONCE]]
            frames = LabelledFrames.load(some)
            drawn = (
                rng.permutation(len(frames)) if self.vary else np.arange(len(frames))
            )
            for batch in np.array_split(drawn, self.batches(len(frames))):
                seeds = rng.integers(2**63, size=len(batch))
                yield batch_of(
                    [
                        frames.example(
                            int(index),
                            np.random.default_rng(seed) if self.vary else None,
                        )
                        for index, seed in zip(batch, seeds, strict=True)
                    ]
                )

    def batches(self, frames: int) -> int:
        """Return the number of batches for a number of frames."""
        return max(1, frames // self.recipe.batch)

    @property
    def steps(self) -> int:
        """Number of batches per epoch."""
        counts = [file.frames for file in self.files]
        starts = range(0, len(counts), FILES_AT_ONCE)
        return sum(self.batches(sum(counts[k : k + FILES_AT_ONCE])) for k in starts)


def batch_of(examples: Sequence[Example]) -> tuple[Tensor, ...]:
    """Stack examples; the order is that of the attributes of ``Example``.

    Args:
        examples: of images with the same size.
    """
    rows = zip(*(vars(example).values() for example in examples), strict=True)
    return tuple(torch.from_numpy(np.stack(row)) for row in rows)


def segmentation_losses(output: Tensor, batch: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Compute the losses of classes and pairs.

    Args:
        output: of the network, (B, 15, h, w).
        batch: see ``batch_of``.

    Returns:
        Two scalars.
    """
    _, classes, same, compared = batch
    of_classes = F.cross_entropy(
        output[:, : len(OUTPUT_CLASSES)], classes, ignore_index=UNKNOWN_CLASS
    )
    lost = F.binary_cross_entropy_with_logits(
        output[:, AFFINITY_OUTPUTS], same, reduction="none"
    )
    lost = lost * (BORDER_WEIGHT + (1 - BORDER_WEIGHT) * same)
    of_pairs = (lost * compared).sum() / compared.sum().clamp(min=1e-6)
    return of_classes, of_pairs


class SegmentationModule(L.LightningModule):
    """AdamW on the losses of classes and pairs; validates on their sum."""

    def __init__(self, recipe: SegmentationRecipe, steps: int) -> None:
        super().__init__()
        self.recipe = recipe
        self.steps = steps
        self.net = SegmentationNet(recipe.width).to(memory_format=torch.channels_last)

    def _loss(self, batch: Sequence[Tensor], prefix: str) -> Tensor:
        output = self.net(batch[0].to(memory_format=torch.channels_last)).float()
        parts = segmentation_losses(output, batch)
        loss = CLASS_WEIGHT * parts[0] + parts[1]
        names = ("loss", "class_loss", "pair_loss")
        self.log_dict(
            {
                f"{prefix}{name}": value
                for name, value in zip(names, (loss, *parts), strict=True)
            },
            on_step=False,
            on_epoch=True,
            batch_size=len(output),
        )
        return loss

    def training_step(self, batch: tuple[Tensor, ...], _: int) -> Tensor:
        """Compute the loss of a batch; see Lightning.

        Args:
            batch: see ``batch_of``.
            _: number of the batch.

        Returns:
            The loss, a scalar.
        """
        return self._loss(batch, "")

    def validation_step(self, batch: tuple[Tensor, ...], _: int) -> None:
        """Log the loss of a batch; see Lightning.

        Args:
            batch: see ``batch_of``.
            _: number of the batch.
        """
        self._loss(batch, "validation_")

    def on_before_optimizer_step(self, optimizer: Any) -> None:
        nn.utils.clip_grad_norm_(self.parameters(), LARGEST_GRADIENT)

    def configure_optimizers(self) -> dict[str, Any]:
        adam = torch.optim.AdamW(
            self.net.parameters(),
            self.recipe.lr,
            weight_decay=self.recipe.weight_decay,
        )
        rate = torch.optim.lr_scheduler.LambdaLR(adam, partial(rate_at, self.steps))
        return {
            "optimizer": adam,
            "lr_scheduler": {"scheduler": rate, "interval": "step"},
        }


def rate_at(steps: int, step: int) -> float:
    """Return the learning rate of a step as a share of the peak: warm-up, then cosine decay.

    Args:
        steps: of the whole training.
        step: number of the step, from 0.
    """
    rise = min(WARM_UP, max(1, steps // 10))
    fall = 0.5 * (1 + math.cos(math.pi * min(1.0, step / steps)))
    return min(1.0, (step + 1) / rise) * (LAST_RATE + (1 - LAST_RATE) * fall)


def start_from_export(
    network: SegmentationNet, exported: SegmentationNetwork, features: Tensor
) -> None:
    """Load the weights of an exported network, whose batch norms are folded into convolutions.

    Each batch norm gets the statistics of its input, and undoes them: the outputs are the same.

    Args:
        network: the network, which is changed.
        exported: an exported network of the same width.
        features: of some frames, (B, C, h, w).

    Raises:
        ModelError: the exported network has another width.
    """

    def undo(norm: nn.BatchNorm2d, inputs: tuple[Tensor, ...]) -> None:
        var, mean = torch.var_mean(inputs[0], (0, 2, 3), correction=0)
        norm.running_var, norm.running_mean = var, mean
        norm.weight.data = (var + norm.eps).sqrt()
        norm.bias.data += mean

    stored = {
        weight.name.removesuffix("_small"): onnx.numpy_helper.to_array(weight)
        for weight in onnx.load(exported.path).graph.initializer
    }
    for name, value in network.named_parameters():
        if name.endswith(".1.weight"):
            continue  # the scale of a batch norm
        values = stored[
            name.replace(".0.weight", ".weight").replace(".1.bias", ".bias")
        ]
        if values.shape != value.shape:
            raise ModelError(f"{exported.path}: has another width; give its --width")
        value.data.copy_(torch.from_numpy(values.astype(np.float32)))

    norms = [one for one in network.modules() if isinstance(one, nn.BatchNorm2d)]
    hooks = [norm.register_forward_pre_hook(undo) for norm in norms]
    with torch.no_grad():
        network.eval()(features)
    for hook in hooks:
        hook.remove()
    network.train()


def files_of(run: Path, recipe: SegmentationRecipe) -> list[list[FrameFile]]:
    """Return the files of training frames, and of validation frames.

    Args:
        run: folder of the run.
        recipe: of the training.
    """
    validating = max(1, round(recipe.validation_share * recipe.frames))
    return [
        frame_files(run / "frames" / part, frames, (recipe.seed, number))
        for number, (part, frames) in enumerate(
            (("training", recipe.frames), ("validation", validating))
        )
    ]


def train_segmentation(
    out: Path,
    meshes: Path | None = None,
    furniture: Path | None = None,
    start: Path | None = None,
    workers: int | None = None,
    recipe: SegmentationRecipe = SegmentationRecipe(),
    hardware: Hardware = Hardware(),
    track: TrackProgress = silently,
) -> Path:
    """Train the network that segments frames into objects, on simulated frames.

    The frames show generated solids on tables, floors, shelves and belts and in bins. They are
    generated first, into OUT/frames. An interrupted run resumes.

    Args:
        out: folder for frames, checkpoints, logs and network.pt, the network of the epoch with the
            lowest validation loss.
        meshes: folder of further objects, of any size; if it has splits, the training split is
            used.
        furniture: folder of furniture with ModelNet10 classes, for rooms and backgrounds.
        start: card of an exported network whose weights are the initial ones, with the same
            --validation-share and --seed, so that its validation meshes remain unseen.
        workers: number of processes that generate frames; by default one per core.

    Raises:
        DatasetError: a folder cannot be used, or another process trains in the same folder.
        ModelError: ``out`` contains another run.
    """
    used, held_out = WorldMeshes.of(meshes, furniture).divided(
        recipe.validation_share, recipe.seed
    )
    exported = None if start is None else load_network(start)
    run = new_run(
        recipe,
        None if exported is None else exported.path,
        held_out.names,
        [] if exported is None else [exported.card],
    )

    def trained() -> nn.Module:
        files = files_of(out, recipe)
        for part, shown, what in zip(
            files, (used, held_out), ("training", "validation"), strict=True
        ):
            drawn = draw_frames(part, shown, workers)
            track(
                (done for done, _ in drawn),
                len(part),
                f"drawing files of frames for {what}",
            )
        return fit_segmentation(files, recipe, out, hardware, exported)

    train_once(out, run, trained)
    return out


def fit_segmentation(
    files: Sequence[Sequence[FrameFile]],
    recipe: SegmentationRecipe,
    out: Path,
    hardware: Hardware = Hardware(),
    exported: SegmentationNetwork | None = None,
) -> SegmentationNet:
    """Train a network on generated frames.

    Args:
        files: training files, and validation files.
        recipe: of the training.
        out: folder of the run.
        hardware: device and precision.
        exported: network whose weights are the initial ones; None for random ones.

    Returns:
        The network of the epoch with the lowest validation loss.
    """
    training, validation = (
        LabelledBatches(part, recipe, vary)
        for part, vary in zip(files, (True, False), strict=True)
    )
    torch.manual_seed(recipe.seed)
    module = SegmentationModule(recipe, recipe.epochs * training.steps)
    if exported is not None:
        some = [batch[0] for batch in islice(training, BATCHES_NORMED)]
        start_from_export(module.net, exported, torch.cat(some))
    start = deepcopy(module.net.state_dict())
    best = fit(module, training, validation, out, "validation_loss", "min", hardware)
    interpolate(best.net, start, recipe.interpolation)
    return best.net.eval()
