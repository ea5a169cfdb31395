"""Intrinsics of a depth camera in the files that cameras and their tools write.

``camera_info`` of ROS (``ros2 topic echo --once``, or of its calibration), the intrinsics of
librealsense, of Open3D's recorder and of BOP's ``camera.json``; JSON or YAML.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from nextview.captured.frames import MILLIMETRES
from nextview.errors import DatasetError
from nextview.files import regular_file
from nextview.geometry.pinhole import pinhole_matrix
from nextview.types import Float

LARGEST_FILE = 2**20  # bytes
MATRICES = ("k", "K", "cam_K", "camera_matrix", "intrinsic_matrix")
PRINCIPAL_POINTS = (("cx", "cy"), ("ppx", "ppy"))
DISTORTIONS = ("d", "D", "coeffs", "distortion_coefficients")
WIDTHS = ("width", "image_width")
HEIGHTS = ("height", "image_height")
SCALES = ("depth_scale", "depth_units")
# where a file holds several cameras, or one with other things
INSIDE = ("depth", "depth_intrinsics", "intrinsics", "camera_info")
# What a depth scale is counted in: the tools do not agree, their values lie far apart.
METRES_BELOW = 0.02  # librealsense: metres that a step stands for, 0.001
STEPS_FROM = 50.0  # Open3D: steps a metre, 1000; between them BOP's millimetres that a step is, 0.1


@dataclass(frozen=True)
class CameraFile:
    """What a file says of a depth camera.

    Attributes:
        intrinsics: pinhole matrix, (3, 3) float64, pixels, first pixel's centre at 0.
        size: width and height of its images, pixels, if the file has them.
        scale: metres that one step of its depth images stands for, if the file has it.
    """

    intrinsics: Float
    size: tuple[int, int] | None
    scale: float | None


def read_camera_file(path: Path) -> CameraFile:
    """Read the intrinsics, and whatever else a file says of a depth camera.

    Args:
        path: JSON or YAML.

    Raises:
        DatasetError: it cannot be read, holds no intrinsics, or those of images that are distorted.
    """
    content = _content(path)
    inside = [
        content[name] for name in INSIDE if isinstance(content.get(name), Mapping)
    ]
    cameras = [each for each in (content, *inside) if _has_intrinsics(each)]
    if not cameras:
        raise DatasetError(
            f"{path}: holds no intrinsics; known are fx, fy with cx, cy or ppx, ppy, and matrices"
            f" called {', '.join(MATRICES)}"
        )
    camera = cameras[0]
    try:
        intrinsics = _intrinsics(camera)
        distortion = np.asarray(_numbers(_first(camera, DISTORTIONS)), np.float64)
        scale = _scale(_first(content, SCALES) or _first(camera, SCALES))
        width = _first(camera, WIDTHS)
        height = _first(camera, HEIGHTS)
        size = None if not width or not height else (int(width), int(height))
    except (TypeError, ValueError, OverflowError) as error:
        raise DatasetError(
            f"{path}: not the intrinsics of a camera ({error})"
        ) from None

    if np.any(distortion):
        raise DatasetError(
            f"{path}: the camera distorts (coefficients {distortion.tolist()}): undistort its"
            " images first, and give the intrinsics of those"
        )
    return CameraFile(intrinsics, size, scale)


def _content(path: Path) -> Mapping[str, Any]:
    """The fields of a JSON or YAML file; of the first document, where it has several."""
    regular_file(path, "the intrinsics of a camera", DatasetError, LARGEST_FILE)
    try:
        text = path.read_text()
        if path.suffix.lower() == ".json":
            content = msgspec.json.decode(text)
        else:
            first = text.removeprefix("---").split("\n---")[0]
            content = msgspec.yaml.decode(first)
    except (OSError, UnicodeDecodeError, msgspec.DecodeError, RecursionError) as error:
        phrase = " ".join(str(error).split())
        raise DatasetError(
            f"{path}: not the intrinsics of a camera ({phrase})"
        ) from None

    if not isinstance(content, Mapping):
        raise DatasetError(
            f"{path}: holds no fields, so not the intrinsics of a camera"
        )

    return content


def _has_intrinsics(camera: Mapping[str, Any]) -> bool:
    """Whether fields hold the intrinsics of a camera."""
    focal = "fx" in camera and "fy" in camera
    points = any(cx in camera and cy in camera for cx, cy in PRINCIPAL_POINTS)
    return _first(camera, MATRICES) is not None or (focal and points)


def _intrinsics(camera: Mapping[str, Any]) -> Float:
    """The pinhole matrix of a camera, (3, 3)."""
    given = _first(camera, MATRICES)
    if given is not None:
        matrix = np.asarray(_numbers(given), np.float64).reshape(3, 3)
        # Open3D writes it column by column
        by_columns = not matrix[:2, 2].any() and matrix[2, :2].any()
        return matrix.T if by_columns else matrix
    cx, cy = next(names for names in PRINCIPAL_POINTS if names[0] in camera)
    return pinhole_matrix(*(float(camera[name]) for name in ("fx", "fy", cx, cy)))


def _numbers(values: Any) -> Any:
    """The numbers of a list, of one in a field "data" as ROS calibrations have it, or none."""
    if isinstance(values, Mapping):
        return values.get("data", [])
    return [] if values is None else values


def _first(fields: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    """The value of the first of some names that is there, or None."""
    return next((fields[name] for name in names if name in fields), None)


def _scale(value: Any) -> float | None:
    """The depth scale in metres that a step stands for; None if there is none."""
    if value is None:
        return None
    number = float(value)
    if not 0 < number < np.inf:
        raise ValueError(f"a depth scale of {number:g}")
    if number < METRES_BELOW:
        return number
    return 1 / number if number >= STEPS_FROM else MILLIMETRES * number
