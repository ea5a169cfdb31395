"""A frozen archive of episodes: what a method may see, and, in files of their own, the truth.

An archive is a folder. ``manifest.json`` names every other file with its SHA-256, and every image
with that of its pixels; the SHA-256 of the manifest is that of the archive. ``things.json`` lists
the things that may be shown, ``episodes/NUMBER/`` holds the candidate views of one thing in one
place, and ``truth/NUMBER.json`` what it is and where it lies. Only ``truth`` reads the latter.
"""

import hashlib
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from nextview.captured.frames import opened_image, rigid, steps_of
from nextview.errors import DatasetError, ModelError, ObservationError
from nextview.files import (
    HashText,
    checked_bytes,
    decode_record,
    regular_file,
    sha256_of,
    write_record,
)
from nextview.types import Float, Float32, Mask

MANIFEST = "manifest.json"
THINGS_FILE = "things.json"
EPISODES_FOLDER = "episodes"
TRUTH_FOLDER = "truth"
SCANS_FOLDER = "scans"
EPISODE_FILE = "episode.json"
FROZEN_FORMAT = 3
LARGEST_FROZEN_VIEWS = 400  # of an episode

Matrix = tuple[tuple[float, ...], ...]


class FrozenManifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What an archive is.

    Attributes:
        format: of the files, FROZEN_FORMAT.
        name: of the archive, with its version, such as nextview-bench-1.0.
        seed: of everything random in it.
        made_with: versions of the libraries by name, with which it can be made again.
        files: SHA-256 of every other file, by its path in the archive; of a PNG that of its pixels
            (``pixels_sha256``).
        sealed: None: the truth of all episodes is in the archive.
    """

    format: int
    name: str
    seed: int
    made_with: dict[str, str]
    files: dict[str, HashText]
    sealed: None = None


class FrozenThing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A thing that may be shown.

    Attributes:
        name: of the thing, the answer that is right.
        sha256: of its scan file, in whose frame poses are given.
        licence: of the scan.
        source: where the scan comes from.
    """

    name: str
    sha256: HashText
    licence: str
    source: str


