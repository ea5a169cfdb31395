"""Packages that an optional part of nextview needs."""

from __future__ import annotations

import sys
from importlib.util import find_spec

from nextview.errors import MissingExtraError

EXTRAS = {
    "arm": ("gymnasium_robotics", "mink", "mujoco"),
    "benchmark": ("jinja2", "pandas", "pyarrow"),
    "cluster": ("dask", "distributed"),
    "explore": ("viser",),
    "record": ("rerun",),
    "envs": ("gymnasium",),
    "ap-gym": ("ap_gym",),
    "rl": ("stable_baselines3",),
    "train": ("lightning", "numcodecs", "onnx", "onnxscript", "torch", "torchmetrics"),
}
"""Packages by the optional part of the installation that brings them."""


def missing_extra(error: ModuleNotFoundError) -> MissingExtraError | None:
    """The sentence that says what to install; None where the module belongs to no optional part."""
    package = (error.name or "").partition(".")[0]
    for extra, packages in EXTRAS.items():
        if package in packages:
            return MissingExtraError(f"this needs the package {package}: pip install 'nextview[{extra}]'")
    return None


def require(extra: str) -> None:
    """End a script, with the sentence that says what to install, before its imports fail for a package of an extra."""
    for package in EXTRAS[extra]:
        if find_spec(package) is None:
            from nextview.cli.ending import say

            say(f"{sys.argv[0]} needs the package {package}: pip install 'nextview[{extra}]'")
            sys.exit(2)
