"""The optional packages of the laboratory."""

from contextlib import AbstractContextManager

from nextview import checks
from nextview.cli import exit_status

PROJECT = "nextview-lab"
EXTRAS = {  # packages by the optional part, as in pyproject.toml, that brings them
    "arm": ("gymnasium_robotics", "mink", "mujoco"),
    "benchmark": ("jinja2", "pandas", "pyarrow"),
    "envs": ("gymnasium",),
    "train": ("lightning", "onnx", "onnxscript", "torch", "torchmetrics"),
}


def extras() -> AbstractContextManager[None]:
    """Stands around imports of optional packages; see ``nextview.checks.extras``."""
    return checks.extras(EXTRAS, PROJECT)


def require(extra: str) -> None:
    """End a script with installation advice; see ``nextview.cli.exit_status.require``.

    Args:
        extra: that the script needs.
    """
    exit_status.require(extra, EXTRAS, PROJECT)
