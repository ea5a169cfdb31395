"""The training run that all networks share: precision, checkpoints, logs, exact epochs after a resume."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path

import lightning as L
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger
from torch.utils.data import DataLoader, IterableDataset


class EpochSeed(L.Callback):
    """Seeds torch by the epoch, so that a resumed run augments as an uninterrupted one would."""

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        torch.manual_seed(pl_module.recipe.seed * 1000 + trainer.current_epoch)


class Batches(L.LightningDataModule):
    """Data sets that make their own batches; the training set is told the epoch."""

    def __init__(self, training: IterableDataset, validation: IterableDataset) -> None:
        super().__init__()
        self.training, self.validation = training, validation

    def train_dataloader(self) -> DataLoader:
        self.training.epoch = self.trainer.current_epoch
        return DataLoader(self.training, batch_size=None)

    def val_dataloader(self) -> DataLoader:
        return DataLoader(self.validation, batch_size=None)


def fit(
    module: L.LightningModule, training: IterableDataset, validation: IterableDataset, epochs: int, out: Path
) -> L.LightningModule:
    """Train a module to its last epoch; checkpoints and logs go to ``out``, from which a second call resumes."""
    # Numbers too small for the normal format are slow on CPUs and mean nothing here.
    torch.set_flush_denormal(True)
    last = out / "last.ckpt"
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    trainer = L.Trainer(
        max_epochs=epochs,
        precision="bf16-mixed",
        accelerator="auto",
        logger=CSVLogger(out, "log", ""),
        callbacks=[ModelCheckpoint(out, "epoch", save_last=True), EpochSeed()],
        enable_model_summary=False,
        reload_dataloaders_every_n_epochs=1,
        log_every_n_steps=1,
    )
    with warnings.catch_warnings():
        # All of them describe what is meant here: a run that resumes, and data sets that make their own batches.
        warnings.filterwarnings("ignore", module="lightning")
        warnings.filterwarnings("ignore", message=".*LeafSpec")
        resume = str(last) if last.exists() else None
        try:
            trainer.fit(module, datamodule=Batches(training, validation), ckpt_path=resume)
        finally:
            torch.set_flush_denormal(False)  # it holds for the whole process
    return module
