"""Render a dataset into a view store, on all cores, resumable."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from uuid import uuid4

import numpy as np
import zarr
from numpy.typing import NDArray

from nextview.arguments import takes_paths
from nextview.cameras.sensors import SensedCamera, Sensor, SensorMix, sensor_named
from nextview.cameras.simulated import SimulatedCamera
from nextview.cloud import POINTS
from nextview.command_line import command_line
from nextview.data.attributes import FORMAT, restored
from nextview.data.folders import Entry, list_dataset
from nextview.data.lock import only_one, writing
from nextview.data.pool import count, each
from nextview.data.store import (
    DEPTH_UNIT,
    DIGEST,
    DONE,
    FAILED,
    PENDING,
    POINT_UNIT,
    ViewStore,
    digest,
    refuse_without_root,
)
from nextview.data.world_views import SIDE, render_scene
from nextview.errors import DatasetError, MeshError, UsageError
from nextview.measures.depth_entropy import depth_entropy
from nextview.mesh import Mesh, load_mesh, make_mesh
from nextview.mesh_format import MAX_FACES
from nextview.models.model_card import read_card
from nextview.observation import Camera
from nextview.sensing.observed_object import SIZE
from nextview.viewsphere import DISTANCE, LAYOUTS, ViewSphere
from nextview.worlds import OccludedCamera, Scene, World, build_scene, sensed_camera
from nextview.worlds.world import SUFFIX

LARGEST_CHUNK = 2**31 - 2**20
"""Bytes that may be compressed at once, the compressor's own included."""
SENSING = 256
"""Sets the draws of a sensor apart from those of a deformation: no byte of a name is as large."""


@dataclass(frozen=True)
class Deform:
    """Make a new object of a mesh: turn it about z by any angle and scale each axis.

    Attributes:
        stretch: each axis is scaled by a factor drawn log-uniformly from 1/(1 + stretch) to 1 + stretch.
        turn: whether to turn about z.

    Raises:
        UsageError: a stretch that is negative or not finite.
    """

    stretch: float = 0.0
    turn: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.stretch < np.inf:
            raise UsageError(f"a stretch is a finite number that is not negative, not {self.stretch}")

    def draw(self, seed: int, name: str) -> tuple[NDArray[np.float64], float]:
        """The factors of the three axes, (3,), and the angle, radians, of the object of that name."""
        rng = np.random.default_rng([seed, *name.encode()])
        reach = np.log1p(self.stretch)
        factors = np.exp(rng.uniform(-reach, reach, 3))
        return factors, rng.uniform(0, 2 * np.pi) if self.turn else 0.0

    def __call__(self, mesh: Mesh, seed: int, name: str) -> Mesh:
        """The new object, normalised again."""
        factors, angle = self.draw(seed, name)
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        return make_mesh((mesh.vertices * mesh.radius * factors) @ turn.T, mesh.faces, mesh.name)


def render_object(camera: Camera, sphere: ViewSphere, size: int) -> dict[str, np.ndarray]:
    """All views of one object as the store keeps them: image, depth, points and depth-entropy."""
    image = np.empty((len(sphere), size, size), np.uint8)
    depth = np.empty((len(sphere), size, size), np.uint16)
    points = np.empty((len(sphere), POINTS, 3), np.float32)
    for view, pose in enumerate(sphere.poses):
        observation = camera.observe(pose)
        image[view], points[view] = observation.picture, observation.points
        depth[view] = np.rint(observation.depth / DEPTH_UNIT).clip(max=np.iinfo(np.uint16).max)
    return {
        "image": image,
        "depth": depth,
        "points": np.rint(points / POINT_UNIT).clip(-32767, 32767).astype(np.int16),
        "measures/depth_entropy": np.array([depth_entropy(d * DEPTH_UNIT) for d in depth], np.float32),
    }


