"""One frame of a depth camera, validated and converted to the units and axes of nextview."""

from collections.abc import Iterable
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from nextview.checks import one_line
from nextview.errors import ObservationError
from nextview.geometry.camera import LARGEST_ENTRY, array_of, numbers
from nextview.geometry.pinhole import PinholeCamera
from nextview.sensing.holes import fill_regular_gaps, filled_mask
from nextview.sensing.noise import (
    ALIKE,
    LEAST_ERROR,
    ROWS_MEASURED,
    Noise,
    estimate_noise,
)
from nextview.types import Float, Float32, Floats, Index, Mask

Part = tuple[slice, slice]  # rows and columns of an image
WHOLE = slice(None), slice(None)
# metres; larger depths are invalid, as they exceed the range of uint16 millimetres
FARTHEST_DEPTH = 65.0
# metres; a depth image with a larger median is in another unit, such as inches
LARGEST_MEDIAN = 20.0
NEAREST_MEDIAN = 0.05  # metres; no depth camera measures nearer
ASPECTS = (
    4 / 3,
    16 / 9,
    16 / 10,
    512 / 424,
    640 / 576,
)  # width over height of uncropped images
# tolerance of equal poses, for metres and elements of rotation matrices
SAME_POSE = 1e-3
CAMERA_AXES = {
    "opencv": np.eye(3),
    "opengl": np.diag([1.0, -1.0, -1.0]),
    "ros": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
}
"""Axes conventions of camera poses: OpenCV (x right, y down, z forward), OpenGL (x right, y up,
z backward) and ROS body axes (x forward, y left, z up; REP 103). The columns are the OpenCV axes in
the named convention."""
# weights of red, green and blue in a grey image (ITU-R BT.601)
LUMA = np.array([0.299, 0.587, 0.114])


