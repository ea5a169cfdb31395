"""Captured frames on disk, and helpers for all layouts."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from nextview.checks import one_line
from nextview.errors import DAMAGED, DatasetError, NextviewError, ObservationError
from nextview.files import regular_file
from nextview.sensing.frame import (
    LARGEST_MEDIAN,
    NEAREST_MEDIAN,
    Frame,
    check_pose,
    one_stand,
)
from nextview.types import Float, Float32

NO_DEPTH = np.iinfo(
    np.uint16
).max  # marks invalid depth in some sensors, in addition to 0
DEEP = ("I;16", "I;16B", "I")  # Pillow's names of grey images of 16 bits
GREY_MODES = ("1", "L", "LA", "La")  # its names of grey images of 8 bits or fewer
LARGEST_TEXT = 2**26  # bytes of a list of images or poses
# of a depth or colour image: 4096 x 4096. A PNG of some hundred kilobytes can declare, and contain,
# a thousand times as many
MOST_PIXELS = 2**24
MILLIMETRES = 0.001


class DepthImage(Protocol):
    """Source of the depth of a captured frame; ``str`` names it in errors."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels, without reading the image."""
        ...

    def read(self) -> NDArray[np.uint16] | Float32:
        """Read the image, (H, W): uint16 units, where 0 and 65535 are invalid, or float32.

        Raises:
            DatasetError: it is damaged.
            ObservationError: it is not a depth image.
        """
        ...


@dataclass(frozen=True)
class DepthFile:
    """A depth image in a file.

    Attributes:
        path: 16-bit grey PNG.
    """

    path: Path

    @cached_property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels, from the file header."""
        regular_file(self.path, "an image", DatasetError)
        try:
            return png_size(self.path)
        except ObservationError as error:
            raise DatasetError(f"{self.path}: {error}") from None

    def read(self) -> NDArray[np.uint16]:
        """Read the depth in units of the file, (H, W).

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
    """A captured view, read on demand.

    Attributes:
        name: in the folder.
        depth: image of distances along the optical axis.
        scale: metres per unit of the depth image.
        intrinsics: pinhole matrix, (3, 3) float64, pixels, first pixel's centre at 0 (OpenCV).
        pose: camera-to-world, (4, 4) float64, metres, OpenCV axes.
        mask: image that is not black on the object, if there is one.
        image: grey or colour image registered to the depth, if there is one.
        camera: name of the camera, see ``Frame``.
    """

    name: str
    depth: DepthImage
    scale: float
    intrinsics: Float
    pose: Float
    mask: Path | None = None
    image: Path | None = None
    camera: str = ""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the depth image, pixels."""
        return self.depth.size

    def read(self, masked: bool = True) -> Frame:
        """Read the images.

        Args:
            masked: whether to read the mask.

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
        return Frame(depth, self.intrinsics, self.pose, mask, image, camera=self.camera)

    def _check_scale(self, depth: Float32) -> None:
        """Reject implausible depth with a message about the scale, before ``Frame`` does."""
        measured = depth[depth > 0]
        middle = float(np.median(measured)) if len(measured) else NEAREST_MEDIAN
        if not NEAREST_MEDIAN <= middle <= LARGEST_MEDIAN:
            what = (
                f"the depth has a median of {middle:.3g} m with "
                f"steps of {1000 * self.scale:.3g} mm"
            )
            far = "near" if middle < NEAREST_MEDIAN else "far"
            raise ObservationError(
                f"{self.depth}: {what}, and no depth camera measures so {far}: the depth scale is"
                " wrong"
            )


@dataclass
class LayoutViews:
    """Views found by the reader of a layout.

    Attributes:
        frames: as in ``Capture``, like all but the last.
        notes: a phrase each.
        unreadable: reasons by name.
        object_is_world: as in ``Capture``.
        z_is_up: whether the z axis of the world points up; otherwise the direction is not known.
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
        folder: or file from which they were read.
        layout: one of ``captured.folders.FOLDER_LAYOUTS``.
        frames: in the folder's order, at least one.
        up: direction against gravity in the world; None if the layout does not define it.
        notes: assumptions and omissions, a phrase each.
        unreadable: frames without a usable pose: name and reason.
        object_is_world: the poses are relative to the object, and its surroundings may move.
        scale_given: the depth scale was set by the user.
    """

    folder: Path
    layout: str
    frames: tuple[CapturedFrame, ...]
    up: tuple[float, float, float] | None
    notes: tuple[str, ...]
    unreadable: tuple[tuple[str, str], ...] = ()
    object_is_world: bool = False
    scale_given: bool = False

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, in the order of the frames."""
        return tuple(dict.fromkeys(frame.camera for frame in self.frames))

    @property
    def stands(self) -> bool:
        """True if each camera has a name and never moves, so that the scene may change."""
        first: dict[str, CapturedFrame] = {}
        return all(
            frame.camera and one_stand(frame, first.setdefault(frame.camera, frame))
            for frame in self.frames
        )

    @property
    def moments(self) -> tuple[tuple[CapturedFrame, ...], ...]:
        """Frames of all cameras that were taken together, in order; they share their name."""
        together: dict[str, list[CapturedFrame]] = {}
        for frame in self.frames:
            name = frame.name.removeprefix(f"{frame.camera}/")
            together.setdefault(name, []).append(frame)
        several = len(self.cameras) > 1
        order = sorted(together) if several else list(together)
        return tuple(tuple(together[name]) for name in order)

    @property
    def at_one_moment(self) -> "Capture":
        """The frames of the first moment, if cameras stand still; otherwise all."""
        if not self.stands or len(self.moments) == 1:
            return self
        first = self.moments[0]
        names = ", ".join(frame.name for frame in first)
        note = f"cameras that stand still show an object at one moment: {names} is used"
        return replace(self, frames=first, notes=(*self.notes, note))

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
    """Read the words of each line that is not a comment.

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
        finite: whether all must be finite.

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
    """Read a mask, (H, W) uint8 (ITU-R BT.601)."""
    return np.asarray(_opened_as(path, shape).convert("L"))


def _picture(path: Path, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Read an image, (H, W) uint8 if it is grey, else (H, W, 3) uint8, RGB."""
    image = _opened_as(path, shape)
    return np.asarray(image.convert("L" if image.mode in GREY_MODES else "RGB"))


def _opened_as(path: Path, shape: tuple[int, ...]) -> Image.Image:
    """Open an 8-bit image of the depth image's size; raises DatasetError otherwise."""
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
            return image  # loaded, although the file is closed
    except ObservationError as error:
        raise DatasetError(f"{path}: {error}") from None


def png_size(file: Path | BinaryIO) -> tuple[int, int]:
    """Return width and height of a PNG, pixels, from its header.

    Args:
        file: or its path.

    Raises:
        ObservationError: it is damaged, or larger than ``MOST_PIXELS``.
    """
    with opened_image(file, ("PNG",)) as image:
        return image.size


def steps_of(file: Path | BinaryIO) -> NDArray[np.uint16]:
    """Return the values of a 16-bit grey PNG, (H, W).

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
    """Open an image of limited size without reading its pixels.

    Args:
        file: or its path.
        formats: as named by Pillow.

    Raises:
        ObservationError: it is damaged, or larger than ``MOST_PIXELS``.
    """
    try:
        with warnings.catch_warnings():
            # Pillow's own limit is higher
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
