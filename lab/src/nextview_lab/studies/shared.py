"""What studies share: scans, and progress."""

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from rich.progress import track

from nextview.cli.progress import console
from nextview.errors import UsageError
from nextview.geometry.mesh import FORMATS, Mesh, load_mesh

SECONDS_BETWEEN_LINES = 30.0  # of progress, where there is no terminal
Item = TypeVar("Item")


def scans_in(folder: Path, formats: Sequence[str] = FORMATS) -> dict[str, Path]:
    """The scans in a folder by their names, in order.

    Args:
        folder: of the scans.
        formats: suffixes of the files that count.

    Raises:
        UsageError: there are none.
    """
    files = {
        path.stem: path
        for path in sorted(folder.iterdir() if folder.is_dir() else ())
        if path.suffix.lower() in formats
    }
    if not files:
        raise UsageError(f"{folder}: holds no scan, NAME{formats[0]}")
    return dict(sorted(files.items()))


def mesh_of(scan: Path) -> Mesh:
    """A scan in metres, called as its file."""
    return replace(load_mesh(scan, unit="m"), name=scan.stem)


def progress(items: Sequence[Item], what: str) -> Iterator[Item]:
    """Some items one after the other, with progress on standard error.

    Args:
        items: that work is done with.
        what: is worked on.
    """
    total = len(items)
    if console.is_terminal:
        yield from track(items, what, total, console=console)
        return
    said = time.monotonic()
    for number, item in enumerate(items, 1):
        yield item
        if time.monotonic() - said > SECONDS_BETWEEN_LINES:
            print(f"{what}: {number} of {total}", file=sys.stderr, flush=True)
            said = time.monotonic()