@takes_paths("dataset", "path", "held_out", "meshes")
def render(
    dataset: Path,
    path: Path,
    sphere: ViewSphere,
    size: int = 224,
    seed: int = 0,
    deform: Deform | None = None,
    split: str | None = None,
    unit: str | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    max_faces: int = MAX_FACES,
    sensor: str | None = None,
    held_out: Path | None = None,
    meshes: Path | None = None,
) -> Iterator[tuple[str, str | None]]:
    """Render every mesh, or the target of every world, that the store lacks; one that failed before is tried again.

    The run may end at any moment, even by a kill or a full disk; the next one goes on with what is missing.

    Args:
        dataset: folder of meshes, or of worlds.
        path: the store.
        sphere: the viewpoints.
        size: side of the images, pixels.
        seed: decides the deformations, and the errors of a sensor: those of an object by its name alone.
        deform: how to make a new object of each mesh; not at all by default.
        split: only this split of the dataset.
        unit: of length in the mesh files, one of ``mesh.UNITS``; None if it is not known. A store that was made without
            one can be told later.
        workers: processes; one for each core by default.
        scheduler: address of a dask.distributed scheduler whose workers see the same files, instead of processes here.
        max_faces: leave out larger meshes, see ``load_mesh``.
        sensor: look through this sensor, see ``sensor_named``; clean renders if None.
        held_out: only the objects that the model of this card calls held out of its training.
        meshes: folder of the meshes that the worlds of the dataset are made of; None if it holds meshes itself.

    Yields:
        (name, None) for each object done, (name, reason) for one that cannot be rendered.

    Raises:
        DatasetError: the dataset is unusable, the viewpoints are too far, the store was begun from another dataset or
            with other settings or lacks an array, another run is writing it, or it cannot be written.
        UsageError: a size, a seed, a sensor or a number of workers that makes no sense.
    """
    entries = entries_of(dataset.absolute(), split, held_out, meshes)
    if not (size > 0 and 2 * len(sphere) * size**2 < LARGEST_CHUNK):
        most = int(np.sqrt((LARGEST_CHUNK - 1) / 2 / len(sphere)))
        raise UsageError(f"the size of {len(sphere)} views is from 1 to {most} pixels, not {size}")
    count(workers)  # says if that makes no sense
    if not 0 <= seed < 2**63:
        raise UsageError(f"a seed is from 0 to {2**63 - 1}, not {seed}")
    deform = deform or Deform()
    if meshes is not None and deform != Deform():
        raise UsageError("worlds are rendered as they are: objects in them are neither stretched nor turned")
    through = None if sensor is None else sensor_named(sensor)
    if through is not None and (size, sphere.distance) != (SIZE, DISTANCE):
        raise UsageError(
            f"what a sensor saw is shown {SIZE} pixels large from {DISTANCE:g} object radii: a store of a sensor has "
            f"views of that size and distance, not of {size} pixels from {sphere.distance:g}"
        )
    farthest = np.iinfo(np.uint16).max * DEPTH_UNIT
    if sphere.distance + 1 > farthest:
        raise DatasetError(
            f"{path}: depth is stored up to {farthest:.2f} object radii, so the distance can be "
            f"{farthest - 1:.2f} at most, not {sphere.distance:g}"
        )
    with only_one(path), writing(path):
        name = dataset.absolute().name
        store = _begin(path.absolute(), entries, sphere, size, seed, deform, unit, name, through, meshes)
        command = _command(dataset, path, sphere, size, seed, deform, split, unit, sensor, held_out, meshes)
        if command not in store.commands:
            store.note(commands=[*store.commands, command])
        todo = [int(i) for i in np.flatnonzero(~store.done)]
        # Largest files first, so that no worker is left with a long one at the end.
        todo.sort(key=lambda i: -entries[i].path.stat().st_size)
        within = None if meshes is None else meshes.absolute()
        task = partial(_render_entry, store.path, uuid4().hex, sphere, size, seed, deform, max_faces, through, within)
        for (i, entry), reason in each(task, [(i, entries[i]) for i in todo], workers, scheduler):
            if reason is not None:
                # Only this process writes reasons; the status comes last, as for an object that is done.
                store.note(failures=store.failures | {entry.name: f"{reason}"})
                store.mark(i, FAILED)
            elif entry.name in store.failures:
                store.note(failures={n: r for n, r in store.failures.items() if n != entry.name})
            yield entry.name, None if reason is None else f"{reason}"


