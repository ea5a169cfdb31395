"""Download a published dataset: resumed where it was cut, verified, and unpacked whole or not at all."""

from __future__ import annotations

import hashlib
import http.client
import shutil
import stat
import time
import urllib.request
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from urllib.error import HTTPError, URLError

from nextview.arguments import as_line, in_one_line, number, of_kind, takes_paths, whole
from nextview.data.lock import only_one
from nextview.errors import DatasetError, UsageError
from nextview.outputs import written_whole

CHUNK = 1 << 18
DAY = 86_400
"""Seconds."""
LONGEST = 200
"""Letters of what a server says of itself."""
PATIENCE = 5
"""Connections in a row that may bring nothing new before we give up."""


@dataclass(frozen=True)
class Archive:
    """A published zip file.

    Attributes:
        url: where it is.
        size: in bytes.
        sha256: of the whole file, hexadecimal.
        folder: the only folder in it that is unpacked.

    Raises:
        DatasetError: these are none.
        UsageError: there is no such size.
    """

    url: str
    size: int
    sha256: str
    folder: str

    def __post_init__(self) -> None:
        for text, what in ((self.url, "URL"), (self.sha256, "SHA-256"), (self.folder, "folder")):
            of_kind(text, str, f"the {what} of an archive is a text", DatasetError)
        whole(self.size, "the size of an archive", 1, 2**50)
        if not self.folder or PurePosixPath(self.folder).name != self.folder:
            raise DatasetError(f"the folder of an archive is a name, not {as_line(self.folder)}")


ARCHIVES = {
    "modelnet10": Archive(
        "http://3dvision.princeton.edu/projects/2014/3DShapeNets/ModelNet10.zip",
        473_402_300,
        "9d8679435fc07d1d26f13009878db164a7aa8ea5e7ea3c8880e42794b7307d51",
        "ModelNet10",
    ),
    "modelnet40": Archive(
        "http://modelnet.cs.princeton.edu/ModelNet40.zip",
        2_039_180_837,
        "42dc3e656932e387f554e25a4eb2cc0e1a1bd3ab54606e2a9eae444c60e536ac",
        "ModelNet40",
    ),
}


@takes_paths("destination")
def download(
    archive: Archive, destination: Path, timeout: float = 60, pause: float = 1
) -> Iterator[tuple[str, int, int]]:
    """Fetch an archive and unpack it as ``destination / archive.folder``; nothing to do if that is there.

    A download that was cut off goes on from the bytes that have arrived. The unpacked
    folder appears when it is complete.

    Args:
        archive: what to fetch.
        destination: folder to put it into.
        timeout: of one connection without a sign of life, seconds.
        pause: before a connection is tried again, seconds; twice as long after each one more that brought nothing new.

    Yields:
        (what is being done, bytes done, bytes in all).

    Raises:
        DatasetError: it cannot be fetched, is not the published file, or cannot be unpacked safely.
        UsageError: no archive, or no times.
    """
    of_kind(archive, Archive, "what is fetched is an Archive")
    for seconds, what, least in ((timeout, "the timeout", 0.001), (pause, "the pause", 0)):
        if not least <= number(seconds, what) <= DAY:
            raise UsageError(f"{what} is from {least} to {DAY} seconds, not {seconds}")
    folder = destination / archive.folder
    try:
        destination.mkdir(parents=True, exist_ok=True)
        with only_one(folder):
            if folder.is_dir() and any(folder.iterdir()):
                return
            if folder.exists() and not folder.is_dir():
                raise DatasetError(f"{folder}: is a file where the dataset's folder has to be; move it away")
            part = destination / f"{archive.folder}.zip.part"
            for done in _fetch(archive, part, timeout, pause):
                yield "downloading", done, archive.size
            for done in _verify(archive, part):
                yield "verifying", done, archive.size
            for done, total in _unpack(archive, part, folder):
                yield "unpacking", done, total
            part.unlink()
    except OSError as error:
        raise DatasetError(f"{destination}: cannot be written ({error.strerror or error})") from None


