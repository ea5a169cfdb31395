"""Inputs of the networks: geometry, a grey image or a cloud, of live or stored views."""

from collections.abc import Sequence
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from nextview.errors import ModelError, ObservationError
from nextview.geometry.depth import object_depth, slope
from nextview.sensing.observation import Observation
from nextview.types import Float, Float32

InputKind = Literal["geometry", "image", "cloud"]
CHANNELS = ("facing", "up", "height", "nearness")
# channels of the kinds of input that are images
CHANNELS_OF = {"geometry": len(CHANNELS), "image": 1}


class InputSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The input that a network takes of a view.

    Attributes:
        kind: see ``geometry_input``, ``image_input`` and ``cloud_input``.
        size: side of the image, pixels; 0 for a point cloud.
    """

    kind: InputKind
    size: int = 0

    def __post_init__(self) -> None:
        if self.size < 0 or (self.kind == "cloud") != (self.size == 0):
            raise ModelError(
                f"a network takes geometry or an image of some size, or a cloud, not {self}"
            )

    @property
    def shape(self) -> tuple[int | None, ...]:
        """Of one view's input; None where it is free."""
        return (
            (None, 3)
            if self.kind == "cloud"
            else (CHANNELS_OF[self.kind], self.size, self.size)
        )


def from_observations(
    spec: InputSpec,
    observations: Sequence[Observation],
) -> NDArray[Any]:
    """Compute the input of a network from observations.

    Args:
        spec: what the network takes.
        observations: B views from one camera.

    Returns:
        Input of the network, (B, ...).

    Raises:
        ObservationError: the views are not from one camera, or do not suit the network.
    """
    if not isinstance(observations, Sequence) or not all(
        isinstance(view, Observation) for view in observations
    ):
        raise ObservationError("views are a list of Observations")
    if not observations:
        raise ObservationError("there is no view to look at")

    first = observations[0]
    for other in observations[1:]:
        if other.depth.shape != first.depth.shape or not np.array_equal(
            other.intrinsics,
            first.intrinsics,
        ):
            raise ObservationError(
                "views that are passed together must be from one camera: of one size and pinhole"
            )

    array = {"geometry": "depth", "image": "picture", "cloud": "points"}[spec.kind]
    views = np.stack([getattr(o, array) for o in observations])
    return _network_input(
        spec,
        views,
        np.stack([o.pose for o in observations]),
        first.intrinsics,
    )


def from_store(
    spec: InputSpec,
    store: Any,
    i: int,
) -> NDArray[Any]:
    """Compute the input of a network from the stored views of an object.

    Args:
        spec: what the network takes.
        store: a ``ViewStore``.
        i: row of the object.

    Returns:
        Input of the network, (B, ...).
    """
    reads: dict[str, Any] = {
        "geometry": store.depth,
        "image": store.image,
        "cloud": store.points,
    }
    return _network_input(
        spec,
        reads[spec.kind](i)[:],
        store.sphere.poses,
        store.intrinsics,
    )


def _network_input(
    spec: InputSpec,
    views: NDArray[Any],
    poses: Float,
    intrinsics: Float,
) -> NDArray[Any]:
    if spec.kind == "cloud":
        return cloud_input(views, poses)
    if spec.kind == "image":
        return image_input(views, spec.size)
    # One view at a time stays in the processor's cache.
    one = [
        geometry_input(views[v : v + 1], poses[v : v + 1], intrinsics, spec.size)
        for v in range(len(views))
    ]
    return np.concatenate(one)


def cloud_input(points: Float32, poses: Float) -> Float32:
    """Turn point clouds to the camera's azimuth and scale each to [0, 1].

    In this frame the cells of the predicted map, all rings and azimuth -1, 0, +1, have the same
    place for every view.

    Args:
        points: (B, P, 3) float32, object frame.
        poses: camera-to-world, (B, 4, 4), object frame.

    Returns:
        Clouds, (B, P, 3) float32, upright, with the camera at azimuth zero; all zero for a cloud
        without extent.
    """
    azimuth = np.arctan2(poses[:, 1, 3], poses[:, 0, 3])
    c = np.cos(azimuth).astype(np.float32)[:, None]
    s = np.sin(azimuth).astype(np.float32)[:, None]
    x = points[..., 0]
    y = points[..., 1]
    z = points[..., 2]
    turned = np.stack([c * x + s * y, c * y - s * x, z], -1)
    low = turned.min((1, 2), keepdims=True)
    span = turned.max((1, 2), keepdims=True) - low
    return np.where(span > 0, (turned - low) / np.where(span > 0, span, 1), 0).astype(
        np.float32
    )


