"""Render a dataset into a view store, in parallel and resumable."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.checks import number, one_of, whole
from nextview.data.folders import Entry, Listing, scan_dataset, select
from nextview.data.pool import WorkerDied, count, each
from nextview.errors import DatasetError, MeshError, UsageError, option
from nextview.files import command, sha256_of
from nextview.geometry.depth import CLOUD_POINTS
from nextview.geometry.mesh import (
    FORMATS,
    MAX_FACES,
    UNITS,
    Mesh,
    load_mesh,
)
from nextview.geometry.viewsphere import CAMERA_DISTANCE, ViewSphere, rotation_z
from nextview.sensing.facets import SIZE
from nextview.sensing.observation import Camera
from nextview.simulation.sensed_camera import SensedCamera
from nextview.simulation.sensor import Sensor, SensorMix, sensor_named
from nextview.simulation.simulated import SimulatedCamera
from nextview.types import Float
from nextview_lab.data.measures import depth_entropy
from nextview_lab.data.store import (
    DEPTH_UNIT,
    DONE,
    FAILED,
    POINT_UNIT,
    RENDERED_ARRAYS,
    Attributes,
    ViewStore,
    describe,
    opened,
    writing,
)

AnySensor = Sensor | SensorMix | None
# bytes, largest chunk for the compressor, including its overhead
LARGEST_CHUNK = 2**31 - 2**20
# largest depth that can be stored, object radii
FARTHEST_STORED = np.iinfo(np.uint16).max * DEPTH_UNIT
# separates the random numbers of sensors from those of deformations: larger than a byte of a name
SENSING = 256


@dataclass(frozen=True)
class Deform:
    """Random deformation of meshes.

    Attributes:
        stretch: scale each axis by a factor from 1/(1 + stretch) to 1 + stretch, drawn
            log-uniformly.
        rotated: rotate by a random angle about the vertical.
    """

    stretch: float = 0.0
    rotated: bool = False

    def draw(self, seed: int, name: str) -> tuple[Float, float]:
        """Draw the deformation of an object.

        Args:
            seed: of the store.
            name: of the object.

        Returns:
            The factors along the three axes, (3,) float64, and the rotation about the vertical,
            radians.
        """
        rng = np.random.default_rng([seed, *name.encode()])
        reach = np.log1p(self.stretch)
        return np.exp(rng.uniform(-reach, reach, 3)), (
            rng.uniform(0, 2 * np.pi) if self.rotated else 0.0
        )

    def __call__(self, mesh: Mesh, seed: int, name: str) -> Mesh:
        """Return the deformed mesh, normalised again."""
        factors, angle = self.draw(seed, name)
        return mesh.reshaped(mesh.vertices * factors @ rotation_z(angle).T)


def render_object(
    camera: Camera,
    sphere: ViewSphere,
    size: int,
) -> dict[str, np.ndarray]:
    """Render all views of an object in the format of a store.

    Args:
        camera: in front of the object.
        sphere: the viewpoints.
        size: side of the images, pixels.

    Returns:
        The arrays "image", "depth", "points" and "measures/depth_entropy" of all V views.
    """
    image = np.empty((len(sphere), size, size), np.uint8)
    depth = np.empty((len(sphere), size, size), np.uint16)
    points = np.empty((len(sphere), CLOUD_POINTS, 3), np.float32)

    for view, pose in enumerate(sphere.poses):
        observation = camera.observe(pose)
        image[view] = observation.picture
        points[view] = observation.points
        depth[view] = np.rint(observation.depth / DEPTH_UNIT).clip(
            max=np.iinfo(np.uint16).max
        )

    return {
        "image": image,
        "depth": depth,
        "points": np.rint(points / POINT_UNIT).clip(-32767, 32767).astype(np.int16),
        "measures/depth_entropy": np.array(
            [depth_entropy(d * DEPTH_UNIT) for d in depth],
            np.float32,
        ),
    }


@dataclass(frozen=True)
class RenderOptions:
    """Objects and images.

    Attributes:
        seed: seed of the deformations and of the sensor errors; those of an object depend only on
            the seed and its name.
        deform: Random deformations of each mesh.
        sensor: simulated depth camera, NAME or NAME:STRENGTH (docs/your_camera.md); by default
            renders are free of noise.
        unit: unit of length of the mesh files (mm, cm, inch, foot, m), so that sizes are known
            (ModelNet: inch).
        split: render only this split of the dataset.
        held_out: render only objects that this model (name or card) held out of its training.
        max_faces: largest number of triangles in a mesh; also limits the file to 60 bytes per
            triangle.
        largest_part: keep only the largest connected part of each mesh.
    """

    seed: int = 0
    deform: Deform = Deform()
    sensor: str | None = None
    unit: str | None = None
    split: str | None = None
    held_out: str | None = None
    max_faces: int = MAX_FACES
    largest_part: bool = False


def render(
    dataset: Path,
    path: Path,
    sphere: ViewSphere,
    size: int = 224,
    options: RenderOptions = RenderOptions(),
    workers: int | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
) -> Iterator[tuple[str, str | None]]:
    """Render the meshes that are missing in a store.

    An object that failed before is tried again. An interrupted run can be continued at any point.

    Args:
        dataset: folder of meshes.
        path: of the view store.
        sphere: the viewpoints.
        size: side of the images, pixels.
        options: selection and rendering of objects.
        workers: number of processes; None for one per core, 0 for this process.
        scheduler: address of a dask.distributed scheduler to use instead.
        overwrite: whether to replace a store with other objects or settings.

    Yields:
        The name of each object and None, or the reason why it cannot be rendered.

    Raises:
        DatasetError: the folder or the store cannot be used, or another run is writing to it.
        UsageError: a setting is not valid.
    """
    dataset = Path(dataset).absolute()
    path = Path(path).absolute()
    sensor = _check(path, sphere, size, options)
    count(workers)
    entries = listing(dataset, options).entries
    with writing(path):
        with ThreadPoolExecutor() as pool:
            hashes = list(pool.map(_hash, [e.path for e in entries]))
        recipe = {
            name: getattr(options, name) for name in ("seed", "unit", "largest_part")
        } | vars(options.deform)
        recipe |= {
            "sha256": hashes,
            "sensor": None if sensor is None else sensor.to_dict(),
        }
        recipe |= {"dataset": dataset.name}
        store = _begin(path, describe(entries, sphere, size, recipe), overwrite)
        if (made_by := command()) not in store.commands:
            store.note(commands=[*store.commands, made_by])
        # Largest files first, to balance the load of the workers.
        todo = sorted(
            np.flatnonzero(~store.done).tolist(),
            key=lambda i: -entries[i].path.stat().st_size,
        )
        items = [(i, entries[i]) for i in todo]
        for (i, entry), result in each(
            partial(_render_entry, path, options, sensor),
            items,
            workers,
            scheduler,
        ):
            reason: str | None = (
                f"{entry.path}: {result}" if isinstance(result, WorkerDied) else result
            )
            others = {
                name: said
                for name, said in store.attributes.failures.items()
                if name != entry.name
            }
            if reason is not None:
                # Only this process writes reasons; the status is written last, as for finished
                # objects.
                store.note(failures=others | {entry.name: reason})
                store.write(i, {"status": np.array(FAILED, np.uint8)})
            elif len(others) < len(store.attributes.failures):
                store.note(failures=others)
            yield entry.name, reason


def _check(
    path: Path,
    sphere: ViewSphere,
    size: int,
    options: RenderOptions,
) -> AnySensor:
    """Check the settings; returns the sensor, if there is one."""
    whole(
        size,
        f"the size of {len(sphere)} views in pixels",
        1,
        int(np.sqrt((LARGEST_CHUNK - 1) / 2 / len(sphere))),
    )
    whole(options.seed, "the seed", 0, 2**63 - 1)
    number(options.deform.stretch, "a stretch", 0)

    one_of(options.unit, (None, *UNITS), "the unit")

    if sphere.distance + 1 > FARTHEST_STORED:
        raise DatasetError(
            f"{path}: depth is stored up to {FARTHEST_STORED:.2f} object radii, so the distance can"
            f" be {FARTHEST_STORED - 1:.2f} at most, not {sphere.distance:g}"
        )

    if options.sensor is None:
        return None
    if (size, sphere.distance) != (SIZE, CAMERA_DISTANCE):
        raise UsageError(
            f"a sensor's views are of {SIZE} pixels, from {CAMERA_DISTANCE:g} object radii; give no"
            " other"
        )
    return sensor_named(options.sensor)


def listing(dataset: Path, options: RenderOptions) -> Listing:
    """List the meshes to render and the files left out.

    Args:
        dataset: the folder.
        options: selection of objects.

    Returns:
        The objects and the files left out.

    Raises:
        DatasetError: there is nothing to render.
    """
    found = scan_dataset(dataset, FORMATS)
    return replace(
        found,
        entries=select(found.entries, dataset, options.split, options.held_out),
    )


def rotations(store: ViewStore) -> Float:
    """Return the rotation about z of each object of a store, radians, (N,)."""
    deform = Deform(store.attributes.stretch, store.attributes.rotated)
    return np.array(
        [deform.draw(store.attributes.seed, name)[1] for name in store.names]
    )


def deformed(store: ViewStore, mesh: Mesh, name: str) -> Mesh:
    """Return a mesh with the deformation that it has in a store.

    Args:
        store: the view store.
        mesh: the mesh of the object.
        name: of the object, which determines its deformation.

    Returns:
        The deformed mesh; the mesh itself if the store has no deformations.
    """
    deform = Deform(store.attributes.stretch, store.attributes.rotated)
    return mesh if deform == Deform() else deform(mesh, store.attributes.seed, name)


def _hash(path: Path) -> str:
    with suppress(OSError):
        return sha256_of(path)
    return f"unreadable {path.name}"  # rendering it will report the reason


def _begin(path: Path, wanted: Attributes, overwrite: bool) -> ViewStore:
    """Open the store of an earlier run with the same settings, or create a new one."""
    if not path.exists():
        return ViewStore.create(path, wanted)
    if not (path / "zarr.json").exists():
        raise DatasetError(f"{path}: exists and is not a view store; give another name")
    store = ViewStore.open(path)
    there = store.attributes
    # attributes that do not affect the views
    noted = ["unit"] if wanted.sensor is None else []
    for key in wanted.__struct_fields__:
        if key in (*noted, "dataset", "failures", "commands") or (
            key == "sha256" and there.sha256 is None
        ):
            continue
        if getattr(there, key) != getattr(wanted, key):
            if overwrite:
                return ViewStore.create(path, wanted, overwrite)
            raise DatasetError(
                f"{path}: was begun with other {key}; give another store, or"
                f" {option('overwrite', True)} to replace it"
            )
    if wanted.unit is not None and there.unit is None:
        store.note(unit=wanted.unit)
    if wanted.unit not in (None, there.unit):
        raise DatasetError(
            f"{path}: its meshes are measured in {there.unit}, not {wanted.unit}"
        )
    for name in RENDERED_ARRAYS:
        store.array(name)  # raises an error if it is missing
    for leftover in path.rglob("*.partial"):  # incomplete files of an interrupted run
        leftover.unlink()
    return store


def _render_entry(
    path: Path,
    options: RenderOptions,
    sensor: AnySensor,
    item: tuple[int, Entry],
) -> str | None:
    """Render one object into the store; the reason if its mesh cannot be used."""
    i, entry = item
    store = opened(path)
    try:
        rendered = _rendered(store, options, sensor, entry)
    except (MeshError, DatasetError) as error:
        return str(error)
    except MemoryError:
        return f"{entry.path}: too large for this machine's memory"
    # the status is written last, when the object is complete
    store.write(i, rendered | {"status": np.array(DONE, np.uint8)})
    return None


def _rendered(
    store: ViewStore,
    options: RenderOptions,
    sensor: AnySensor,
    entry: Entry,
) -> dict[str, NDArray]:
    """Return the stored arrays of an object."""
    sphere = store.sphere
    size = store.attributes.size
    rng = np.random.default_rng([options.seed, SENSING, *entry.name.encode()])
    read = load_mesh(
        entry.path,
        unit=options.unit,
        max_faces=options.max_faces,
        largest_part=options.largest_part,
    )
    mesh = deformed(store, read, entry.name)
    camera: Camera = (
        SimulatedCamera(mesh, size, sphere.distance)
        if sensor is None
        else SensedCamera(mesh, sensor, rng)
    )
    # A store keeps the lengths of the files, whose unit may be specified later.
    metres = 1.0 if options.unit is None else UNITS[options.unit]
    radius = np.array(mesh.radius / metres)
    return render_object(camera, sphere, size) | {"radius": radius}
