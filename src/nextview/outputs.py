"""Outputs that appear whole or not at all, and replace nothing but what nextview itself has written.

What is being written lies in a hidden folder of its own, ``.nextview-NAME-XXXXXXXX`` beside its place, until it is
whole. A run that is killed leaves that folder behind, and the next one that writes to the same place removes it: each
run holds a lock on its own, which the system frees when it dies. A folder of results
lists its files in manifest.json, and is replaced only while it holds these files, unchanged, and no others.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from nextview.data.lock import hold, only_one
from nextview.errors import ResultsError

MANIFEST = "manifest.json"
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""What the system says when nothing more can be written."""


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A path to write a file or a new folder to, which then takes the place of ``path``. Missing folders are made.

    Raises:
        ResultsError: it cannot be written, or the disk is full; what was at ``path`` is still there.
    """
    place = _place(path)
    with ExitStack() as cleanup:
        with _said_of(path):
            place.parent.mkdir(parents=True, exist_ok=True)
            aside = _new_folder_beside(place, cleanup)
        with _disk_full_is_said(path):
            yield aside / place.name
        with _said_of(path):
            os.replace(aside / place.name, place)


def check_file(path: Path) -> None:
    """See, before any work is done, that a file can be written; nothing is touched.

    Raises:
        ResultsError: ``path`` is a link or a folder, lies below a file, or cannot be written.
    """
    _check_place(path)
    if path.is_dir():
        raise ResultsError(f"{path}: is a folder; give the name of a file")


def check_new_folder(folder: Path) -> None:
    """See, before any work is done, that a new folder can be written with ``written_whole``; nothing is touched.

    Raises:
        ResultsError: ``folder`` is a link or a file, holds something, lies below a file, or cannot be written.
    """
    _check_place(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        what = "holds something already" if folder.is_dir() else "is a file"
        raise ResultsError(f"{folder}: {what}; give the name of a new folder")


@contextmanager
def written_results(folder: Path, kind: str) -> Iterator[Path]:
    """A new folder to write results into, which then takes the place of ``folder``.

    No other run can write there meanwhile. The old results are moved aside, the new ones put in their place, and only
    then the old ones removed. If a run was killed in between, the next one puts its results in place first.

    Args:
        folder: earlier results of the same kind there are replaced.
        kind: of results, such as "benchmark".

    Raises:
        ResultsError: ``folder`` cannot be written, must not be replaced, see ``check_folder``, or the disk is full.
        DatasetError: another run is writing there.
    """
    check_folder(folder, kind)
    place = _place(folder)
    with only_one(place), ExitStack() as cleanup:
        _finish_cut(place, kind)
        check_folder(folder, kind)
        with _said_of(folder):
            aside = _new_folder_beside(place, cleanup)
        new = aside / "new"
        with _disk_full_is_said(folder):
            new.mkdir()
            yield new
            files = {
                entry.name: _size_and_hash(Path(entry.path)) for entry in sorted(os.scandir(new), key=lambda e: e.name)
            }
            _write_manifest(new, kind, files)
        cleanup.pop_all()  # from here on, whatever happens, the new results are kept
        _swap(folder, place, aside, kind)


def check_folder(folder: Path, kind: str) -> None:
    """See, before any work is done, that results can be written; nothing is touched.

    Raises:
        ResultsError: ``folder`` is a link or a file, lies below a file, cannot be written, or holds anything but
            unchanged results of that kind that nextview has written.
    """
    _check_place(folder)
    place = _place(folder)
    if not place.exists():
        return
    if not place.is_dir():
        raise ResultsError(f"{folder}: is a file; give a folder")
    if Path.cwd().is_relative_to(place):
        raise ResultsError(f"{folder}: the working folder cannot be replaced; give another folder")
    if os.path.ismount(place):
        raise ResultsError(f"{folder}: a mount point cannot be replaced; give a folder in it")
    if not os.access(place, os.R_OK | os.W_OK | os.X_OK):
        raise ResultsError(f"{folder}: cannot be written (Permission denied)")
    names = sorted(entry.name for entry in os.scandir(place))
    if not names:
        return
    files = _read_manifest(place, kind)
    if files is None:
        raise ResultsError(f"{folder}: is there and holds no {kind} results of nextview's; give another folder")
    for name in names:
        if name == MANIFEST:
            continue
        if name not in files:
            raise ResultsError(f"{folder}: holds {name}, which nextview did not write; move it or give another folder")
        if not _is_as_noted(place / name, files[name]):
            raise ResultsError(f"{folder}: {name} has changed since nextview wrote it; move it or give another folder")


def begin_folder(folder: Path, kind: str) -> None:
    """Give a folder, made if it is not there, the manifest in which ``added_file`` notes what it adds.

    Raises:
        ResultsError: it cannot be written, or holds another manifest.json.
    """
    if _read_manifest(folder, kind) is None:
        path = folder / MANIFEST
        check_file(path)
        if path.exists():
            raise ResultsError(f"{path}: is there and is none of nextview's {kind} results; give another folder")
        with written_whole(path) as part:
            _write_manifest(part.parent, kind, {})


@contextmanager
def added_file(folder: Path, name: str, kind: str) -> Iterator[Path]:
    """A path to write one more file of a folder of results to, which is then put there and noted in the manifest.

    Raises:
        ResultsError: it cannot be written, or must not be replaced, see ``check_added``.
        DatasetError: another run is writing there.
    """
    check_added(folder, name, kind)
    place = _place(folder.resolve())
    with only_one(place), ExitStack() as cleanup:
        check_added(folder, name, kind)
        with _said_of(folder):
            aside = _new_folder_beside(place, cleanup)
        with _disk_full_is_said(folder / name):
            yield aside / name
            files = _read_manifest(place, kind)
            if files is not None:
                _write_manifest(aside, kind, files | {name: _size_and_hash(aside / name)})
        with _said_of(folder / name):
            if files is not None:
                os.replace(aside / MANIFEST, place / MANIFEST)
            os.replace(aside / name, place / name)


def check_added(folder: Path, name: str, kind: str) -> None:
    """See, before any work is done, that a file can be added to results; nothing is touched.

    Raises:
        ResultsError: the file cannot be written, or is there and is not as nextview has written it.
    """
    check_file(folder / name)
    files = _read_manifest(folder, kind) or {}
    if (folder / name).exists() and not (name in files and _is_as_noted(folder / name, files[name])):
        raise ResultsError(f"{folder / name}: is there and is not as nextview wrote it; move it or give another name")


def changed_files(folder: Path, kind: str) -> list[str]:
    """Names of the files of a folder of results that are there and not as they were written."""
    files = _read_manifest(folder, kind) or {}
    return [
        name for name, noted in files.items() if (folder / name).exists() and not _is_as_noted(folder / name, noted)
    ]


def left_by_a_cut(folder: Path, kind: str) -> Path | None:
    """Whole results, beside ``folder``, of a run that was killed just while it put them there; None if there are none.

    That is so while nothing has the name of the folder and old and new results lie together.
    """
    place = _place(folder)
    if os.path.lexists(place) or not place.parent.is_dir():
        return None
    for aside in _asides(place):
        if (aside / "new").is_dir() and (aside / "old").is_dir():
            for found in (aside / "new", aside / "old"):
                files = _read_manifest(found, kind)
                if files and all(_is_as_noted(found / name, noted) for name, noted in files.items()):
                    return found
    return None


def _finish_cut(place: Path, kind: str) -> None:
    """Put the results of a run that was killed in between in place, and remove those that they replace."""
    found = left_by_a_cut(place, kind)
    if found is not None:
        found.rename(place)
        if found.name == "new":
            with suppress(OSError):  # something else is in it: it stays
                _remove(found.with_name("old"), kind)
                found.parent.rmdir()


def _swap(folder: Path, place: Path, aside: Path, kind: str) -> None:
    """Put the new results in place, then remove the old ones. At every moment one of the two is whole."""
    new, old = aside / "new", aside / "old"
    try:
        check_folder(folder, kind)  # it may have changed while the results were made
        if place.exists():
            place.rename(old)
        try:
            new.rename(place)
        except OSError:
            if old.exists():
                old.rename(place)
            raise
    except ResultsError as error:
        raise ResultsError(f"{error}; the new results are in {new}") from None
    except OSError as error:
        raise ResultsError(f"{folder}: cannot be replaced ({error.strerror}); the new results are in {new}") from None
    try:
        if old.exists():
            _remove(old, kind)
        aside.rmdir()
    except OSError as error:
        raise ResultsError(f"{folder}: is written, but {old} cannot be removed ({error.strerror})") from None


def _remove(folder: Path, kind: str) -> None:
    """Remove the files that the manifest of results names, if unchanged, and the folder if nothing else is in it."""
    for name, noted in (_read_manifest(folder, kind) or {}).items():
        if _is_as_noted(folder / name, noted):
            (folder / name).unlink()
    if {entry.name for entry in os.scandir(folder)} == {MANIFEST}:
        (folder / MANIFEST).unlink()
    folder.rmdir()


def _check_place(path: Path) -> None:
    """Refuse a link, and what cannot be made where it is to be."""
    if path.is_symlink():
        raise ResultsError(f"{path}: is a link; give what it points to")
    above = _place(path).parent
    while not os.path.lexists(above):
        above = above.parent
    if not above.is_dir():
        raise ResultsError(f"{path}: cannot be written ({above} is not a folder)")
    if not os.access(above, os.W_OK | os.X_OK):
        raise ResultsError(f"{path}: cannot be written (no permission to write in {above})")


def _place(path: Path) -> Path:
    """Where a path lies, without links on the way and with a name of its own also for ``.`` and ``..``."""
    if path.name in ("", ".."):
        return Path(os.path.realpath(path))
    return Path(os.path.realpath(path.parent)) / path.name


def _new_folder_beside(place: Path, cleanup: ExitStack) -> Path:
    """A hidden folder that is removed by ``cleanup``; before, those that killed runs have left are removed."""
    for left in _asides(place):
        # Results that are whole are kept: nothing else may have them.
        if not (left / "new" / MANIFEST).exists() and not (left / "old").exists():
            with hold(left) as ours:
                if ours:
                    shutil.rmtree(left, ignore_errors=True)
    aside = Path(tempfile.mkdtemp(prefix=f".nextview-{place.name}-", dir=place.parent))
    cleanup.callback(shutil.rmtree, aside, ignore_errors=True)
    cleanup.enter_context(hold(aside))
    return aside


def _asides(place: Path) -> list[Path]:
    """The hidden folders in which what is to be at ``place`` is or was being written."""
    ours = re.compile(re.escape(f".nextview-{place.name}-") + "[a-z0-9_]{8}")
    return sorted(path for path in place.parent.iterdir() if ours.fullmatch(path.name) and not path.is_symlink())


@contextmanager
def _said_of(path: Path) -> Iterator[None]:
    """Turn what the system refuses into a sentence."""
    try:
        yield
    except OSError as error:
        raise ResultsError(f"{path}: cannot be written ({error.strerror or error})") from None


@contextmanager
def _disk_full_is_said(path: Path) -> Iterator[None]:
    """Turn a full disk into a sentence; libraries raise it without the name of a file."""
    try:
        yield
    except OSError as error:
        if error.errno not in FULL:
            raise
        raise ResultsError(f"{path}: cannot be written ({os.strerror(error.errno)})") from None


def _size_and_hash(path: Path) -> dict[str, Any]:
    """What the manifest notes of a file, which is on the disk for good afterwards."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())
        return {"size": path.stat().st_size, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}


def _is_as_noted(path: Path, noted: dict[str, Any]) -> bool:
    """Whether a file is the one that the manifest tells of."""
    if path.is_symlink() or not path.is_file() or path.stat().st_size != noted["size"]:
        return False
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() == noted["sha256"]


def _write_manifest(folder: Path, kind: str, files: dict[str, dict[str, Any]]) -> None:
    manifest = {"program": "nextview", "kind": kind, "files": files}
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n")
    _size_and_hash(folder / MANIFEST)


def _read_manifest(folder: Path, kind: str) -> dict[str, dict[str, Any]] | None:
    """The files of a folder of results; None if nextview has written none of that kind there."""
    path = folder / MANIFEST
    if path.is_symlink() or not path.is_file():
        return None
    try:
        manifest = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        return None
    if not isinstance(manifest, dict) or (manifest.get("program"), manifest.get("kind")) != ("nextview", kind):
        return None
    files = manifest.get("files")
    if not isinstance(files, dict):
        return None
    for name, noted in files.items():
        if Path(name).name != name or not isinstance(noted, dict) or not {"size", "sha256"} <= noted.keys():
            return None  # what lies elsewhere is none of ours
    return files