def image_input(images: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    """Reduce grey images to one channel of the network's size.

    Args:
        images: (B, H, W) uint8, with H = W a multiple of ``size``.
        size: side of the result, pixels.

    Returns:
        Mean over squares of pixels, (B, 1, size, size) uint8.

    Raises:
        ObservationError: the images cannot be reduced to this size.
    """
    b, h, w = images.shape
    if h != w or h % size:
        raise ObservationError(
            f"an image of {h}x{w} cannot be reduced to {size}x{size}: use a multiple of {size}"
        )
    squares = images.reshape(b, size, h // size, size, h // size)
    return np.rint(squares.mean((2, 4), dtype=np.float32)).astype(np.uint8)[:, None]


def geometry_input(
    depth: Float32,
    poses: Float,
    intrinsics: Float,
    size: int,
) -> NDArray[np.uint8]:
    """Convert depth images to four channels in the frame of gravity and of the viewing ray.

    The channels do not depend on texture or lighting. "facing": cosine between the surface normal
    and the ray to the camera, 0 to 1, as a headlight would show it. "up": vertical component of the
    normal, -1 to 1. "height": above the object's centre, -1 to 1 radii. "nearness": towards the
    camera from the object's centre, -1 to 1 radii. Each is mapped to 1 to 255; 0 is background.

    Normals come from differences between neighbouring pixels of the full image, on the side where
    the depth changes less. The image is then thinned to every k-th pixel.

    Args:
        depth: (B, H, W) float32, object radii; 0 where there is no object. H = W is a multiple of
            ``size``.
        poses: camera-to-world, (B, 4, 4), object frame.
        intrinsics: pinhole matrix, (3, 3), pixels.
        size: side of the result, pixels.

    Returns:
        The channels, (B, 4, size, size) uint8.

    Raises:
        ObservationError: the images cannot be thinned to this size.
    """
    _b, h, w = depth.shape
    if h != w or h % size:
        raise ObservationError(
            f"a depth image of {h}x{w} cannot be thinned to {size}x{size}: use a multiple of {size}"
        )
    k = h // size
    rotation = poses[:, :3, :3].astype(np.float32)
    origin = poses[:, :3, 3].astype(np.float32)
    padded = np.pad(
        object_depth(depth).astype(np.float32, copy=False),
        ((0, 0), (1, 1), (1, 1)),
    )
    z = padded[:, 1:-1:k, 1:-1:k]
    along_column = slope(padded[:, 1:-1:k, :-2:k], z, padded[:, 1:-1:k, 2::k])
    along_row = slope(padded[:, :-2:k, 1:-1:k], z, padded[:, 2::k, 1:-1:k])
    focal = intrinsics[0, 0].astype(np.float32)
    focal_y = intrinsics[1, 1].astype(np.float32)
    along_row *= focal_y / focal  # a step down the image as long as one across it
    x = ((np.arange(0, w, k) + 0.5 - intrinsics[0, 2]) / focal).astype(np.float32)[
        None,
        None,
        :,
    ]
    y = ((np.arange(0, h, k) + 0.5 - intrinsics[1, 2]) / focal_y).astype(np.float32)[
        None,
        :,
        None,
    ]
    # The surface is P = (x z, y z, z); the cross product of its derivatives, scaled, points to the
    # camera:
    through = z / focal + x * along_column + y * along_row
    length = np.sqrt(along_column**2 + along_row**2 + through**2) + 1e-12

    def vertical(a: NDArray, b: NDArray, c: NDArray) -> NDArray:
        up = rotation[:, 2, :, None, None]  # the world's z axis in each camera's frame
        return up[:, 0] * a + up[:, 1] * b + up[:, 2] * c

    facing = z / focal / (length * np.sqrt(x**2 + y**2 + 1))
    up = vertical(along_column, along_row, -through) / length
    height = vertical(x * z, y * z, z) + origin[:, 2, None, None]
    nearness = np.linalg.norm(origin, axis=1)[:, None, None] - z
    channels = np.stack([2 * facing - 1, up, height, nearness], 1)
    coded = 1 + 127 * (np.clip(channels, -1, 1) + 1) + 0.5
    return np.where(z[:, None] > 0, coded, 0).astype(np.uint8)
