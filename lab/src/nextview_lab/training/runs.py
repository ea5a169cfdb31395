"""Training runs: folder, checkpoints, exact resumption, and initial weights."""

import csv
import io
import logging
import re
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from pickle import UnpicklingError  # raised by torch if it refuses to unpickle
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np

from nextview.cores import asked_cores
from nextview.errors import DAMAGED, ModelError
from nextview.files import (
    command,
    decode_record,
    new_file,
    only_one,
    read_record,
    sha256_of,
    write_record,
)
from nextview.segmentation.network import SegmentationCard
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.store import ViewStore
from nextview_lab.extras import extras
from nextview_lab.training.architectures import LiteNet, ResNet
from nextview_lab.training.recipes import Hardware

with extras():
    import lightning as L
    import torch
    from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO
    from lightning.pytorch.callbacks import ModelCheckpoint
    from torch import Tensor, nn
    from torch.utils.data import DataLoader, IterableDataset

Recipe = TypeVar("Recipe")
N = TypeVar("N", bound=nn.Module)


class OwnBatches(IterableDataset):
    """A dataset that creates its own batches from the epoch."""

    epoch = 0


class Batches(L.LightningDataModule):
    """Training and validation datasets that create their own batches."""

    def __init__(self, training: IterableDataset, validation: IterableDataset) -> None:
        super().__init__()
        self.training = training
        self.validation = validation

    def train_dataloader(self) -> DataLoader:
        self.training.epoch = self.trainer.current_epoch
        return _loader(self.training)

    def val_dataloader(self) -> DataLoader:
        return _loader(self.validation)


def _loader(batches: IterableDataset) -> DataLoader:
    # on a CPU, creating a batch takes milliseconds, and a training step a second
    gpu = torch.cuda.is_available()
    ahead: dict[str, Any] = (
        {"num_workers": 1, "prefetch_factor": 4, "pin_memory": True} if gpu else {}
    )
    return DataLoader(batches, batch_size=None, **ahead)


class StepSeed(L.Callback):
    """Seeds torch by epoch and step, so that a resumed run uses the same random numbers."""

    def on_train_batch_start(
        self,
        trainer: L.Trainer,
        pl_module: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Seed torch by the number of the batch, so that a resumed run repeats its random numbers.

        Args:
            trainer: Lightning's trainer.
            pl_module: the module.
            batch: the batch.
            batch_idx: number of the batch in its epoch.
        """
        # the last number is that of the device
        step = [pl_module.recipe.seed, trainer.current_epoch, batch_idx, 0]
        torch.manual_seed(
            int(np.random.SeedSequence(step).generate_state(1, np.uint64)[0])
        )


class WholeCheckpoints(TorchCheckpointIO):
    """Writes checkpoints atomically, so that an interruption never damages the previous one.

    Lightning would copy them from the system's temporary folder.
    """

    def save_checkpoint(
        self,
        checkpoint: dict[str, Any],
        path: str | Path,
        storage_options: Any = None,
    ) -> None:
        """Write a checkpoint, completely or not at all.

        Args:
            checkpoint: its content.
            path: of the file.
            storage_options: not used.
        """
        save_whole(checkpoint, Path(path))


def save_whole(values: dict[str, Any], path: Path) -> None:
    """Write values with torch, completely or not at all.

    Args:
        values: the values by name.
        path: of the file, which is replaced.
    """
    written = io.BytesIO()
    # written to memory first, as torch reports a full disk as a RuntimeError
    torch.save(values, written)
    with new_file(path, overwrite=True) as part:
        part.write_bytes(written.getbuffer())


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a file written by ``save_whole``; only tensors and containers are created."""
    try:
        with warnings.catch_warnings():
            # Torch warns about foreign pickles before it rejects them.
            warnings.filterwarnings("ignore", "Detected pickle protocol")
            return torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise ModelError(f"{path}: there is no such checkpoint") from None
    except (*DAMAGED, UnpicklingError) as error:
        what = f"a damaged checkpoint or one that torch cannot read safely ({type(error).__name__})"
        raise ModelError(
            f"{path}: {what}; give another, or delete it to begin this training anew"
        ) from None


class Log(L.Callback):
    """Writes a row per epoch to log/metrics.csv, and keeps existing rows when a run resumes."""

    def __init__(self, out: Path) -> None:
        self.path = out / "log/metrics.csv"
        self.rows = list[dict[str, float]]()

    def on_train_epoch_start(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
    ) -> None:
        """Start the clock of an epoch.

        Args:
            trainer: Lightning's trainer.
            pl_module: the module.
        """
        self.began = time.perf_counter()

    def on_train_epoch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
    ) -> None:
        """Append a row with the scores and the duration of an epoch.

        Args:
            trainer: Lightning's trainer.
            pl_module: the module.
        """
        row = {"epoch": trainer.current_epoch + 1, "step": trainer.global_step}
        row |= {name: float(value) for name, value in trainer.callback_metrics.items()}
        row["rate"] = trainer.optimizers[0].param_groups[0]["lr"]
        row["seconds"] = round(time.perf_counter() - self.began, 3)
        self.rows.append(row)
        with (
            new_file(self.path, overwrite=True) as part,
            part.open("w", newline="", encoding="utf-8") as file,
        ):
            table = csv.DictWriter(file, list(self.rows[0]))
            table.writeheader()
            table.writerows(self.rows)

    def state_dict(self) -> dict[str, Any]:
        return {"rows": self.rows}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.rows = state_dict["rows"]


