"""The view store: every view of every object of a dataset, in one Zarr group.

An object is one chunk of each array.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import msgspec
import numpy as np
import zarr
from msgspec import Meta
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, Crc32cCodec

from nextview.data.folders import Entry
from nextview.errors import DAMAGED, DatasetError
from nextview.files import decode_record, new_folder, only_one
from nextview.geometry.camera import pinhole
from nextview.geometry.depth import CLOUD_POINTS
from nextview.geometry.mesh import UNITS
from nextview.geometry.viewsphere import ViewSphere
from nextview.types import Float, Float32, Index, Mask

STORE_FORMAT = 2
DEPTH_UNIT = 1e-4  # unit of the uint16 depth, object radii
POINT_UNIT = 1 / 32767  # unit of the int16 points, object radii
PENDING = 0
DONE = 1
FAILED = 2
# arrays created by rendering
RENDERED_ARRAYS = (
    "image",
    "depth",
    "points",
    "measures/depth_entropy",
    "radius",
    "status",
)
Name = Annotated[str, Meta(min_length=1)]
Split = Literal["train", "test", "val", ""]
Pixels = Annotated[int, Meta(ge=1, le=100_000)]


class Attributes(msgspec.Struct, omit_defaults=True):
    """The objects and views of a store, and how it was rendered.

    Attributes:
        format: version of the layout.
        names: of the objects, unique.
        labels: class of each object.
        splits: split of each object; "" if it has none.
        elevations: of the rings of viewpoints, degrees.
        azimuths: views on each ring.
        distance: from the camera to the object centre, object radii.
        size: side of the images, pixels.
        seed: of the points, of random rotations and stretches, and of the sensor errors.
        stretch: each axis is scaled by a random factor from 1/(1 + stretch) to 1 + stretch.
        rotated: whether each object is rotated at random about the vertical.
        largest_part: whether only the largest connected part of each mesh is kept.
        sensor: parameters of the simulated sensor; None for clean renders.
        sha256: hash of the mesh file of each object.
        unit: unit of length of the mesh files; None if it is not known.
        dataset: path of the meshes.
        failures: why objects were left out, by name.
        commands: commands that made the store, in order.
    """

    format: Literal[2]
    names: Annotated[list[Name], Meta(min_length=1)]
    labels: list[Name]
    splits: list[Split]
    elevations: Annotated[
        list[Annotated[float, Meta(ge=-90, le=90)]],
        Meta(min_length=1),
    ]
    azimuths: Annotated[int, Meta(ge=3, le=100_000)]
    distance: Annotated[float, Meta(gt=1, lt=1e300)]
    size: Pixels
    seed: Annotated[int, Meta(ge=0)] = 0
    stretch: Annotated[float, Meta(ge=0, lt=1e300)] = 0.0
    rotated: bool = False
    largest_part: bool = False
    sensor: dict[str, Any] | None = None
    sha256: list[str] | None = None
    unit: Literal["mm", "cm", "inch", "foot", "m"] | None = None
    dataset: str = ""
    failures: dict[str, str] = {}
    commands: list[str] = []


def describe(
    entries: Sequence[Entry],
    sphere: ViewSphere,
    size: int,
    recipe: Mapping[str, Any],
) -> Attributes:
    """Return the attributes of a new store.

    Args:
        entries: its objects.
        sphere: its viewpoints.
        size: side of the images, pixels.
        recipe: all other attributes by name.

    Returns:
        The attributes.
    """
    return Attributes(
        format=2,
        names=[e.name for e in entries],
        labels=[e.label for e in entries],
        splits=[cast(Split, e.split) for e in entries],
        elevations=list(sphere.elevations),
        azimuths=sphere.azimuths,
        distance=sphere.distance,
        size=size,
        **recipe,
    )


@dataclass(frozen=True)
class ViewStore:
    """Views of N objects from the V views of a sphere.

    Arrays of the group, with one chunk per object: ``image`` (N, V, S, S) uint8; ``depth``
    (N, V, S, S) uint16 in DEPTH_UNIT, 0 = no object; ``points`` (N, V, 1024, 3) int16 in
    POINT_UNIT, object frame; ``measures/NAME`` (N, V) float32; ``radius`` (N,) float64, in
    the unit of its mesh file; ``status`` (N,) uint8. Every chunk has a checksum. Zarr reads the
    fill value for a missing chunk, so every read checks that the file exists.

    Attributes:
        path: of the store, a zarr folder.
        group: the arrays.
        attributes: the objects, the views, and the settings of the rendering.
    """

    path: Path
    group: zarr.Group
    attributes: Attributes

    @classmethod
    def create(
        cls,
        path: Path,
        attributes: Attributes,
        overwrite: bool = False,
    ) -> "ViewStore":
        """Create an empty store, completely or not at all.

        Args:
            path: of the store.
            attributes: of the store.
            overwrite: whether to replace an existing store.

        Returns:
            The store.
        """
        with new_folder(path, overwrite, last="zarr.json") as part:
            store = cls(part, zarr.open_group(part, mode="w"), attributes)
            store.note()
            for name in RENDERED_ARRAYS:
                store.add(name)
            if overwrite and (path / "zarr.json").exists():
                there = cls.open(path)
                for name in (*RENDERED_ARRAYS, *there.added):
                    there.remove(name)
        return cls.open(path)

    @classmethod
    def open(cls, path: str | Path) -> "ViewStore":
        """Open a store; DatasetError if it is missing, damaged, or in another format."""
        path = Path(path)
        if not (path / "zarr.json").is_file():
            raise DatasetError(
                f"{path}: there is no view store; make one with nextview-lab render"
            )

        try:
            group = zarr.open_group(path, mode="r+")
        except DAMAGED as error:
            raise DatasetError(
                f"{path}: zarr.json is damaged ({error}); copy it back or render again"
            ) from None
        content = group.attrs.asdict()
        if content.get("format") != STORE_FORMAT:
            raise DatasetError(
                f"{path}: not a view store of format {STORE_FORMAT}; render it again"
            )

        return cls(
            path,
            group,
            decode_record(
                content,
                Attributes,
                f"{path}: zarr.json is damaged",
                DatasetError,
            ),
        )

    @property
    def added(self) -> list[str]:
        """Names of the arrays that were added later."""
        files = self.path.glob("[!.]*/*/zarr.json")
        return sorted(
            {file.parent.relative_to(self.path).as_posix() for file in files}
            - {*RENDERED_ARRAYS}
        )

    def note(self, **changes: Any) -> None:
        """Change and write attributes."""
        for key, value in changes.items():
            setattr(self.attributes, key, value)
        self.group.attrs.put(msgspec.to_builtins(self.attributes))

    def add(self, name: str) -> None:
        """Add an array, if there is none of that name."""
        if self.holds(name):
            return
        shape, dtype, fill = self._layout(name)
        packed = BloscCodec(cname="zstd", clevel=2, shuffle="shuffle"), Crc32cCodec()
        layout = {
            "shape": (len(self), *shape),
            "chunks": (1, *shape),
            "dtype": dtype,
            "fill_value": fill,
        }
        self.group.create_array(name, **layout, compressors=packed)

    def remove(self, name: str) -> None:
        """Remove an array, if there is one of that name."""
        if self.holds(name):
            del self.group[name]

    def _layout(self, name: str) -> tuple[tuple[int, ...], str, float]:
        """Return shape per object, type and fill value of an array."""
        v = len(self.sphere)
        size = self.attributes.size
        layouts = {
            "image": ((v, size, size), "uint8", 0),
            "depth": ((v, size, size), "uint16", 0),
            "points": ((v, CLOUD_POINTS, 3), "int16", 0),
            "measures/depth_entropy": ((v,), "float32", 0),
            "radius": ((), "float64", np.nan),
            "status": ((), "uint8", PENDING),
        }
        measure = ((v,), "float32", np.nan)
        return layouts.get(name, measure)

    def array(self, name: str) -> zarr.Array:
        """Return an array of the store."""
        try:
            array = self.group[name]
        except KeyError:
            raise DatasetError(
                f"{self.path}: the array {name} is missing; {self._remedy(name)}"
            ) from None
        except DAMAGED as error:
            raise DatasetError(
                f"{self.path}: the array {name} cannot be opened ({error})"
            ) from None

        shape, dtype, _ = self._layout(name)
        wanted = ((len(self), *shape), (1, *shape), dtype)
        if (
            not isinstance(array, zarr.Array)
            or (array.shape, array.chunks, str(array.dtype)) != wanted
        ):
            raise DatasetError(
                f"{self.path}: the array {name} is not one of {wanted[0]} {dtype}"
            )

        return array

    def _remedy(self, name: str) -> str:
        if name in RENDERED_ARRAYS:
            return "remove the store and render again"
        kind, _, rest = name.partition("/")
        maker = (
            f"nextview-lab measure {self.path} --measures {rest}"
            if kind == "measures"
            else "the command that made it"
        )
        return f"{maker} makes it"

    def holds(self, name: str) -> bool:
        """Return True if there is an array of that name."""
        return (self.path / name / "zarr.json").exists()

    def _chunk(self, array: zarr.Array, i: int) -> Path:
        """Return the file with the values of object i in an array."""
        return (
            self.path
            / array.path
            / array.metadata.encode_chunk_key((i,) + (0,) * (array.ndim - 1))
        )

    def held(self, name: str) -> Mask:
        """Return which objects have values in an array, (N,)."""
        array = self.array(name)
        return np.array([self._chunk(array, i).exists() for i in range(len(self))])

    def read(self, name: str, i: int) -> NDArray:
        """Read the values of an object as they are stored.

        Args:
            name: of the array.
            i: row of the object.

        Returns:
            The values.

        Raises:
            DatasetError: they are missing or damaged.
        """
        array = self.array(name)
        what = f"{name} of {self.names[i]}"
        if not self._chunk(array, i).exists():
            raise DatasetError(f"{self.path}: {what} is missing; {self._remedy(name)}")
        return self._values(array, i, what)

    def _values(self, array: zarr.Array, at: int | slice, what: str) -> NDArray:
        try:
            return array[at]
        except DAMAGED as error:
            raise DatasetError(
                f"{self.path}: {what} cannot be read ({error}); {self._remedy(array.path)}"
            ) from None

    def rows(self, name: str) -> NDArray:
        """Return an array as it is stored, (N, ...).

        Rows of objects that are not rendered are undefined.
        """
        done = self.done
        array = self.array(name)
        with suppress(*DAMAGED):  # a damaged chunk is identified below
            values = array[:]
            if self.held(name)[done].all():
                return values
        values = np.full(array.shape, array.fill_value, array.dtype)
        for i in np.flatnonzero(done):
            values[i] = self.read(name, int(i))
        return values

    def write(self, i: int, arrays: Mapping[str, NDArray]) -> None:
        """Write the values of an object, each array completely or not at all.

        Args:
            i: row of the object.
            arrays: values by array name, written in this order.
        """
        # includes zeros, as missing chunks mean missing values
        with zarr.config.set({"array.write_empty_chunks": True}):
            for name, values in arrays.items():
                self.group[name][i] = values

    def __len__(self) -> int:
        return len(self.names)

    @property
    def names(self) -> list[str]:
        """Names of the objects, unique, N of them."""
        return self.attributes.names

    def rows_of(self, names: Sequence[str]) -> Index:
        """Return the rows of objects by name, (n,); -1 for missing ones."""
        row = {name: i for i, name in enumerate(self.names)}
        return np.array([row.get(name, -1) for name in names])

    @property
    def classes(self) -> list[str]:
        """Names of the classes, sorted."""
        return sorted(set(self.attributes.labels))

    @property
    def labels(self) -> Index:
        """Class of each object as an index into ``classes``, (N,) int64."""
        return np.unique(self.attributes.labels, return_inverse=True)[1]

    @property
    def splits(self) -> NDArray[np.str_]:
        """ "train", "test", "val" or "" for each object, (N,)."""
        return np.array(self.attributes.splits)

    @property
    def dataset(self) -> str:
        """Name of the dataset folder, in lower case; that of the store if not known."""
        name = (self.attributes.dataset or self.path.stem).lower()
        return re.sub(r"[^a-z0-9_.]+", "-", name).strip("-") or "objects"

    @property
    def commands(self) -> tuple[str, ...]:
        """Commands that created it, in order."""
        return tuple(self.attributes.commands)

    @property
    def sphere(self) -> ViewSphere:
        """The viewpoints."""
        a = self.attributes
        return ViewSphere(tuple(a.elevations), a.azimuths, a.distance)

    @property
    def intrinsics(self) -> Float:
        """Pinhole matrix of all views, (3, 3) float64, pixels."""
        return pinhole(self.attributes.size, self.sphere.distance)

    @property
    def done(self) -> Mask:
        """Objects that are rendered, (N,)."""
        return self._values(self.array("status"), slice(None), "status") == DONE

    @property
    def radii(self) -> Float:
        """Radii of the objects, metres, (N,) float64; NaN if not known."""
        unit = self.attributes.unit
        return (
            np.full(len(self), np.nan)
            if unit is None
            else self.rows("radius") * UNITS[unit]
        )

    def image(self, i: int) -> NDArray[np.uint8]:
        """Return all views of object i, (V, S, S) uint8."""
        return self.read("image", i)

    def depth(self, i: int) -> Float32:
        """Return all depth images of object i, (V, S, S) float32, object radii, 0 = no object."""
        return self.read("depth", i).astype(np.float32) * np.float32(DEPTH_UNIT)

    def points(self, i: int) -> Float32:
        """Return the point clouds of all views of object i, (V, 1024, 3) float32, object frame."""
        return self.read("points", i).astype(np.float32) * np.float32(POINT_UNIT)

    @property
    def measures(self) -> list[str]:
        """Names of the stored view measures, sorted."""
        return sorted(
            file.parent.name for file in self.path.glob("measures/*/zarr.json")
        )

    def measure(self, name: str = "depth_entropy") -> Float32:
        """Return a measure of all views, (N, V) float32.

        Values of objects that are not rendered are undefined.
        """
        return self.rows(f"measures/{name}")


def opened(path: Path) -> ViewStore:
    """Open a store once per process, and again when its attributes change."""
    about = (path / "zarr.json").stat()
    return _opened(path, about.st_ino, about.st_mtime_ns)


@lru_cache(maxsize=1)
def _opened(path: Path, *_: int) -> ViewStore:
    return ViewStore.open(path)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Lock the store for one writer; disk errors become a sentence."""
    with only_one(path):
        try:
            yield
        except OSError as error:
            reason = (
                f"cannot be written ({error.strerror or error}); what is done is kept, run again to"
                " go on"
            )
            raise DatasetError(f"{path}: {reason}") from None
