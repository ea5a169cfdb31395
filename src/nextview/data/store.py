"""The view store: every view of every object of a dataset, in one Zarr group, one chunk an object."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, Crc32cCodec

from nextview.arguments import takes_paths
from nextview.cloud import POINTS
from nextview.data.attributes import CHECKSUM, FORMAT, checksum, validate
from nextview.data.folders import Entry
from nextview.errors import DatasetError
from nextview.mesh import UNITS
from nextview.observation import pinhole
from nextview.viewsphere import ViewSphere

DEPTH_UNIT = 1e-4
"""Depth is stored as uint16 in steps of this many object radii."""
POINT_UNIT = 1 / 32767
"""Points are stored as int16 in steps of this many object radii."""
PENDING, DONE, FAILED = 0, 1, 2
PLANNED = 5
"""Views of a plan: the thesis's longest episode."""
RENDERED = ("image", "depth", "points", "measures/depth_entropy", "radius", "status")
"""The arrays that rendering makes; others are added later."""
SCENE = (
    "scene/depth", "scene/owner", "scene/reachable", "measures/visible_share", "measures/clearance",
)  # fmt: skip
"""The arrays that rendering makes of worlds beside these, see ``data.world_views``."""
DIGEST = "digest"
"""The array of what ``digest`` gives of each object; stores that were begun before there was one have none."""
RESTORE = "nextview render restores it, with the meshes and the settings that the store was made with"
_logger = logging.getLogger(__name__)


class ChunkError(Exception):
    """What is wrong with one object's chunk of an array: it is missing, or cannot be read."""


class MissingChunkError(ChunkError):
    """There is none."""


def digest(name: str, rows: Mapping[str, NDArray]) -> NDArray[np.uint8]:
    """SHA-256 of the name of an object and its rows of image, depth, points and radius, as stored, (32,)."""
    found = hashlib.sha256(name.encode())
    for array in ("image", "depth", "points", "radius"):
        found.update(np.ascontiguousarray(rows[array]).data)
    return np.frombuffer(found.digest(), np.uint8)


