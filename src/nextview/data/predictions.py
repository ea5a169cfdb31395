"""What the models say of every view of every object: the table from which policies are replayed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from nextview.data.splits import deduplicated
from nextview.errors import PredictionsError
from nextview.files import decode_record, new_file, regular_file
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.base import Evidence
from nextview.recognition.belief import PLAIN_SUM, Calibration, log_evidence_of

FORMAT = 1
ARRAYS = ("logits", "depth_entropy", "labels", "splits", "conflicting")
OPTIONAL = ("azimuth_bins", "of_size")
KEYS = (
    *ARRAYS, *OPTIONAL, "format", "names", "classes", "elevations", "azimuths", "distance", "calibration", "models",
    "store", "commands",
)  # fmt: skip
GROUPS = ("map/", "valley/")
"""The arrays of a file, and how the names of those begin of which there may be several; others are not read."""
PACKED, SPARE = 100, 64 * 2**20
"""A file holds at most this many times its size, and so many bytes more."""
SAME = 1e-5
"""Difference between logits that are the same, but for rounding."""
KINDS = {"labels": "iu", "splits": "U", "conflicting": "b"}
"""Of numpy's types; all other arrays are of floats."""


@dataclass(frozen=True)
class Predictions:
    """What the models say of N objects from the V views of a sphere; C classes, R rings.

    Attributes:
        logits: of the recogniser for each view alone, (N, V, C) float32.
        maps: predicted local maps around each view by name ("lem"), each (N, V, R, 3) float32; those of the whole
            sphere ("lem-sphere") are (N, V, R, azimuths), once round from the view.
        depth_entropy: the true measure, bits, (N, V) float32.
        names: of the objects, unique.
        labels: true class of each as an index into ``classes``, (N,) int64.
        classes: their names, in the order of the logits.
        splits: "train", "test" or "" for each object, (N,).
        conflicting: objects that are the very mesh of another one with another label, (N,) bool.
        sphere: the viewpoints.
        models: name and SHA-256 of the recogniser ("recogniser") and of each map network ("lem").
        valley_classes: for each map, the classes for which its card says that the valley is the better view.
        calibration: how far a sum of the recogniser's logits is to be trusted.
        azimuth_bins: see ``Evidence``, (N, V, C, azimuth bins) float32; None if the recogniser cannot tell them.
        of_size: what the object's size added to the logits, (N, C) float32; None if sizes are not known.
        store: absolute path of the view store they were made from; empty if it is not known.
        commands: all that made them, in order, from the meshes on; () if that is not known.
    """

    logits: NDArray[np.float32]
    maps: dict[str, NDArray[np.float32]]
    depth_entropy: NDArray[np.float32]
    names: tuple[str, ...]
    labels: NDArray[np.int64]
    classes: tuple[str, ...]
    splits: NDArray[np.str_]
    conflicting: NDArray[np.bool_]
    sphere: ViewSphere
    models: dict[str, tuple[str, str]]
    valley_classes: dict[str, tuple[str, ...]]
    calibration: Calibration = PLAIN_SUM
    azimuth_bins: NDArray[np.float32] | None = None
    of_size: NDArray[np.float32] | None = None
    store: str = ""
    commands: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n, v, c = len(self.names), len(self.sphere), len(self.classes)
        if n == 0:
            raise PredictionsError("these predictions hold no objects")
        if c == 0:
            raise PredictionsError("these predictions name no classes")
        wanted = {"logits": (n, v, c), "depth_entropy": (n, v), "labels": (n,), "splits": (n,), "conflicting": (n,)}
        arrays = {name: getattr(self, name) for name in wanted}
        for name, values in self.maps.items():
            columns = self.sphere.azimuths if name.endswith("-sphere") else 3
            wanted[f"map {name}"], arrays[f"map {name}"] = (n, v, self.sphere.rings, columns), values
        if self.azimuth_bins is not None:
            wanted["azimuth_bins"], arrays["azimuth_bins"] = (n, v, c, *self.azimuth_bins.shape[-1:]), self.azimuth_bins
        if self.of_size is not None:
            wanted["of_size"], arrays["of_size"] = (n, c), self.of_size
        for name, shape in wanted.items():
            if arrays[name].shape != shape:
                raise PredictionsError(f"{name} of these predictions has the shape {arrays[name].shape}, not {shape}")
            if arrays[name].dtype.kind not in KINDS.get(name, "f"):
                raise PredictionsError(f"{name} of these predictions is of the wrong type, {arrays[name].dtype}")
            if arrays[name].dtype.kind == "f" and not np.isfinite(arrays[name]).all():
                bad = self.names[int(np.flatnonzero(~np.isfinite(arrays[name].reshape(n, -1)).all(1))[0])]
                raise PredictionsError(f"{name} of object {bad} is not a finite number")
        if not all(isinstance(name, str) for name in (*self.names, *self.classes, *self.models)):
            raise PredictionsError("a name in these predictions is no text")
        if len(set(self.names)) < n:
            raise PredictionsError("two objects of these predictions have the same name")
        if ((self.labels < 0) | (self.labels >= c)).any():
            raise PredictionsError(f"a label of these predictions is not one of the {c} classes")

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def log_evidence(self) -> NDArray[np.float32]:
        """What the recogniser says of each view, so that views can be summed, (N, V, D); see ``log_evidence_of``."""
        return log_evidence_of(self.logits, self.azimuth_bins, self.sphere.azimuth)

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """Whether enough of the object shows in each view to say anything of it, (N, V): else all classes are alike."""
        return np.ptp(self.by_shape().logits, axis=2) > (SAME if len(self.classes) > 1 else -1)

    def evidence(self, objects: NDArray[np.int64], views: NDArray[np.int64]) -> Evidence:
        """What the models say of objects (rows), (B,), each seen from one view, (B,)."""
        return Evidence(
            self.logits[objects, views],
            {name: values[objects, views] for name, values in self.maps.items()},
            azimuth_bins=None if self.azimuth_bins is None else self.azimuth_bins[objects, views],
            seen=self.seen[objects, views],
        )

    def of_split(self, split: str) -> Predictions:
        """The objects of one split."""
        kept = self.splits == split
        if not kept.any():
            there = ", ".join(repr(str(name)) for name in np.unique(self.splits))
            raise PredictionsError(f"these predictions hold no objects of the split {split!r}, only of {there}")
        return self.of_objects(np.flatnonzero(kept))

    def deduplicate(self) -> Predictions:
        """One object of each shape and label: without the copies that look the same from every view."""
        return self.of_objects(deduplicated(self.labels, self.depth_entropy))

    def of_objects(self, kept: NDArray[np.int64]) -> Predictions:
        """Some of the objects, by their rows, (n,)."""
        arrays = {name: getattr(self, name)[kept] for name in ("logits", "depth_entropy", "labels", "splits")}
        maps = {name: values[kept] for name, values in self.maps.items()}
        optional = {
            name: values[kept] for name in ("azimuth_bins", "of_size") if (values := getattr(self, name)) is not None
        }
        names = tuple(self.names[i] for i in kept)
        return replace(self, **arrays, **optional, names=names, maps=maps, conflicting=self.conflicting[kept])

    def by_shape(self) -> Predictions:
        """What the recogniser says to those who do not know how large the objects are."""
        if self.of_size is None:
            return self
        return replace(self, logits=self.logits - self.of_size[:, None], of_size=None)

    def save(self, path: Path, overwrite: bool = False) -> None:
        """Write one .npz file, whole or not at all; ResultsError if that cannot be."""
        arrays: dict[str, Any] = {name: getattr(self, name) for name in ARRAYS}
        arrays |= {name: values for name in OPTIONAL if (values := getattr(self, name)) is not None}
        arrays |= {f"map/{name}": values for name, values in self.maps.items()}
        arrays |= {f"valley/{name}": np.array(classes, np.str_) for name, classes in self.valley_classes.items()}
        arrays |= {
            "format": FORMAT,
            "names": np.array(self.names),
            "classes": np.array(self.classes),
            "elevations": np.array(self.sphere.elevations),
            "azimuths": self.sphere.azimuths,
            "distance": self.sphere.distance,
            "calibration": np.array(msgspec.json.encode(self.calibration).decode()),
            "store": np.array(self.store),
            "models": np.array([(kind, *model) for kind, model in self.models.items()]).reshape(-1, 3),
            "commands": np.array(self.commands, np.str_),
        }
        with new_file(Path(path), overwrite) as part, part.open("wb") as file:
            np.savez_compressed(file, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> Predictions:
        """Read what ``save`` wrote; PredictionsError if it is missing or damaged. Nothing is unpickled."""
        path = Path(path)
        if not path.exists():
            raise PredictionsError(f"{path}: there is no such file; make one with nextview predict")
        regular_file(path, "a predictions file", PredictionsError)
        try:
            return cls._from(_arrays(path))
        except KeyError as error:
            raise PredictionsError(f"{path}: lacks {error.args[0]}") from None
        except PredictionsError as error:
            raise PredictionsError(f"{path}: {error}") from None
        except Exception as error:  # zipfile, zlib and numpy raise whatever a damaged file makes them raise
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise PredictionsError(f"{path}: not a predictions file ({reason})") from None

    @classmethod
    def _from(cls, f: dict[str, NDArray]) -> Predictions:
        def group(prefix: str) -> dict[str, NDArray]:
            return {name.removeprefix(prefix): values for name, values in f.items() if name.startswith(prefix)}

        if "format" not in f or f["format"].tolist() != FORMAT:
            raise PredictionsError(f"not a predictions file of format {FORMAT}; make it again")
        arrays: dict[str, Any] = {name: f[name] for name in ARRAYS} | {name: f.get(name) for name in OPTIONAL}
        return cls(
            **arrays,
            maps=group("map/"),
            names=tuple(f["names"].tolist()),
            classes=tuple(f["classes"].tolist()),
            sphere=ViewSphere(tuple(f["elevations"].tolist()), int(f["azimuths"]), float(f["distance"])),
            models={kind: (name, sha) for kind, name, sha in f["models"].tolist()},
            valley_classes={name: tuple(classes.tolist()) for name, classes in group("valley/").items()},
            calibration=_calibration(f["calibration"]) if "calibration" in f else PLAIN_SUM,
            store=str(f.get("store", "")),
            commands=tuple(f["commands"].tolist()) if "commands" in f else (),
        )


def _calibration(text: NDArray[np.str_]) -> Calibration:
    return decode_record(str(text).encode(), Calibration, "not a calibration", PredictionsError)


def _arrays(path: Path) -> dict[str, NDArray]:
    """The arrays of a file that are read, by name, after the sizes that they announce were held against the file's."""
    with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
        wanted = [name for name in file.files if name in KEYS or name.startswith(GROUPS)]
        members = {name: file.zip.getinfo(f"{name}.npy") for name in wanted}
        if sum(member.file_size for member in members.values()) > PACKED * path.stat().st_size + SPARE:
            raise PredictionsError("announces more than such a file can hold")
        for member in members.values():
            with file.zip.open(member) as stream:
                first = npy.read_magic(stream) == (1, 0)
                shape, _, dtype = (npy.read_array_header_1_0 if first else npy.read_array_header_2_0)(stream)
            if math.prod(shape) * dtype.itemsize > member.file_size:
                raise PredictionsError(f"{member.filename} announces more than it holds")
        return {name: file[name] for name in wanted}
