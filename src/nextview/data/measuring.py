"""Compute something of every rendered object of a store, into the store; resumable by object."""

from __future__ import annotations

import resource
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import zarr
from numpy.typing import NDArray

from nextview.arguments import takes_paths
from nextview.cameras.simulated import SimulatedCamera
from nextview.data.folders import list_dataset
from nextview.data.lock import only_one, writing
from nextview.data.pool import WorkerDied, each
from nextview.data.rendering import deformed
from nextview.data.store import DEPTH_UNIT, ViewStore
from nextview.errors import DatasetError, MeasureError
from nextview.measures.measured_view import MeasuredView
from nextview.measures.registry import find_measure, names_of
from nextview.measures.surface import Surface
from nextview.mesh import load_mesh
from nextview.mesh_format import MAX_FACES
from nextview.models.model_card import file_hash
from nextview.own_code import own_code

READING, CASTING = "reading depth", "finding faces"
"""What is done for all measures, beside them."""
Made = tuple[dict[str, NDArray[np.float32]], "Cost | None"]
"""Arrays by name, and what they cost if anyone wants to know."""


@dataclass
class Cost:
    """What measuring cost.

    Attributes:
        seconds: of one processor, by measure; what several measures share is counted to the first of them.
        views: measured.
        peak: memory of the largest process, bytes.
    """

    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    views: int = 0
    peak: int = 0

    def add(self, other: Cost) -> None:
        """Count another one in."""
        for name, seconds in other.seconds.items():
            self.seconds[name] += seconds
        self.views += other.views
        self.peak = max(self.peak, other.peak)

    def per_second(self) -> dict[str, float]:
        """Views a second of one processor, by measure, and "all" together."""
        rates = {name: self.views / seconds for name, seconds in self.seconds.items() if seconds}
        return rates | {"all": self.views / max(sum(self.seconds.values()), 1e-9)}


@takes_paths("path", "meshes")
def measure(
    path: Path,
    names: Sequence[str] = (),
    workers: int | None = None,
    scheduler: str | None = None,
    meshes: Path | None = None,
    max_faces: int = MAX_FACES,
    cost: Cost | None = None,
    objects: NDArray[np.int64] | None = None,
) -> Iterator[tuple[int, int]]:
    """Put view measures into a store, as ``measures/NAME`` (N, V) float32.

    Args:
        path: the store.
        names: of the measures, "all", or "module:function", see ``measures.registry``; by default all that can be had.
        workers: processes; one for each core by default; 0 to work in this one.
        scheduler: address of a dask.distributed scheduler, to use instead.
        meshes: the dataset folder that the store was rendered from, for measures that need the mesh.
        max_faces: of a mesh, as it was rendered.
        cost: is told what this run costs.
        objects: indices of those to measure; all that are rendered by default.

    Yields:
        Objects done so far, and how many there are.

    Raises:
        DatasetError: there is no store, the meshes are not those that it was rendered from, or it cannot be written.
        MeasureError: there is no such measure, it needs the meshes, or it failed.
    """
    names = names_of(names, meshes is not None)
    store = ViewStore.open(path)
    store.array("depth")  # says if it is missing, before anything is begun
    if all(find_measure(name).needs == "depth" for name in names):
        meshes = None
    if meshes is not None:
        meshes = meshes.absolute()
        _check_meshes(store, meshes)
    function = partial(_measure, names, meshes, max_faces)
    yield from keep(path, [f"measures/{name}" for name in names], function, workers, scheduler, cost, objects)


def _check_meshes(store: ViewStore, meshes: Path) -> None:
    """Look for the mesh file of each rendered object.

    Raises:
        DatasetError: one is not there, or the store looked through a sensor.
    """
    if "sensor" in store.group.attrs:
        raise DatasetError(f"{store.path}: was rendered through a sensor, whose depth does not tell which face is seen")
    names, found = store.names, {entry.name for entry in list_dataset(meshes)}
    lacking = [names[i] for i in np.flatnonzero(store.done) if names[i] not in found]
    if lacking:
        raise DatasetError(f"{meshes}: holds no mesh called {lacking[0]}, of which {store.path} has views")


@lru_cache(maxsize=1)  # once for each process
def _files(meshes: Path, store: Path) -> dict[str, Path]:
    """The mesh files of a dataset by name. The store is asked for nothing: for each one it is looked anew."""
    return {entry.name: entry.path for entry in list_dataset(meshes)}


