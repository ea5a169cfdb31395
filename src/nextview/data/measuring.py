"""Compute something of every rendered object of a store, into the store; resumable by object."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.checks import plugin_errors
from nextview.data.folders import list_dataset
from nextview.data.measured_view import MeasuredView, Surface
from nextview.data.measures import MEASURES, find_measure, names_of
from nextview.data.pool import counted
from nextview.data.rendering import deformed
from nextview.data.store import DEPTH_UNIT, ViewStore, opened, writing
from nextview.errors import DatasetError, MeasureError
from nextview.files import sha256_of
from nextview.geometry.mesh import MAX_FACES, load_mesh
from nextview.simulation.simulated import SimulatedCamera

Made = dict[str, NDArray[np.float32]]
"""The values of one object, by the names of their arrays."""


def measure(
    path: Path,
    names: Sequence[str] = (),
    workers: int | None = None,
    scheduler: str | None = None,
    meshes: Path | None = None,
    max_faces: int = MAX_FACES,
    objects: NDArray[np.int64] | None = None,
    overwrite: bool = False,
) -> Iterator[tuple[int, int]]:
    """Put view measures into a store, as ``measures/NAME`` (N, V) float32; see ``nextview measure``.

    Args:
        path: the store.
        names: of the measures, "all", or "MODULE:FUNCTION", see ``find_measure``; by default all that can be had.
        workers, scheduler: see ``pool.each``.
        meshes, max_faces: the dataset folder, as the store was rendered from it, for measures that need the mesh.
        objects: indices of those to measure; all that are rendered by default.
        overwrite: measure anew what is there.

    Yields:
        Objects done so far, and how many there are.
    """
    names = names_of(names, meshes is not None)
    store = ViewStore.open(path)
    store.array("depth")  # says if it is missing, before anything is begun
    files = None
    if meshes is not None and any(find_measure(name).needs == "mesh" for name in names):
        files = {entry.name: entry.path.absolute() for entry in list_dataset(meshes)}
        if store.attributes.sensor is not None:
            raise DatasetError(f"{path}: was rendered through a sensor, whose depth does not tell which face is seen")
        lacking = [store.names[i] for i in np.flatnonzero(store.done) if store.names[i] not in files]
        if lacking:
            raise DatasetError(f"{meshes}: holds no mesh called {lacking[0]}, of which {path} has views")
    function = partial(_measure, names, files, max_faces)
    yield from keep(path, [f"measures/{name}" for name in names], function, workers, scheduler, objects, overwrite)


def _measure(names: tuple[str, ...], files: dict[str, Path] | None, max_faces: int, store: ViewStore, i: int) -> Made:
    depths, object_name = store.read("depth", i), store.names[i]
    surface = camera = None
    if files is not None:
        hashes, file = store.attributes.sha256, files[object_name]
        if hashes and sha256_of(file) != hashes[i]:
            raise DatasetError(f"{file}: is not the mesh that {store.path} was rendered from")
        mesh = deformed(store, load_mesh(file, max_faces=max_faces), object_name)
        surface = Surface(mesh.vertices, mesh.faces)
        camera = SimulatedCamera(mesh, depths.shape[-1], store.sphere.distance)
    functions = {name: find_measure(name) for name in names}
    values = {name: np.empty(len(depths), np.float32) for name in names}
    for k, (depth, pose) in enumerate(zip(depths, store.sphere.poses, strict=True)):
        depth = depth * DEPTH_UNIT  # float64, as when it was rendered
        faces = None if camera is None else camera.face_ids(pose, depth)
        view = MeasuredView(depth, pose, store.intrinsics, surface, faces)
        for name, function in functions.items():
            with _guard(name, object_name), np.errstate(over="ignore"):  # what is too large for float32 is told below
                values[name][k] = function(view)
    for name, found in values.items():
        if not np.isfinite(found).all():
            raise MeasureError(f"measure {name} of {object_name}, view {np.isfinite(found).argmin()}, is not finite")
    return {f"measures/{name}": found for name, found in values.items()}


def _guard(name: str, of: str) -> AbstractContextManager[None]:
    """What a measure of a plugin raises becomes one sentence."""
    return nullcontext() if name in MEASURES else plugin_errors(lambda s: MeasureError(f"measure {name} of {of}: {s}"))


def keep(
    path: Path,
    names: Sequence[str],
    function: Callable[[ViewStore, int], Made],
    workers: int | None = None,
    scheduler: str | None = None,
    objects: NDArray[np.int64] | None = None,
    overwrite: bool = False,
) -> Iterator[tuple[int, int]]:
    """Call ``function(store, i)`` for the objects that lack values in the arrays, and keep what it returns."""
    with writing(path):
        store = ViewStore.open(Path(path).absolute())
        wanted = store.done & (True if objects is None else np.isin(np.arange(len(store)), objects))
        for name in names:
            if overwrite:
                store.remove(name)
            store.add(name)
        held = np.all([store.held(name) for name in names], axis=0)
        items, total = np.flatnonzero(wanted & ~held).tolist(), int(wanted.sum())
        work = partial(_keep_object, store.path, function)
        try:
            yield from counted(work, items, total, lambda i: f"{path}: {store.names[i]}", workers, scheduler)
        finally:  # nothing is left of what failed at once
            for name in names:
                if not store.held(name).any():
                    store.remove(name)


def _keep_object(path: Path, function: Callable[[ViewStore, int], Made], i: int) -> None:
    store = opened(path)
    store.write(i, function(store, i))
