"""Functions whose results depend on their arguments alone, each computed once a run."""

import pickle
from collections.abc import Callable
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from filelock import FileLock


@dataclass(frozen=True)
class Kept:
    """A function, and the folder of its results.

    Attributes:
        function: it.
        folder: of the results, one file for each.
        given: bytes that tell its arguments; None for a call whose result is not kept.
    """

    function: Callable[..., Any]
    folder: Path
    given: Callable[..., bytes | None]

    def __call__(self, *arguments, **named):
        given = self.given(*arguments, **named)
        if given is None:
            return self.function(*arguments, **named)
        file = self.folder / f"{self.function.__name__}-{sha256(given).hexdigest()}"
        with FileLock(f"{file}.lock"):
            if not file.exists():
                result = self.function(*arguments, **named)
                part = file.with_suffix(".part")
                part.write_bytes(pickle.dumps(result))
                part.rename(file)
        return pickle.loads(file.read_bytes())


def of_teach(path, name, how) -> bytes | None:
    """Of ``thing_views.teach`` for a mesh file that refers to no other file."""
    if not path.is_file() or path.suffix.lower() not in (".off", ".ply", ".stl"):
        return None
    return repr((path.name, name, how)).encode() + path.read_bytes()


def of_show(card, sensor, seed, item) -> bytes:
    """Of ``shown_views.show``; the card holds the hash of the memory."""
    return repr((sensor, seed, item)).encode() + card.read_bytes()


def of_mesh(mesh) -> bytes:
    """Of ``resting.resting_poses``."""
    return mesh.vertices.tobytes() + mesh.faces.tobytes()