class Checkpoint(ModelCheckpoint):
    """Keeps the best epoch by a score, or the last one; the folder may be moved between runs."""

    def __init__(
        self,
        out: Path,
        name: str,
        select: str | None = None,
        mode: str = "min",
    ) -> None:
        super().__init__(
            out,
            name,
            monitor=select,
            mode=mode,
            enable_version_counter=False,
        )

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict | {"dirpath": self.dirpath})


def fit(
    module: L.LightningModule,
    training: IterableDataset,
    validation: IterableDataset,
    out: Path,
    select: str,
    mode: Literal["min", "max"],
    hardware: Hardware = Hardware(),
) -> L.LightningModule:
    """Train a module with its ``recipe``.

    Args:
        module: the module.
        training: batches of training data.
        validation: batches of validation data.
        out: folder of the run; an unfinished run in it is resumed.
        select: name of the score that selects the best epoch.
        mode: whether the lowest ("min") or the highest ("max") score is the best.
        hardware: device and precision.

    Returns:
        The module after its best epoch.
    """
    recipe: Any = module.recipe
    # The last checkpoint comes last, as it contains the states of the others.
    callbacks = [
        StepSeed(),
        Log(out),
        Checkpoint(out, "best", select, mode),
        Checkpoint(out, "last"),
    ]
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    with warnings.catch_warnings():
        # Lightning's warnings concern intended behaviour: resuming, and datasets that create their
        # own batches.
        warnings.filterwarnings("ignore", module="lightning")
        warnings.filterwarnings("ignore", message=".*LeafSpec")
        trainer = L.Trainer(
            max_epochs=recipe.epochs,
            precision=hardware.precision,
            accelerator=hardware.accelerator,
            devices=1,
            logger=False,
            callbacks=callbacks,
            plugins=[WholeCheckpoints()],
            enable_model_summary=False,
            num_sanity_val_steps=0,
            reload_dataloaders_every_n_epochs=1,
            log_every_n_steps=1,
        )
        last = out / "last.ckpt"
        best = out / "best.ckpt"
        resume = last if last.exists() and read_checkpoint(last) else None
        try:
            # Denormal numbers are slow on CPUs and irrelevant here.
            torch.set_flush_denormal(True)
            if (asked := asked_cores()) is not None:
                torch.set_num_threads(asked)
            trainer.fit(
                module,
                datamodule=Batches(training, validation),
                ckpt_path=resume,
                weights_only=True,
            )
        finally:
            torch.set_flush_denormal(False)  # the setting is global for the process
    # Without a complete validation batch there is no score, and the last epoch is kept.
    module.load_state_dict(
        read_checkpoint(best if best.exists() else last)["state_dict"]
    )
    return module


