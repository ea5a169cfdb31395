"""The memory of taught things: their stored views, and the likelihood of a view given each."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from nextview.checks import check_array, did_you_mean, one_line
from nextview.errors import ModelError
from nextview.files import arrays_in, checked_bytes, new_file
from nextview.geometry.mesh import Mesh, make_mesh
from nextview.geometry.observation import Observation
from nextview.recognition.evidence import Evidence
from nextview.recognition.inference import Features, NetworkRecogniser
from nextview.recognition.model_card import FEATURE_NETWORK, ModelCard, find_card
from nextview.recognition.novelty import ROUNDED, Quantiles, unit
from nextview.things.approximate import NearestViews, is_large
from nextview.things.stored_surfaces import StoredSurfaces
from nextview.types import Float32, Floats, Index

RINGS = (0.0, 18.0, 36.0, 54.0, 72.0)  # elevations of the stored views, degrees
AZIMUTHS = 16  # stored views on a ring: the azimuth bins of a memory
THING_PICTURE = 64  # side of the picture of a thing, pixels
# metres: a camera cannot go around a larger thing
LARGEST_THING_RADIUS = 1e4
# entry of a memory file for an unknown radius: NaN would mean damage
NO_RADIUS = 0.0
LARGEST_LOGIT = 700.0  # largest logit of a head: the exponential of more overflows


@dataclass(frozen=True)
class Memory:
    """Stored appearance of T things in H resting poses, sorted by class.

    Geometry alone recognises things of known size that are each a class of their own. Their memory
    contains no embeddings, and F and K are 0.

    Attributes:
        views: Embeddings of the stored views, unit vectors, (H, rings, azimuths, F); zero for a
            missing view.
        thing: Thing of each resting pose, ascending, (H,) int64.
        rotations: Rotation from the axes of the file to each resting pose, (H, 3, 3) float32.
        held_out: Embeddings of K held-out views of each thing through a sensor, in one of its
            resting poses, (T, K, F), for calibration and reports; zero where nothing was visible.
        held_out_views: Elevation and azimuth of each held-out view, radians, (T, K, 2) float32.
        radii: Object radius of each thing, metres, (T,) float32; NaN if unknown.
        pictures: A picture of each thing, (T, 64, 64) uint8.
        head: Weights of a linear classifier of embeddings for classes of several things, (F, C).
        head_bias: Its biases, (C,).
        surfaces: Surfaces of the things, in metres, in the frames of their scan files.
    """

    views: Floats
    thing: Index
    rotations: Floats
    held_out: Floats
    held_out_views: Floats
    radii: Floats
    pictures: NDArray[np.uint8]
    head: Floats
    head_bias: Floats
    surfaces: StoredSurfaces

    def __post_init__(self) -> None:
        self._check_shapes()
        self._check_values()

    @property
    def has_features(self) -> bool:
        """Whether the memory contains embeddings of views."""
        return self.views.shape[-1] > 0

    def _check_shapes(self) -> None:
        """Check that all arrays are finite, and that their types and shapes agree."""
        check_array("its thing", self.thing, np.integer, (None,))
        check_array("its radii", self.radii, np.floating, (None,), finite=False)
        poses = len(self.thing)
        things = len(self.radii)

        check_array(
            "its views",
            self.views,
            np.floating,
            (poses, len(RINGS), AZIMUTHS, None),
            empty=True,
        )
        size = self.views.shape[-1]
        check_array("its rotations", self.rotations, np.floating, (poses, 3, 3))

        check_array(
            "its held_out",
            self.held_out,
            np.floating,
            (things, None, size),
            empty=True,
        )
        held_out = self.held_out.shape[1]
        if (held_out > 0) != self.has_features:
            raise ModelError("its held_out and its views have different features")
        check_array(
            "its held_out_views",
            self.held_out_views,
            np.floating,
            (things, held_out, 2),
        )
        check_array(
            "its pictures",
            self.pictures,
            np.uint8,
            (things, THING_PICTURE, THING_PICTURE),
        )

        check_array("its head_bias", self.head_bias, np.floating, (None,))
        check_array("its head", self.head, np.floating, (size, len(self.head_bias)))
        if len(self.surfaces) != things:
            raise ModelError(
                f"its surfaces are of {len(self.surfaces)} things, not {things}"
            )

    def _check_values(self) -> None:
        """Check that the values are valid."""
        if np.unique(self.thing).tolist() != list(range(len(self.radii))):
            raise ModelError("its thing refers to missing things, or omits some")
        if (np.diff(self.thing) < 0).any():
            raise ModelError("its thing does not ascend")

        known = self.radii[~np.isnan(self.radii)]
        if not ((known > 0) & (known <= LARGEST_THING_RADIUS)).all():
            raise ModelError(
                f"its radii are not above zero and at most {LARGEST_THING_RADIUS:g} m"
            )

        nameless = np.isnan(self.radii) & (self.surfaces.counts[:, 0] > 0)
        if nameless.any():
            raise ModelError(
                "its radii lack the radius of a thing with a surface in metres"
            )

        head = self.head.astype(np.float64)
        # Views are unit vectors.
        largest = np.linalg.norm(head, axis=0) + np.abs(
            self.head_bias.astype(np.float64)
        )
        if largest.max() > LARGEST_LOGIT:
            raise ModelError(
                f"its head gives logits above {LARGEST_LOGIT:g}, whose exponentials overflow"
            )

        for name in ("views", "held_out"):
            lengths = np.linalg.norm(getattr(self, name).astype(np.float32), axis=-1)
            if (np.minimum(lengths, np.abs(lengths - 1)) > ROUNDED).any():
                raise ModelError(f"its {name} are not unit vectors")

        rotations = self.rotations.astype(np.float64)
        products = rotations @ rotations.swapaxes(1, 2)
        turned = (
            np.abs(products - np.eye(3)).max() < ROUNDED
            and (np.linalg.det(rotations) > 0).all()
        )
        if not turned:
            raise ModelError("its rotations are not rotation matrices")

        if not self.has_features and not (self.surfaces.counts[:, 0] > 0).all():
            raise ModelError(
                "it contains neither views nor a surface of one of its things"
            )

        if (np.abs(self.held_out_views[..., 0]) > np.pi / 2 + ROUNDED).any():
            raise ModelError("its held_out_views have elevations beyond 90 degrees")

    def save(self, path: Path, overwrite: bool = False) -> str:
        """Write the memory to a .safetensors file, with embeddings in half precision.

        Args:
            path: path of the file.
            overwrite: whether to replace an existing file.

        Returns:
            SHA-256 of the file.
        """
        arrays = {name: np.ascontiguousarray(getattr(self, name)) for name in _OF_VIEWS}
        arrays |= {name: getattr(self.surfaces, name) for name in _OF_SURFACES}
        arrays |= {
            name: arrays[name].astype(np.float16) for name in ("views", "held_out")
        }
        arrays["radii"] = np.where(
            np.isnan(self.radii),
            self.radii.dtype.type(NO_RADIUS),
            self.radii,
        )
        content = save(arrays)
        with new_file(path, overwrite) as part:
            part.write_bytes(content)
        return hashlib.sha256(content).hexdigest()


_OF_SURFACES = tuple(f.name for f in fields(StoredSurfaces))
_OF_VIEWS = tuple(f.name for f in fields(Memory) if f.name != "surfaces")


@lru_cache(maxsize=2)
def read_memory(path: Path, sha256: str) -> Memory:
    """Read a file that ``Memory.save`` wrote.

    Args:
        path: path of the file.
        sha256: expected hash of its content.

    Returns:
        The memory.

    Raises:
        ModelError: the file is missing, has another hash, comes from an earlier version without
            geometry, or contains an invalid value.
    """
    content = checked_bytes(path, sha256, "a memory")
    where = f"{path}: not a memory"
    arrays = arrays_in(content, _OF_VIEWS, where)
    stored = arrays_in(content, (), where, _OF_SURFACES)
    if not stored:
        raise ModelError(
            f"{path}: is of an earlier version; teach it again with nextview learn"
        )
    missing = sorted(set(_OF_SURFACES) - set(stored))
    if missing:
        raise ModelError(f"{where} (it holds no {missing[0]})")

    try:
        arrays["radii"] = _radii_of(arrays["radii"])
        return Memory(**arrays, surfaces=StoredSurfaces(**stored))
    except ModelError as error:
        raise ModelError(f"{where} ({error})") from None


def _radii_of(stored: Floats) -> Floats:
    """The radii of a file, (T,); NaN where they are unknown.

    Raises:
        ModelError: they are no numbers.
    """
    check_array("its radii", stored, np.floating, (None,), finite=False)
    if np.isnan(stored).any():
        raise ModelError(
            "its radii are not all numbers: teach it again with nextview learn"
        )
    return np.where(stored == NO_RADIUS, stored.dtype.type(np.nan), stored)


def open_memory(model: str | Path) -> tuple[ModelCard, Memory]:
    """Open the card of a memory of taught things and the memory, and check that they agree.

    Args:
        model: name of a bundled memory, or the path of its card.

    Returns:
        The card and the memory.

    Raises:
        ModelError: one of them is missing or damaged, the memory uses other features than this
            version of the package, or the two do not agree.
    """
    card = find_card(model)
    if card.memory is None:
        raise ModelError(f"{card.card_path}: is not a memory of things")

    features = find_card(FEATURE_NETWORK)
    if card.memory.features_sha256 not in (None, features.sha256):
        raise ModelError(
            f"{card.card_path}: was taught with other features; teach it again with nextview learn"
        )
    if card.input != features.input:
        raise ModelError(
            f"{card.card_path}: takes other inputs than the features that it was taught with"
        )
    has_features = card.memory.features_sha256 is not None
    bins = AZIMUTHS if has_features else 0
    if card.azimuth_bins != bins:
        raise ModelError(
            f"{card.card_path}: has {card.azimuth_bins} azimuth bins, not {bins}"
        )

    memory = read_memory(card.path, card.sha256)
    if memory.has_features != has_features:
        holds = "holds" if memory.has_features else "holds no"
        raise ModelError(
            f"{card.path}: {holds} features, and its card, {card.card_path}, disagrees"
        )
    if memory.thing.tolist() != list(card.memory.poses):
        raise ModelError(
            f"{card.path}: its resting poses are not those of the things on its card,"
            f" {card.card_path}"
        )
    if len(memory.head_bias) != len(card.classes):
        raise ModelError(
            f"{card.path}: is of {len(memory.head_bias)} classes, and its card of"
            f" {len(card.classes)}"
        )
    return card, memory


def check_features(card: ModelCard, memory: Memory, size: int) -> None:
    """Check that the embeddings of a memory, if there are any, have the size of the features.

    Args:
        card: card of the memory, for error messages.
        memory: the memory.
        size: number of components of an embedding.

    Raises:
        ModelError: the sizes differ.
    """
    if memory.has_features and memory.views.shape[-1] != size:
        raise ModelError(
            f"{card.path}: its views have {memory.views.shape[-1]} features, not {size}"
        )


def similarities(views: Floats, embeddings: Floats, elevations: Floats) -> Float32:
    """Cosine similarities of views with the stored views, interpolated between two rings.

    Args:
        views: stored views, ring by ring, (rings, H * azimuths, F) float32.
        embeddings: embeddings of the views, unit vectors, (B, F) float32.
        elevations: elevations of the views, radians, (B,).

    Returns:
        Similarities, (B, H, azimuths) float32.
    """
    shares = ring_shares(elevations)
    found = np.zeros((len(embeddings), views.shape[1]), np.float32)
    for ring, share in enumerate(shares.T):
        rows = np.flatnonzero(share)
        if len(rows):
            found[rows] += share[rows, None] * (embeddings[rows] @ views[ring].T)
    return found.reshape(len(embeddings), -1, AZIMUTHS)


def ring_shares(elevations: Floats) -> Float32:
    """Interpolation weights of the rings.

    Args:
        elevations: elevations of the views, radians, (B,).

    Returns:
        Weights, (B, rings) float32, at most two of which are positive for a view.
    """
    place = np.interp(elevations, np.radians(RINGS), np.arange(len(RINGS)))
    shares = np.maximum(1 - np.abs(place[:, None] - np.arange(len(RINGS))), 0)
    return np.where(shares > 1e-6, shares, 0).astype(np.float32)


class TaughtRecogniser(NetworkRecogniser):
    """Recognises taught things in each view by comparison with their stored views."""

    def __init__(self, model: str | Path, threads: int = 0) -> None:
        """Open a memory.

        Args:
            model: name of a bundled memory, or the path of its card.
            threads: number of threads of the feature network; 0 for one on each core.

        Raises:
            ModelError: see ``open_memory``.
        """
        self.card, self.memory = open_memory(model)
        self.classes = self.card.classes
        self.azimuth_bins = self.card.azimuth_bins
        self.calibration = self.card.calibration

        self._features: Features | None = None
        self._nearest: NearestViews | None = None
        if self.memory.has_features:
            self._features = Features(threads)
            check_features(self.card, self.memory, self._features.size)
            self._views = by_ring(self.memory.views)
            if is_large(self._views):
                self._nearest = NearestViews(self._views)

        about = self.card.memory
        assert about is not None
        self.novelty = None
        if about.novelty:
            judged = np.array([self.memory.held_out[..., 0].size])
            usual = np.array(about.usual) if about.usual else None
            self.novelty = Quantiles(
                np.array(about.novelty),
                judged,
                joint=True,
                usual=usual,
            )

    def by_shape(self, observations: Sequence[Observation]) -> Evidence:
        """Evidence of views by shape alone; uniform without features.

        Args:
            observations: B views.

        Returns:
            Their evidence.
        """
        if self._features is None:
            return self._even(len(observations))
        return super().by_shape(observations)

    def from_inputs(
        self,
        inputs: NDArray[Any],
        elevations: Floats | None = None,
    ) -> Evidence:
        """Evidence of network inputs by shape alone.

        Args:
            inputs: inputs of the feature network, (B, ...).
            elevations: elevations of the cameras, radians, (B,).

        Returns:
            Their evidence; uniform if the memory contains no features.

        Raises:
            ModelError: the elevations are missing.
        """
        if self._features is None:
            return self._even(len(inputs))
        if elevations is None:
            raise ModelError("a memory of things needs the elevations of the views")
        return self.evidence(self._features(inputs), elevations)

    def _even(self, count: int) -> Evidence:
        """Uniform evidence of some views."""
        return Evidence(np.zeros((count, len(self.classes)), np.float32))

    def evidence(self, embeddings: Floats, elevations: Floats) -> Evidence:
        """Evidence of views by their embeddings.

        Args:
            embeddings: unit vectors, (B, F).
            elevations: elevations of the cameras, radians, (B,).

        Returns:
            Their evidence.
        """
        assert self.card.memory is not None
        if self._nearest is None:
            alike = similarities(self._views, embeddings, elevations)
        else:
            alike = self._nearest.similarities(embeddings, ring_shares(elevations))
            alike = alike.reshape(len(embeddings), -1, AZIMUTHS)
        logits = embeddings @ self.memory.head + self.memory.head_bias
        return Evidence(logits, azimuth_bins=self.card.memory.weight * alike)


def by_ring(views: Floats) -> Float32:
    """Sort stored views by ring.

    Args:
        views: stored views, (H, rings, azimuths, F).

    Returns:
        The same views, (rings, H * azimuths, F) float32.
    """
    h, rings, azimuths, f = views.shape
    return np.ascontiguousarray(
        views.swapaxes(0, 1).reshape(rings, h * azimuths, f),
        np.float32,
    )


def joined(clean: Floats, sensed: Floats) -> Float32:
    """Mean of clean and sensed embeddings, as a memory stores it.

    Args:
        clean: embeddings of views without sensor errors, (..., F).
        sensed: embeddings of the same views with sensor errors, (..., F).

    Returns:
        Unit vectors, (..., F) float32.
    """
    return unit(np.asarray(clean, np.float32) + np.asarray(sensed, np.float32))


def taught_meshes(model: str | Path, names: Sequence[str]) -> list[Mesh]:
    """Return the stored surfaces of taught things as meshes, for example to simulate them.

    Args:
        model: name of a bundled memory, or the path of its card.
        names: of things with surfaces.

    Returns:
        The meshes, in metres, in the order of the names.

    Raises:
        ModelError: see ``open_memory``; or a thing is not known, or has no surface.
    """
    card, memory = open_memory(model)
    assert card.memory is not None
    known = [thing.name for thing in card.memory.things]
    meshes = []
    for name in names:
        if name not in known:
            raise ModelError(
                f"{card.card_path}: knows no {one_line(name)}{did_you_mean(name, known)}"
            )
        surface = memory.surfaces.surface(known.index(name), name)
        if surface is None:
            raise ModelError(f"{card.card_path}: {one_line(name)} has no surface")
        vertices = surface.vertices.astype(np.float64)
        meshes.append(make_mesh(vertices, surface.faces, name, "m"))
    return meshes
