"""The memory of taught things: what each looks like from around, and how likely a view is given each of them."""

import hashlib
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from nextview.errors import ModelError
from nextview.files import checked_bytes, new_file
from nextview.recognition.approximate import NearestViews, is_large
from nextview.recognition.evidence import Evidence
from nextview.recognition.inference import Features, Recogniser
from nextview.recognition.model_card import MEMORY_SUFFIX, find_card
from nextview.recognition.novelty import Quantiles, unit

RINGS = (0.0, 18.0, 36.0, 54.0, 72.0)  # elevations of the remembered views, degrees
AZIMUTHS = 16  # remembered views on a ring: the azimuth bins of a memory
Float = NDArray[np.floating]


@dataclass(frozen=True)
class Memory:
    """What T things look like, each in one or more resting poses: H of these in all, sorted by class."""

    # embedding of each remembered view, unit vectors, (H, rings, azimuths, F); zero where nothing is remembered
    views: Float
    thing: NDArray[np.int64]  # which thing each resting pose is of, (H,) int64
    rotations: Float  # of each resting pose, from the file's axes, (H, 3, 3) float32
    # embeddings of views through a sensor that are not remembered, K of each thing in its first resting pose, (T, K,
    # F): what calibration and reports are made of
    held_out: Float
    held_out_views: Float  # elevation and azimuth of each, radians, (T, K, 2) float32
    radii: Float  # object radius of each thing, metres, (T,) float32; NaN where it is not known
    pictures: NDArray[np.uint8]  # a picture of each thing, (T, 64, 64) uint8
    head: Float  # a linear classifier of embeddings for classes of several things, (F, C) and (C,)
    head_bias: Float

    def __post_init__(self) -> None:
        h, t, f = len(self.thing), len(self.radii), self.views.shape[-1]
        k, c = self.held_out.shape[1], len(self.head_bias)
        shapes = {"views": (h, len(RINGS), AZIMUTHS, f), "thing": (h,), "rotations": (h, 3, 3), "radii": (t,)}
        shapes |= {"held_out": (t, k, f), "held_out_views": (t, k, 2), "pictures": (t, 64, 64), "head": (f, c)}
        for name, shape in shapes.items():
            values = getattr(self, name)
            if values.shape != shape or 0 in shape or (name != "radii" and not np.isfinite(values).all()):
                raise ModelError(f"no memory: {name} has the shape {values.shape}, or is not finite")
        if sorted(set(self.thing.tolist())) != list(range(t)):
            raise ModelError("no memory: resting poses of things that are not there")

    def save(self, path: Path, overwrite: bool = False) -> str:
        """Write a .safetensors file, embeddings in half precision; returns its SHA-256."""
        arrays = {f.name: np.ascontiguousarray(getattr(self, f.name)) for f in fields(self)}
        arrays |= {name: arrays[name].astype(np.float16) for name in ("views", "held_out")}
        content = save(arrays)
        with new_file(path, overwrite) as part:
            part.write_bytes(content)
        return hashlib.sha256(content).hexdigest()


@lru_cache(maxsize=2)
def read_memory(path: Path, sha256: str) -> Memory:
    """Read what ``Memory.save`` wrote; ModelError if it is not that."""
    try:
        arrays = load(checked_bytes(path, sha256, "a memory"))
        return Memory(**{f.name: arrays[f.name] for f in fields(Memory)})
    except (SafetensorError, KeyError) as error:
        raise ModelError(f"{path}: not a memory ({error})") from None


def similarities(views: Float, embeddings: Float, elevations: Float) -> NDArray[np.float32]:
    """How alike views are to what is remembered, between two rings interpolated: cosines, (B, H, azimuths) float32.

    The memory's ``views`` are ring by ring, (rings, H * azimuths, F) float32; ``embeddings`` unit vectors, (B, F)
    float32; ``elevations`` those from which the views were taken, radians, (B,).
    """
    shares = ring_shares(elevations)
    found = np.zeros((len(embeddings), views.shape[1]), np.float32)
    for ring, share in enumerate(shares.T):
        rows = np.flatnonzero(share)
        if len(rows):
            found[rows] += share[rows, None] * (embeddings[rows] @ views[ring].T)
    return found.reshape(len(embeddings), -1, AZIMUTHS)


