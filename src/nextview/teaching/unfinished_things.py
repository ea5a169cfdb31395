"""Results of an interrupted run: a file for each taught thing, with a stamp of its source."""

import hashlib
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from safetensors import SafetensorError
from safetensors.numpy import load_file

from nextview.teaching.thing_sources import ThingSource
from nextview.teaching.thing_views import Arrays, TeachingOptions


def stamp_of(source: ThingSource, how: TeachingOptions) -> str:
    """Stamp of the inputs of a thing, which is taught again if the stamp changes.

    The stamp contains the path, the name, size and time of its file or of each file in its folder,
    and the options. It ignores the time of the folder itself, which does not change when its files
    are overwritten.

    Args:
        source: the thing.
        how: options of the teaching.

    Returns:
        The stamp.
    """
    content = hashlib.sha256()
    for file in _files_of(source.path):
        try:
            status = file.stat()
            seen = f"{file}\0{status.st_size}\0{status.st_mtime_ns}\0"
        except OSError as error:  # a broken link: the reader of the thing reports it
            seen = f"{file}\0{error.errno}\0"
        content.update(seen.encode(errors="surrogateescape"))

    return repr(
        (
            str(source.path.resolve()),
            content.hexdigest(),
            replace(how, any_size=False, symmetry=()),
        )
    )


def _files_of(path: Path) -> Iterator[Path]:
    """A file itself, or all files in a folder in order, including those behind links to folders."""
    if not path.is_dir():
        yield path
        return

    for place, folders, names in os.walk(path, followlinks=True):
        real = Path(place).resolve()
        above = {real, *real.parents}
        # A link to a parent folder would cause an infinite walk.
        folders[:] = [
            name for name in sorted(folders) if Path(place, name).resolve() not in above
        ]
        yield from (Path(place, name) for name in sorted(names))


def part_of(part: Path, source: ThingSource) -> Path:
    """File of a thing in an unfinished run; the length of its name is bounded.

    Args:
        part: folder of unfinished results.
        source: the thing.

    Returns:
        Path of the file.
    """
    name = source.name.encode(errors="surrogateescape")
    return part / f"{hashlib.sha256(name).hexdigest()[:32]}.safetensors"


def finished(file: Path, stamp: str) -> Arrays | None:
    """Load a thing that an interrupted run has taught.

    Args:
        file: see ``part_of``.
        stamp: see ``stamp_of``.

    Returns:
        Its arrays; None if the file is missing, damaged or out of date.
    """
    try:
        arrays = load_file(file)
    except (OSError, SafetensorError):  # missing or damaged: taught again
        return None
    found = arrays.pop("stamp", None)
    if found is None or found.tobytes() != stamp.encode(errors="surrogateescape"):
        return None
    return arrays