def _measure(names: tuple[str, ...], meshes: Path | None, max_faces: int, store: ViewStore, i: int) -> Made:
    cost = Cost(views=len(store.sphere))
    began = time.process_time()

    def lap(name: str) -> None:
        nonlocal began
        now = time.process_time()
        cost.seconds[name] += now - began
        began = now

    measures = {name: find_measure(name) for name in names}
    depths = store.read("depth", i)
    lap(READING)
    surface = camera = None
    if meshes is not None:
        name, hashes = store.names[i], store.group.attrs.get("sha256")
        file = _files(meshes, store.path)[name]
        if hashes and file_hash(file) != hashes[i]:
            raise DatasetError(f"{file}: is not the mesh that {store.path} was rendered from")
        mesh = deformed(store, load_mesh(file, max_faces=max_faces), name)
        surface = Surface(mesh.vertices, mesh.faces)
        camera = SimulatedCamera(mesh, depths.shape[-1], store.sphere.distance)
        lap(CASTING)
    values = {name: np.empty(len(depths), np.float32) for name in names}
    for k, (depth, pose) in enumerate(zip(depths, store.sphere.poses, strict=True)):
        depth = depth * DEPTH_UNIT  # float64, as when it was rendered
        faces = None if camera is None else camera.face_ids(pose, depth)
        view = MeasuredView(depth, pose, store.intrinsics, surface, faces)
        lap(READING if camera is None else CASTING)
        for name, function in measures.items():
            own = own_code(partial(_failed, name, store.names[i])) if ":" in name else nullcontext()
            with own, np.errstate(over="ignore"):  # what is too large for float32 is told below
                values[name][k] = function(view)
            lap(name)
    for name, found in values.items():
        if not np.isfinite(found).all():
            raise MeasureError(f"measure {name} of {store.names[i]}, view {np.isfinite(found).argmin()}, is not finite")
    cost.peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return {f"measures/{name}": found for name, found in values.items()}, cost


def _failed(name: str, of: str, said: str) -> MeasureError:
    return MeasureError(f"measure {name} of {of}: {said}")


def keep(
    path: Path,
    names: Sequence[str],
    function: Callable[[ViewStore, int], Made],
    workers: int | None = None,
    scheduler: str | None = None,
    cost: Cost | None = None,
    objects: NDArray[np.int64] | None = None,
) -> Iterator[tuple[int, int]]:
    """Call ``function(store, i)`` for the objects that lack a sound row of the arrays, and keep what it returns.

    Args:
        path: the store.
        names: of the arrays; one that is missing or cannot be opened is made.
        function: returns one array of finite numbers for each name, and what they cost.
        workers: processes; one for each core by default; 0 to work in this one.
        scheduler: address of a dask.distributed scheduler, to use instead.
        cost: is told what this run costs.
        objects: indices of those that are wanted; all that are rendered by default.

    Yields:
        Objects done so far, and how many there are.

    Raises:
        DatasetError: there is no store, another run is writing it, or it cannot be written.
    """
    with only_one(path), writing(path):
        store = ViewStore.open(path.absolute())
        done = np.flatnonzero(store.done)
        done = done if objects is None else np.intersect1d(done, objects)
        for name in names:
            if not store.sound(name):
                store.add(name)
        lacking: set[int] = set()
        for name in names:
            values, wrong = store.scan(name, done.tolist())
            blank = np.isnan(values.reshape(len(store), -1)[done]).any(1)
            lacking |= {*wrong, *done[blank].tolist()}  # what is damaged is made anew
        items = sorted(lacking)
        yield len(done) - len(items), len(done)
        finished = len(done) - len(items)
        for i, spent in each(partial(_keep_object, store.path, function), items, workers, scheduler):
            if isinstance(spent, WorkerDied):
                raise DatasetError(f"{path}: object {store.names[i]} cannot be computed ({spent})")
            if cost is not None and spent is not None:
                cost.add(spent)
            finished += 1
            yield finished, len(done)


def _keep_object(path: Path, function: Callable[[ViewStore, int], Made], i: int) -> Cost | None:
    store = ViewStore.open(path)
    found, cost = function(store, i)
    with zarr.config.set({"array.write_empty_chunks": True}):  # zeros too: an object without a chunk is a damaged one
        for name, values in found.items():
            store.group[name][i] = values
    return cost
