"""Captured frames as they lie on the disk, and what all layouts of them are read with."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from nextview.checks import one_line
from nextview.errors import DAMAGED, DatasetError, NextviewError, ObservationError
from nextview.files import regular_file
from nextview.sensing.frame import LARGEST_MEDIAN, NEAREST_MEDIAN, Frame, check_pose
from nextview.types import Float, Float32

NO_DEPTH = np.iinfo(np.uint16).max  # what some sensors give for "nothing" besides 0
DEEP = ("I;16", "I;16B", "I")  # Pillow's names of grey images of 16 bits
GREY_MODES = ("1", "L", "LA", "La")  # its names of grey images of 8 bits or fewer
LARGEST_TEXT = 2**26  # bytes of a list of images or poses
# of a depth image or a picture beside it: 4096 x 4096. A PNG of some hundred kilobytes can claim,
# and hold, a thousand times as much
MOST_PIXELS = 2**24
MILLIMETRES = 0.001


class DepthImage(Protocol):
    """Where the depth of a captured frame is kept; ``str`` names it in errors."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels, without reading the image."""
        ...

    def read(self) -> NDArray[np.uint16] | Float32:
        """Read the image, (H, W): uint16 steps, of which 0 and 65535 mean nothing, or float32.

        Raises:
            DatasetError: it is damaged.
            ObservationError: it is no depth image.
        """
        ...


@dataclass(frozen=True)
class DepthFile:
    """A depth image in a file.

    Attributes:
        path: grey PNG of 16 bits.
    """

    path: Path

    @cached_property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels, from the file's header alone."""
        regular_file(self.path, "an image", DatasetError)
        try:
            return png_size(self.path)
        except ObservationError as error:
            raise DatasetError(f"{self.path}: {error}") from None

    def read(self) -> NDArray[np.uint16]:
        """Read the steps of the image, (H, W).

        Raises:
            DatasetError: it is damaged, or has 8 bits.
        """
        regular_file(self.path, "an image", DatasetError)
        try:
            return steps_of(self.path)
        except ObservationError as error:
            raise DatasetError(f"{self.path}: {error}") from None

    def __str__(self) -> str:
        return str(self.path)


