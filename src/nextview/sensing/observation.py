"""What one view yields for the networks, and what can take a view."""

from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from nextview.checks import one_line
from nextview.errors import ObservationError
from nextview.geometry.camera import (
    LARGEST_ENTRY,
    checked_intrinsics,
    checked_pose,
    depth_image,
    numbers,
)
from nextview.geometry.depth import (
    FARTHEST_SURFACE,
    headlight,
    object_depth,
    visible_points,
)
from nextview.sensing.object_frame import ObjectFrame
from nextview.sensing.sighting import Sighting
from nextview.types import Float, Float32, Mask

LEAST_VISIBLE_SHARE = 0.006
"""An object is seen if one connected part of it fills this share of the image. In the networks'
images of 112 pixels a side, less are specks of 8 x 9 pixels. The thinnest object of ModelNet10, a
screen seen from its edge, fills 0.011."""
SPECKS = 8  # or if all its parts together fill so many times as much
LEAST_PIXELS = 9  # the least share in pixels, for small images


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
        sighting: in the frame that the view was resampled from. None where only the object is
            known: then nothing is taken to hide it.
        object_frame: where the object frame is in the world of the sighting.
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
    sighting: Sighting | None = None
    object_frame: ObjectFrame | None = None
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

        if (self.sighting is None) != (self.object_frame is None):
            raise ObservationError("a sighting and its object frame are given together")
        if self.radius is not None:
            if not (isinstance(self.radius, Real) and 0 < self.radius < LARGEST_ENTRY):
                shown = one_line(repr(self.radius))
                raise ObservationError(
                    f"the object radius is a positive number of metres, or None, not {shown}"
                )
            object.__setattr__(self, "radius", float(self.radius))

    @property
    def whole_frame(self) -> tuple[Float32, Float, Float]:
        """Depth, pose and intrinsics of the whole frame, in object radii and the object frame."""
        if self.sighting is None or self.object_frame is None:  # both, or none
            return self.depth, self.pose, self.intrinsics
        frame = self.sighting.frame
        depth = frame.depth / np.float32(self.object_frame.radius)
        pose = self.object_frame.pose_in_object(frame.camera_to_world)
        return depth, pose, frame.intrinsics

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
