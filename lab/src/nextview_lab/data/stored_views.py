"""The objects of a view store in the explorer."""

from functools import partial
from pathlib import Path

import numpy as np

from nextview.errors import DatasetError
from nextview.geometry.viewsphere import direction_of
from nextview.sensing.observation import Observation
from nextview.types import Float
from nextview.viewers.exploration import ShownObject
from nextview_lab.data.store import ViewStore


class StoredViews:
    """A camera that answers with the nearest stored view of an object."""

    def __init__(self, store: ViewStore, row: int) -> None:
        self.sphere = store.sphere
        self._intrinsics = store.intrinsics
        self._depth = store.depth(row)
        self._image = store.image(row)
        radius = float(store.radii[row])
        self._exact = store.attributes.sensor is None
        self._radius = radius if 0 < radius < np.inf else None

    def observe(self, pose: Float) -> Observation:
        """Return the stored view nearest to a pose, (4, 4), object frame, with its actual pose."""
        k, _ = self.sphere.nearest(direction_of(pose))
        seen = (
            self._depth[k],
            self.sphere.poses[k],
            self._intrinsics,
            self._radius,
            self._image[k],
        )
        return Observation(*seen, exact=self._exact)


def objects_of(path: Path) -> tuple[ShownObject, ...]:
    """List the rendered objects of a view store.

    Args:
        path: of the store.

    Returns:
        The objects, in order.

    Raises:
        DatasetError: it is not a store, or no object in it is rendered.
    """
    store = ViewStore.open(path)
    rows = np.flatnonzero(store.done).tolist()
    if not rows:
        raise DatasetError(f"{path}: no object in it is rendered yet")
    labels = [store.classes[label] for label in store.labels]
    return tuple(
        ShownObject(store.names[k], partial(StoredViews, store, k), labels[k])
        for k in rows
    )