def _fetch(archive: Archive, part: Path, timeout: float, pause: float) -> Iterator[int]:
    """Bring ``part`` to the archive's size, over as many connections as it takes; yields its size."""
    failures, reason = 0, ""
    furthest = start = part.stat().st_size if part.exists() else 0
    while start < archive.size:
        if failures == PATIENCE:
            raise DatasetError(f"{archive.url}: {reason}; {start} of {archive.size} bytes are kept, try again later")
        if reason:
            time.sleep(pause * 2**failures)
        failures += 1
        try:
            request = urllib.request.Request(archive.url, headers={"Range": f"bytes={start}-"} if start else {})
            with urllib.request.urlopen(request, timeout=timeout) as answer:
                start = _announced(archive, answer, start)
                with part.open("ab" if start else "wb") as file:
                    while data := _read(answer, archive.size - start):
                        file.write(data)
                        start += len(data)
                        if start > furthest:  # a server that knows no ranges brings the same again, perhaps for ever
                            furthest, failures = start, 0
                        yield start
            reason = "the connection ends before the file does"
        except DatasetError:
            raise
        except HTTPError as error:
            error.close()
            reason = f"the server answers {error.code} {in_one_line(str(error.reason), LONGEST)}"
            if error.code < 500:
                raise DatasetError(f"{archive.url}: {reason}") from None
        except (http.client.HTTPException, ConnectionError, TimeoutError, URLError, ValueError) as error:
            said = in_one_line(str(getattr(error, "reason", error)), LONGEST) or type(error).__name__
            reason = f"the connection fails ({said})"


def _announced(archive: Archive, answer: http.client.HTTPResponse, start: int) -> int:
    """From which byte on an answer brings the file, 0 if the server knows no ranges.

    Raises:
        DatasetError: it brings another file, or says of it what makes no sense.
    """
    length, given = answer.headers.get("Content-Length"), answer.headers.get("Content-Range", f"bytes {start}-")
    if answer.status != 206:
        start = 0
    elif not given.startswith(f"bytes {start}-"):
        raise DatasetError(f"{archive.url}: asked for the bytes from {start} on, the server sends {given[:60]!r}")
    if length is None:
        return start
    if not (length.isascii() and length.isdigit() and len(length) < 20):
        raise DatasetError(f"{archive.url}: the server announces {length[:60]!r} bytes, which is no number")
    if start + int(length) != archive.size:
        raise DatasetError(
            f"{archive.url}: the server announces {start + int(length)} bytes, "
            f"but the published file has {archive.size}"
        )
    return start


def _read(answer: http.client.HTTPResponse, missing: int) -> bytes:
    """The next bytes, never more than are missing: a server that sends too much fills no disk."""
    return answer.read1(min(CHUNK, missing)) if missing else b""


def _verify(archive: Archive, part: Path) -> Iterator[int]:
    digest, done = hashlib.sha256(), 0
    with part.open("rb") as file:
        while data := file.read(1 << 22):
            digest.update(data)
            done += len(data)
            yield done
    if (done, digest.hexdigest()) != (archive.size, archive.sha256):
        part.unlink()
        raise DatasetError(f"{archive.url}: what arrived is not the published file (its SHA-256 differs); removed it")


def _unpack(archive: Archive, part: Path, folder: Path) -> Iterator[tuple[int, int]]:
    """Unpack the archive's folder beside its place, then rename it there; yields bytes done and in all."""
    try:
        with written_whole(folder) as aside, zipfile.ZipFile(part) as file:
            members = [m for m in file.infolist() if not m.is_dir()]
            for member in members:
                path = PurePosixPath(member.filename)
                if path.is_absolute() or ".." in path.parts or "\\" in member.filename or ":" in member.filename:
                    raise DatasetError(f"{archive.url}: refused, it wants to write outside its folder ({path})")
                if stat.S_ISLNK(member.external_attr >> 16):
                    raise DatasetError(f"{archive.url}: refused, it holds a link ({path})")
            members = [m for m in members if PurePosixPath(m.filename).parts[0] == archive.folder]
            if not members:
                raise DatasetError(f"{archive.url}: holds no folder {archive.folder}")
            done, total = 0, sum(m.file_size for m in members)
            free = shutil.disk_usage(folder.parent).free
            if total > free:
                raise DatasetError(f"{folder.parent}: {total} bytes are to be unpacked, but only {free} are free")
            for member in members:
                target = aside.joinpath(*PurePosixPath(member.filename).parts[1:])
                target.parent.mkdir(parents=True, exist_ok=True)
                with file.open(member) as source, target.open("wb") as out:
                    shutil.copyfileobj(source, out)  # no more than file_size, and its CRC is checked
                done += member.file_size
                yield done, total
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError) as error:
        raise DatasetError(f"{archive.url}: cannot be unpacked ({error})") from None