def ring_shares(elevations: Float) -> NDArray[np.float32]:
    """How much each ring counts for views from elevations, (B,), radians: (B, rings)."""
    place = np.interp(elevations, np.radians(RINGS), np.arange(len(RINGS)))
    shares = np.maximum(1 - np.abs(place[:, None] - np.arange(len(RINGS))), 0)
    return np.where(shares > 1e-6, shares, 0).astype(np.float32)


class TaughtRecogniser(Recogniser):
    """Recognises taught things in each view by what is remembered of them; ``model`` is the path of its card."""

    def __init__(self, model: str | Path, threads: int = 0) -> None:
        self.card = find_card(model)
        if (about := self.card.memory) is None:
            raise ModelError(f"model {self.card.name} is no memory of things")
        self.classes, self.azimuth_bins = self.card.classes, self.card.azimuth_bins
        self.calibration = self.card.calibration
        self.memory = read_memory(self.card.path, self.card.sha256)
        self._features = Features(threads)
        if self._features.card.sha256 != about.features_sha256:
            raise ModelError(f"{self.card.path}: was taught with other features; teach it again with nextview learn")
        h, things = len(self.memory.thing), len(about.things)
        if (h, things) != (len(self.calibration.hypotheses), len(self.memory.radii)):
            raise ModelError(f"{self.card.path}: holds {h} resting poses, and its card is of others")
        self._views = by_ring(self.memory.views)
        self._nearest = NearestViews(self._views) if is_large(self._views) else None
        judged = np.array([self.memory.held_out[..., 0].size])
        usual = np.array(about.usual) if about.usual else None
        self.novelty = Quantiles(np.array(about.novelty), judged, joint=True, usual=usual) if about.novelty else None

    def from_inputs(self, inputs: NDArray[Any], elevations: Float | None = None) -> Evidence:
        """Evidence by shape alone, from what the network takes and the elevations of the cameras, radians, (B,)."""
        if elevations is None:
            raise ModelError("a memory of things needs the elevations of the views")
        return self.evidence(self._features(inputs), elevations)

    def evidence(self, embeddings: Float, elevations: Float) -> Evidence:
        """Evidence of views by their embeddings, unit vectors, (B, F), and elevations, radians, (B,)."""
        assert self.card.memory is not None
        if self._nearest is None:
            alike = similarities(self._views, embeddings, elevations)
        else:
            alike = self._nearest.similarities(embeddings, ring_shares(elevations))
            alike = alike.reshape(len(embeddings), -1, AZIMUTHS)
        logits = embeddings @ self.memory.head + self.memory.head_bias
        return Evidence(logits, azimuth_bins=self.card.memory.weight * alike)

    def features(self, inputs: NDArray[Any]) -> NDArray[np.float32]:
        """The embeddings of views, (B, F)."""
        return self._features(inputs)


def by_ring(views: Float) -> NDArray[np.float32]:
    """Remembered views, (H, rings, azimuths, F), ring by ring, (rings, H * azimuths, F) float32."""
    h, rings, azimuths, f = views.shape
    return np.ascontiguousarray(views.swapaxes(0, 1).reshape(rings, h * azimuths, f), np.float32)


def joined(clean: Float, sensed: Float) -> NDArray[np.float32]:
    """What is remembered of views, by their embeddings without and with a sensor's errors: the mean, (..., F)."""
    return unit(np.asarray(clean, np.float32) + np.asarray(sensed, np.float32))


def open_recogniser(model: str | Path, threads: int = 0) -> Recogniser:
    """A recogniser, or a memory of taught things, by the name of a bundled model or the path of a card."""
    card = find_card(model)
    return (TaughtRecogniser if card.path.suffix == MEMORY_SUFFIX else Recogniser)(model, threads)
