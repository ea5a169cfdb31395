"""The optional parts of research, and what is said where one is not installed."""

from contextlib import AbstractContextManager

from nextview import checks
from nextview.cli import exit_status
from nextview_lab.extras import EXTRAS as LAB

EXTRAS = {  # packages by the optional part, as in pyproject.toml, that brings them
    "ap-gym": ("ap_gym", "gymnasium"),
    "arm": ("gymnasium_robotics", "mink", "mujoco"),
    "film": ("imageio_ffmpeg",),
    "ppf": ("cv2",),
    "rl": (*LAB["envs"], *LAB["train"], "stable_baselines3"),
}
PROJECT = "./research"


def require(extra: str) -> None:
    """End a script with the sentence that says what to install, see
    ``nextview.cli.exit_status.require``.
    """
    exit_status.require(extra, EXTRAS, PROJECT)


def extras() -> AbstractContextManager[None]:
    """Stands around imports from optional parts, see ``nextview.checks.extras``."""
    return checks.extras(EXTRAS, PROJECT)