@dataclass(frozen=True)
class ViewStore:
    """Views of N objects from the V views of a sphere.

    Arrays of the group, sharded by object (axis 0): ``image`` (N, V, S, S) uint8; ``depth`` (N, V, S, S) uint16 in
    DEPTH_UNIT, 0 = no object; ``points`` (N, V, 1024, 3) int16 in POINT_UNIT, object frame; ``measures/depth_entropy``
    (N, V) float32, bits, and other measures alike; ``plans/NAME`` (N, V, PLANNED) float32, the views that a policy
    takes from each first view, see ``data.planning``; ``radius`` (N,) float64, of the object in the unit of its mesh
    file; ``status`` (N,) uint8; ``digest`` (N, 32) uint8, of an object's name and arrays together, see ``digest``.
    Names, labels, splits, the SHA-256 of the mesh files and their unit, what was rendered how, and why meshes were left
    out are attributes. They and all chunks carry a checksum, so that damage is noticed when they are read. A chunk that
    is gone is noticed too: zarr would read its fill value, so every read looks for the file first.
    """

    path: Path
    group: zarr.Group

    @classmethod
    @takes_paths("path")
    def create(cls, path: Path, entries: list[Entry], sphere: ViewSphere, size: int, recipe: dict) -> ViewStore:
        """Make an empty store, whole or not at all; ``recipe`` is kept in the attributes as it is (JSON values)."""
        path = Path(os.path.realpath(path)) if path.name in ("", "..") else path  # "." has no name
        for left in path.parent.glob("*.part"):  # of a run that was killed while it did this; no other is under way
            if re.fullmatch(re.escape(path.name) + r"\.[0-9a-f]{32}\.part", left.name):
                shutil.rmtree(left, ignore_errors=True)
        part = path.with_name(f"{path.name}.{uuid4().hex}.part")  # nobody else's
        try:
            cls._fill(part, entries, sphere, size, recipe)
            part.rename(path)
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            raise
        return cls.open(path)

    @classmethod
    def _fill(cls, path: Path, entries: list[Entry], sphere: ViewSphere, size: int, recipe: dict) -> None:
        store = cls(path, zarr.open_group(path, mode="w-"))
        store.note(
            format=FORMAT,
            names=[e.name for e in entries],
            labels=[e.label for e in entries],
            splits=[e.split for e in entries],
            elevations=list(sphere.elevations),
            azimuths=sphere.azimuths,
            distance=sphere.distance,
            size=size,
            failures={},
            **recipe,
        )
        for name in (*store.rendered, DIGEST):
            store.add(name)

    @property
    def rendered(self) -> tuple[str, ...]:
        """Names of the arrays that rendering makes: more where the objects stand in worlds."""
        return (*RENDERED, *SCENE) if "scene" in self.group.attrs else RENDERED

    def note(self, **changes: Any) -> None:
        """Change attributes, and with them their checksum."""
        attributes = self.group.attrs.asdict() | changes
        self.group.attrs.put(attributes | {CHECKSUM: checksum(attributes)})

    def add(self, name: str) -> None:
        """Add an array, where there is none or one that cannot be opened. Chunks that are there already are kept."""
        damaged = [self.path / name / "zarr.json"]
        if "/" in name and not self._opens(name.rpartition("/")[0]):
            damaged.append(self.path / name.rpartition("/")[0] / "zarr.json")
        for file in damaged:
            file.unlink(missing_ok=True)
        shape, dtype, fill = self._layout(name)
        self.group.create_array(
            name,
            shape=(len(self), *shape),
            chunks=(1, *shape),
            dtype=dtype,
            fill_value=fill,
            compressors=(BloscCodec(cname="zstd", clevel=2, shuffle="shuffle"), Crc32cCodec()),
        )

    def _layout(self, name: str) -> tuple[tuple[int, ...], str, float]:
        """Shape for one object, type and fill value of an array."""
        v, size, scene = len(self.sphere), self.group.attrs["size"], self.group.attrs.get("scene", 0)
        layouts = {
            "image": ((v, size, size), "uint8", 0),
            "depth": ((v, size, size), "uint16", 0),
            "points": ((v, POINTS, 3), "int16", 0),
            "measures/depth_entropy": ((v,), "float32", 0),
            "radius": ((), "float64", np.nan),
            "status": ((), "uint8", PENDING),
            DIGEST: ((32,), "uint8", 0),
            "correspondence": ((v, v), "float32", np.nan),
            "scene/depth": ((v, scene, scene), "uint16", 0),
            "scene/owner": ((v, scene, scene), "uint8", 0),
            "scene/reachable": ((v,), "bool", False),
        }
        if name.startswith("plans/"):
            return (v, min(PLANNED, v)), "float32", np.nan
        return layouts.get(name, ((v,), "float32", np.nan))  # another measure

    @classmethod
    @takes_paths("path")
    def open(cls, path: str | Path) -> ViewStore:
        """Open a store for reading.

        Raises:
            DatasetError: there is none, it is of another format, or damaged.
        """
        path = Path(path)
        file = path / "zarr.json"
        if not file.exists():
            refuse_without_root(path)
            raise DatasetError(f"{path}: there is no view store; make one with nextview render")
        state = file.stat()
        try:
            group = zarr.open_group(path, mode="r+")
        except Exception as error:  # zarr and JSON raise whatever a damaged file makes them raise
            raise DatasetError(f"{path}: zarr.json is damaged ({error}); {RESTORE}") from None
        if group.attrs.get("format") != FORMAT:
            raise DatasetError(f"{path}: not a view store of format {FORMAT}; render it again")
        _validate(path, (state.st_ino, state.st_mtime_ns, state.st_size))
        return cls(path, group)

    def array(self, name: str) -> zarr.Array:
        """One of the store's arrays.

        Raises:
            DatasetError: it is missing, damaged, or not of the store's objects and views.
        """
        remedy = self._maker(name) or f"nextview check {self.path} --repair makes it, and nextview render fills it"
        try:
            array = self.group[name]
        except KeyError:
            raise DatasetError(f"{self.path}: the array {name} is missing; {remedy}") from None
        except Exception as error:  # zarr and JSON raise whatever a damaged file makes them raise
            raise DatasetError(f"{self.path}: the array {name} cannot be opened ({error}); {remedy}") from None
        shape, dtype, _ = self._layout(name)
        wanted = ((len(self), *shape), (1, *shape), dtype)
        if not isinstance(array, zarr.Array) or (array.shape, array.chunks, str(array.dtype)) != wanted:
            raise DatasetError(f"{self.path}: the array {name} is not one of {wanted[0]} {dtype}; {remedy}")
        return array

    def _maker(self, name: str) -> str | None:
        """Which command makes an array, if it is not one of rendering."""
        kind, _, rest = name.partition("/")
        if kind == "measures":
            return f"nextview measure {self.path} --measures {rest} makes it"
        return f"nextview plan {self.path} {rest} makes it" if kind == "plans" else None

    def holds(self, name: str) -> bool:
        """Whether there is an array of that name, be it damaged."""
        return (self.path / name / "zarr.json").exists()

    def sound(self, name: str) -> bool:
        """Whether there is an array of that name, of the store's objects and views, and a group that it is in."""
        try:
            self.array(name)
        except DatasetError:
            return False
        return "/" not in name or self._opens(name.rpartition("/")[0])

    def _opens(self, group: str) -> bool:
        try:
            return isinstance(self.group[group], zarr.Group)
        except Exception:  # zarr and JSON raise whatever a damaged file makes them raise
            return False

    def has(self, name: str, i: int) -> bool:
        """Whether there is anything of object i in one of the arrays."""
        return _chunk_exists(self.path, self.array(name), i)

    def chunk(self, name: str, i: int) -> NDArray:
        """What one of the arrays holds of object i, as it is stored.

        Raises:
            ChunkError: nothing, or it is damaged there.
            DatasetError: the array is missing.
        """
        return _chunk(self.path, self.array(name), i)

    def read(self, name: str, i: int) -> NDArray:
        """What one of the arrays holds of object i, as it is stored.

        Raises:
            DatasetError: the array is missing, or lacks the object, or is damaged there.
        """
        try:
            return self.chunk(name, i)
        except ChunkError as error:
            raise DatasetError(self._damage(name, i, error)) from None

    def scan(self, name: str, objects: Iterable[int]) -> tuple[NDArray, dict[int, ChunkError]]:
        """One of the arrays, as it is stored, and what is wrong with its chunks of some objects.

        Args:
            name: of the array.
            objects: indices of those that should be there. The rows of others are not looked at, and may hold anything.

        Returns:
            (N, ...), with the fill value where nothing can be read; and the errors, by object.

        Raises:
            DatasetError: the array is missing.
        """
        array = self.array(name)
        wrong: dict[int, ChunkError] = {
            i: MissingChunkError("is missing") for i in objects if not _chunk_exists(self.path, array, i)
        }
        try:
            return array[:], wrong
        except Exception:  # a damaged chunk raises whatever its codec makes of it; find out which it is
            values = np.full(array.shape, array.fill_value, array.dtype)
        for i in objects:
            try:
                values[i] = _chunk(self.path, array, i)
            except ChunkError as error:
                wrong[i] = error
        return values, wrong

    def rows(self, name: str) -> NDArray:
        """One of the arrays, as it is stored, (N, ...). Rows of objects that are not rendered may hold anything.

        Raises:
            DatasetError: the array is missing, or lacks a rendered object, or is damaged there.
        """
        values, wrong = self.scan(name, range(len(self)))
        if wrong:
            done = self.done
            for i in sorted(wrong):
                if done[i]:
                    values[i] = self.read(name, i)  # a run that renders may have finished it since
        return values

    def _damage(self, name: str, i: int, error: ChunkError) -> str:
        anew = f"nextview check {self.path} --repair takes the object out, and nextview render makes it anew"
        remedy = self._maker(name) or anew
        return f"{self.path}: {name} of {self.names[i]} {error}; {remedy}"

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
        """Objects that are rendered, (N,). One whose status is lost counts as not rendered; a warning names it."""
        status, lost = self._status()
        if lost:
            _warn_of_status(self.path, tuple(self.names[i] for i in lost))
        return status == DONE

    @property
    def lost(self) -> dict[int, str]:
        """Objects whose status is lost, and how."""
        return {i: f"status {error}" for i, error in self._status()[1].items()}

    def mark(self, i: int, status: int) -> None:
        """Set the status of object i. PENDING is written too: where there is none, an object that was begun lost it."""
        with zarr.config.set({"array.write_empty_chunks": True}):
            self.group["status"][i] = status

    def _status(self) -> tuple[NDArray[np.uint8], dict[int, ChunkError]]:
        """Of all objects; those for which nothing was ever written are PENDING.

        A run that renders writes the status of an object first, and the others may do so at any moment: what was begun
        is found out before the statuses are read.
        """
        radius = self.array("radius") if self.sound("radius") else None
        begun = [radius is not None and _chunk_exists(self.path, radius, i) for i in range(len(self))]
        status, wrong = self.scan("status", range(len(self)))
        return status, {i: error for i, error in wrong.items() if begun[i] or not isinstance(error, MissingChunkError)}

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
        return self.rows("radius") * UNITS[unit]

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
        return self.rows("points")

    @property
    def measures(self) -> list[str]:
        """Names of the view measures it holds, sorted."""
        return sorted(file.parent.name for file in self.path.glob("measures/*/zarr.json"))

    def measure(self, name: str = "depth_entropy") -> NDArray[np.float32]:
        """A view measure of all objects, (N, V) float32; anything where an object is not rendered.

        Raises:
            DatasetError: it is not there, or not of every rendered object.
        """
        return self.rows(f"measures/{name}")


