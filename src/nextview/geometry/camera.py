"""What cameras give, checked: arrays, depth images, poses and intrinsics."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.checks import number
from nextview.errors import ObservationError
from nextview.geometry.depth import FARTHEST_SURFACE
from nextview.geometry.pinhole import PinholeCamera
from nextview.types import Float

LARGEST_ENTRY = 1e9  # numbers of poses and intrinsics are smaller
# how far a pose may be from a rigid motion: numbers may have been written with four digits
RIGID = 1e-3


def numbers(values: Any, what: str) -> NDArray[Any]:
    """Convert values to an array of real numbers.

    Args:
        values: anything that NumPy takes for an array.
        what: name of the values in the error message.

    Returns:
        The array, of an integer or floating type.

    Raises:
        ObservationError: the values are not an array of real numbers.
    """
    array = array_of(values, what)
    if array.dtype.kind not in "fiu":
        raise ObservationError(f"{what} is an array of numbers, not of {array.dtype}")
    return array


def array_of(values: Any, what: str) -> NDArray[Any]:
    """Convert values to an array in the byte order of this machine.

    Masked elements of a masked array become 0: nothing was measured there.

    Args:
        values: anything that NumPy takes for an array.
        what: name of the values in the error message.

    Returns:
        The array, of any type.

    Raises:
        ObservationError: the values cannot become an array.
    """
    try:
        array = (
            np.ma.filled(values, 0)
            if isinstance(values, np.ma.MaskedArray)
            else np.asarray(values)
        )
    # rows of different lengths, or what cannot become an array at all
    except (ValueError, TypeError) as error:
        raise ObservationError(
            f"{what} cannot be taken for an array of numbers ({error})"
        ) from None
    return (
        array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))
    )


def depth_image(depth: Any) -> NDArray[Any]:
    """A depth image, (H, W), of numbers in any unit; ObservationError if it is none."""
    depth = numbers(depth, "the depth")
    if depth.ndim != 2 or depth.size == 0:
        raise ObservationError(
            f"the depth is one image of the shape (H, W), not {depth.shape}"
        )
    return depth


def checked_pose(pose: Any) -> Float:
    """Check a camera-to-world pose, (4, 4) float64, OpenCV axes, object radii.

    ObservationError if no camera has it.
    """
    pose = numbers(pose, "the pose").astype(np.float64, copy=False)
    if pose.shape != (4, 4):
        raise ObservationError(
            f"the pose is a camera-to-world matrix of the shape (4, 4), not {pose.shape}"
        )
    if not (np.abs(pose) < LARGEST_ENTRY).all():  # not so if there is a NaN
        raise ObservationError(
            "the pose holds NaN or infinity, or a number that no camera has"
        )
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > RIGID:
        raise ObservationError(
            f"the last row of the pose is {pose[3].tolist()}, not 0 0 0 1: is it transposed?"
        )

    rotation = pose[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > RIGID:
        raise ObservationError(
            "the pose is not rigid: its rotation does not keep lengths and angles"
        )
    if np.linalg.det(rotation) < 0:
        raise ObservationError(
            "the pose is mirrored: an axis is reversed (OpenCV axes are x right, y down, z forward)"
        )

    distance = float(np.sqrt((pose[:3, 3] ** 2).sum()))
    if distance > 2 * FARTHEST_SURFACE:
        what = f"the camera stands {distance:.4g} object radii from the object"
        raise ObservationError(
            f"{what}: is its position in millimetres? Divide it by the object radius"
        )

    return pose


def checked_intrinsics(intrinsics: Any, shape: tuple[int, ...]) -> Float:
    """Check the pinhole matrix of an image.

    Args:
        intrinsics: the matrix, (3, 3), pixels.
        shape: rows and columns of the image.

    Returns:
        The matrix, (3, 3) float64.

    Raises:
        ObservationError: no camera has this matrix.
    """
    intrinsics = numbers(intrinsics, "the matrix of intrinsics").astype(
        np.float64,
        copy=False,
    )
    if intrinsics.shape != (3, 3):
        raise ObservationError(
            f"the intrinsics are a pinhole matrix of the shape (3, 3), not {intrinsics.shape}"
        )
    if not (np.abs(intrinsics) < LARGEST_ENTRY).all():  # not so if there is a NaN
        raise ObservationError(
            "the intrinsics hold NaN, infinity or a number that no camera has"
        )
    if np.abs(intrinsics[2] - (0, 0, 1)).max() > RIGID:
        last = intrinsics[2].tolist()
        raise ObservationError(
            f"the last row of the intrinsics is {last}, not 0 0 1: are they transposed?"
        )

    focal = intrinsics[0, 0], intrinsics[1, 1]
    if not min(focal) > 0.01 * max(
        shape
    ):  # less would show all that lies ahead: metres, say
        wanted = f"positive numbers of pixels, about as many as the image has a side ({max(shape)})"
        raise ObservationError(
            f"the focal lengths are {wanted}, not {focal[0]:g} and {focal[1]:g}"
        )

    return intrinsics


def pinhole(size: int, distance: float) -> Float:
    """Return the pinhole matrix of a square image that just contains the unit sphere.

    Args:
        size: side of the image, pixels.
        distance: of the camera from the centre of the sphere, object radii.

    Returns:
        The matrix, (3, 3) float64, pixels.

    Raises:
        ObservationError: the camera is inside the sphere.
    """
    distance = number(distance, "the distance")
    if not 1 < distance < LARGEST_ENTRY:
        raise ObservationError(
            f"the camera has to stand more than one object radius from the centre, not {distance:g}"
        )
    # size/2 over the tangent of the half angle asin(1/distance)
    focal = size / 2 * np.sqrt(distance**2 - 1)
    return PinholeCamera.centred(focal, (size, size)).matrix
