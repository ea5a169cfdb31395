"""What the explorer can show: sample meshes, a mesh file, a folder of meshes, the objects of a view store."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import takes_paths
from nextview.data.folders import list_dataset
from nextview.data.samples import SAMPLES, sample_mesh
from nextview.errors import DatasetError
from nextview.mesh import FORMATS, Mesh, load_mesh
from nextview.observation import Camera, Observation
from nextview.viewsphere import direction_of

if TYPE_CHECKING:
    from nextview.data.store import ViewStore


class StoredViews:
    """A camera before an object of a view store: the stored view nearest to the one asked for answers.

    Args:
        store: the store.
        row: of the object.
    """

    def __init__(self, store: ViewStore, row: int) -> None:
        self.sphere, self._intrinsics = store.sphere, store.intrinsics
        self._depth, self._image = store.depth(row), store.image(row)
        radius = store.radii[row]
        self._radius = float(radius) if np.isfinite(radius) and radius > 0 else None

    def observe(self, pose: NDArray[np.float64]) -> Observation:
        """The stored view nearest to a pose, (4, 4), object frame; its own pose comes with it."""
        view, _ = self.sphere.nearest(direction_of(pose))
        return Observation(
            self._depth[view], self.sphere.poses[view], self._intrinsics, self._radius, self._image[view]
        )


@dataclass(frozen=True)
class ShownObject:
    """An object by name.

    Attributes:
        name: unique among those that are shown together.
        open: reads it: a mesh, or a camera where there are only pictures.
        label: its class, if it is known.
    """

    name: str
    open: Callable[[], Mesh | Camera]
    label: str | None = None


@takes_paths("path")
def shown_objects(path: Path | None = None, up: str | None = None) -> tuple[ShownObject, ...]:
    """The objects of a path, in order.

    Args:
        path: a mesh file; a folder with meshes in it, or in class folders as ``list_dataset`` has them; a view store
            (.zarr). The bundled samples if not given.
        up: the up axis of mesh files, "y" or "z"; see ``load_mesh``.

    Raises:
        DatasetError: the folder holds no meshes, or the store no object that is rendered.
    """
    if path is None:
        return tuple(ShownObject(name, partial(sample_mesh, name), name) for name in SAMPLES)
    if not path.is_dir():
        return (ShownObject(path.stem, partial(load_mesh, path, up)),)
    if (path / "zarr.json").exists():
        return _of_store(path)
    flat = sorted(file for file in path.iterdir() if file.suffix.lower() in FORMATS and file.is_file())
    if flat:
        return tuple(ShownObject(file.name, partial(load_mesh, file, up)) for file in flat)
    entries = list_dataset(path)
    return tuple(ShownObject(entry.name, partial(load_mesh, entry.path, up), entry.label) for entry in entries)


def _of_store(path: Path) -> tuple[ShownObject, ...]:
    from nextview.data.store import ViewStore

    store = ViewStore.open(path)
    found = [
        ShownObject(store.names[row], partial(StoredViews, store, row), store.classes[store.labels[row]])
        for row in np.flatnonzero(store.done).tolist()
    ]
    if not found:
        raise DatasetError(f"{path}: no object in it is rendered yet")
    return tuple(found)