def optimiser(parameters: Any, recipe: Any, steps: int, falls: float) -> dict[str, Any]:
    """Create the optimiser and the schedule of its learning rate.

    It is AdamW with a one-cycle schedule over all steps, or with a rate that falls every fifth
    epoch.

    Args:
        parameters: of the network.
        recipe: of the training.
        steps: number of all steps.
        falls: factor by which the rate falls.

    Returns:
        The return value of Lightning's ``configure_optimizers``.
    """
    adam = torch.optim.AdamW(parameters, lr=recipe.lr, weight_decay=recipe.weight_decay)
    if recipe.lr_schedule == "one-cycle":
        cycle = torch.optim.lr_scheduler.OneCycleLR(
            adam,
            recipe.lr,
            steps,
            pct_start=0.2,
        )
        return {
            "optimizer": adam,
            "lr_scheduler": {"scheduler": cycle, "interval": "step"},
        }

    stairs = torch.optim.lr_scheduler.StepLR(adam, step_size=5, gamma=falls)
    return {
        "optimizer": adam,
        "lr_scheduler": {"scheduler": stairs, "interval": "epoch"},
    }


class Run(msgspec.Struct, frozen=True):
    """Description of a run, stored in its folder.

    Attributes:
        recipe: settings of the training.
        weights: SHA-256 of the initial weights; None for random ones.
        held_out: names of the validation objects, which select the checkpoint.
        commands: commands that led to the run.
    """

    recipe: dict[str, Any]
    weights: str | None
    held_out: tuple[str, ...]
    commands: tuple[str, ...]


def new_run(
    recipe: Any,
    weights: Path | None,
    held_out: Sequence[str],
    made: Iterable[ViewStore | Predictions | SegmentationCard],
) -> Run:
    """Describe a run of the current command.

    Args:
        recipe: of the training.
        weights: file or run with the initial weights; None for random ones.
        held_out: names of the validation objects.
        made: stores, predictions and networks that the run uses.

    Returns:
        The description.

    Raises:
        DatasetError: the initial weights were trained on some of the validation objects.
    """
    before = [line for source in made for line in source.commands]

    if weights is not None and weights.is_dir():
        earlier = read_run(weights)
        own = set(held_out)
        seen = sorted(own - set(earlier.held_out))

        if 0 < len(seen) < len(own):
            what = (
                f"{len(seen)} of the {len(own)} objects that this network must not have seen,"
                f" {seen[0]} among them"
            )
            raise ModelError(
                f"{weights}: was trained on {what}; take its --seed and --validation-share"
            )

        before += earlier.commands
        weights /= "network.pt"
    if weights is not None and not weights.is_file():
        raise ModelError(f"{weights}: there is no such checkpoint")

    sha256 = None if weights is None else sha256_of(weights)
    return Run(
        asdict(recipe),
        sha256,
        tuple(held_out),
        tuple(dict.fromkeys((*before, command()))),
    )


def train_once(out: Path, run: Run, train: Callable[[], nn.Module]) -> None:
    """Train a network into the folder of a run unless it exists already.

    Other processes are locked out.

    Args:
        out: folder of the run.
        run: its description.
        train: trains and returns the network.

    Raises:
        ModelError: the folder contains a run with another recipe, other initial weights or other
            objects.
    """
    with only_one(out):
        if (out / "run.json").exists():
            before = read_record(out / "run.json", Run, "a training run")
            recipe = msgspec.to_builtins(run.recipe)

            changed = [
                name
                for name, value in recipe.items()
                if before.recipe.get(name) != value
            ]
            faults = [
                f"another recipe ({name} was {before.recipe.get(name)}, not {recipe[name]})"
                for name in changed
            ]
            if before.weights != run.weights:
                faults.append("other first weights")
            if before.held_out != run.held_out:
                faults.append("other objects")

            if faults:
                again = "give the same options to resume it, or another folder"
                raise ModelError(f"{out}: holds a run of {faults[0]}; {again}")
        else:
            other = [
                path.name
                for path in (out.iterdir() if out.is_dir() else ())
                if not path.name.startswith(".")
            ]
            if other:
                raise ModelError(
                    f"{out}: holds {other[0]} and no training run; give a new folder, or an"
                    " empty one"
                )
            write_record(out / "run.json", run)

        if not (out / "network.pt").exists():
            save_whole(train().state_dict(), out / "network.pt")


def read_run(out: Path) -> Run:
    """Read the description of a finished run."""
    if not (out / "run.json").exists():
        raise ModelError(f"{out}: holds no training run")
    run = read_record(out / "run.json", Run, "a training run")
    if not (out / "network.pt").exists():
        raise ModelError(
            f"{out}: the training is not done; give its command again to go on"
        )
    return run


