"""What studies share: scans, results line by line, intervals of shares, progress."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypeVar

from rich.progress import track

from nextview.cli.progress import console
from nextview.errors import UsageError
from nextview.geometry.mesh import FORMATS, Mesh, load_mesh

SECONDS_BETWEEN_LINES = 30.0  # of progress, where there is no terminal
Item = TypeVar("Item")
Asked = TypeVar("Asked", bound=tuple)


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


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The results in a file, one in each line; none if there is no file.

    What a run that was killed left of its last line is cut off.
    """
    if not path.exists():
        return []
    written = path.read_bytes()
    whole = written.rfind(b"\n") + 1
    if whole < len(written):
        with path.open("r+b") as file:
            file.truncate(whole)
    return [json.loads(line) for line in written[:whole].splitlines()]


def results(
    path: Path,
    fields: Sequence[str],
    asked: Sequence[Asked],
    run: Callable[[Asked], dict[str, Any]],
    what: str,
) -> list[dict[str, Any]]:
    """Results of all that is asked for; what a file holds already is not run again.

    Args:
        path: JSON lines, to which each result is added as soon as it is there.
        fields: names of the values by which a result is known; they begin its line.
        asked: tuples of these values.
        run: returns the rest of the line.
        what: is run, for the progress that is shown.

    Returns:
        A line for each that is asked for, in their order.
    """

    def key(values: Any) -> str:
        return json.dumps(values, default=asdict)

    known = {
        key([line.get(name) for name in fields]): line for line in read_lines(path)
    }
    missing = [item for item in asked if key(item) not in known]
    with path.open("a") as file:
        for item in progress(missing, what) if missing else ():
            known_by = dict(zip(fields, item, strict=True))
            line = json.dumps(known_by | run(item), default=asdict)
            file.write(f"{line}\n")
            file.flush()
            known[key(item)] = json.loads(line)
    return [known[key(item)] for item in asked]


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
