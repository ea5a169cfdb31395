"""The training run that all networks share: devices, checkpoints, early stopping, logs, exact epochs after a resume."""

import csv
import io
import logging
import time
import warnings
from pathlib import Path
from typing import Any, Literal

import lightning as L
import numpy as np
import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO
from lightning.fabric.utilities.rank_zero import rank_zero_only
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint
from torch.utils.data import DataLoader, IterableDataset

from nextview.errors import ModelError
from nextview.files import new_file
from nextview.learning.recipes import Hardware


class OwnBatches(IterableDataset):
    """A data set that makes its own batches, from the epoch and the share of each batch that is this device's."""

    epoch = 0
    share = slice(None)


class Batches(L.LightningDataModule):
    """Sets of training and validation, each of which makes its own batches."""

    def __init__(self, training: IterableDataset, validation: IterableDataset) -> None:
        super().__init__()
        self.training, self.validation = training, validation

    def setup(self, stage: str) -> None:
        self.training.share = self.validation.share = slice(self.trainer.global_rank, None, self.trainer.world_size)

    def train_dataloader(self) -> DataLoader:
        self.training.epoch = self.trainer.current_epoch
        return _loader(self.training)

    def val_dataloader(self) -> DataLoader:
        return _loader(self.validation)


def _loader(batches: IterableDataset) -> DataLoader:
    gpu = torch.cuda.is_available()  # on a CPU a batch takes milliseconds to make, and a second to learn from
    ahead: dict[str, Any] = {"num_workers": 1, "prefetch_factor": 4, "pin_memory": True} if gpu else {}
    return DataLoader(batches, batch_size=None, **ahead)


class StepSeed(L.Callback):
    """Seeds torch by epoch, step and device, so that a resumed run augments as an uninterrupted one would."""

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        step = [pl_module.recipe.seed, trainer.current_epoch, batch_idx, trainer.global_rank]
        torch.manual_seed(int(np.random.SeedSequence(step).generate_state(1, np.uint64)[0]))


class WholeCheckpoints(TorchCheckpointIO):
    """Lightning moves checkpoints from the system's temporary folder: a kill in that copy would cost the old one."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        save_whole(checkpoint, Path(path))


def save_whole(values: dict[str, Any], path: Path) -> None:
    """Write what torch can, whole or not at all."""
    written = io.BytesIO()
    torch.save(values, written)  # into a file it would turn a full disk into a RuntimeError
    with new_file(path, overwrite=True) as part:
        part.write_bytes(written.getbuffer())


def read_checkpoint(path: Path) -> dict[str, Any]:
    """What ``save_whole`` wrote, by torch's reader that makes nothing but tensors and containers."""
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise ModelError(f"{path}: there is no such checkpoint") from None
    except Exception as error:  # a damaged or foreign file raises whatever the reader stumbles over
        what = f"a damaged checkpoint or one that torch cannot read safely ({type(error).__name__})"
        raise ModelError(f"{path}: {what}; give another, or delete it to begin this training anew") from None


class Log(L.Callback):
    """A row for every epoch in log/metrics.csv and in the checkpoint; Lightning's own log begins anew on a resume."""

    def __init__(self, out: Path) -> None:
        self.path, self.rows = out / "log/metrics.csv", list[dict[str, float]]()

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.began = time.perf_counter()

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        row = {"epoch": trainer.current_epoch + 1, "step": trainer.global_step}
        row |= {name: float(value) for name, value in trainer.callback_metrics.items()}
        row["rate"] = trainer.optimizers[0].param_groups[0]["lr"]
        row["seconds"] = round(time.perf_counter() - self.began, 3)
        self.rows.append(row)
        if trainer.is_global_zero:
            with new_file(self.path, overwrite=True) as part, part.open("w", newline="") as file:
                table = csv.DictWriter(file, list(self.rows[0]))
                table.writeheader()
                table.writerows(self.rows)

    def state_dict(self) -> dict[str, Any]:
        return {"rows": self.rows}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.rows = state_dict["rows"]


class Checkpoint(ModelCheckpoint):
    """Keeps the best epoch by a score, or the last one; the folder may have been moved since."""

    def __init__(self, out: Path, name: str, select: str | None = None, mode: str = "min") -> None:
        super().__init__(out, name, monitor=select, mode=mode, enable_version_counter=False)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict | {"dirpath": self.dirpath})


class Patience(EarlyStopping):
    """Stops when the score has not improved for so many epochs; a run that was stopped so stays stopped."""

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        trainer.should_stop = self.wait_count >= self.patience


def fit(
    module: L.LightningModule,
    training: IterableDataset,
    validation: IterableDataset,
    out: Path,
    select: str,
    mode: Literal["min", "max"],
    hardware: Hardware = Hardware(),
) -> L.LightningModule:
    """Train a module by its ``recipe`` and return it as it was after its best epoch."""
    recipe: Any = module.recipe
    # The last checkpoint comes last: it holds the states of the others.
    callbacks = [StepSeed(), Log(out), Checkpoint(out, "best", select, mode), Checkpoint(out, "last")]
    if recipe.patience:
        callbacks.append(Patience(select, patience=recipe.patience, mode=mode, verbose=False))
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    with warnings.catch_warnings():
        # All of them describe what is meant here: a run that resumes, and data sets that make their own batches.
        warnings.filterwarnings("ignore", module="lightning")
        warnings.filterwarnings("ignore", message=".*LeafSpec")
        trainer = L.Trainer(
            max_epochs=recipe.epochs,
            precision=hardware.precision,
            accelerator=hardware.accelerator,
            devices=hardware.devices,
            # Batch norm sees the whole batch, as on one device; torch has this for GPUs alone.
            sync_batchnorm=hardware.devices > 1 and hardware.accelerator != "cpu" and torch.cuda.is_available(),
            logger=False,
            callbacks=callbacks,
            plugins=[WholeCheckpoints()],
            enable_model_summary=False,
            num_sanity_val_steps=0,
            reload_dataloaders_every_n_epochs=1,
            log_every_n_steps=1,
        )
        last, best = out / "last.ckpt", out / "best.ckpt"
        resume = last if last.exists() and read_checkpoint(last) else None
        try:
            # Numbers too small for the normal format are slow on CPUs and mean nothing here.
            torch.set_flush_denormal(True)
            trainer.fit(module, datamodule=Batches(training, validation), ckpt_path=resume, weights_only=True)
        finally:
            torch.set_flush_denormal(False)  # it holds for the whole process
    # Too few objects for one batch of validation leave nothing to choose by: the last epoch is kept.
    module.load_state_dict(read_checkpoint(best if best.exists() else last)["state_dict"])
    return module


def optimiser(parameters: Any, recipe: Any, steps: int, falls: float) -> dict[str, Any]:
    """AdamW, by one cycle over all steps, or with a rate that falls to such a part every fifth epoch."""
    adam = torch.optim.AdamW(parameters, lr=recipe.lr, weight_decay=recipe.weight_decay)
    if recipe.schedule == "one-cycle":
        cycle = torch.optim.lr_scheduler.OneCycleLR(adam, recipe.lr, steps, pct_start=0.2)
        return {"optimizer": adam, "lr_scheduler": {"scheduler": cycle, "interval": "step"}}
    stairs = torch.optim.lr_scheduler.StepLR(adam, step_size=5, gamma=falls)
    return {"optimizer": adam, "lr_scheduler": {"scheduler": stairs, "interval": "epoch"}}


def is_first() -> bool:
    """Whether this process is the one of a training's that writes for all of them."""
    return rank_zero_only.rank == 0