@dataclass(frozen=True)
class Frame:
    """One frame of a depth camera; only depth and intrinsics are required.

    An ObservationError names the likely mistake in invalid input. ``with_pose`` and
    ``with_depth`` change one of its parts; ``dataclasses.replace`` loses ``colour``, as ``image``
    is stored in grey, and ``counted``.

    Attributes:
        depth: along the optical axis, (H, W). Input is either float metres, where NaN, infinity,
            zero and negative numbers are invalid, or uint16 millimetres, where 0 and 65535 are
            invalid. Masked entries of a masked array are invalid too. Stored as float32, metres, 0
            = invalid; regular gaps between pixels are filled.
        intrinsics: pinhole matrix, (3, 3), pixels. Stored as float64, with the centre of the first
            pixel at 0.5.
        pose: camera-to-world, (4, 4), metres, any world frame; stored with OpenCV axes. None: the
            camera frame is the world frame, which only works for a single frame.
        mask: of the object, (H, W) bool; None if the object is to be found.
        image: grey (H, W) or colour (H, W, 3) uint8, registered to the depth; stored as grey.
        colour: the original image, (H, W, 3) uint8, RGB; None if it is grey.
        counted: whether the input depth is uint16, whose unit may differ from millimetres.
        axes: of the input pose: "opencv", "opengl" or "ros", see CAMERA_AXES. Stored as "opencv".
        pixel_centre: coordinate of the first pixel's centre in the input intrinsics: 0 for OpenCV
            and ROS, 0.5 for OpenGL and for nextview's own ``Observation``. Stored as 0.5.
        camera: name of the camera, where there are several, or where one stands still; "" for the
            one camera.
    """

    depth: Float32
    intrinsics: Float
    pose: Float | None = None
    mask: Mask | None = None
    image: NDArray[np.uint8] | None = None
    counted: bool = field(init=False, default=False)
    colour: NDArray[np.uint8] | None = field(init=False, default=None)
    axes: str = "opencv"
    pixel_centre: float = 0.0
    camera: str = ""

    def __post_init__(self) -> None:
        values = numbers(self.depth, "the depth")
        depth, source = fill_regular_gaps(_metres(values))
        intrinsics = _check_intrinsics(self.intrinsics, depth.shape)
        centre = self.pixel_centre
        if not isinstance(centre, int | float) or not abs(centre) <= 1:
            raise ObservationError(
                f"the first pixel's centre has the coordinate 0 or 0.5, not"
                f" {one_line(repr(centre))}"
            )
        intrinsics[:2, 2] += 0.5 - centre

        if not isinstance(self.camera, str):
            raise ObservationError(
                f"the name of a camera is text, not {one_line(repr(self.camera))}"
            )
        if not isinstance(self.axes, str) or self.axes not in CAMERA_AXES:
            raise ObservationError(
                f"the axes of a pose are {', '.join(CAMERA_AXES)}, not"
                f" {one_line(repr(self.axes))}"
            )

        # axes and centre are those of what is stored, so that dataclasses.replace keeps both
        stored: dict[str, object] = {
            "depth": depth,
            "intrinsics": intrinsics,
            "counted": values.dtype == np.uint16,
            "axes": "opencv",
            "pixel_centre": 0.5,
        }
        if self.pose is not None:
            pose = check_pose(self.pose)
            pose[:3, :3] = pose[:3, :3] @ CAMERA_AXES[self.axes]
            stored["pose"] = pose
        if self.mask is not None:
            mask = _check_mask(self.mask, depth)
            stored["mask"] = (
                mask.copy() if source is None else filled_mask(mask, source)
            )
        if self.image is not None:
            image = _check_image(self.image, depth.shape)
            if image.ndim == 3:
                stored["colour"] = image.copy()
                image = np.rint(image @ LUMA).astype(np.uint8)
            stored["image"] = image
        for name, value in stored.items():
            object.__setattr__(self, name, value)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, pixels."""
        return self.depth.shape[0], self.depth.shape[1]

    def shifted(self, shift: Float) -> "Frame":
        """Return the frame with its pose, which must exist, shifted in the world, (3,), metres."""
        pose = self.camera_to_world.copy()
        pose[:3, 3] += shift
        return self.with_pose(pose)

    def with_pose(self, pose: Float) -> "Frame":
        """Return the frame with another rigid pose, camera-to-world, (4, 4), metres."""
        other = copy(self)  # skips validation
        object.__setattr__(other, "pose", pose)
        return other

    def with_depth(self, depth: Float32) -> "Frame":
        """Return the frame with another depth image, (H, W) float32, metres."""
        other = copy(self)  # skips validation
        object.__setattr__(other, "depth", depth)
        vars(other).pop("noise", None)
        return other

    @property
    def pinhole(self) -> PinholeCamera:
        """Pinhole camera of the frame."""
        return PinholeCamera.of(self.intrinsics, self.shape)

    @property
    def camera_to_world(self) -> Float:
        """Pose of the camera, or the identity if there is none."""
        return np.eye(4) if self.pose is None else self.pose

    @cached_property
    def noise(self) -> Noise:
        """Noise of the depth."""
        few = slice(None, None, max(1, self.shape[0] // ROWS_MEASURED))
        return estimate_noise(self.depth[few], self.depth[few] > 0)

    @property
    def depth_range(self) -> Float:
        """Nearest depth, without flying pixels, median and farthest depth, (3,), metres."""
        few = self.depth[::4, ::4]
        few = few[few > 0] if few.any() else self.depth[self.depth > 0]
        return np.array([*np.quantile(few, [0.02, 0.5]), self.depth.max()])

    @property
    def rays(self) -> tuple[Float32, Float32]:
        """x and y of the rays (x, y, 1) through the columns, (W,), and the rows, (H,), float32."""
        x, y = self.pinhole.image_slopes
        return x.astype(np.float32), y.astype(np.float32)

    def positions(self, rows: Index, columns: Index) -> Float:
        """Return the world positions of pixels.

        Args:
            rows: of the pixels, (N,) int64.
            columns: of the pixels, (N,) int64.

        Returns:
            Positions, (N, 3) float64, metres.
        """
        pose = self.camera_to_world
        return self.positions_in_camera(rows, columns) @ pose[:3, :3].T + pose[:3, 3]

    def points(self, mask: Mask) -> Float:
        """Return the world positions of some 500 measured pixels of a mask.

        Args:
            mask: (H, W) bool.

        Returns:
            Positions, (N, 3) float64, metres.
        """
        part = within(mask)
        rows, columns = np.nonzero(mask[part] & (self.depth[part] > 0))
        few = slice(None, None, max(1, len(rows) // 500))
        return self.positions(rows[few] + part[0].start, columns[few] + part[1].start)

    def positions_in_camera(self, rows: Index, columns: Index) -> Float:
        """Return the positions of pixels in the camera frame.

        Args:
            rows: of the pixels, (N,) int64.
            columns: of the pixels, (N,) int64.

        Returns:
            Positions, (N, 3) float64, metres.
        """
        x, y = self.rays
        z = self.depth[rows, columns].astype(np.float64)
        return np.stack([x[columns], y[rows], np.ones(len(z))], 1) * z[:, None]

    def along(
        self,
        direction: Float,
        offset: float = 0.0,
        part: Part = WHOLE,
    ) -> Float32:
        """Return ``direction @ position + offset`` of every pixel.

        Args:
            direction: world, (3,).
            offset: metres.
            part: rows and columns to compute.

        Returns:
            Values, (H, W) float32; undefined where the depth is 0.
        """
        x, y = self.rays
        pose = self.camera_to_world
        a, b, c = (pose[:3, :3].T @ direction).astype(np.float32)
        towards = (a * x)[None, part[1]] + (b * y + c)[part[0], None]
        return self.depth[part] * towards + np.float32(direction @ pose[:3, 3] + offset)


class PosedCamera(Protocol):
    """A camera with a name at a pose."""

    @property
    def camera(self) -> str:
        """Name of the camera."""

    @property
    def pose(self) -> Float | None:
        """Camera-to-world, (4, 4); None if it is not known."""


def one_stand(one: PosedCamera, other: PosedCamera) -> bool:
    """Return True if one camera took two frames without moving in between."""
    if one.camera != other.camera or one.pose is None or other.pose is None:
        return False
    return float(np.abs(one.pose - other.pose).max()) <= SAME_POSE


def stands_still(frame: PosedCamera, earlier: Iterable[PosedCamera]) -> bool:
    """Return True if a camera with a name took a frame and all earlier ones from one place."""
    return frame.camera != "" and all(one_stand(one, frame) for one in earlier)


def shown_before(frame: Frame, empty: Frame) -> Mask:
    """Return the pixels that show what a frame of the empty place shows, too, (H, W) bool.

    Args:
        frame: the frame.
        empty: of the same place without things, from anywhere.
    """
    rows, columns = np.nonzero(frame.depth)
    pose = empty.camera_to_world
    points = (frame.positions(rows, columns) - pose[:3, 3]) @ pose[:3, :3]
    ahead = points[:, 2] > 0
    place = np.full((len(points), 2), -1.0)
    place[ahead] = empty.pinhole.project(points[ahead])
    column, row = np.floor(place).astype(int).T
    height, width = empty.shape
    seen = (row >= 0) & (row < height) & (column >= 0) & (column < width)

    # between the depths of neighbouring pixels: a surface may be steep
    row = row[seen]
    column = column[seen]
    nearest = ndimage.minimum_filter(np.where(empty.depth > 0, empty.depth, np.inf), 3)
    farthest = ndimage.maximum_filter(empty.depth, 3)
    rows = rows[seen]
    columns = columns[seen]
    z = points[seen, 2]
    margin = ALIKE * np.hypot(frame.noise.at(z) * z**2, LEAST_ERROR * z)
    found = np.zeros(frame.shape, bool)
    found[rows, columns] = (z > nearest[row, column] - margin) & (
        z < farthest[row, column] + margin
    )
    return found


def within(shown: NDArray[np.float32 | np.bool_], margin: int = 0) -> Part:
    """Return the rows and columns of an image that contain all nonzero pixels.

    Args:
        shown: depth image or mask, (H, W).
        margin: pixels to add on each side.

    Returns:
        Slices of the rows and columns.
    """
    at = [np.flatnonzero(shown.any(1 - axis)) for axis in (0, 1)]
    low, high = zip(*((k[0], k[-1] + 1) if len(k) else (0, 0) for k in at), strict=True)
    return spans(
        np.array(low) - margin,
        np.array(high) + margin * bool(high[0]),
        shown.shape,
    )


def holes_of(shown: Mask) -> Mask:
    """Return the enclosed holes of a mask, (H, W), as a mask, (H, W) bool."""
    beside, _ = ndimage.label(np.pad(~shown, 1, constant_values=True))
    around = beside[0, 0]
    beside = beside[1:-1, 1:-1]
    return np.asarray((beside > 0) & (beside != around))


def spans(low: Floats, high: Floats, shape: tuple[int, ...]) -> Part:
    """Return the rows and columns of a rectangle, clipped to the image.

    Args:
        low: first row and column, (2,).
        high: row and column after the last, (2,).
        shape: rows and columns of the image.

    Returns:
        Slices of the rows and columns.
    """
    first, last = (
        np.clip(np.floor(at), 0, shape).astype(int).tolist() for at in (low, high)
    )
    return slice(first[0], last[0]), slice(first[1], last[1])


def _metres(depth: NDArray) -> Float32:
    if depth.ndim != 2 or min(depth.shape) < 2:
        raise ObservationError(f"a depth image is (H, W), not {depth.shape}")
    if depth.dtype == np.uint16:
        metres = np.where(depth == np.iinfo(np.uint16).max, 0, depth) * np.float32(
            0.001
        )
    elif np.issubdtype(depth.dtype, np.floating):
        metres = depth.astype(np.float32)
        # comparisons with NaN are False
        metres = np.where((metres > 0) & (metres < np.inf), metres, np.float32(0))
    else:
        raise ObservationError(
            f"depth is float metres or uint16 millimetres, not {depth.dtype}"
        )
    seen = metres[::4, ::4]
    middle = float(np.median(seen[seen > 0])) if (seen > 0).any() else 0.0
    wrong = ""
    if middle > FARTHEST_DEPTH:
        wrong = (
            "where metres are expected: millimetres? Divide them "
            "by 1000, or hand them in as uint16"
        )
    elif middle > LARGEST_MEDIAN:
        wrong = "m, and no depth camera measures so far: is it in inches or feet?"
    elif 0 < middle < NEAREST_MEDIAN:
        wrong = (
            "m, and no depth camera measures so near: scaled to 0 .. 1, divided twice, or uint16"
            " of another unit?"
        )
    if wrong:
        raise ObservationError(f"the depth has a median of {middle:.4g} {wrong}")
    metres = np.where(metres < FARTHEST_DEPTH, metres, np.float32(0))
    if not metres.any():
        raise ObservationError("nothing is seen: no pixel has a depth")
    return metres


def _matrix(values: ArrayLike, what: str, shape: tuple[int, int]) -> Float:
    matrix = numbers(values, what).astype(np.float64)
    if matrix.shape != shape or not (np.abs(matrix) < LARGEST_ENTRY).all():
        given = (
            f"of the shape {matrix.shape}"
            if matrix.shape != shape
            else "with NaN, infinity or what no camera has"
        )
        raise ObservationError(
            f"{what} is a {shape} matrix of finite numbers, not one {given}"
        )
    return matrix


def _check_mask(given: object, depth: Float32) -> Mask:
    """Return a mask of a depth image; ObservationError if it is none."""
    mask = array_of(given, "the mask")
    if mask.shape != depth.shape or mask.dtype != bool:
        found = f"{mask.shape} {mask.dtype}"
        raise ObservationError(
            f"a mask is (H, W) bool as the depth, {depth.shape}, not {found}"
        )
    if not (mask & (depth > 0)).any():
        raise ObservationError(
            "no pixel of the mask has a depth: a mask of another image, or empty"
        )
    return mask


def _check_image(given: object, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Return an image that is registered to a depth image; ObservationError if it is none."""
    image = array_of(given, "the image")
    if image.dtype != np.uint8 or image.shape not in (shape, (*shape, 3)):
        wanted = f"(H, W) or (H, W, 3) uint8 registered to the depth, {shape}"
        raise ObservationError(f"an image is {wanted}, not {image.shape} {image.dtype}")
    return image


