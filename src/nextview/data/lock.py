"""One run at a time on what is being written, and one sentence if it cannot be."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from nextview.errors import DatasetError


@contextmanager
def only_one(path: Path) -> Iterator[None]:
    """Hold the lock file beside ``path``. The system frees it when its holder ends, however that dies.

    Raises:
        DatasetError: another run holds it, or the folder cannot be written.
    """
    path = path.absolute()
    lock = FileLock(path.with_name(path.name + ".lock"), timeout=0)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except Timeout:
        raise DatasetError(f"{path}: another run is writing it; wait for that one or stop it") from None
    except OSError as error:
        raise DatasetError(f"{path}: cannot be written ({error.strerror or error})") from None
    try:
        yield
    finally:
        lock.release()


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn what the disk says against writing into a sentence.

    Raises:
        DatasetError: ``path`` cannot be written.
    """
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise DatasetError(f"{path}: cannot be written ({reason}); what is done is kept, run again to go on") from None
