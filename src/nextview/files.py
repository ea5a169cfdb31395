"""Write and read files: complete or absent outputs, typed JSON records, checked weights.

What exists is refused; with ``overwrite`` exactly the files that are written are replaced. A file
is written under a temporary name beside its place and then renamed, so a run that is killed leaves
what was there before.

Temporary folders have random names and hold a marker, MARKER: only a folder with the marker is ever
removed.
"""

import errno
import glob
import hashlib
import os
import shlex
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np

from nextview.checks import one_line
from nextview.errors import (
    DatasetError,
    ModelError,
    NextviewError,
    ResultsError,
    option,
)

T = TypeVar("T")
# a field of a record: a hash in hexadecimal digits
HashText = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # errors of a full disk
# in each temporary folder: an ``Unfinished`` record
MARKER = "nextview-unfinished.json"
# letters of an output's name that the name of its temporary folder holds
LONGEST_OUTPUT_NAME = 40
LONGEST_PATH = 300  # letters of a path that a sentence shows
# bytes of a JSON record; a card takes some hundred thousand
LARGEST_RECORD = 64 * 2**20


def check_new(path: Path, overwrite: bool = False, folder: bool = False) -> None:
    """Refuse, before any work is done, an output that cannot be written or must not be replaced.

    A ``folder`` may be there if it is empty. ResultsError: it exists, is a link, or its place
    cannot be written.

    Args:
        path: of the output.
        overwrite: whether a file that exists may be replaced.
        folder: whether the output is a folder.
    """
    check_writable(path)
    _check_free(path, overwrite, folder)


def check_writable(path: Path) -> None:
    """Refuse, before any work is done, an output whose place cannot be written.

    It is tried: rights alone do not tell it, as for the administrator or a read-only disk.
    ResultsError: nothing can be written in the folder, or where it would have to be made.

    Args:
        path: of a file or folder, which may be there.
    """
    try:
        os.path.lexists(path)
        place = path.absolute()
        place = place if path.is_dir() and not path.is_symlink() else place.parent
        place = next(p for p in (place, *place.parents) if p.exists())
        if not place.is_dir():
            raise ResultsError(f"{path}: cannot be written ({place} is not a folder)")
        os.rmdir(tempfile.mkdtemp(prefix=".nextview-", dir=place))
    except PermissionError:
        raise ResultsError(
            f"{path}: cannot be written (no permission to write in {place})"
        ) from None
    except OSError as error:
        shown = one_line(str(path), LONGEST_PATH)
        raise ResultsError(f"{shown}: cannot be written ({error.strerror})") from None


def _check_free(path: Path, overwrite: bool, folder: bool = False) -> None:
    """Refuse an output that exists and must not be replaced, see ``check_new``."""
    if path.is_symlink():
        raise ResultsError(f"{path}: is a link; give what it points to")

    if path.exists():
        kind = "pipe or a device"
        if path.is_dir():
            kind = "folder"
        elif path.is_file():
            kind = "file"
        if kind != ("folder" if folder else "file"):
            raise ResultsError(f"{path}: is a {kind}; give another name")
        if not overwrite and not (folder and not any(path.iterdir())):
            raise ResultsError(
                f"{path}: exists; give another name, or {option('overwrite', True)} to replace it"
            )


@contextmanager
def new_file(path: Path, overwrite: bool = False) -> Iterator[Path]:
    """Write a file completely or not at all; see ``check_new``.

    Yields a temporary path beside the file, with the same suffix.

    Args:
        path: of the output.
        overwrite: whether a file that exists may be replaced.
    """
    check_new(path, overwrite)
    with _beside(path) as temporary:
        part = temporary / path.name
        yield part
        _sync(part)
        _check_free(path, overwrite)  # it may have appeared meanwhile
        os.replace(part, path)