def read_recipe(out: Path, kind: type[Recipe]) -> Recipe:
    """Read the recipe of a finished run.

    Args:
        out: folder of the run.
        kind: type of the recipe.

    Returns:
        The recipe.

    Raises:
        ModelError: the folder holds no run of this kind.
    """
    recipe = read_run(out).recipe
    if set(recipe) != set(kind.__annotations__):
        raise ModelError(f"{out}: holds no run of a {kind.__name__} of this version")
    return decode_record(
        recipe,
        kind,
        f"{out}: not a recipe of such a network",
        ModelError,
    )


def load_run(network: N, run: Path) -> N:
    """Load the parameters of a finished run into a network.

    Args:
        network: the network.
        run: folder of the run.

    Returns:
        The network, in evaluation mode.

    Raises:
        ModelError: the parameters are of another network.
    """
    path = run / "network.pt"
    try:
        network.load_state_dict(_read_state(path))
    except RuntimeError:  # names what is missing, unknown or of another shape
        raise ModelError(
            f"{path}: not the weights of the network that {run}/run.json describes"
        ) from None
    return network.eval()


def interpolate(network: nn.Module, start: dict[str, Tensor], share: float) -> None:
    """Move the parameters of a trained network back towards their initial values.

    Args:
        network: the network, which is changed.
        start: its initial parameters.
        share: of the way from the initial (0) to the trained ones (1).
    """
    network.load_state_dict(
        {
            name: torch.lerp(start[name].to(values), values, share)
            if values.is_floating_point()
            else values
            for name, values in network.state_dict().items()
        }  # counters are not interpolated
    )


# patterns of parameter names in ports of EfficientNet to PyTorch, and names in a ``LiteNet``
LITE_NAMES = {
    r"^_conv_": "",
    "^_blocks": "stages",
    r"\._(expand|depthwise|project)_conv": r".\1",
    "_bn": "norm",
    "^_fc": "fc",
}


def start_from(network: ResNet | LiteNet, weights: Path, head: bool = True) -> None:
    """Load initial parameters into a network.

    The last layers are not loaded if those of the file have another shape.

    Args:
        network: the network.
        weights: folder of a finished run, or file of a published checkpoint.
        head: whether to load the last layers too.

    Raises:
        ModelError: the parameters are of another network.
    """
    path = weights / "network.pt" if weights.is_dir() else weights
    state = {
        name.removeprefix("resnet."): value for name, value in _read_state(path).items()
    }
    lite = isinstance(network, LiteNet)
    for theirs, ours in LITE_NAMES.items() if lite and path == weights else ():
        state = {re.sub(theirs, ours, name): value for name, value in state.items()}
    own = network.state_dict()
    first = "stem.weight" if lite else "conv1.weight"
    for name, value in own.items():
        # Files from before PyTorch 0.4.1, including some of torchvision's, have no batch counters.
        lacks = name not in state and (
            name.endswith("_tracked") or name.startswith("side.")
        )
        other = name in state and state[name].shape != value.shape
        if lacks or (name.startswith(("fc.", "side.")) and (other or not head)):
            state[name] = value
    state = {
        name: value
        for name, value in state.items()
        if name in own or not name.startswith("side.")
    }
    if (
        first in state
        and state[first].ndim == 4
        and state[first].shape != own[first].shape
    ):
        colours = state[first].shape[1]
        channels = own[first].shape[1]
        # the colour kernels are assigned to the channels cyclically
        turn = torch.arange(max(colours, channels))
        share = torch.zeros(colours, channels)
        share[turn % colours, turn % channels] = 1
        share /= share.sum(1, keepdim=True)
        state[first] = torch.einsum("okhw,kc->ochw", state[first], share)
    wanted, given = (
        {name: tuple(value.shape) for name, value in values.items()}.items()
        for values in (own, state)
    )
    if wanted != given:
        raise ModelError(
            f"{path}: not the weights of this {network.name} ({min(wanted ^ given)[0]} is missing,"
            " unknown or of another shape)"
        )
    for name, value in state.items():
        if not torch.isfinite(value).all():
            raise ModelError(
                f"{path}: {name} holds numbers that are not finite; download the checkpoint again"
            )
    network.load_state_dict(state)


def _read_state(path: Path) -> dict[str, Tensor]:
    state = read_checkpoint(path)
    if not isinstance(state, dict) or not all(
        isinstance(value, Tensor) for value in state.values()
    ):
        raise ModelError(
            f"{path}: not a state dict: it should map names of parameters to tensors"
        )
    return dict(state)
