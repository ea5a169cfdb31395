"""Render a dataset into a view store, on all cores, resumable."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from nextview.cameras.simulated import SimulatedCamera
from nextview.data.folders import DatasetError, Entry, list_dataset
from nextview.data.store import DEPTH_UNIT, DONE, FAILED, PENDING, POINT_UNIT, ViewStore
from nextview.measures.depth_entropy import depth_entropy
from nextview.mesh import Mesh, MeshError, load_mesh, make_mesh
from nextview.viewsphere import ViewSphere


@dataclass(frozen=True)
class Deform:
    """Make a new object of a mesh: turn it about z by any angle and scale each axis.

    Attributes:
        stretch: each axis is scaled by a factor drawn log-uniformly from 1/(1 + stretch) to 1 + stretch.
        turn: whether to turn about z.
    """

    stretch: float = 0.0
    turn: bool = False

    def __call__(self, mesh: Mesh, rng: np.random.Generator) -> Mesh:
        reach = np.log1p(self.stretch)
        factors = np.exp(rng.uniform(-reach, reach, 3))
        angle = rng.uniform(0, 2 * np.pi) if self.turn else 0.0
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        return make_mesh((mesh.vertices * factors) @ turn.T, mesh.faces, mesh.name)


def render_object(mesh: Mesh, sphere: ViewSphere, size: int) -> dict[str, np.ndarray]:
    """All views of one mesh as the store keeps them: image, depth, points and depth-entropy."""
    camera = SimulatedCamera(mesh, size, sphere.distance)
    looks = [camera.observe(pose) for pose in sphere.poses]
    depth = np.stack([np.rint(look.depth / DEPTH_UNIT).astype(np.uint16) for look in looks])
    return {
        "image": np.stack([look.image for look in looks]),
        "depth": depth,
        "points": np.stack([np.rint(look.points / POINT_UNIT).clip(-32767, 32767).astype(np.int16) for look in looks]),
        "measures/depth_entropy": np.array([depth_entropy(d * DEPTH_UNIT) for d in depth], np.float32),
    }


def render(
    dataset: Path,
    path: Path,
    sphere: ViewSphere,
    size: int = 224,
    seed: int = 0,
    deform: Deform | None = None,
    split: str | None = None,
    workers: int | None = None,
) -> Iterator[tuple[str, str | None]]:
    """Render every mesh that the store does not hold yet.

    Args:
        dataset: folder of meshes.
        path: the store.
        sphere: the viewpoints.
        size: side of the images, pixels.
        seed: decides the deformations.
        deform: how to make a new object of each mesh; not at all by default.
        split: only this split of the dataset.
        workers: processes; one for each core by default.

    Yields:
        (name, None) for each object done, (name, reason) for one that cannot be rendered.

    Raises:
        DatasetError: the dataset is unusable, or the store was begun from another one or with other settings.
    """
    entries = [e for e in list_dataset(dataset) if split in (None, e.split)]
    deform = deform or Deform()
    recipe = {"seed": seed, "stretch": deform.stretch, "turn": deform.turn}
    if path.exists():
        store = ViewStore.open(path)
        wanted = {
            "names": [e.name for e in entries],
            "size": size,
            "elevations": list(sphere.elevations),
            "azimuths": sphere.azimuths,
            **recipe,
        }
        for key, value in wanted.items():
            if store.group.attrs.get(key) != value:
                raise DatasetError(f"{path}: was begun with other {key}; give another store or the same settings")
    else:
        store = ViewStore.create(path, entries, sphere, size, recipe)
    todo = [int(i) for i in np.flatnonzero(store.group["status"][:] == PENDING)]
    # Largest files first, so that no worker is left with a long one at the end.
    todo.sort(key=lambda i: -entries[i].path.stat().st_size)
    workers = workers or os.cpu_count() or 1
    with ProcessPoolExecutor(workers, get_context("spawn"), _open_store, (path,)) as pool:
        jobs = [pool.submit(_render_entry, i, entries[i], sphere, size, seed, deform) for i in todo]
        for job in as_completed(jobs):
            yield job.result()


_store: ViewStore


def _open_store(path: Path) -> None:
    global _store
    _store = ViewStore.open(path)


def _render_entry(
    i: int, entry: Entry, sphere: ViewSphere, size: int, seed: int, deform: Deform
) -> tuple[str, str | None]:
    try:
        mesh = load_mesh(entry.path)
        if deform != Deform():
            mesh = deform(mesh, np.random.default_rng([seed, *entry.name.encode()]))
        arrays = render_object(mesh, sphere, size)
    except MeshError as error:
        _store.group["status"][i] = FAILED
        return entry.name, str(error)
    for name, values in arrays.items():
        _store.group[name][i] = values
    _store.group["status"][i] = DONE  # last, so that an object counts only when it is whole
    return entry.name, None
