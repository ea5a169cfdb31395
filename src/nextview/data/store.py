"""The view store: every view of every object of a dataset, in one Zarr group, one chunk an object."""

from __future__ import annotations

import re
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, Crc32cCodec

from nextview.cloud import POINTS
from nextview.data.folders import Entry
from nextview.errors import DatasetError
from nextview.mesh import UNITS
from nextview.observation import pinhole
from nextview.viewsphere import ViewSphere

FORMAT = 2
DEPTH_UNIT = 1e-4
"""Depth is stored as uint16 in steps of this many object radii."""
POINT_UNIT = 1 / 32767
"""Points are stored as int16 in steps of this many object radii."""
PENDING, DONE, FAILED = 0, 1, 2
RENDERED = ("image", "depth", "points", "measures/depth_entropy", "radius", "status")
"""The arrays that rendering makes; others are added later."""


@dataclass(frozen=True)
class ViewStore:
    """Views of N objects from the V views of a sphere.

    Arrays of the group, sharded by object (axis 0): ``image`` (N, V, S, S) uint8; ``depth`` (N, V, S, S) uint16 in
    DEPTH_UNIT, 0 = no object; ``points`` (N, V, 1024, 3) int16 in POINT_UNIT, object frame; ``measures/depth_entropy``
    (N, V) float32, bits, and other measures alike; ``radius`` (N,) float64, of the object in the unit of its mesh file;
    ``status`` (N,) uint8. Names, labels, splits, the SHA-256 of the mesh files and their unit, what was rendered how,
    and why meshes were left out are attributes. Chunks carry a checksum, so that a damaged one is noticed when it is
    read.
    """

    path: Path
    group: zarr.Group

    @classmethod
    def create(cls, path: Path, entries: list[Entry], sphere: ViewSphere, size: int, recipe: dict) -> ViewStore:
        """Make an empty store, whole or not at all; ``recipe`` is kept in the attributes as it is (JSON values)."""
        part = path.with_name(path.name + ".part")
        shutil.rmtree(part, ignore_errors=True)
        store = cls(part, zarr.open_group(part, mode="w-"))
        v = len(sphere)
        store.group.attrs.update(
            {
                "format": FORMAT,
                "names": [e.name for e in entries],
                "labels": [e.label for e in entries],
                "splits": [e.split for e in entries],
                "elevations": list(sphere.elevations),
                "azimuths": sphere.azimuths,
                "distance": sphere.distance,
                "size": size,
                "failures": {},
                **recipe,
            }
        )
        store.add("image", (v, size, size), "uint8")
        store.add("depth", (v, size, size), "uint16")
        store.add("points", (v, POINTS, 3), "int16")
        store.add("measures/depth_entropy", (v,), "float32")
        store.add("radius", (), "float64", np.nan)
        store.add("status", (), "uint8")
        part.rename(path)
        return cls.open(path)

    def add(self, name: str, shape: tuple[int, ...], dtype: str, fill: float = 0) -> None:
        """Add an array of one ``shape`` for each object."""
        self.group.create_array(
            name,
            shape=(len(self), *shape),
            chunks=(1, *shape),
            dtype=dtype,
            fill_value=fill,
            compressors=(BloscCodec(cname="zstd", clevel=2, shuffle="shuffle"), Crc32cCodec()),
        )

    @classmethod
    def open(cls, path: str | Path) -> ViewStore:
        """Open a store for reading.

        Raises:
            DatasetError: there is none, it is of another format, or damaged.
        """
        path = Path(path)
        if not (path / "zarr.json").exists():
            raise DatasetError(f"{path}: there is no view store; make one with nextview render")
        try:
            group = zarr.open_group(path, mode="r+")
        except Exception as error:  # zarr and JSON raise whatever a damaged file makes them raise
            raise DatasetError(f"{path}: zarr.json cannot be read ({error}); copy or render the store again") from None
        if group.attrs.get("format") != FORMAT:
            raise DatasetError(f"{path}: not a view store of format {FORMAT}; render it again")
        return cls(path, group)

    def array(self, name: str) -> zarr.Array:
        """One of the store's arrays.

        Raises:
            DatasetError: it is missing, damaged, or not as long as the store.
        """
        remedy = "copy or render the store again"
        if name.startswith("measures/"):
            remedy = f"nextview measure {self.path} {name.removeprefix('measures/')} makes it"
        try:
            array = self.group[name]
        except KeyError:
            raise DatasetError(f"{self.path}: the array {name} is missing; {remedy}") from None
        except Exception as error:  # zarr and JSON raise whatever a damaged file makes them raise
            raise DatasetError(f"{self.path}: the array {name} cannot be opened ({error})") from None
        if array.shape[0] != len(self):
            raise DatasetError(f"{self.path}: the array {name} is of {array.shape[0]} objects, not {len(self)}")
        return array

    def read(self, name: str, i: int) -> NDArray:
        """What one of the arrays holds of object i, as it is stored.

        Raises:
            DatasetError: the array is missing, or damaged there.
        """
        array = self.array(name)
        try:
            return array[i]
        except Exception as error:  # a damaged chunk raises whatever its codec makes of it
            raise DatasetError(
                f"{self.path}: {name} of {self.names[i]} cannot be read ({error}); "
                "nextview check --repair takes it out, and nextview render makes it anew"
            ) from None

    def __len__(self) -> int:
        return len(self.names)

    @property
    def names(self) -> list[str]:
        """Of the objects, unique, N of them."""
        return self.group.attrs["names"]

    @property
    def classes(self) -> list[str]:
        """Names of the classes, sorted."""
        return sorted(set(self.group.attrs["labels"]))

    @property
    def labels(self) -> NDArray[np.int64]:
        """Class of each object as an index into ``classes``, (N,) int64."""
        row = {name: i for i, name in enumerate(self.classes)}
        return np.array([row[label] for label in self.group.attrs["labels"]])

    @property
    def splits(self) -> NDArray[np.str_]:
        """ "train", "test" or "" for each object, (N,)."""
        return np.array(self.group.attrs["splits"])

    @property
    def dataset(self) -> str:
        """What the objects are called together, in lower case: the name of the folder of their meshes.

        That of the store if it was made before this was noted.
        """
        name = self.group.attrs.get("dataset") or self.path.stem
        return re.sub(r"[^a-z0-9_.]+", "-", name.lower()).strip("-") or "objects"

    @property
    def commands(self) -> tuple[str, ...]:
        """That made it, in order; () if it was made before this was noted."""
        return tuple(self.group.attrs.get("commands", ()))

    @property
    def sphere(self) -> ViewSphere:
        """The viewpoints."""
        a = self.group.attrs
        return ViewSphere(tuple(a["elevations"]), a["azimuths"], a["distance"])

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """Pinhole matrix of all views, (3, 3) float64, pixels."""
        return pinhole(self.group.attrs["size"], self.sphere.distance)

    @property
    def done(self) -> NDArray[np.bool_]:
        """Objects that are rendered, (N,)."""
        return self.array("status")[:] == DONE

    @property
    def failures(self) -> dict[str, str]:
        """Why objects were left out, by name."""
        return self.group.attrs.get("failures", {})

    @property
    def radii(self) -> NDArray[np.float64]:
        """Of the objects, metres, (N,) float64; NaN where it is not known."""
        unit = self.group.attrs.get("unit")
        if unit is None:
            return np.full(len(self), np.nan)
        return self.array("radius")[:] * UNITS[unit]

    @property
    def duplicates(self) -> list[list[int]]:
        """Groups of objects whose mesh files hold the same bytes; none are known in a store made without hashes."""
        groups: dict[str, list[int]] = {}
        for i, digest in enumerate(self.group.attrs.get("sha256", ())):
            groups.setdefault(digest, []).append(i)
        return [group for group in groups.values() if len(group) > 1]

    def image(self, i: int) -> NDArray[np.uint8]:
        """All views of object i, (V, S, S) uint8."""
        return self.read("image", i)

    def depth(self, i: int) -> NDArray[np.float32]:
        """Depth of all views of object i, (V, S, S) float32, object radii, 0 = no object."""
        return self.read("depth", i).astype(np.float32) * np.float32(DEPTH_UNIT)

    def points(self, i: int) -> NDArray[np.float32]:
        """Clouds of all views of object i, (V, 1024, 3) float32, object frame."""
        return self.read("points", i).astype(np.float32) * np.float32(POINT_UNIT)

    def all_points(self) -> NDArray[np.int16]:
        """Clouds of all views of all objects as stored, (N, V, 1024, 3) int16: 240 kB an object."""
        return self.array("points")[:]

    @property
    def measures(self) -> list[str]:
        """Names of the view measures it holds, sorted."""
        return sorted(self.group["measures"]) if "measures" in self.group else []

    def measure(self, name: str = "depth_entropy") -> NDArray[np.float32]:
        """A view measure of all objects, (N, V) float32, NaN where it is not made yet."""
        return self.array(f"measures/{name}")[:]
