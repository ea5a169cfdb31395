"""One run at a time on what is being written, and one sentence if it cannot be."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from nextview.errors import DatasetError


@contextmanager
def only_one(path: Path) -> Iterator[None]:
    """Hold the lock file beside ``path``. The system frees it when its holder ends, however that dies.

    Raises:
        DatasetError: another run holds it, something else has its name, or the folder cannot be written.
    """
    path = path.absolute()
    file = path.with_name(path.name + ".lock")
    if file.is_symlink() or (file.exists() and (not file.is_file() or file.stat().st_size > 0)):  # poetry.lock, say
        raise DatasetError(f"{file}: is there and is no lock of nextview's, which is an empty file; give another name")
    lock = FileLock(file, timeout=0)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except Timeout:
        if not file.exists():  # filelock tries again, in vain, where some file systems take no new file
            raise DatasetError(f"{path}: cannot be written (no lock file can be made beside it)") from None
        raise DatasetError(f"{path}: another run is writing it; wait for that one or stop it") from None
    except OSError as error:
        raise DatasetError(f"{path}: cannot be written ({error.strerror or error})") from None
    try:
        yield
    finally:
        lock.release()


@contextmanager
def hold(folder: Path) -> Iterator[bool]:
    """Hold a folder while it is in use; whether nobody else does. The system frees it when its holder ends.

    False too where folders cannot be locked, and on systems that know no such locks.
    """
    try:
        import fcntl
    except ImportError:
        yield False
        return
    try:
        place = os.open(folder, os.O_RDONLY)
    except OSError:
        yield False
        return
    try:
        fcntl.flock(place, fcntl.LOCK_EX | fcntl.LOCK_NB)
        free = True
    except OSError:
        free = False
    try:
        yield free
    finally:
        os.close(place)


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
