"""Model outputs for every view of every object: the table from which policies are replayed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.lib import format as npy
from numpy.typing import ArrayLike, NDArray

from nextview.errors import DAMAGED, DatasetError, option
from nextview.files import decode_record, new_file, regular_file
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.base import Evidence
from nextview.recognition.belief import PLAIN_SUM, Calibration, log_evidence_of
from nextview.sensing.observation import enough_shows
from nextview.types import Float, Float32, Index, Mask
from nextview_lab.data.splits import deduplicated, duplicate_groups, some_objects
from nextview_lab.data.store import ViewStore
from nextview_lab.errors import PredictionsError

PREDICTIONS_FORMAT = 1
# limits of the decompressed size: factor of the file size, and additional bytes
PACKED = 100
SPARE = 64 * 2**20
SAME_LOGIT = 1e-5  # tolerance of equal logits
# kinds of numpy types; all other arrays are floats
ARRAY_KINDS = {"labels": "iu", "splits": "U", "conflicting": "b"}


@dataclass(frozen=True)
class Predictions:
    """Model outputs for N objects from the V views of a sphere; C classes, R rings.

    Attributes:
        logits: of the recogniser for each view alone, (N, V, C).
        maps: predicted local maps around each view by name ("lem"), each (N, V, R, 3); those of the
            whole sphere ("lem-sphere") are (N, V, R, azimuths), once around from the view.
        depth_entropy: the true measure, bits, (N, V).
        names: of the objects, unique.
        labels: true class of each as an index into ``classes``, (N,).
        classes: their names, in the order of the logits.
        splits: "train", "test" or "" for each object, (N,).
        conflicting: objects whose identical mesh also has another label, (N,).
        sphere: the V viewpoints.
        models: name and SHA-256 of the "recogniser" and of each map network ("lem").
        valley_classes: for each map, the classes for which the valley is the better view.
        calibration: of summed logits of the recogniser.
        azimuth_bins: see ``Evidence``, (N, V, C, bins); None if not known.
        of_size: contribution of the size to the logits, (N, C); None if not known.
        store: absolute path of the view store; empty if not known.
        commands: all commands that created them, in order, starting from the meshes; () if not
            known.
    """

    logits: Float32
    maps: dict[str, Float32]
    depth_entropy: Float32
    names: tuple[str, ...]
    labels: Index
    classes: tuple[str, ...]
    splits: NDArray[np.str_]
    conflicting: Mask
    sphere: ViewSphere
    models: dict[str, tuple[str, str]]
    valley_classes: dict[str, tuple[str, ...]]
    calibration: Calibration = PLAIN_SUM
    azimuth_bins: Float32 | None = None
    of_size: Float32 | None = None
    store: str = ""
    commands: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.names)
        v = len(self.sphere)
        c = len(self.classes)

        if n == 0:
            raise PredictionsError("these predictions hold no objects")
        if c == 0:
            raise PredictionsError("these predictions name no classes")

        bins = () if self.azimuth_bins is None else self.azimuth_bins.shape[-1:]
        shapes: dict[str, tuple[int, ...]] = {
            "logits": (n, v, c),
            "depth_entropy": (n, v),
            "labels": (n,),
            "splits": (n,),
            "conflicting": (n,),
            "azimuth_bins": (n, v, c, *bins),
            "of_size": (n, c),
        }

        for name, values in (
            self._arrays()
            | {f"map {name}": values for name, values in self.maps.items()}
        ).items():
            shape = shapes.get(
                name,
                (
                    n,
                    v,
                    self.sphere.rings,
                    self.sphere.azimuths if name.endswith("-sphere") else 3,
                ),
            )
            if values.shape != shape:
                raise PredictionsError(
                    f"{name} of these predictions has the shape {values.shape}, not {shape}"
                )
            if values.dtype.kind not in ARRAY_KINDS.get(name, "f"):
                raise PredictionsError(
                    f"{name} of these predictions is of the wrong type, {values.dtype}"
                )
            if values.dtype.kind == "f" and not np.isfinite(values).all():
                bad = self.names[
                    int(np.isfinite(values.reshape(n, -1)).all(1).argmin())
                ]
                raise PredictionsError(f"{name} of object {bad} is not a finite number")

        if not all(
            isinstance(name, str) for name in (*self.names, *self.classes, *self.models)
        ):
            raise PredictionsError("a name in these predictions is not text")
        if len(set(self.names)) < n:
            raise PredictionsError(
                "two objects of these predictions have the same name"
            )
        if ((self.labels < 0) | (self.labels >= c)).any():
            raise PredictionsError(
                f"a label of these predictions is not one of the {c} classes"
            )

    def __len__(self) -> int:
        return len(self.names)

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays with a row for each object, without the maps."""
        return {
            f.name: values
            for f in fields(self)
            if isinstance(values := getattr(self, f.name), np.ndarray)
        }

    @cached_property
    def log_evidence(self) -> Float32:
        """Log-evidence of each view, (N, V, D), which can be summed over views.

        See ``log_evidence_of``.
        """
        return log_evidence_of(self.logits, self.azimuth_bins, self.sphere.azimuth)

    @cached_property
    def seen(self) -> Mask:
        """Whether enough of the object is visible in each view, (N, V).

        In all other views the logits of all classes are equal.
        """
        seen = np.ptp(self.by_shape().logits, axis=2) > (
            SAME_LOGIT if len(self.classes) > 1 else -1
        )
        return (
            seen
            if self.azimuth_bins is None
            else seen | (np.ptp(self.azimuth_bins, axis=(2, 3)) > SAME_LOGIT)
        )

    @property
    def weights(self) -> Float:
        """Weights of the objects, (N,), with sum N; all occurring classes have the same weight."""
        count = np.bincount(self.labels, minlength=len(self.classes))
        return len(self) / ((count > 0).sum() * count[self.labels])

    @property
    def log_truth(self) -> Float:
        """Log-probability of the true class in each view alone, (N, V)."""
        return of_true_class(self.logits.astype(np.float64), self.labels)

    def evidence(self, objects: Index, views: Index) -> Evidence:
        """Return the outputs of the models for single views.

        Args:
            objects: rows of the objects, (B,) int64.
            views: view of each, (B,) int64.

        Returns:
            Evidence of B views.
        """
        return Evidence(
            self.logits[objects, views],
            {name: values[objects, views] for name, values in self.maps.items()},
            azimuth_bins=None
            if self.azimuth_bins is None
            else self.azimuth_bins[objects, views],
            seen=self.seen[objects, views],
        )

    def of_split(self, split: str) -> "Predictions":
        """Return the objects of one split."""
        kept = self.splits == split
        if not kept.any():
            if not self.splits.any():
                raise PredictionsError(
                    f"these predictions name no splits, so no objects of {split!r}: take them all"
                )
            names = [str(name) for name in np.unique(self.splits)]
            there = ", ".join(map(repr, names))
            raise PredictionsError(
                f"these predictions hold no objects of the split {split!r}, only of {there}: take"
                f" {option('split', names[-1])}, or predict the others with nextview-lab"
                f" predict STORE OUT --split {split}"
            )
        return self.of_objects(np.flatnonzero(kept))

    def deduplicate(self) -> "Predictions":
        """Return one object of each shape and label."""
        return self.of_objects(deduplicated(self.labels, self.depth_entropy))

    def of_objects(self, kept: Index) -> "Predictions":
        """Return some of the objects, by rows, (n,)."""
        arrays: dict[str, Any] = {
            name: values[kept] for name, values in self._arrays().items()
        }
        maps = {name: values[kept] for name, values in self.maps.items()}
        return replace(
            self,
            **arrays,
            maps=maps,
            names=tuple(self.names[i] for i in kept),
        )

    @classmethod
    def joined(cls, parts: Sequence["Predictions"]) -> "Predictions":
        """Join predictions by the same models; names of part K end in #K."""
        found = [part._arrays() for part in parts]
        arrays: dict[str, Any] = {
            name: np.concatenate([own[name] for own in found])
            if all(name in own for own in found)
            else None
            for name in found[0]
        }

        maps = {
            name: np.concatenate([part.maps[name] for part in parts])
            for name in parts[0].maps
        }
        names = (
            f"{name}#{k}" if k else name
            for k, part in enumerate(parts)
            for name in part.names
        )
        return replace(parts[0], **arrays, maps=maps, names=tuple(names))

    def by_shape(self) -> "Predictions":
        """Return the predictions without size evidence."""
        if self.of_size is None:
            return self
        return replace(self, logits=self.logits - self.of_size[:, None], of_size=None)

    @classmethod
    def from_logits(
        cls,
        store: ViewStore | str | Path,
        logits: ArrayLike,
        classes: Sequence[str] | None = None,
        split: str | None = None,
    ) -> "Predictions":
        """Create predictions from the logits of your own recogniser, without maps and models.

        Args:
            store: view store, or its path.
            logits: of each view of the rendered objects of the split, in the store's order,
                (N, V, C). Those of views without a visible object are set to 0, which is no
                evidence.
            classes: their names; those of the store by default.
            split: "train", "test" or "val"; all objects by default.

        Raises:
            DatasetError, PredictionsError: store, classes and logits are not consistent.
        """
        store = store if isinstance(store, ViewStore) else ViewStore.open(store)
        objects = some_objects(store, split)
        logits = np.array(logits, np.float32)
        made = replace(
            cls.of_objects_in(store, objects, classes or store.classes),
            logits=logits,
        )

        if (logits >= 0).all() and np.allclose(logits.sum(2), 1, atol=1e-3):
            raise PredictionsError(
                "these are probabilities where logits are expected; hand in their logarithms"
            )

        for row, i in enumerate(objects):
            logits[
                row,
                [not enough_shows(depth > 0) for depth in store.read("depth", i)],
            ] = 0

        return made

    @classmethod
    def of_objects_in(
        cls,
        store: ViewStore,
        objects: Index,
        classes: Sequence[str],
    ) -> "Predictions":
        """Create empty predictions of objects in a store; all logits are 0.

        Args:
            store: the view store.
            objects: rows of the objects, (N,) int64.
            classes: names of the recogniser's classes.

        Returns:
            The predictions.

        Raises:
            DatasetError: the recogniser does not know a class of the store.
        """
        labels = [store.classes[label] for label in store.labels[objects]]
        if unknown := sorted(set(labels) - set(classes)):
            raise DatasetError(
                f"{store.path}: the recogniser does not know the class {unknown[0]!r}"
            )

        group = duplicate_groups(store.measure())
        several = np.zeros((group.max() + 1, len(store.classes)), bool)
        several[group, store.labels] = True

        return cls(
            logits=np.zeros(
                (len(objects), len(store.sphere), len(classes)),
                np.float32,
            ),
            maps={},
            depth_entropy=store.measure()[objects],
            names=tuple(store.names[i] for i in objects),
            labels=np.array([classes.index(label) for label in labels]),
            classes=tuple(classes),
            splits=store.splits[objects],
            conflicting=((several.sum(1) > 1)[group] & store.done)[objects],
            sphere=store.sphere,
            models={},
            valley_classes={},
            store=str(store.path.resolve()),
            commands=store.commands,
        )

    def save(self, path: Path, overwrite: bool = False) -> None:
        """Write the predictions to an .npz file, completely or not at all.

        Args:
            path: of the file.
            overwrite: whether to replace an existing file.

        Raises:
            ResultsError: the file cannot be written.
        """
        arrays: dict[str, Any] = self._arrays()
        arrays |= {f"map/{name}": values for name, values in self.maps.items()}
        arrays |= {
            f"valley/{name}": np.array(classes, np.str_)
            for name, classes in self.valley_classes.items()
        }

        arrays |= {
            "format": PREDICTIONS_FORMAT,
            "names": np.array(self.names),
            "classes": np.array(self.classes),
            "elevations": np.array(self.sphere.elevations),
            "azimuths": self.sphere.azimuths,
            "distance": self.sphere.distance,
            "calibration": np.array(msgspec.json.encode(self.calibration).decode()),
            "store": np.array(self.store),
            "models": np.array(
                [(kind, *model) for kind, model in self.models.items()]
            ).reshape(-1, 3),
            "commands": np.array(self.commands, np.str_),
        }

        with new_file(Path(path), overwrite) as part, part.open("wb") as file:
            np.savez_compressed(file, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> "Predictions":
        """Read a file written by ``save``; PredictionsError if it is missing or damaged.

        Nothing is unpickled.
        """
        path = Path(path)
        if not path.exists():
            raise PredictionsError(
                f"{path}: there is no such file; make one with nextview-lab predict"
            )

        regular_file(path, "a predictions file", PredictionsError)

        try:
            return cls._from(_read(path))
        except KeyError as error:
            raise PredictionsError(f"{path}: lacks {error.args[0]}") from None
        except PredictionsError as error:
            raise PredictionsError(f"{path}: {error}") from None
        except DAMAGED as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise PredictionsError(
                f"{path}: not a predictions file ({reason})"
            ) from None

    @classmethod
    def _from(cls, f: dict[str, NDArray]) -> "Predictions":
        def group(prefix: str) -> dict[str, NDArray]:
            return {
                name.removeprefix(prefix): values
                for name, values in f.items()
                if name.startswith(prefix)
            }

        if "format" not in f or f["format"].tolist() != PREDICTIONS_FORMAT:
            raise PredictionsError(
                f"not a predictions file of format {PREDICTIONS_FORMAT}; make it again"
            )
        needed = ("logits", "depth_entropy", "labels", "splits", "conflicting")
        arrays: dict[str, Any] = {name: f[name] for name in needed}
        trust = str(f.get("calibration", "{}")).encode()
        return cls(
            **arrays,
            azimuth_bins=f.get("azimuth_bins"),
            of_size=f.get("of_size"),
            maps=group("map/"),
            names=tuple(f["names"].tolist()),
            classes=tuple(f["classes"].tolist()),
            sphere=ViewSphere(
                tuple(f["elevations"].tolist()),
                int(f["azimuths"]),
                float(f["distance"]),
            ),
            models={kind: (name, sha) for kind, name, sha in f["models"].tolist()},
            valley_classes={
                name: tuple(classes.tolist())
                for name, classes in group("valley/").items()
            },
            calibration=decode_record(
                trust,
                Calibration,
                "not a calibration",
                PredictionsError,
            ),
            store=str(f.get("store", "")),
            commands=tuple(f["commands"].tolist()) if "commands" in f else (),
        )


def _read(path: Path) -> dict[str, NDArray]:
    """Read the arrays of a file, after checking their declared sizes."""
    with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
        members = file.zip.infolist()
        if (
            sum(member.file_size for member in members)
            > PACKED * path.stat().st_size + SPARE
        ):
            raise PredictionsError("announces more than such a file can hold")
        for member in members:
            with file.zip.open(member) as stream:
                npy.read_magic(stream)
                shape, _, dtype = npy.read_array_header_1_0(stream)
            if math.prod(shape) * dtype.itemsize > member.file_size:
                raise PredictionsError(
                    f"{member.filename} announces more than it holds"
                )
        return dict(file)


def of_true_class(logs: Float, labels: Index) -> Float:
    """Return the log-belief in the true class.

    Args:
        logs: logits up to a constant, (N, ..., C).
        labels: true classes, (N,) int64.

    Returns:
        Log-belief, (N, ...) float64.
    """
    top = logs.max(-1)
    of_truth = logs[np.arange(len(labels)), ..., labels]
    return of_truth - top - np.log(np.exp(logs - top[..., None]).sum(-1))