def refuse_without_root(path: Path) -> None:
    """Say what to do with a store of which only the file is gone that says what its arrays are of.

    Raises:
        DatasetError: that is so.
    """
    if (path / "status" / "zarr.json").exists() and not (path / "zarr.json").exists():
        raise DatasetError(
            f"{path}: its zarr.json, which tells whose views these are, is gone; copy it back, or move the folder away "
            "and run nextview render again"
        )


def _chunk_exists(store: Path, array: zarr.Array, i: int) -> bool:
    """Whether there is a file of object i; its chunk is the only one in its row."""
    return os.path.exists(f"{store}/{array.path}/{array.metadata.encode_chunk_key((i,) + (0,) * (array.ndim - 1))}")


def _chunk(store: Path, array: zarr.Array, i: int) -> NDArray:
    if not _chunk_exists(store, array, i):
        raise MissingChunkError("is missing")
    try:
        return array[i]
    except Exception as error:  # a damaged chunk raises whatever its codec makes of it
        raise ChunkError(f"cannot be read ({error})") from None


@lru_cache  # a process opens a store often, and thousands of names take longer than what it wants there
def _validate(path: Path, state: tuple[int, int, int]) -> None:
    """Validate the attributes of a store, once for each state of their file (inode, time, bytes)."""
    try:
        validate(json.loads((path / "zarr.json").read_bytes())["attributes"])
    except DatasetError as error:
        raise DatasetError(f"{path}: zarr.json is damaged ({error}); {RESTORE}") from None


@lru_cache  # once for each process: many things ask which objects are done
def _warn_of_status(path: Path, names: tuple[str, ...]) -> None:
    some = ", ".join(names[:3]) + (f" and {len(names) - 3} others" if len(names) > 3 else "")
    _logger.warning(
        "nextview: %s: the status of %s is lost, so it counts as not rendered; nextview render makes it anew",
        path,
        some,
    )
