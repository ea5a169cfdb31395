"""Read the intrinsics of a depth camera from the files of common tools.

Supported are ``camera_info`` of ROS (``ros2 topic echo --once``, or from its calibration), the
intrinsics of librealsense, Open3D (its recorder's, and ``PinholeCameraParameters``), BOP's
``camera.json``, Zivid and OpenCV, as JSON or YAML. A text file (.txt) contains only the pinhole
matrix.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from nextview.captured.frames import MILLIMETRES, DepthImage, read_table
from nextview.captured.yaml_fields import read_yaml
from nextview.checks import one_line
from nextview.errors import DatasetError
from nextview.files import regular_file
from nextview.geometry.pinhole import pinhole_matrix
from nextview.types import Float

LARGEST_FILE = 2**20  # bytes
MOST_MATRIX_NUMBERS = (
    100  # more than the nine of a matrix or the 14 coefficients of a distortion
)
# names of fields, case-insensitive
MATRICES = ("k", "cam_k", "camera_matrix", "cameramatrix", "intrinsic_matrix")
PRINCIPAL_POINTS = (("cx", "cy"), ("ppx", "ppy"))
DISTORTIONS = ("d", "coeffs", "distortion_coefficients", "distcoeffs", "distortion")
WIDTHS = ("width", "image_width")
HEIGHTS = ("height", "image_height")
SCALES = ("depth_scale", "depth_units")
# fields that contain the depth camera; searched before the top level, which may be the colour
# camera's
INSIDE_FIRST = ("depth", "depth_intrinsics")
INSIDE = ("intrinsics", "intrinsic", "camera_info", "cameraintrinsics")
# Tools define the depth scale differently, but the values are far apart.
METRES_BELOW = 0.02  # librealsense: metres per unit, such as 0.001
STEPS_FROM = (
    50.0  # Open3D: units per metre, such as 1000; in between, BOP: millimetres per unit
)


@dataclass(frozen=True)
class CameraFile:
    """Contents of a camera file.

    Attributes:
        intrinsics: pinhole matrix, (3, 3) float64, pixels, first pixel's centre at 0.
        size: width and height of its images, pixels, if the file has them.
        scale: metres per unit of its depth images, if the file has it.
        file: its path; "" for intrinsics passed in by the user.
    """

    intrinsics: Float
    size: tuple[int, int] | None
    scale: float | None
    file: str = ""


def read_camera_file(path: Path) -> CameraFile:
    """Read the intrinsics and other properties of a depth camera from a file.

    Args:
        path: JSON or YAML, or the pinhole matrix in a text file.

    Raises:
        DatasetError: it cannot be read, has no intrinsics, or those of distorted images.
    """
    if path.suffix.lower() == ".txt":
        matrix = read_table(path, "the pinhole matrix", 3)
        return CameraFile(matrix, None, None, str(path))
    content = _content(path)
    camera = _depth_camera(content)
    if camera is None:
        raise DatasetError(
            f"{path}: holds no intrinsics; known are fx, fy with cx, cy or ppx, ppy, and matrices"
            f" called {', '.join(MATRICES)}"
        )
    try:
        intrinsics = _intrinsics(camera)
        distortion = _coefficients(_first(camera, DISTORTIONS))
        scale = _scale(_first(camera | content, SCALES))
        offset, size = _part_of_sensor(camera)
    except (TypeError, ValueError, OverflowError) as error:
        raise DatasetError(
            f"{path}: not the intrinsics of a camera ({one_line(str(error), 200)})"
        ) from None

    if not np.isfinite(intrinsics).all():
        raise DatasetError(f"{path}: its intrinsics are not all finite numbers")
    intrinsics[:2, 2] -= offset
    if np.any(distortion):
        raise DatasetError(
            f"{path}: the camera distorts (coefficients {distortion.tolist()}): undistort its"
            " images first, and give the intrinsics of those"
        )
    return CameraFile(intrinsics, size, scale, str(path))


def check_size(camera: CameraFile, depth: DepthImage) -> None:
    """Check that intrinsics belong to images of this size.

    Args:
        camera: contents of a camera file.
        depth: an image of that camera.

    Raises:
        DatasetError: the file is for images of another size.
    """
    if camera.size is not None and camera.size != depth.size:
        wanted = "{} x {}".format(*camera.size)
        there = "{} x {}".format(*depth.size)
        raise DatasetError(
            f"{camera.file}: the intrinsics are of images of {wanted} pixels, and {depth} has"
            f" {there}: are they those of the colour camera, or of another resolution?"
        )


def _content(path: Path) -> dict[str, Any]:
    """Return the fields of a JSON or YAML file; of the first document if there are several."""
    what = "the intrinsics of a camera"
    regular_file(path, what, DatasetError, LARGEST_FILE)
    try:
        text = path.read_text()
        if path.suffix.lower() == ".json":
            content = msgspec.json.decode(text)
        else:
            content = read_yaml(text, f"{path}: not {what}")
    except (OSError, UnicodeDecodeError, msgspec.DecodeError, RecursionError) as error:
        raise DatasetError(
            f"{path}: not {what} ({one_line(str(error), 200)})"
        ) from None

    if not isinstance(content, Mapping):
        raise DatasetError(
            f"{path}: holds no fields, so not the intrinsics of a camera"
        )
    return _fields(content)


def _fields(content: Mapping[Any, Any]) -> dict[str, Any]:
    """Convert field names to lower case."""
    return {str(name).lower(): value for name, value in content.items()}


def _depth_camera(content: dict[str, Any]) -> dict[str, Any] | None:
    """Return the fields of the depth camera at any supported place; None if there is none."""

    def inside(names: Sequence[str]) -> list[dict[str, Any]]:
        return [
            _fields(content[name])
            for name in names
            if isinstance(content.get(name), Mapping)
        ]

    cameras = [*inside(INSIDE_FIRST), content, *inside(INSIDE)]
    return next((each for each in cameras if _has_intrinsics(each)), None)


def _has_intrinsics(camera: dict[str, Any]) -> bool:
    """Return True if fields contain the intrinsics of a camera."""
    focal = "fx" in camera and "fy" in camera
    points = any(cx in camera and cy in camera for cx, cy in PRINCIPAL_POINTS)
    return _first(camera, MATRICES) is not None or (focal and points)


def _intrinsics(camera: dict[str, Any]) -> Float:
    """Return the pinhole matrix of a camera, (3, 3)."""
    given = _first(camera, MATRICES)
    if isinstance(given, Mapping) and _has_intrinsics(_fields(given)):
        return _intrinsics(_fields(given))  # Zivid: FX, FY, CX, CY inside
    if given is not None:
        matrix = _numbers(given).reshape(3, 3)
        # Open3D writes the matrix in column-major order
        by_columns = not matrix[:2, 2].any() and matrix[2, :2].any()
        return matrix.T.copy() if by_columns else matrix
    cx, cy = next(names for names in PRINCIPAL_POINTS if names[0] in camera)
    return pinhole_matrix(*(float(camera[name]) for name in ("fx", "fy", cx, cy)))


def _part_of_sensor(camera: dict[str, Any]) -> tuple[Float, tuple[int, int] | None]:
    """Return the offset of the images on the sensor, (2,), pixels, and their size, if known.

    A cropped camera has fields x_offset and y_offset of its own, or in the ``roi`` of ROS, whose
    width and height are then those of the images (0: all).

    Raises:
        ValueError: the images are binned.
    """
    if any(float(camera.get(f"binning_{axis}") or 1) > 1 for axis in "xy"):
        raise ValueError("it puts pixels together: give the intrinsics of its images")

    roi = camera.get("roi")
    part = camera if not isinstance(roi, Mapping) else _fields(roi)
    offset = np.array([float(part.get(f"{axis}_offset") or 0) for axis in "xy"])
    if not (np.isfinite(offset) & (offset >= 0)).all():
        raise ValueError(f"its images begin at {offset.tolist()} of the sensor")
    width, height = (
        _first(part, names) or _first(camera, names) for names in (WIDTHS, HEIGHTS)
    )
    return offset, None if not width or not height else (int(width), int(height))


def _coefficients(values: Any) -> Float:
    """Return the distortion coefficients, (N,), from a list or from fields (K1, P1; Zivid)."""
    if values is None or isinstance(values, str):  # the name of a distortion model
        return np.zeros(0)
    if isinstance(values, Mapping) and "data" not in _fields(values):
        values = [each for each in values.values() if not isinstance(each, str)]
    return _numbers(values)


def _numbers(values: Any) -> Float:
    """Return the numbers of a list as an array, (N,).

    The list may contain rows, or be in a field "data", as in ROS calibrations and OpenCV files.

    Raises:
        ValueError: there are more than a camera has.
        TypeError: they are not numbers.
    """
    if isinstance(values, Mapping):
        values = _fields(values).get("data", [])
    rows = values if isinstance(values, list) else [values]
    row = [
        value for each in rows for value in (each if isinstance(each, list) else [each])
    ]
    if len(row) > MOST_MATRIX_NUMBERS:
        raise ValueError(f"a list of {len(row)} numbers")
    return np.array([float(value) for value in row])


def _first(fields: Mapping[str, Any], names: Sequence[str]) -> Any:
    """Return the value of the first of some names that exists, or None."""
    return next((fields[name] for name in names if name in fields), None)


def _scale(value: Any) -> float | None:
    """Return the depth scale in metres per unit; None if there is none."""
    if value is None:
        return None
    number = float(value)
    if not 0 < number < np.inf:
        raise ValueError(f"a depth scale of {number:g}")
    if number < METRES_BELOW:
        return number
    return 1 / number if number >= STEPS_FROM else MILLIMETRES * number
