"""Packages that an optional part of nextview needs."""

import sys
from importlib.util import find_spec

EXTRAS = {
    "benchmark": ("jinja2", "pandas", "pyarrow"),
    "cluster": ("dask", "distributed"),
    "explore": ("viser",),
    "record": ("rerun",),
    "envs": ("gymnasium",),
    "train": ("lightning", "numcodecs", "onnx", "onnxscript", "torch", "torchmetrics"),
}
"""Packages by the optional part of the installation that brings them."""


def missing_extra(error: ModuleNotFoundError) -> str | None:
    """What to install; None where the module belongs to no optional part."""
    package = (error.name or "").partition(".")[0]
    extra = next((extra for extra, packages in EXTRAS.items() if package in packages), None)
    return None if extra is None else f"this needs the package {package}: pip install 'nextview[{extra}]'"


def require(extra: str) -> None:
    """End a script, before its imports fail, with the sentence that says what to install."""
    for package in EXTRAS[extra]:
        if find_spec(package) is None:
            print(f"{sys.argv[0]} needs the package {package}: pip install 'nextview[{extra}]'", file=sys.stderr)
            sys.exit(2)