@dataclass(frozen=True)
class CapturedFrame:
    """A captured view, as yet unread.

    Attributes:
        name: in the folder.
        depth: image of distances along the optical axis.
        scale: metres that one step of the depth image stands for.
        intrinsics: pinhole matrix, (3, 3) float64, pixels, first pixel's centre at 0 (OpenCV).
        pose: camera-to-world, (4, 4) float64, metres, OpenCV axes.
        mask: picture that is not black where the object is, if there is one.
        image: grey or colour picture registered to the depth, if there is one.
    """

    name: str
    depth: DepthImage
    scale: float
    intrinsics: Float
    pose: Float
    mask: Path | None = None
    image: Path | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the depth image, pixels."""
        return self.depth.size

    def read(self, masked: bool = True) -> Frame:
        """Read the images.

        Args:
            masked: whether the mask is read.

        Raises:
            DatasetError: an image is damaged.
            ObservationError: the depth image has no usable depth.
        """
        raw = self.depth.read()
        something = raw != NO_DEPTH if raw.dtype == np.uint16 else np.isfinite(raw)
        depth = np.where(something, raw, 0) * np.float32(self.scale)
        self._check_scale(depth)

        mask = None
        if masked and self.mask is not None:
            mask = _as_grey(self.mask, raw.shape) > 0
        image = None if self.image is None else _picture(self.image, raw.shape)
        return Frame(depth, self.intrinsics, self.pose, mask, image)

    def _check_scale(self, depth: Float32) -> None:
        """Refuse depth that no camera measures: ``Frame`` would speak of other mistakes."""
        measured = depth[depth > 0]
        middle = float(np.median(measured)) if len(measured) else NEAREST_MEDIAN
        if not NEAREST_MEDIAN <= middle <= LARGEST_MEDIAN:
            what = (
                f"the depth has a median of {middle:.3g} m with "
                f"steps of {1000 * self.scale:.3g} mm"
            )
            raise ObservationError(f"{self.depth}: {what}: the depth scale is wrong")


@dataclass
class LayoutViews:
    """What a layout's reader finds.

    Attributes:
        frames: as in ``Capture``, like all but the last.
        notes: a phrase each.
        unreadable: reasons by name.
        object_is_world: see there.
        z_is_up: whether the z axis of the world is against gravity; else that is not known.
    """

    frames: list[CapturedFrame]
    notes: list[str]
    unreadable: dict[str, str] = field(default_factory=dict)
    object_is_world: bool = False
    z_is_up: bool = True


@dataclass(frozen=True)
class Capture:
    """Captured views of one scene.

    Attributes:
        folder: or the file that they were read from.
        layout: one of ``captured.LAYOUTS``.
        frames: in the folder's order, at least one.
        up: direction against gravity in its world; None if the layout says nothing.
        notes: what was assumed or left out, a phrase each.
        unreadable: frames without a usable pose: name and reason.
        object_is_world: the poses are relative to the object: what is around it may move.
        scale_given: the depth scale was given by hand.
    """

    folder: Path
    layout: str
    frames: tuple[CapturedFrame, ...]
    up: tuple[float, float, float] | None
    notes: tuple[str, ...]
    unreadable: tuple[tuple[str, str], ...] = ()
    object_is_world: bool = False
    scale_given: bool = False

    def __repr__(self) -> str:
        count = "1 frame" if len(self.frames) == 1 else f"{len(self.frames)} frames"
        return "; ".join([f"{self.folder}: {self.layout} layout, {count}", *self.notes])


def rigid(pose: ArrayLike, where: str) -> Float:
    """Check and copy a rigid pose.

    Args:
        pose: (4, 4).
        where: beginning of the error message.

    Returns:
        The copy, (4, 4) float64.

    Raises:
        DatasetError: the pose is not rigid.
    """
    try:
        return check_pose(pose)
    except ObservationError as error:
        raise DatasetError(f"{where}: {error}") from None


def lines_of(path: Path, columns: int, what: str) -> list[list[str]]:
    """Read the words of each line that is no comment.

    Args:
        path: of the file.
        columns: number of words in each line.
        what: content of the file, for messages.

    Returns:
        The words of each line; at least one line.

    Raises:
        DatasetError: the file cannot be read, is empty, or has other lines.
    """
    regular_file(path, f"a list of {what}", DatasetError, LARGEST_TEXT)
    try:
        lines = [
            (n, line.split()) for n, line in enumerate(path.read_text().splitlines(), 1)
        ]
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: cannot be read as text ({error})") from None

    lines = [(n, words) for n, words in lines if words and not words[0].startswith("#")]

    for n, words in ((n, words) for n, words in lines if len(words) != columns):
        raise DatasetError(
            f"{path}: line {n} has {len(words)} words; it lists {what}, {columns} words a line"
        )

    if not lines:
        raise DatasetError(f"{path}: lists nothing; it should list {what}")
    return [words for _, words in lines]


def numbers_of(path: Path, words: list[list[str]], finite: bool = True) -> Float:
    """Convert the words of a file to numbers.

    Args:
        path: of the file, for messages.
        words: of each line.
        finite: whether all have to be finite.

    Returns:
        The numbers.

    Raises:
        DatasetError: a word is not a number, or not finite.
    """
    try:
        values = np.array(words, np.float64)
    except ValueError as error:
        raise DatasetError(f"{path}: a number is expected ({error})") from None
    if finite and not np.isfinite(values).all():
        raise DatasetError(
            f"{path}: holds NaN or infinity; was the camera lost here? Remove this frame"
        )
    return values


def read_table(path: Path, what: str, side: int) -> Float:
    """Read a square table of numbers.

    Args:
        path: of the file.
        what: content of the file, for messages.
        side: rows and columns.

    Returns:
        The table, (side, side) float64.

    Raises:
        DatasetError: the file holds another table.
    """
    values = numbers_of(path, lines_of(path, side, what))
    if len(values) != side:
        raise DatasetError(f"{path}: not {what}, {side} x {side} numbers")
    return values


def _as_grey(path: Path, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """A mask, (H, W) uint8 (ITU-R BT.601)."""
    return np.asarray(_opened_as(path, shape).convert("L"))


def _picture(path: Path, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """A picture, (H, W) uint8 if it is grey, else (H, W, 3) uint8, RGB."""
    image = _opened_as(path, shape)
    return np.asarray(image.convert("L" if image.mode in GREY_MODES else "RGB"))


def _opened_as(path: Path, shape: tuple[int, ...]) -> Image.Image:
    """An image of 8 bits and of the depth image's shape; else a DatasetError."""
    regular_file(path, "an image", DatasetError)
    try:
        with opened_image(path, ("PNG", "JPEG")) as image:
            if (image.height, image.width) != shape:
                raise ObservationError(
                    f"is {image.width} x {image.height} pixels, the depth image {shape[1]} x"
                    f" {shape[0]}"
                )
            if image.mode in DEEP:
                raise ObservationError(
                    "has 16 bits where 8 are expected; is it a depth image?"
                )
            image.load()
            return image  # its file is closed, its pixels stay
    except ObservationError as error:
        raise DatasetError(f"{path}: {error}") from None


def png_size(file: Path | BinaryIO) -> tuple[int, int]:
    """Width and height of a PNG, pixels, from its header alone.

    Args:
        file: or its path.

    Raises:
        ObservationError: it is damaged, or larger than ``MOST_PIXELS``.
    """
    with opened_image(file, ("PNG",)) as image:
        return image.size


def steps_of(file: Path | BinaryIO) -> NDArray[np.uint16]:
    """The steps of a grey PNG of 16 bits, (H, W).

    Args:
        file: or its path.

    Raises:
        ObservationError: it is damaged, has 8 bits, or is larger than ``MOST_PIXELS``.
    """
    with opened_image(file, ("PNG",)) as image:
        if image.mode not in DEEP:
            raise ObservationError(
                f"depth is a grey PNG of 16 bits, this one has 8 (mode {image.mode})"
            )
        return np.asarray(image).astype(np.uint16)


@contextmanager
def opened_image(
    file: Path | BinaryIO,
    formats: tuple[str, ...],
) -> Iterator[Image.Image]:
    """Open an image whose pixels fit into memory, as yet unread.

    Args:
        file: or its path.
        formats: as Pillow names them.

    Raises:
        ObservationError: it is damaged, or larger than ``MOST_PIXELS``.
    """
    try:
        with warnings.catch_warnings():
            # of Pillow's own limit, which lies higher
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(file, formats=formats)
        with image:
            if image.width * image.height > MOST_PIXELS:
                raise ObservationError(
                    f"has {image.width} x {image.height} pixels, more than any depth camera"
                )
            yield image
    except NextviewError:
        raise
    except (*DAMAGED, Image.DecompressionBombError) as error:
        raise ObservationError(
            f"the image is damaged or cannot be read ({one_line(str(error), 200)})"
        ) from None