@contextmanager
def new_folder(
    path: Path,
    overwrite: bool = False,
    last: str = "",
    withdraw: bool = False,
) -> Iterator[Path]:
    """Write a folder of files: yields a temporary folder beside it.

    A folder that was not there appears whole. Of one that is there, with ``overwrite``, each file
    that was written replaces the one of its name, and all others stay: the deepest first, ``last``
    at the end. No file is replaced before every place is known to be free.

    Args:
        path: The folder.
        overwrite: Whether files in it may be replaced; without, it has to be empty.
        last: The file, directly in the folder, that names or describes the others. Whoever is
            stopped before it is replaced leaves the one that was there.
        withdraw: Whether that file is removed before the first other is replaced: for files that
            keep their names, so that whoever is stopped leaves no mixture of old and new ones, but
            a folder that says nothing.

    Raises:
        ResultsError: see ``check_new``; or the disk is full.
    """
    check_new(path, overwrite, folder=True)
    there = path.is_dir()
    # the folder above one that is there may not be writable
    place = path / "new" if there else path
    with _beside(place) as temporary:
        part = temporary / place.name
        part.mkdir()
        yield part

        written = [file.relative_to(part) for file in part.rglob("*") if file.is_file()]
        for file in written:
            _sync(part / file)

        if not there:
            _check_free(path, overwrite, folder=True)
            if not path.exists():
                os.rename(part, path)
                _sync_folder(path.parent)
                return

        for file in written:
            _check_inside(path, file, overwrite)
        if withdraw:
            (path / last).unlink(missing_ok=True)
            _sync_folder(path)
        _replace(part, path, written, last)


def _replace(part: Path, folder: Path, files: Sequence[Path], last: str) -> None:
    """Move files from one folder into another, the deepest first, ``last`` at the end.

    Paths are relative to the folders.
    """
    for file in sorted(
        files, key=lambda file: (file.as_posix() == last, -len(file.parts), file)
    ):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        if file.as_posix() == last:
            _sync_folder(folder)  # what it names is on the disk before it is
        os.replace(part / file, folder / file)
    _sync_folder(folder)


def _check_inside(folder: Path, file: Path, overwrite: bool) -> None:
    """``check_new`` of a file in a folder, which no link on the way may lead out of."""
    for above in file.parents:
        if (folder / above).is_symlink() and above != Path():
            raise ResultsError(f"{folder / above}: is a link; give what it points to")
    _check_free(folder / file, overwrite)


