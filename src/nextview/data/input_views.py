"""What a network sees of an object in a store: the same as it sees of a view in live use."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.data.store import ViewStore
from nextview.models.cloud_input import cloud_input
from nextview.models.geometry_input import geometry_input
from nextview.models.image_input import image_input


def input_views(store: ViewStore, i: int, sees: str, size: int) -> NDArray[Any]:
    """What a network sees of all views of object i.

    Args:
        store: the views.
        i: the object.
        sees: "geometry", "image" or "cloud".
        size: side of the network's image, pixels; clouds have none.

    Returns:
        Geometry (V, 4, size, size) or image (V, 1, size, size), uint8; or clouds (V, 1024, 3) float32.
    """
    poses = store.sphere.poses
    if sees == "cloud":
        return cloud_input(store.points(i), poses)
    if sees == "image":
        return image_input(store.image(i), size)
    depth = store.depth(i)  # one view at a time stays in the processor's cache
    one = [geometry_input(depth[v : v + 1], poses[v : v + 1], store.intrinsics, size) for v in range(len(poses))]
    return np.concatenate(one)