class FrozenEpisode(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a method knows of an episode before it looks.

    Attributes:
        held: whether a gripper holds the thing, so that it need not lie on anything.
        first: number of the first view.
        metres_per_unit: of the depth images.
        intrinsics: pinhole matrix, (3, 3), pixels, the centre of the first pixel at 0.
        poses: reported camera-to-world pose of each candidate view, (V, 4, 4), OpenCV axes,
            metres, in a world with z up.
    """

    held: bool
    first: int
    metres_per_unit: float
    intrinsics: Matrix
    poses: tuple[Matrix, ...]


class EpisodeTruth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What an episode shows.

    Attributes:
        thing: its name.
        place: where it lies, such as shelf.
        pose: of its scan in the world, (4, 4), metres.
        cameras: true camera-to-world poses of the candidate views, (V, 4, 4), metres.
        pixels: of the thing that have a depth, in each candidate view.
    """

    thing: str
    place: str
    pose: Matrix
    cameras: tuple[Matrix, ...]
    pixels: tuple[int, ...]


class FrozenView(NamedTuple):
    """The two images of a view.

    Attributes:
        depth: PNG of 16 bits, 0 where nothing was measured.
        mask: PNG, the pixels of the thing are not 0.
    """

    depth: Path
    mask: Path


class FrozenArchive:
    """An archive on the disk.

    Attributes:
        folder: of the archive.
        manifest: what it is.
        sha256: of the manifest, and so of all files.
    """

    def __init__(self, folder: Path) -> None:
        """Read the manifest and the list of things.

        Args:
            folder: of the archive.

        Raises:
            DatasetError: it is no archive, or one of another format.
        """
        self.folder = Path(folder)
        path = self.folder / MANIFEST
        if not path.is_file():
            raise DatasetError(
                f"{self.folder}: is no frozen archive, which has a {MANIFEST} (docs/submit.md)"
            )

        self.sha256 = sha256_of(path)
        where = f"{path}: not the manifest of an archive"
        self.manifest = decode_record(
            path.read_bytes(), FrozenManifest, where, DatasetError
        )
        if self.manifest.format != FROZEN_FORMAT:
            raise DatasetError(
                f"{path}: has format {self.manifest.format}, this version reads {FROZEN_FORMAT}"
            )

        if not self.numbers:
            raise DatasetError(f"{self.folder}: holds no episode")

    def file(self, path: str) -> Path:
        """Return the place of a file.

        Args:
            path: of the file in the archive.

        Raises:
            DatasetError: the manifest does not name it, or it lies outside.
        """
        if path not in self.manifest.files or ".." in Path(path).parts:
            raise DatasetError(f"{self.folder / path}: is not in the manifest")
        return self.folder / path

    def content(self, path: str) -> bytes:
        """Read a file that is no image, and compare it with the manifest.

        Args:
            path: of the file in the archive.

        Raises:
            DatasetError: it is missing, or has changed.
        """
        place = self.file(path)
        try:
            return checked_bytes(
                place, self.manifest.files[path], "a file of an archive"
            )
        except ModelError:
            raise changed(place) from None

    @cached_property
    def things(self) -> dict[str, FrozenThing]:
        """The things that may be shown, by their names."""
        listed: Any = self._record(THINGS_FILE, tuple[FrozenThing, ...])
        return {thing.name: thing for thing in listed}

    @cached_property
    def numbers(self) -> tuple[str, ...]:
        """Numbers of the episodes, in order."""
        paths = map(Path, self.manifest.files)
        return tuple(
            sorted(path.parent.name for path in paths if path.name == EPISODE_FILE)
        )

    def episode(self, number: str) -> FrozenEpisode:
        """Read what a method knows of an episode.

        Args:
            number: of the episode.

        Raises:
            DatasetError: a file is damaged.
        """
        where = f"{EPISODES_FOLDER}/{number}/{EPISODE_FILE}"
        episode: FrozenEpisode = self._record(where, FrozenEpisode)
        place = str(self.folder / where)
        views = len(episode.poses)
        if not 0 < views <= LARGEST_FROZEN_VIEWS or not 0 <= episode.first < views:
            raise DatasetError(f"{place}: its first view is none of its {views} views")
        if np.shape(episode.intrinsics) != (3, 3) or episode.metres_per_unit <= 0:
            raise DatasetError(f"{place}: its camera is none")
        for pose in episode.poses:
            rigid(pose, place)
        return episode

    def view(self, number: str, view: int) -> FrozenView:
        """Return the images of a view, whose pixels are compared with the manifest.

        Args:
            number: of the episode.
            view: number of the view.

        Raises:
            DatasetError: a file is missing, or has changed.
        """
        place = f"{EPISODES_FOLDER}/{number}/{view:03d}"
        names = (f"{place}.png", f"{place}-mask.png")
        for name in names:
            image = self.file(name)
            try:
                same = pixels_sha256(image) == self.manifest.files[name]
            except ObservationError:
                same = False
            if not same:
                raise changed(image)
        return FrozenView(*(self.folder / name for name in names))

    def truths(self) -> dict[str, EpisodeTruth]:
        """Read what the episodes show, which no method may, by their numbers.

        Raises:
            DatasetError: a file is damaged.
        """
        return {number: self._truth(number) for number in self.numbers}

    def _truth(self, number: str) -> EpisodeTruth:
        """Read what an episode shows; DatasetError."""
        where = f"{TRUTH_FOLDER}/{number}.json"
        truth: EpisodeTruth = self._record(where, EpisodeTruth)
        rigid(truth.pose, str(self.folder / where))
        if truth.thing not in self.things:
            raise DatasetError(
                f"{self.folder / where}: its thing is not in {THINGS_FILE}"
            )
        return truth

    def scan(self, name: str) -> Path:
        """Return the scan file of a thing that may be shown; DatasetError if it has changed.

        Args:
            name: of the thing.
        """
        place = f"{SCANS_FOLDER}/{name}.ply"
        self.content(place)
        return self.folder / place

    def _record(self, path: str, record: Any) -> Any:
        where = f"{self.folder / path}: not what it should be"
        return decode_record(self.content(path), record, where, DatasetError)


def changed(place: Path) -> DatasetError:
    """Return the error of a file that is not as the manifest has it."""
    return DatasetError(
        f"{place}: is missing, or not the file that the manifest names; get the archive again"
    )


def pixels_sha256(path: Path) -> str:
    """Return the SHA-256 of the pixels of a PNG, whose bytes depend on the library that wrote it.

    Hashed are the shape as text, such as ``(480, 640)``, and the values row by row, 4 bytes each,
    little-endian.

    Args:
        path: of the image.

    Raises:
        ObservationError: it is missing or damaged.
    """
    regular_file(path, "an image of an archive", ObservationError)
    with opened_image(path, ("PNG",)) as image:
        pixels = np.asarray(image).astype("<u4")
    return hashlib.sha256(str(pixels.shape).encode() + pixels.tobytes()).hexdigest()


def read_view(view: FrozenView, metres_per_unit: float) -> tuple[Float32, Mask]:
    """Read the images of a view.

    Args:
        view: their files.
        metres_per_unit: of the depth image.

    Returns:
        Depth, (H, W) float32, metres, 0 for holes; and the pixels of the thing, (H, W) bool.

    Raises:
        DatasetError: an image is damaged, or the two differ in size.
    """
    try:
        depth = steps_of(view.depth)
        with opened_image(view.mask, ("PNG",)) as image:
            mask = np.asarray(image.convert("L")) > 0
    except ObservationError as error:
        raise DatasetError(f"{view.depth}: {error}") from None
    if mask.shape != depth.shape:
        raise DatasetError(f"{view.mask}: has another size than the depth image")
    return (depth * metres_per_unit).astype(np.float32), mask


def seal(
    folder: Path,
    name: str,
    seed: int,
    made_with: dict[str, str],
) -> str:
    """Write the manifest of an archive, which makes it whole.

    Args:
        folder: with all other files; those whose names begin with a dot do not belong to it.
        name: of the archive, with its version.
        seed: of everything random in it.
        made_with: versions of the libraries by name.

    Returns:
        The SHA-256 of the archive.

    Raises:
        ResultsError: the folder has a manifest.
    """
    files = {}
    for path in sorted(folder.rglob("*")):
        place = path.relative_to(folder)
        if path.is_file() and not any(part.startswith(".") for part in place.parts):
            hashed = pixels_sha256 if path.suffix == ".png" else sha256_of
            files[place.as_posix()] = hashed(path)
    manifest = FrozenManifest(FROZEN_FORMAT, name, seed, made_with, files)
    write_record(folder / MANIFEST, manifest)
    return sha256_of(folder / MANIFEST)


def as_matrix(values: Float) -> Matrix:
    """Return an array, (N, M), as a matrix of a record."""
    return tuple(tuple(map(float, row)) for row in np.asarray(values))