@takes_paths("dataset", "held_out", "meshes")
def entries_of(
    dataset: Path, split: str | None = None, held_out: Path | None = None, meshes: Path | None = None
) -> list[Entry]:
    """The meshes, or the worlds, of a dataset folder that are asked for; see ``render``.

    Raises:
        DatasetError: there are none, there is no such folder, or it holds the other of both.
        ModelError: the card is none.
    """
    entries = [e for e in _listed(dataset, meshes) if split in (None, e.split)]
    if not entries:
        raise DatasetError(f"{dataset}: nothing in CLASS/{split}/NAME below it")
    if held_out is None:
        return entries
    kept = set(read_card(held_out).held_out)
    entries = [e for e in entries if e.name.partition("@")[0] in kept]
    if not entries:
        raise DatasetError(f"{dataset}: holds no object that {held_out} calls held out")
    return entries


def _listed(dataset: Path, meshes: Path | None) -> list[Entry]:
    """The meshes of a dataset; or its worlds, if their meshes are elsewhere."""
    try:
        return list_dataset(dataset) if meshes is None else list_dataset(dataset, (SUFFIX,))
    except DatasetError:
        if meshes is None and any(dataset.glob(f"*/**/*@*{SUFFIX}")):
            raise DatasetError(f"{dataset}: holds worlds; say with --meshes where the meshes are in them") from None
        raise


def _command(
    dataset: Path,
    path: Path,
    sphere: ViewSphere,
    size: int,
    seed: int,
    deform: Deform,
    split: str | None,
    unit: str | None,
    sensor: str | None,
    held_out: Path | None,
    meshes: Path | None,
) -> str:
    """The command that renders so; of a sphere that has no name, the part that the command line can say."""
    names = [name for name in LAYOUTS if LAYOUTS[name].elevations == sphere.elevations]
    azimuths = None if names and LAYOUTS[names[0]].azimuths == sphere.azimuths else sphere.azimuths
    return command_line(
        "render",
        dataset,
        path,
        sphere=names[0] if names else None,
        azimuths=azimuths,
        size=size,
        split=split,
        stretch=deform.stretch,
        turn=deform.turn,
        unit=unit,
        sensor=sensor,
        held_out=held_out,
        meshes=meshes,
        seed=seed,
    )


def turns(store: ViewStore) -> NDArray[np.float64]:
    """By how much each object of a store was turned about z when it was rendered, radians, (N,)."""
    recipe = store.group.attrs
    deform = Deform(float(recipe.get("stretch", 0.0)), bool(recipe.get("turn", False)))
    return np.array([deform.draw(int(recipe.get("seed", 0)), name)[1] for name in store.names])


def deformed(store: ViewStore, mesh: Mesh, name: str) -> Mesh:
    """A mesh as it was deformed when a store's object of that name was rendered."""
    recipe = store.group.attrs
    deform = Deform(float(recipe.get("stretch", 0.0)), bool(recipe.get("turn", False)))
    return mesh if deform == Deform() else deform(mesh, int(recipe.get("seed", 0)), name)


def _begin(
    path: Path,
    entries: list[Entry],
    sphere: ViewSphere,
    size: int,
    seed: int,
    deform: Deform,
    unit: str | None,
    dataset: str,
    sensor: Sensor | SensorMix | None,
    meshes: Path | None,
) -> ViewStore:
    """The store as an earlier run left it, if that had the same meshes and settings, or a new one."""
    with ThreadPoolExecutor() as pool:
        hashes = list(pool.map(_file_hash, [e.path for e in entries]))
    recipe = {"seed": seed, "stretch": deform.stretch, "turn": deform.turn, "sha256": hashes}
    if sensor is not None:
        recipe["sensor"] = sensor.to_dict()
    if meshes is not None:
        recipe["scene"] = SIDE
    if not path.exists():
        return ViewStore.create(path, entries, sphere, size, recipe | {"unit": unit, "dataset": dataset})
    if not (path / "zarr.json").exists():
        refuse_without_root(path)
        raise DatasetError(f"{path}: is there, and is no view store; give another name")
    wanted = {
        "format": FORMAT,
        "names": [e.name for e in entries],
        "labels": [e.label for e in entries],
        "splits": [e.split for e in entries],
        "size": size,
        "elevations": list(sphere.elevations),
        "azimuths": sphere.azimuths,
        "distance": sphere.distance,
        **recipe,
    }
    try:
        store = ViewStore.open(path)
    except DatasetError as damage:
        _restore(path, wanted, unit, dataset, damage)
        store = ViewStore.open(path)
    before = store.group.attrs.get("sensor")
    if before != wanted.get("sensor"):
        was = "without a sensor" if before is None else f"through the sensor {before['name']}"
        now = "without one" if sensor is None else f"through {sensor.name}"
        same = " of other strengths" if sensor is not None and before and before["name"] == sensor.name else ""
        raise DatasetError(f"{path}: was begun {was}{same}, and cannot go on {now}; give another store or the same one")
    for key, value in wanted.items():
        if store.group.attrs.get(key, value) != value:
            raise DatasetError(f"{path}: was begun with other {key}; give another store or the same settings")
    known = store.group.attrs.get("unit")
    if unit not in (None, known):
        if known is not None:
            raise DatasetError(f"{path}: its meshes are measured in {known}, not {unit}")
        store.note(unit=unit)
    for name in store.rendered:
        store.array(name)  # says what is missing
    if not store.sound(DIGEST):
        store.add(DIGEST)
    for leftover in path.rglob("*.partial"):  # what was being written when a run was killed
        leftover.unlink()
    return store