def _check_intrinsics(intrinsics: ArrayLike, shape: tuple[int, ...]) -> Float:
    k = _matrix(intrinsics, "the matrix of intrinsics", (3, 3))
    if (
        not np.array_equal(k[2], [0, 0, 1])
        or k[1, 0] != 0
        or abs(k[0, 1]) > 1e-3 * abs(k[0, 0])
    ):
        raise ObservationError(
            "intrinsics are [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]: transposed, or with a skew?"
        )
    k[0, 1] = 0
    height, width = shape
    if not (k[0, 0] > 0 and k[1, 1] > 0):
        raise ObservationError(
            "the focal lengths have to be positive: an image that is flipped?"
        )
    focal = min(k[0, 0], k[1, 1])
    if focal < 0.1 * max(shape):
        short = f"a focal length of {focal:.3g} is too short for an image of {width} x {height}"
        raise ObservationError(
            f"{short}: it is expected in pixels, not in millimetres or parts of the image"
        )
    point = f"the principal point ({k[0, 2]:.0f}, {k[1, 2]:.0f}) is"
    if not (-width < k[0, 2] < 2 * width and -height < k[1, 2] < 2 * height):
        raise ObservationError(
            f"{point} far off an image of {width} x {height}: intrinsics of another resolution?"
        )
    # 1 at the image centre
    across = 2 * k[0, 2] / width
    down = 2 * k[1, 2] / height
    scale = (across + down) / 2
    whole = min(abs(width / height / aspect - 1) for aspect in ASPECTS) < 0.01
    if whole and abs(scale - 1) > 0.2 and abs(across - down) < 0.08 * scale:
        sizes = f"{scale * width:.0f} x {scale * height:.0f}, and the depth is {width} x {height}"
        raise ObservationError(
            f"{point} the middle of an image of {sizes}: intrinsics of another resolution"
        )
    upright = min(abs(height / width / aspect - 1) for aspect in ASPECTS) < 0.01
    turned = max(abs(2 * k[0, 2] / height - 1), abs(2 * k[1, 2] / width - 1))
    if upright and turned < 0.08 and abs(across - 1) > 0.2:
        raise ObservationError(
            f"{point} the middle of an image of {height} x {width}, and the depth is {width} x"
            f" {height}: is it turned by a quarter turn?"
        )
    return k


