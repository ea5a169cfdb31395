"""What one view yields, and what can take a view."""

from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from nextview.checks import number, one_line
from nextview.errors import ObservationError
from nextview.geometry.depth import (
    FARTHEST_SURFACE,
    headlight,
    object_depth,
    visible_points,
)
from nextview.geometry.pinhole import PinholeCamera
from nextview.types import Float, Float32, Mask

LEAST_VISIBLE_SHARE = 0.006
"""An object is seen if one connected part of it fills this share of the image. In the networks'
images of 112 pixels a side, less are specks of 8 x 9 pixels. The thinnest object of ModelNet10, a
screen seen from its edge, fills 0.011."""
SPECKS = 8  # or if all its parts together fill so many times as much
LEAST_PIXELS = 9  # the least share in pixels, for small images
LARGEST_ENTRY = 1e9  # numbers of poses and intrinsics are smaller
# how far a pose may be from a rigid motion: numbers may have been written with four digits
RIGID = 1e-3


@dataclass(frozen=True)
class SceneView:
    """All that one frame shows, the object and its surroundings.

    It is given in the object frame and object radii.

    Its pinhole and distance may be others than those of its observation. ObservationError: no
    images of one shape.

    Attributes:
        depth: along the optical axis, (H, W), object radii, 0 where nothing was measured.
        target: pixels that show the object, (H, W).
        pose: camera-to-world, (4, 4), OpenCV axes; the world is the object frame.
        intrinsics: pinhole matrix, (3, 3), pixels; the first pixel's centre is at 0.5.
        background_free: whether nothing is there where nothing was measured, as in renders; a
            sensor may miss what is black or shiny.
        camera: name of the camera; "" for the one camera.
        support: plane under the object, if it is known, (4,): upward normal, object frame, and
            height of the origin above the plane, object radii.
    """

    depth: Float32
    target: Mask
    pose: Float
    intrinsics: Float
    background_free: bool = False
    camera: str = ""
    support: Float | None = None

    def __post_init__(self) -> None:
        if self.depth.ndim != 2 or self.target.shape != self.depth.shape:
            what = (
                "the depth of a scene and the object's pixels are images of one shape"
            )
            raise ObservationError(
                f"{what}, not {self.depth.shape} and {self.target.shape}"
            )


@dataclass(
    frozen=True,
    eq=False,
)  # each is itself, and can be the key of what is made of it
class Observation:
    """One view of an object. It keeps copies of the arrays, which nobody can write to.

    Attributes:
        depth: distance along the optical axis, (H, W) float32, object radii, 0 where there is no
            object. What a sensor gives for nothing else (see ``object_depth``) becomes 0 here.
        pose: camera-to-world, (4, 4) float64, OpenCV axes (x right, y down, z forward); the world
            is the object frame.
        intrinsics: pinhole matrix, (3, 3) float64, pixels; pixel (row, column) has its centre at
            (column + 0.5, row + 0.5).
        radius: the object radius, metres: what positions were divided by. None if the camera does
            not know its scale.
        image: grey picture, (H, W) uint8, 0 where there is no object. None if the camera has none.
        scene: all that the camera saw. None where only the object is known: then nothing is taken
            to hide it.
        exact: whether the depth is without a sensor's errors, as of a render.
        colour: RGB picture, (H, W, 3) uint8, 0 where there is no object, for recognisers of your
            own. None if the camera has none, as in simulations.

    Raises:
        ObservationError: a shape is not as above, or no camera can have the numbers; the message
            names the likely mistake.

    Example:
        >>> camera = nextview.SimulatedCamera(sample_mesh("chair"), size=64)
        >>> camera.observe(nextview.ViewSphere.named("40").poses[3]).depth.shape
        (64, 64)
    """

    depth: Float32
    pose: Float
    intrinsics: Float
    radius: float | None = None
    image: NDArray[np.uint8] | None = None
    scene: SceneView | None = None
    exact: bool = False
    colour: NDArray[np.uint8] | None = None

    def __post_init__(self) -> None:
        with np.errstate(over="ignore"):  # what is too large becomes infinity, and so 0
            given = depth_image(self.depth).astype(np.float32, copy=False)
        depth = object_depth(given)
        if depth is not given:
            _check_unit(given, int(np.count_nonzero(depth)))
        checked = {
            "depth": depth,
            "pose": checked_pose(self.pose),
            "intrinsics": checked_intrinsics(self.intrinsics, depth.shape),
            "image": None if self.image is None else _image(self.image, depth.shape),
            "colour": None
            if self.colour is None
            else _image(self.colour, (*depth.shape, 3), "the colour image is RGB"),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, None if value is None else _own(value))
        if self.radius is not None:
            if not (isinstance(self.radius, Real) and 0 < self.radius < LARGEST_ENTRY):
                shown = one_line(repr(self.radius))
                raise ObservationError(
                    f"the object radius is a positive number of metres, or None, not {shown}"
                )
            object.__setattr__(self, "radius", float(self.radius))

    @cached_property
    def visible(self) -> int:
        """Number of pixels that show the object."""
        return int(np.count_nonzero(self.depth))

    @cached_property
    def seen(self) -> bool:
        """Whether enough of the object is visible to say anything of it.

        A view without it is no evidence.
        """
        return enough_shows(self.depth > 0)

    @cached_property
    def points(self) -> Float32:
        """Points on the visible surface, (1024, 3) float32, object frame, object radii.

        They are all zero if nothing is visible.
        """
        return visible_points(self.depth, self.pose, self.intrinsics)

    @cached_property
    def picture(self) -> NDArray[np.uint8]:
        """The image, (H, W) uint8; without one, the depth under a headlight."""
        return (
            headlight(self.depth, self.intrinsics) if self.image is None else self.image
        )


