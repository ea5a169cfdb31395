"""Things that were taught by a run that was stopped: each in a file, with a stamp of its source."""

import hashlib
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from safetensors import SafetensorError
from safetensors.numpy import load_file

from nextview.recognition.model_card import FEATURE_NETWORK, find_card
from nextview.teaching.thing_sources import ThingSource
from nextview.teaching.thing_views import TeachingOptions
from nextview.teaching.view_features import Arrays


def stamp_of(source: ThingSource, how: TeachingOptions, features: bool) -> str:
    """Describe what a thing is taught from: it is taught again if any of this has changed.

    That is its path, the name, size and time of its file or of each file in its folder, the
    options, and the features. The time of the folder itself does not tell: copying over its files
    leaves it as it was.

    Args:
        source: the thing.
        how: how it is taught.
        features: whether its views are remembered even if its geometry is known.
    """
    content = hashlib.sha256()
    for file in _files_of(source.path):
        try:
            status = file.stat()
            seen = f"{file}\0{status.st_size}\0{status.st_mtime_ns}\0"
        except OSError as error:  # a broken link: what reads the thing says so
            seen = f"{file}\0{error.errno}\0"
        content.update(seen.encode(errors="surrogateescape"))

    network = find_card(FEATURE_NETWORK).sha256
    return repr(
        (
            str(source.path.resolve()),
            content.hexdigest(),
            replace(how, any_size=False, symmetry=()),
            features,
            network,
        )
    )


def _files_of(path: Path) -> Iterator[Path]:
    """A file itself, or all files in a folder, also behind links to folders, in order."""
    if not path.is_dir():
        yield path
        return

    for place, folders, names in os.walk(path, followlinks=True):
        real = Path(place).resolve()
        above = {real, *real.parents}
        # A link to a folder above would be walked for ever.
        folders[:] = [
            name for name in sorted(folders) if Path(place, name).resolve() not in above
        ]
        yield from (Path(place, name) for name in sorted(names))


def part_of(part: Path, source: ThingSource) -> Path:
    """Return the file in which an unfinished run keeps a thing; its name has a limited length.

    Args:
        part: folder of what is not finished.
        source: the thing.
    """
    name = source.name.encode(errors="surrogateescape")
    return part / f"{hashlib.sha256(name).hexdigest()[:32]}.safetensors"


def finished(file: Path, stamp: str) -> Arrays | None:
    """Return a thing that an interrupted run has taught; None if it cannot be used.

    Args:
        file: see ``part_of``.
        stamp: see ``stamp_of``.
    """
    try:
        arrays = load_file(file)
    except (OSError, SafetensorError):  # missing, or damaged: it is made again
        return None
    found = arrays.pop("stamp", None)
    if found is None or found.tobytes() != stamp.encode(errors="surrogateescape"):
        return None
    return arrays
