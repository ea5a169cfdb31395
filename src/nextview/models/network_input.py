"""What the networks take of a view: one function, for views of a live camera and for those of a store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import of_kind
from nextview.errors import ModelError, ObservationError
from nextview.models.cloud_input import cloud_input
from nextview.models.geometry_input import CHANNELS, geometry_input
from nextview.models.image_input import image_input
from nextview.observation import Observation
from nextview.viewsphere import ViewSphere

InputKind = Literal["geometry", "image", "cloud"]
CHANNELS_OF = {"geometry": len(CHANNELS), "image": 1}
"""Channels of the kinds of input that are images."""


@dataclass(frozen=True)
class InputSpec:
    """What a network takes of a view.

    Attributes:
        kind: "geometry", four channels from the depth image and its pose (see ``geometry_input``); "image", the shaded
            image in grey; or "cloud", the visible points, upright, the camera at azimuth zero (see ``cloud_input``).
        size: side of the image, pixels; 0 for a cloud.

    Raises:
        ModelError: there is no such input.
    """

    kind: InputKind
    size: int = 0

    def __post_init__(self) -> None:
        if self.kind not in get_args(InputKind) or (self.kind == "cloud") != (self.size == 0) or self.size < 0:
            raise ModelError(f"a network takes geometry or an image of some size, or a cloud, not {self}")

    @property
    def shape(self) -> tuple[int | None, ...]:
        """Of one view's input; None where it is free."""
        return (None, 3) if self.kind == "cloud" else (CHANNELS_OF[self.kind], self.size, self.size)


class StoredViews(Protocol):
    """What ``nextview.data.store.ViewStore`` offers of its objects."""

    @property
    def sphere(self) -> ViewSphere:
        """The viewpoints, V of them."""

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """Pinhole matrix of all views, (3, 3), pixels."""

    def depth(self, i: int) -> NDArray[np.float32]:
        """Of all views of object i, (V, S, S), object radii, 0 = no object."""

    def image(self, i: int) -> NDArray[np.uint8]:
        """All views of object i, (V, S, S)."""

    def points(self, i: int) -> NDArray[np.float32]:
        """Of all views of object i, (V, 1024, 3), object frame."""


def from_observations(spec: InputSpec, observations: Sequence[Observation]) -> NDArray[Any]:
    """What a network takes of B views from one camera.

    Returns:
        Geometry (B, 4, size, size) or image (B, 1, size, size), uint8; or clouds (B, 1024, 3) float32.

    Raises:
        ObservationError: they are not from one camera, or their image does not suit the network.
    """
    of_kind(observations, Sequence, "views are a list of them", ObservationError)
    for view in observations:
        of_kind(view, Observation, "a view is an Observation", ObservationError)
    if not observations:
        raise ObservationError("there is no view to look at")
    first = observations[0]
    for other in observations[1:]:
        if other.depth.shape != first.depth.shape or not np.array_equal(other.intrinsics, first.intrinsics):
            raise ObservationError("views that are handed in together are from one camera: of one size and one pinhole")
    array = {"geometry": "depth", "image": "picture", "cloud": "points"}[spec.kind]
    views = np.stack([getattr(o, array) for o in observations])
    return _network_input(spec, views, np.stack([o.pose for o in observations]), first.intrinsics)


def from_store(
    spec: InputSpec, store: StoredViews, i: int, chosen: NDArray[np.int64] | slice = slice(None)
) -> NDArray[Any]:
    """What a network takes of all V views of object i of a store, or of some: the same as it takes of these live.

    Returns:
        Geometry (V, 4, size, size) or image (V, 1, size, size), uint8; or clouds (V, 1024, 3) float32.
    """
    if spec.kind == "geometry":
        views: NDArray[Any] = store.depth(i)
    else:
        views = store.image(i) if spec.kind == "image" else store.points(i)
    return _network_input(spec, views[chosen], store.sphere.poses[chosen], store.intrinsics)


def _network_input(
    spec: InputSpec, views: NDArray[Any], poses: NDArray[np.float64], intrinsics: NDArray[np.float64]
) -> NDArray[Any]:
    if spec.kind == "cloud":
        return cloud_input(views, poses)
    if spec.kind == "image":
        return image_input(views, spec.size)
    # One view at a time stays in the processor's cache.
    one = [geometry_input(views[v : v + 1], poses[v : v + 1], intrinsics, spec.size) for v in range(len(views))]
    return np.concatenate(one)