def _own(values: NDArray[Any]) -> NDArray[Any]:
    """The values in an array that nobody can write to: a copy where somebody could."""
    if values.flags.writeable or values.base is not None:
        values = values.copy()
        values.flags.writeable = False
    return values


def enough_shows(mask: Mask) -> bool:
    """Return whether enough pixels show the object, (H, W) bool; see LEAST_VISIBLE_SHARE."""
    least = max(LEAST_PIXELS, LEAST_VISIBLE_SHARE * mask.size)
    n = np.count_nonzero(mask)
    if not least <= n < SPECKS * least:
        return bool(n >= least)
    parts, _ = label(mask, np.ones((3, 3)))
    return bool(np.bincount(parts.ravel())[1:].max() >= least)


class Camera(Protocol):
    """Looks at the object from a given pose.

    Example:
        >>> camera = nextview.SimulatedCamera(sample_mesh("chair"))
        >>> camera.observe(nextview.ViewSphere.named("40").poses[3]).seen
        True
    """

    def observe(self, pose: Float) -> Observation:
        """Look from a camera-to-world pose, (4, 4), OpenCV axes, object frame, object radii.

        Raises:
            NoViewLeftError: no view is left, which ends the session.
        """


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


def _check_unit(given: Float32, near: int) -> None:
    """Refuse depth of which next to nothing is near enough to be an object.

    One large number is that for nothing.
    """
    if 99 * near >= given.size:
        return
    far = given[np.isfinite(given) & (given >= FARTHEST_SURFACE)]
    varied = np.count_nonzero(far < far.max()) if len(far) else 0
    if varied > max(LEAST_PIXELS, 99 * near):
        raise ObservationError(
            "the depth looks like millimetres, or metres, not object radii (its median is"
            f" {np.median(far):.4g}, and {FARTHEST_SURFACE:g} and more counts as nothing): divide"
            " it by the object radius, and set all else to 0"
        )


def _image(
    image: Any,
    shape: tuple[int, ...],
    what: str = "the image is grey",
) -> NDArray[np.uint8]:
    image = numbers(image, "the image")
    if image.shape != shape:
        raise ObservationError(
            f"{what} and of the depth's shape {shape}, not {image.shape}"
        )
    if image.dtype != np.uint8 and (
        image.dtype.kind == "f" or image.min() < 0 or image.max() > 255
    ):
        raise ObservationError(
            f"the image holds whole numbers from 0 to 255 (uint8), not {image.dtype}"
        )
    return image.astype(np.uint8, copy=False)


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
