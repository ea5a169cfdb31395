"""On what a training runs. None of it belongs to the recipe. No torch here, so that the command line can show it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Hardware:
    """Devices, precision and logs; see docs/training.md for several devices and machines.

    Attributes:
        devices: processes on this machine, each with its own GPU where there are any; they share every batch out.
        nodes: machines, started by torchrun or Slurm.
        accelerator: "auto" takes GPUs where there are any.
        strategy: Lightning's name of how devices work together; "auto" is ddp where there are several.
        precision: of the arithmetic; weights are kept in single precision. Take 16-mixed on GPUs older than Ampere.
        tensorboard: log for TensorBoard too.
    """

    devices: int = 1
    nodes: int = 1
    accelerator: Literal["auto", "cpu", "gpu"] = "auto"
    strategy: str = "auto"
    precision: Literal["bf16-mixed", "16-mixed", "32-true"] = "bf16-mixed"
    tensorboard: bool = False
