"""One captured view: where its images lie, and what they mean."""

from __future__ import annotations

import struct
import warnings
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from nextview.arguments import takes_paths
from nextview.errors import DatasetError, ObservationError
from nextview.sensing.frame import Frame, check_pose

Float = NDArray[np.float64]

NOTHING = np.iinfo(np.uint16).max
"""What some sensors give for "nothing" besides 0."""
DEEP = ("I;16", "I;16B", "I")
"""Pillow's names of grey images of 16 bits."""


@dataclass(frozen=True)
class CapturedFrame:
    """A captured view, as yet unread.

    Attributes:
        name: how the folder calls it.
        depth: 16-bit PNG of distances along the optical axis; 0 and 65535 mean nothing.
        scale: metres that one step of the depth image stands for.
        intrinsics: pinhole matrix, (3, 3) float64, pixels, first pixel's centre at 0 (OpenCV).
        pose: camera-to-world, (4, 4) float64, metres, OpenCV axes.
        mask: picture that is not black where the object is; None if there is none.
        image: grey or colour picture registered to the depth; None if there is none.
    """

    name: str
    depth: Path
    scale: float
    intrinsics: Float
    pose: Float
    mask: Path | None = None
    image: Path | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the depth image, pixels, from its header alone.

        Raises:
            DatasetError: it is no PNG.
        """
        return _open(self.depth, ("PNG",), load=False).size

    def read(self, masked: bool = True) -> Frame:
        """Read the images, the mask only if ``masked``.

        Raises:
            DatasetError: one of them is missing, damaged, of another kind or of another size.
            ObservationError: they are whole, but show nothing of use.
        """
        raw = read_depth(self.depth)
        depth = np.where(raw == NOTHING, 0, raw) * np.float32(self.scale)
        mask = _as_grey(self.mask, raw.shape) > 0 if masked and self.mask is not None else None
        image = None if self.image is None else _as_grey(self.image, raw.shape)
        return Frame(depth, self.intrinsics, self.pose, mask, image)


@takes_paths("path")
def read_depth(path: Path) -> NDArray[np.uint16]:
    """A 16-bit grey PNG, (H, W) uint16.

    Raises:
        DatasetError: it is missing, damaged, or of another kind.
    """
    image = _open(path, ("PNG",))
    if image.mode not in DEEP:
        raise DatasetError(f"{path}: depth is a grey PNG of 16 bits, this one has 8 (mode {image.mode})")
    return np.asarray(image).astype(np.uint16)


def _as_grey(path: Path, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """A mask or a picture, (H, W) uint8 (ITU-R BT.601)."""
    image = _open(path, ("PNG", "JPEG"))
    if (image.height, image.width) != shape:
        depth = f"{shape[1]} x {shape[0]}"
        raise DatasetError(f"{path}: is {image.width} x {image.height} pixels, and the depth image beside it {depth}")
    if image.mode in DEEP:
        raise DatasetError(f"{path}: has 16 bits where 8 are expected; is it a depth image?")
    return np.asarray(image.convert("L"))


def _open(path: Path, formats: tuple[str, ...], load: bool = True) -> Image.Image:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path, formats=formats) as image:
                if load:
                    image.load()
                return image  # its file is closed, its pixels stay
    except FileNotFoundError:
        raise DatasetError(f"{path}: there is no such file") from None
    except Image.UnidentifiedImageError:
        raise DatasetError(f"{path}: not a {' or '.join(formats)} image") from None
    except (Image.DecompressionBombWarning, Image.DecompressionBombError):
        raise DatasetError(f"{path}: has more than {Image.MAX_IMAGE_PIXELS:,} pixels") from None
    except (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error) as error:
        raise DatasetError(f"{path}: the image is damaged or cannot be read ({error})") from None


@takes_paths("path")
def read_numbers(path: Path, what: str, shape: tuple[int, ...]) -> Float:
    """A table of finite numbers in a text file.

    Args:
        path: the file.
        what: it is, for messages.
        shape: of the table.

    Raises:
        DatasetError: it is missing or something else.
    """
    try:
        text = path.read_text()
        values = np.array([[float(word) for word in line.split()] for line in text.splitlines() if line.strip()])
    except FileNotFoundError:
        raise DatasetError(f"{path}: there is no such file; it gives {what}") from None
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError:  # a word that is no number, lines of different lengths, or bytes that are no text
        values = np.zeros(0)
    if values.shape != shape:
        raise DatasetError(f"{path}: not {what}, {' x '.join(map(str, shape))} numbers")
    if not np.isfinite(values).all():
        raise DatasetError(f"{path}: {what} holds NaN or infinity; was the camera lost here? Remove this frame")
    return values


def rigid(pose: ArrayLike, where: str) -> Float:
    """A camera-to-world pose of a file, (4, 4), if it is one.

    Raises:
        DatasetError: it is not rigid; ``where`` names the file.
    """
    try:
        return check_pose(pose)
    except ObservationError as error:
        raise DatasetError(f"{where}: {error}") from None


def inverse(rotation: Float, translation: Float) -> Float:
    """Camera-to-world, (4, 4), of a world-to-camera rotation (3, 3) and translation (3,)."""
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ translation
    return pose


def pinhole_of(fx: float, fy: float, cx: float, cy: float) -> Float:
    """Pinhole matrix, (3, 3), of focal lengths and principal point, pixels."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