def _restore(path: Path, wanted: dict, unit: str | None, dataset: str, damage: DatasetError) -> None:
    """Mend the damaged attributes of a store from the meshes and the settings.

    Raises:
        DatasetError: they are not those that the store was begun with, or too little of it is left to tell.
    """
    mended = restored(path / "zarr.json", wanted, unit, dataset)
    if mended is None:
        sentence = f"{damage}; with these it cannot: give the right ones, copy zarr.json back, or make another store"
        raise DatasetError(sentence) from None
    part = path / f"zarr.{uuid4().hex}.partial"
    part.write_text(json.dumps({"attributes": mended, "zarr_format": 3, "node_type": "group"}, indent=2))
    part.replace(path / "zarr.json")


def _file_hash(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return f"unreadable {path.name}"  # its rendering will say why


@lru_cache(maxsize=1)
def _arrays(path: Path, run: str) -> dict[str, zarr.Array]:
    """The store's arrays, opened once for each process and run."""
    # Finding out whether a chunk is worth writing costs more than writing it.
    with zarr.config.set({"array.write_empty_chunks": True}):
        store = ViewStore.open(path)
        return {name: store.array(name) for name in (*store.rendered, DIGEST)}


def _render_entry(
    path: Path,
    run: str,
    sphere: ViewSphere,
    size: int,
    seed: int,
    deform: Deform,
    max_faces: int,
    sensor: Sensor | SensorMix | None,
    meshes: Path | None,
    item: tuple[int, Entry],
) -> str | None:
    """Render one object, or the target of one world, into the store; the reason if its mesh cannot be used."""
    i, entry = item
    arrays = _arrays(path, run)
    rng = np.random.default_rng([seed, SENSING, *entry.name.encode()])
    try:
        if meshes is None:
            mesh = load_mesh(entry.path, max_faces=max_faces)
            if deform != Deform():
                mesh = deform(mesh, seed, entry.name)
            camera: Camera = (
                SimulatedCamera(mesh, size, sphere.distance) if sensor is None else SensedCamera(mesh, sensor, rng)
            )
            rendered = render_object(camera, sphere, size)
        else:
            scene = build_scene(World.load(entry.path), meshes, max_faces)
            mesh = scene.target
            rendered = render_object(_camera_in(scene, sphere, size, sensor, rng), sphere, size)
            rendered |= render_scene(scene, sphere)
    except (MeshError, DatasetError) as error:
        return str(error)
    except MemoryError:
        return f"{entry.path}: too large for this machine's memory"
    rendered["radius"] = np.array(mesh.radius)
    arrays["status"][i] = PENDING  # first: whoever reads the store meanwhile is not to take it for lost
    for name, values in rendered.items():
        arrays[name][i] = values
    arrays[DIGEST][i] = digest(entry.name, rendered)
    arrays["status"][i] = DONE  # last, so that an object counts only when it is whole
    return None


def _camera_in(
    scene: Scene, sphere: ViewSphere, size: int, sensor: Sensor | SensorMix | None, rng: np.random.Generator
) -> Camera:
    return OccludedCamera(scene, size, sphere.distance) if sensor is None else sensed_camera(scene, sensor, rng)