class Unfinished(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What marks a folder as a temporary one of this package.

    Attributes:
        output: The name of the output that it is for.
        key: What the parts in it are of, see ``unfinished``; TEMPORARY where they are of no further
            use.
    """

    output: str
    key: str


TEMPORARY = "temporary"


@contextmanager
def unfinished(output: Path, key: str) -> Iterator[Path]:
    """A folder beside an output for the parts of it that are done, so that a stopped run can go on.

    It is the folder that an earlier run with the same key left, or a new one. It is removed at the
    end, but stays after an error if there is anything in it. Folders that earlier runs with other
    keys left are removed, and temporary ones of runs that were killed. Use it inside ``only_one``.

    Args:
        output: what the parts are for.
        key: what the run depends on: parts of another key are of no use.

    Raises:
        ResultsError: it cannot be written.
    """
    output = output.absolute()
    found = None
    for folder in _marked(output.parent, output.name):
        if found is None and _marker(folder) == Unfinished(output.name, key):
            found = folder
        else:
            _remove(folder)
    for folder in _marked(output, "new") if output.is_dir() else ():
        _remove(folder)

    folder = _marked_folder(output, key) if found is None else found
    try:
        yield folder
    except BaseException:  # also where the user stops it
        if [path.name for path in folder.iterdir()] == [MARKER]:
            _remove(folder)
        raise
    _remove(folder)


def _marked_folder(path: Path, key: str) -> Path:
    """Make a temporary folder of a random name beside a path, with its marker."""
    folder = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(
            tempfile.mkdtemp(
                prefix=f".{path.name[:LONGEST_OUTPUT_NAME]}-",
                dir=path.parent,
            )
        )
        (folder / MARKER).write_bytes(msgspec.json.encode(Unfinished(path.name, key)))
    except OSError as error:
        if folder is not None:
            _remove(folder)
        raise ResultsError(f"{path}: cannot be written ({error.strerror})") from None
    return folder


def _marked(place: Path, name: str) -> list[Path]:
    """The temporary folders for an output of that name in a folder, by their markers."""
    found = []
    for folder in sorted(place.glob(f".{glob.escape(name[:LONGEST_OUTPUT_NAME])}-*")):
        marker = _marker(folder)
        if marker is not None and marker.output == name:
            found.append(folder)
    return found


def _marker(folder: Path) -> Unfinished | None:
    """What marks a folder as a temporary one of ours; None if nothing does."""
    file = folder / MARKER
    try:
        if folder.is_symlink() or file.is_symlink() or not file.is_file():
            return None
        return msgspec.json.decode(file.read_bytes(), type=Unfinished)
    # of another user, or another's file of that name
    except (OSError, msgspec.DecodeError, UnicodeDecodeError):
        return None


def _remove(folder: Path) -> None:
    """Remove a temporary folder, as far as the system lets us.

    Its marker goes after all else: what a kill leaves of it is still known as ours.
    """
    with suppress(OSError):
        for path in folder.iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            elif path.name != MARKER:
                path.unlink(missing_ok=True)
        (folder / MARKER).unlink(missing_ok=True)
        folder.rmdir()


@contextmanager
def _beside(path: Path) -> Iterator[Path]:
    """Create a temporary folder on the same disk, and remove it at the end.

    An error of the disk becomes one sentence.
    """
    with _folders_above(path):
        temporary = _marked_folder(path, TEMPORARY)
        try:
            yield temporary
        except OSError as error:
            if error.errno not in FULL:
                raise
            raise ResultsError(
                f"{path}: cannot be written ({error.strerror})"
            ) from None
        finally:
            _remove(temporary)


@contextmanager
def _folders_above(path: Path) -> Iterator[None]:
    """If the block fails, remove the empty folders above a path that it created."""
    missing = [folder for folder in path.absolute().parents if not folder.exists()]
    try:
        yield
    except BaseException:
        for folder in missing:  # the innermost comes first
            with suppress(OSError):  # it was never made, or something else is in it
                folder.rmdir()
        raise


def _sync(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def _sync_folder(path: Path) -> None:
    """See that the renames in a folder are on the disk, as far as the system can tell."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    # no file is lost without it: some network file systems refuse it, as does a folder that
    with suppress(OSError):
        # can be written but not read
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def only_one(path: Path) -> Iterator[None]:
    """Admit one writer of ``path`` at a time, among processes.

    DatasetError is raised if another one is writing, or the path cannot be written.
    """
    from filelock import (
        FileLock,
        Timeout,
    )  # here, as whoever only recognises needs none

    place = path.absolute()
    file = place.with_name(f".{place.name}.lock")
    lock = FileLock(file, timeout=0)
    if file.is_symlink() or (
        file.exists() and (not file.is_file() or file.stat().st_size > 0)
    ):
        # a lock is an empty file, where the system has locks
        what = "another run's lock, or no file of this program"
        raise DatasetError(f"{path}: cannot be written while {file} is there: {what}")
    with _folders_above(place):
        try:
            place.parent.mkdir(parents=True, exist_ok=True)
            lock.acquire()
        except Timeout:
            raise DatasetError(
                f"{path}: another run is writing it; wait for that one or stop it"
            ) from None
        except OSError as error:
            raise DatasetError(
                f"{path}: cannot be written ({error.strerror})"
            ) from None
        try:
            yield
        finally:
            # while it is held: who opened it before sees that it is gone, and tries anew
            file.unlink(missing_ok=True)
            lock.release()


def regular_file(
    path: Path,
    what: str,
    error: type[NextviewError],
    largest: int | None = None,
) -> None:
    """Check that a path names a regular file.

    A pipe would wait for its writer, and a device might never end.

    Else it is an ``error``, which says ``what`` it should be ("a model card"); ``largest`` is a
    size in bytes.

    Args:
        path: that was handed in.
        what: the file should be, in the sentence ("a model card").
        error: kind of error that is raised.
        largest: size in bytes.
    """
    # Not Path.exists, which raises where a name is too long.
    if not os.path.exists(path):
        raise error(f"{one_line(str(path), LONGEST_PATH)}: no such file")
    if not path.is_file():
        raise error(f"{path}: is no file, so not {what}")
    if largest is not None and path.stat().st_size > largest:
        raise error(f"{path}: not {what}, which takes {largest >> 20} MB at most")


def read_record(
    path: Path,
    record: type[T],
    what: str,
    error: type[NextviewError] = ModelError,
) -> T:
    """Read a typed record from a JSON file.

    An ``error`` is raised if the file is missing, too large, or holds no such record.

    Args:
        path: of the JSON file.
        record: type of the record.
        what: the file should be, in the sentence.
        error: kind of error that is raised.
    """
    regular_file(path, what, error, LARGEST_RECORD)
    try:
        content = path.read_bytes()
    except OSError as raised:
        raise error(f"{path}: cannot be read ({raised.strerror})") from None
    return decode_record(content, record, f"{path}: not {what}", error)


def decode_record(
    content: bytes | dict[str, Any],
    record: type[T],
    where: str,
    error: type[NextviewError],
) -> T:
    """A typed record from JSON, or from the objects that JSON was read to.

    Where it is none, an ``error`` names the field; its sentence begins with ``where``.

    Args:
        content: JSON, or what it was read to.
        record: type of the record.
        where: beginning of the sentence of an error.
        error: kind of error that is raised.
    """
    try:
        if isinstance(content, bytes):
            return msgspec.json.decode(content, type=record)
        return msgspec.convert(content, record)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as raised:
        raise error(f"{where} ({raised})") from None


def write_record(path: Path, record: Any, overwrite: bool = False) -> None:
    """Write a record as indented JSON, whole or not at all; see ``new_file``.

    Args:
        path: of the JSON file.
        record: a dataclass.
        overwrite: whether a file that exists may be replaced.
    """
    with new_file(path, overwrite) as part:
        part.write_bytes(
            msgspec.json.format(msgspec.json.encode(record, enc_hook=_plain), indent=1)
            + b"\n"
        )


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError(f"{type(value).__name__} in a record")


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file, 64 hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def checked_bytes(path: Path, sha256: str, what: str = "weights") -> bytes:
    """Read a file and compare it with the hash on its card.

    ModelError is raised if the file is missing or differs.

    Args:
        path: of the file.
        sha256: its hash, hexadecimal.
        what: the file holds, in the sentence.
    """
    regular_file(path, what, ModelError)
    content = path.read_bytes()
    if hashlib.sha256(content).hexdigest() != sha256:
        raise ModelError(
            f"{path}: is not the file that its card describes (the SHA-256 differs)"
        )
    return content


def arrays_in(
    content: bytes,
    names: Sequence[str],
    where: str,
) -> dict[str, np.ndarray]:
    """Read the named arrays from the content of a safetensors file.

    Args:
        content: bytes of the file.
        names: required arrays; other arrays are ignored.
        where: beginning of an error message ("a.safetensors: not a memory").

    Returns:
        The arrays by name. The caller checks their shapes and types.

    Raises:
        ModelError: the content is not a safetensors file, or an array is missing.
    """
    # here, as most of what imports this module reads no arrays
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        arrays = load(content)
    except SafetensorError as error:
        raise ModelError(f"{where} ({error})") from None
    except KeyError as error:  # a type that NumPy does not have, such as BF16
        raise ModelError(f"{where} (it holds numbers of the type {error})") from None

    for name in names:
        if name not in arrays:
            raise ModelError(f"{where} (it holds no {name})")
    return {name: arrays[name] for name in names}


def command() -> str:
    """The command that runs now, one line for a shell: noted by what it makes."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
