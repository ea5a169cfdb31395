"""Download a published dataset, verify it, and unpack it completely or not at all."""

import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

from nextview.checks import one_line
from nextview.errors import DatasetError
from nextview.files import new_folder, only_one

LONGEST_ANSWER = 200  # characters of a server's message that are shown


@dataclass(frozen=True)
class Archive:
    """A published zip file.

    Attributes:
        url: address of the zip file.
        sha256: its SHA-256, hexadecimal.
        folder: folder inside the archive that is unpacked.
    """

    url: str
    sha256: str
    folder: str


ARCHIVES = {
    "modelnet10": Archive(
        "http://3dvision.princeton.edu/projects/2014/3DShapeNets/ModelNet10.zip",
        "9d8679435fc07d1d26f13009878db164a7aa8ea5e7ea3c8880e42794b7307d51",
        "ModelNet10",
    ),
    "modelnet40": Archive(
        "http://modelnet.cs.princeton.edu/ModelNet40.zip",
        "42dc3e656932e387f554e25a4eb2cc0e1a1bd3ab54606e2a9eae444c60e536ac",
        "ModelNet40",
    ),
}


def download(archive: Archive, destination: Path) -> Path:
    """Download and verify an archive and unpack it below a folder.

    Nothing is done if the unpacked folder already exists.

    Args:
        archive: the archive.
        destination: folder in which ``archive.folder`` is created.

    Returns:
        The unpacked folder.

    Raises:
        DatasetError: the archive cannot be downloaded, is not the published file, or cannot be
            unpacked.
    """
    import pooch
    import requests

    folder = Path(destination) / archive.folder
    with only_one(folder):
        if folder.is_dir() and any(folder.iterdir()):
            return folder
        with (
            new_folder(folder) as part,
            tempfile.TemporaryDirectory(dir=folder.parent, prefix=".zip-") as place,
        ):
            pooch.get_logger().setLevel("ERROR")
            try:
                file = pooch.retrieve(
                    archive.url, f"sha256:{archive.sha256}", "archive.zip", place
                )
                with zipfile.ZipFile(file) as content:
                    inside = [
                        m
                        for m in content.infolist()
                        if m.filename.startswith(f"{archive.folder}/")
                    ]
                    content.extractall(place, inside)
            except (
                requests.RequestException,
                ValueError,
                zipfile.BadZipFile,
                NotImplementedError,
            ) as error:
                raise DatasetError(
                    f"{archive.url}: {one_line(str(error), LONGEST_ANSWER)}"
                ) from None
            if not inside:
                raise DatasetError(f"{archive.url}: holds no folder {archive.folder}")
            part.rmdir()
            (Path(place) / archive.folder).rename(part)
    return folder