def check_pose(pose: ArrayLike) -> Float:
    """Copy and check a rigid pose, (4, 4); an ObservationError names the likely mistake."""
    pose = _matrix(pose, "the pose", (4, 4))
    if not np.allclose(pose[3], [0, 0, 0, 1], atol=1e-6):
        sentence = (
            f"the last row of a pose is 0, 0, 0, 1, not {np.round(pose[3], 3).tolist()}"
        )
        if np.allclose(pose[:, 3], [0, 0, 0, 1], atol=1e-6):
            sentence += ": transposed?"
        raise ObservationError(sentence)

    rotation = pose[:3, :3]
    gram = rotation.T @ rotation
    scale = np.sqrt(np.trace(gram) / 3)
    if not np.allclose(gram, np.eye(3), atol=1e-3):
        scaled = scale > 0 and np.allclose(gram / scale**2, np.eye(3), atol=1e-3)
        what = (
            f"its rotation is scaled by {scale:.3g}" if scaled else "no rotation matrix"
        )
        raise ObservationError(f"the pose is not rigid: {what}")
    if np.linalg.det(rotation) < 0:
        raise ObservationError(
            "the pose is mirrored (left-handed axes): one axis has the wrong sign"
        )

    u, _, vt = np.linalg.svd(rotation)
    pose[:3, :3] = u @ vt  # removes rounding errors of poses from text files

    return pose
