"""The training run that all networks share: devices, checkpoints, early stopping, logs, exact epochs after a resume."""

from __future__ import annotations

import csv
import importlib.util
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
from lightning.pytorch.loggers import TensorBoardLogger
from torch.utils.data import DataLoader, IterableDataset

from nextview.errors import ModelError
from nextview.outputs import written_whole
from nextview.training.ahead import Ahead
from nextview.training.hardware import Hardware


class Batches(L.LightningDataModule):
    """Data sets that make their own batches. They are told the epoch and which share of each batch is this device's.

    A data set that knows no shares gives every device whole batches: as exact, though no faster.
    """

    def __init__(self, training: IterableDataset, validation: IterableDataset) -> None:
        super().__init__()
        self.training, self.validation = training, validation

    def setup(self, stage: str) -> None:
        share = slice(self.trainer.global_rank, None, self.trainer.world_size)
        self.training.share = self.validation.share = share

    def train_dataloader(self) -> DataLoader:
        self.training.epoch = self.trainer.current_epoch
        return DataLoader(Ahead(self.training), batch_size=None, pin_memory=torch.cuda.is_available())

    def val_dataloader(self) -> DataLoader:
        return DataLoader(Ahead(self.validation), batch_size=None, pin_memory=torch.cuda.is_available())


class StepSeed(L.Callback):
    """Seeds torch by epoch, step and device, so that a resumed run augments as an uninterrupted one would.

    The loaders draw from torch too, and not as often in a run that resumes: the epoch's seed would not do.
    """

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        step = [pl_module.recipe.seed, trainer.current_epoch, batch_idx, trainer.global_rank]
        torch.manual_seed(int(np.random.SeedSequence(step).generate_state(1, np.uint64)[0]))


class WholeCheckpoints(TorchCheckpointIO):
    """Writes checkpoints aside in their own folder, then renames them.

    Lightning writes them to the system's folder for temporary files and moves them. Where that lies on another disk the
    move is a copy, and a kill in it would cost the checkpoint that was there.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        save_whole(checkpoint, Path(path))


def save_whole(values: dict[str, Any], path: Path) -> None:
    """Write what torch can, whole or not at all.

    Raises:
        ResultsError: it cannot be written.
    """
    written = io.BytesIO()
    torch.save(values, written)  # into a file it would turn a full disk into a RuntimeError
    with written_whole(path) as part:
        part.write_bytes(written.getbuffer())


class Log(L.Callback):
    """Keeps a row for every epoch in log/metrics.csv and in the checkpoint, so that none is lost or doubled."""

    def __init__(self, out: Path) -> None:
        self.path = out / "log/metrics.csv"
        self.rows: list[dict[str, float]] = []

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.began = time.perf_counter()

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        row = {"epoch": trainer.current_epoch + 1, "step": trainer.global_step}
        row |= {name: float(value) for name, value in trainer.callback_metrics.items()}
        row["rate"] = trainer.optimizers[0].param_groups[0]["lr"]
        row["seconds"] = round(time.perf_counter() - self.began, 3)
        self.rows.append(row)
        if trainer.is_global_zero:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with written_whole(self.path) as part, part.open("w", newline="") as file:
                table = csv.DictWriter(file, list(self.rows[0]))
                table.writeheader()
                table.writerows(self.rows)

    def state_dict(self) -> dict[str, Any]:
        return {"rows": self.rows}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.rows = state_dict["rows"]


class Checkpoint(ModelCheckpoint):
    """Keeps one checkpoint under a name, of the best epoch by a score or of the last; the folder may be moved since."""

    def __init__(self, out: Path, name: str, select: str | None = None, mode: str = "min") -> None:
        super().__init__(out, name, monitor=select, mode=mode, enable_version_counter=False)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict | {"dirpath": self.dirpath})


class Patience(EarlyStopping):
    """Stops when the score has not improved for so many epochs; a run that was stopped so stays stopped."""

    def __init__(self, select: str, mode: Literal["min", "max"], epochs: int) -> None:
        super().__init__(select, patience=epochs, mode=mode, verbose=False)

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        trainer.should_stop = self.wait_count >= self.patience


def fit(
    module: L.LightningModule,
    training: IterableDataset,
    validation: IterableDataset,
    epochs: int,
    out: Path,
    select: str = "validation_mse",
    mode: Literal["min", "max"] = "min",
    patience: int = 0,
    hardware: Hardware = Hardware(),
) -> L.LightningModule:
    """Train a module and return it as it was after its best epoch.

    Checkpoints and logs go to ``out``; a second call resumes from them and ends with the same weights as a run that was
    never stopped, on the same devices. An epoch that was cut off is begun anew.

    Args:
        module: its ``recipe`` has a seed.
        training: makes the batches of one epoch, that of its attribute ``epoch``.
        validation: makes batches, the same every time.
        epochs: to train for.
        out: folder.
        select: the score on validation that tells the best epoch.
        mode: whether the best is the lowest or the highest.
        patience: stop after so many epochs without a better one; 0 never stops early.
        hardware: on what.

    Raises:
        ModelError: a checkpoint in ``out`` is damaged, or TensorBoard is asked for and not there.
    """
    if hardware.tensorboard and importlib.util.find_spec("tensorboard") is None:
        raise ModelError("--tensorboard needs TensorBoard: pip install tensorboard")
    # The last checkpoint comes last: it holds what the others know.
    callbacks = [StepSeed(), Log(out), Checkpoint(out, "best", select, mode), Checkpoint(out, "last")]
    if patience:
        callbacks.append(Patience(select, mode, patience))
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    with warnings.catch_warnings():
        # All of them describe what is meant here: a run that resumes, and data sets that make their own batches.
        warnings.filterwarnings("ignore", module="lightning")
        warnings.filterwarnings("ignore", message=".*LeafSpec")
        several = hardware.devices * hardware.nodes > 1
        trainer = L.Trainer(
            max_epochs=epochs,
            precision=hardware.precision,
            accelerator=hardware.accelerator,
            devices=hardware.devices,
            num_nodes=hardware.nodes,
            strategy=hardware.strategy,
            # Batch norm sees the whole batch, as on one device; torch has this for GPUs alone.
            sync_batchnorm=several and hardware.accelerator != "cpu" and torch.cuda.is_available(),
            logger=TensorBoardLogger(out, "log", "") if hardware.tensorboard else False,
            callbacks=callbacks,
            plugins=[WholeCheckpoints()],
            enable_model_summary=False,
            num_sanity_val_steps=0,
            reload_dataloaders_every_n_epochs=1,
            log_every_n_steps=1,
        )
        last = out / "last.ckpt"
        resume = last if last.exists() and _read(last) else None
        try:
            # Numbers too small for the normal format are slow on CPUs and mean nothing here.
            torch.set_flush_denormal(True)
            trainer.fit(module, datamodule=Batches(training, validation), ckpt_path=resume, weights_only=True)
        finally:
            torch.set_flush_denormal(False)  # it holds for the whole process
    best = out / "best.ckpt"
    # Too few objects for one batch of validation leave nothing to choose by: the last epoch is kept.
    module.load_state_dict(_read(best if best.exists() else last)["state_dict"])
    return module


def is_first() -> bool:
    """Whether this process is the one of a training's that writes what all of them have made."""
    return rank_zero_only.rank == 0


def _read(path: Path) -> dict[str, Any]:
    """A checkpoint, by torch's reader that makes nothing but tensors and containers."""
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file raises whatever the reader stumbles over
        what = type(error).__name__
        raise ModelError(f"{path}: a damaged checkpoint ({what}); delete it to begin this training anew") from None
