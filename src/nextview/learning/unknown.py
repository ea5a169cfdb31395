"""Notice objects of no known class: synthetic outliers, a novelty score, and the fit of it to a recogniser."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from scipy.special import expit

from nextview.checks import whole
from nextview.data.folders import list_dataset
from nextview.data.pool import WorkerDied, each
from nextview.data.progress import Track, silently
from nextview.data.splits import deduplicated
from nextview.data.store import ViewStore
from nextview.errors import DatasetError, MeshError, ModelError
from nextview.files import command
from nextview.geometry.mesh import Mesh, load_mesh, make_mesh
from nextview.geometry.observation import Camera
from nextview.learning.fitting_set import card_to_fit
from nextview.recognition.inference import Recogniser
from nextview.recognition.model_card import ModelCard
from nextview.recognition.network_input import from_observations, from_store
from nextview.recognition.novelty import Novelty, in_half, novelty_path, unit
from nextview.simulation.sensed_camera import SensedCamera
from nextview.simulation.simulated import SimulatedCamera

Float = NDArray[np.float64]

FAMILIES = ("primitives", "turned", "stretched", "cut", "joined")
"""The first needs no mesh."""
_ROUND, _MAX_STRETCH, _MAX_PRIMITIVES = 24, 6.0, 6


def synthetic_outlier(family: str, mesh: Mesh, other: Mesh, rng: np.random.Generator) -> Mesh:
    """An object of no class: ``mesh`` changed as the family says, for "joined" with a part of ``other``."""
    if family == "primitives":
        vertices, faces = _joined([_primitive(rng) for _ in range(rng.integers(1, _MAX_PRIMITIVES + 1))])
    elif family == "turned":
        vertices, faces = mesh.vertices @ rotation(rng).T, mesh.faces
    elif family == "stretched":
        vertices, faces = mesh.vertices * _stretch(rng), mesh.faces
    elif family == "cut":
        vertices, faces = mesh.vertices, _beyond(mesh, rng)
    elif family == "joined":
        shifted = other.vertices * rng.uniform(0.5, 1) + rng.uniform(-0.5, 0.5, 3)
        vertices, faces = _joined([(mesh.vertices, _beyond(mesh, rng)), (shifted, _beyond(other, rng))])
    else:
        raise ValueError(f"no family of outliers is called {family!r}")
    return make_mesh(vertices, faces, f"a synthetic outlier ({family})")


def rotation(rng: np.random.Generator) -> Float:
    """A rotation, all equally likely, (3, 3): a unit quaternion from four Gaussians (Muller, 1959)."""
    return Rotation.from_quat(rng.normal(size=4), scalar_first=True).as_matrix()


def _stretch(rng: np.random.Generator) -> Float:
    """Factors along the axes, (3,): one or two of them 2 to 6 or its inverse."""
    factors = np.ones(3)
    axes = rng.permutation(3)[: rng.integers(1, 3)]
    factors[axes] = np.exp(rng.uniform(np.log(2), np.log(_MAX_STRETCH)) * rng.choice([-1, 1]))
    return factors


def _beyond(mesh: Mesh, rng: np.random.Generator) -> NDArray[np.int32]:
    """The faces on one side of a random plane, a quarter of them at least and three quarters at most."""
    normal = rng.normal(size=3)
    along = mesh.vertices[mesh.faces].mean(1) @ normal
    kept: NDArray[np.int32] = mesh.faces[along >= np.quantile(along, rng.uniform(0.25, 0.75))]
    return kept


def _primitive(rng: np.random.Generator) -> tuple[Float, NDArray[np.int32]]:
    """A box, an ellipsoid, a cylinder or a cone of some size at some place, upright in half of the cases."""
    kind = rng.integers(4)
    if kind == 0:
        profile, sides = np.array([(0, -1), (1, -1), (1, 1), (0, 1)], float), 4
    elif kind == 1:
        angle = np.linspace(-np.pi / 2, np.pi / 2, _ROUND // 2)
        profile, sides = np.stack([np.cos(angle), np.sin(angle)], 1), _ROUND
    else:
        top = 1.0 if kind == 2 else rng.uniform(0, 0.6)
        profile, sides = np.array([(0, -1), (1, -1), (top, 1), (0, 1)]), _ROUND
    vertices, faces = turned_on_a_lathe(profile, sides)
    vertices = vertices * np.exp(rng.uniform(np.log(0.1), np.log(1), 3))
    if rng.random() < 0.5:
        vertices = vertices @ rotation(rng).T
    return vertices + rng.uniform(-0.6, 0.6, 3), faces


def turned_on_a_lathe(profile: Float, sides: int) -> tuple[Float, NDArray[np.int32]]:
    """A solid of revolution about z, from its profile, (P, 2): radius and height, from the bottom up."""
    angle = 2 * np.pi * np.arange(sides) / sides
    radius, height = profile[:, 0, None], np.broadcast_to(profile[:, 1, None], (len(profile), sides))
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1).reshape(-1, 3)
    low = (np.arange(len(profile) - 1)[:, None] * sides + np.arange(sides)).ravel()
    after = (np.arange(len(profile) - 1)[:, None] * sides + (np.arange(sides) + 1) % sides).ravel()
    faces = np.concatenate(
        [np.stack([low, after, after + sides], 1), np.stack([low, after + sides, low + sides], 1)]
    ).astype(np.int32)
    return vertices, faces


def _joined(parts: list[tuple[Float, NDArray[np.int32]]]) -> tuple[Float, NDArray[np.int32]]:
    """Several meshes as one."""
    begin = np.cumsum([0, *[len(vertices) for vertices, _ in parts[:-1]]])
    faces = np.concatenate([faces + first for (_, faces), first in zip(parts, begin, strict=True)])
    return np.concatenate([vertices for vertices, _ in parts]), faces.astype(np.int32)


DISTANCE_DIRECTIONS, PERCEPTRON_DIRECTIONS, HIDDEN, DECAY, STEPS = 64, 128, 64, 1e-3, 100
"""Principal components for either part; the perceptron's hidden units, weight decay and steps of L-BFGS."""
NEIGHBOURS = 4500
"""Known views that are kept."""
LEVELS = 201
"""Of the quantiles."""


def fit_novelty(
    known: Float,
    labels: NDArray[np.int64],
    outliers: Float,
    held_out: Float,
    held_out_labels: NDArray[np.int64],
    rng: np.random.Generator,
    n_views: int = 5,
) -> Novelty:
    """A novelty score, standardised and calibrated on objects that the recogniser was not trained on."""
    middle, directions, _ = principal_components(known, DISTANCE_DIRECTIONS)
    kept = rng.permutation(len(known))[:NEIGHBOURS]
    neighbours = unit((known[kept] - middle) @ directions)
    hidden, hidden_bias, output, output_bias = fit_perceptron(known, labels, outliers, rng)
    hidden_bias = hidden_bias + middle @ hidden  # of features from which the middle is taken away
    raw = Novelty(
        middle=middle.astype(np.float32),
        directions=_as_stored(directions),
        neighbours=_as_stored(neighbours),
        hidden=_as_stored(hidden),
        hidden_bias=hidden_bias.astype(np.float32),
        output=output.astype(np.float32),
        output_bias=output_bias.astype(np.float32),
        standard=np.array([[0, 1], [0, 1]], np.float32),
        quantiles=np.zeros((1, 2), np.float32),
        objects=np.array([len(held_out)]),
    )
    parts = raw.parts(held_out.reshape(-1, held_out.shape[-1]))
    standard = np.stack([parts.mean(0), parts.std(0)], 1).astype(np.float32)
    ready = replace(raw, standard=standard)
    scores = ready.scores(held_out.reshape(-1, held_out.shape[-1])).reshape(held_out.shape[:2])
    return replace(ready, quantiles=quantiles(scores, held_out_labels, n_views))


def _as_stored(table: NDArray[np.floating]) -> NDArray[np.float32]:
    """Rounded as ``Novelty.save`` rounds, so that what is calibrated is what is read."""
    return in_half(table).astype(np.float32)


def principal_components(rows: Float, most: int) -> tuple[Float, Float, Float]:
    """Middle (F,), directions (F, D) and variances along these (D,) of the largest components, in descending order."""
    middle = rows.mean(0)
    centred = rows - middle
    f = rows.shape[1]
    variances, directions = eigh(centred.T @ centred / len(rows), subset_by_index=[max(0, f - most), f - 1])
    kept = variances > 1e-6 * variances.max()
    return middle, directions[:, kept][:, ::-1], variances[kept][::-1]


def fit_perceptron(
    known: Float, labels: NDArray[np.int64], outliers: Float, rng: np.random.Generator
) -> tuple[Float, Float, Float, Float]:
    """A perceptron with one hidden layer of tanh that is above zero for outliers."""
    middle, directions, variances = principal_components(np.concatenate([known, outliers]), PERCEPTRON_DIRECTIONS)
    whiten = directions / np.sqrt(variances)
    rows = ((np.concatenate([known, outliers]) - middle) @ whiten).astype(np.float32)
    truth = np.repeat([0.0, 1.0], [len(known), len(outliers)]).astype(np.float32)
    count = np.bincount(labels)
    weights = np.concatenate([1 / count[labels] / (count > 0).sum(), np.full(len(outliers), 1 / len(outliers))]) / 2
    weights = weights.astype(np.float32)
    d = rows.shape[1]
    cuts = np.cumsum([d * HIDDEN, HIDDEN, HIDDEN])

    def layers(parameters: Float) -> tuple[Float, Float, Float, Float]:
        first, bias, second, last = np.split(parameters, cuts)
        return first.reshape(d, HIDDEN), bias, second, last

    def loss(parameters: Float) -> tuple[float, Float]:
        first, bias, second, last = layers(parameters.astype(np.float32))
        units = np.tanh(rows @ first + bias)
        logit = units @ second + last
        error = weights * (expit(logit) - truth)
        back = error[:, None] * second * (1 - units**2)
        gradient = np.concatenate([(rows.T @ back).ravel(), back.sum(0), units.T @ error, [error.sum()]])
        value = weights @ (np.logaddexp(0, logit) - truth * logit) + DECAY / 2 * parameters @ parameters
        return float(value), gradient.astype(np.float64) + DECAY * parameters

    begin = [rng.normal(size=d * HIDDEN) / np.sqrt(d), np.zeros(HIDDEN), rng.normal(size=HIDDEN) / np.sqrt(HIDDEN), [0]]
    fitted = minimize(loss, np.concatenate(begin), jac=True, method="L-BFGS-B", options={"maxiter": STEPS})
    first, bias, second, last = layers(fitted.x)
    folded = whiten @ first
    return folded, bias - middle @ folded, second, last


def quantiles(scores: Float, labels: NDArray[np.int64], n_views: int) -> NDArray[np.float32]:
    """Quantiles of the mean score over 1 to ``n_views`` views, classes weighted evenly: (views, LEVELS), ascending."""
    count = np.bincount(labels)
    each, levels = 1 / count[labels], []
    for n in range(1, min(n_views, scores.shape[1]) + 1):
        draws = scores.shape[1] // n
        means = scores[:, : draws * n].reshape(len(scores), draws, n).mean(2)
        order = np.argsort(means, axis=None)
        weight = np.repeat(each, draws)[order]
        share = (np.cumsum(weight) - weight / 2) / weight.sum()
        levels.append(np.interp(np.linspace(0, 1, LEVELS), share, means.ravel()[order]))
    return np.array(levels, np.float32)


LEARNED_VIEWS, OUTLIER_VIEWS, HELD_OUT_VIEWS = 3, 4, 12
"""Views of each object to which a novelty score is fitted."""
NONE = np.zeros((0, 0), np.float32)
"""Features of an object in which nothing is seen."""


@dataclass(frozen=True)
class FittedUnknown:
    """What ``fit_unknown`` fitted to."""

    objects: int
    outliers: int
    held_out: int


@dataclass(frozen=True)
class KnownViews:
    """The first ``wanted`` of some stored views of an object in which anything is seen."""

    store: str
    card: str
    row: int
    views: tuple[int, ...]
    wanted: int


@dataclass(frozen=True)
class OutlierViews:
    """Views of a synthetic outlier, made of two meshes, from the viewpoints and at the size of a store."""

    store: str
    card: str
    family: str
    mesh: str
    other: str
    views: tuple[int, ...]
    seed: int
    sensor: str | None


def fit_unknown(
    store: Path,
    meshes: Path,
    card: Path,
    outliers: int = 1700,
    seed: int = 0,
    sensed: tuple[Path, Path] | None = None,
    workers: int | None = None,
    track: Track = silently,
) -> FittedUnknown:
    """Teach a recogniser to notice objects of no class that it knows, at a false-alarm rate that can be chosen.

    The novelty score goes into NAME.novelty.safetensors beside the card, and its SHA-256 into the card. Nothing is
    learned from the test split. When stopped, it begins anew.

    Args:
        store: view store of the recogniser's training objects.
        meshes: folder of their meshes, of which the synthetic outliers are made.
        card: of the recogniser; the objects that it calls held out calibrate the false-alarm rate.
        outliers: synthetic ones to make.
        seed: of all that is drawn.
        sensed: stores of the training objects and of those held out, through sensors (nextview render --sensor mix, and
            the same with --held-out): these views are known as well.
        workers: processes; one for each core by default.
        track: follows the rendering and the recogniser.

    Raises:
        UsageError, DatasetError, ModelError: the arguments make no sense, or do not fit together.
    """
    whole(outliers, "the number of outliers", 1)
    views, rng = ViewStore.open(store), np.random.default_rng(seed)
    with card_to_fit(card) as (model, write):
        if not model.is_recogniser:
            raise ModelError(f"{card}: is a {model.kind}, not a recogniser")
        learned, held_out = _known(views, model, card)
        known, calibrating = (
            _Items(views, card, model, learned, LEARNED_VIEWS, rng),
            _Items(views, card, model, held_out, HELD_OUT_VIEWS, rng),
        )
        for items, path in zip((known, calibrating), sensed or (), strict=False):
            items.add_sensed(path, rng)
        synthetic = _outliers(views, meshes, card, model, (outliers, seed, sensed is not None), rng)
        novel = features_of(outlier_features, synthetic, workers, track, "synthetic outliers")
        if not any(map(len, novel)):
            raise DatasetError(f"{meshes}: no outlier could be made of its meshes")
        ordinary = features_of(known_features, known.views, workers, track, "objects that it was trained on")
        others = features_of(known_features, calibrating.views, workers, track, "held-out objects")
        enough = [k for k, rows in enumerate(others) if len(rows) == HELD_OUT_VIEWS]
        novelty = fit_novelty(
            np.concatenate([rows for rows in ordinary if len(rows)]),
            known.labels.repeat([len(rows) for rows in ordinary]),
            np.concatenate([rows for rows in novel if len(rows)]),
            np.stack([others[k] for k in enough]),
            calibrating.labels[enough],
            rng,
        )
        number = sum(len(rows) > 0 for rows in novel)
        write(
            msgspec.structs.replace(model, novelty_sha256="")
        )  # killed between the two files, this leaves no hash of another score
        sha256 = novelty.save(novelty_path(model.path), overwrite=True)
        about = (
            f"{len(learned)} objects of the training split and {number} synthetic outliers, calibrated on "
            f"{len(held_out)} others" + ", clean and through sensors" * (sensed is not None)
        )
        model = msgspec.structs.replace(model, novelty_sha256=sha256, fitted_to={**model.fitted_to, "novelty": about})
        write(model.made_by(*views.commands, command()))
    return FittedUnknown(len(learned), number, len(held_out))


def _known(views: ViewStore, model: ModelCard, card: Path) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the objects that a recogniser was trained on, and of those held out."""
    known = np.array([name in model.classes for name in views.classes])[views.labels]
    usable = np.flatnonzero(views.done & (views.splits != "test") & known)
    aside = np.isin(np.array(views.names)[usable], model.held_out)
    learned, held_out = usable[~aside], usable[aside]
    if len(learned) == 0 or len(held_out) == 0:
        raise DatasetError(f"{views.path}: holds no object that {card} was trained on, or none that it calls held out")
    return learned, held_out[deduplicated(views.labels[held_out], views.measure()[held_out])]


class _Items:
    """Views of known objects, drawn at random, and the labels of their objects."""

    def __init__(
        self,
        store: ViewStore,
        card: Path,
        model: ModelCard,
        rows: NDArray[np.int64],
        wanted: int,
        rng: np.random.Generator,
    ) -> None:
        self.names, self.card, self.wanted = [store.names[i] for i in rows], card, wanted
        classes = np.array([model.classes.index(name) if name in model.classes else -1 for name in store.classes])
        self.views, self.labels = self._draw(store, rows, rng), classes[store.labels[rows]]

    def add_sensed(self, path: Path, rng: np.random.Generator) -> None:
        """Add views of the same objects from another store."""
        store = ViewStore.open(path)
        done = store.done
        row = {name: i for i, name in enumerate(store.names) if done[i]}
        there = [k for k, name in enumerate(self.names) if name in row]
        if not there:
            raise DatasetError(f"{path}: holds none of {len(self.names)} objects, {self.names[0]} among them")
        self.views += self._draw(store, np.array([row[self.names[k]] for k in there]), rng)
        self.labels = np.concatenate([self.labels, self.labels[there]])

    def _draw(self, store: ViewStore, rows: NDArray[np.int64], rng: np.random.Generator) -> list[KnownViews]:
        path, card, n = str(store.path.absolute()), str(self.card.absolute()), len(store.sphere)
        return [KnownViews(path, card, int(i), tuple(rng.permutation(n).tolist()), self.wanted) for i in rows]


def _outliers(
    views: ViewStore,
    meshes: Path,
    card: Path,
    model: ModelCard,
    options: tuple[int, int, bool],
    rng: np.random.Generator,
) -> list[OutlierViews]:
    """So many synthetic outliers from a seed, every second one through sensors if wanted."""
    number, seed, sensed = options
    paths = [
        str(e.path.absolute())
        for e in list_dataset(meshes)
        if e.split in ("train", "") and e.name not in model.held_out
    ]
    if not paths:
        raise DatasetError(f"{meshes}: holds no mesh to make outliers of")
    place = str(views.path.absolute()), str(card.absolute())
    outliers = []
    for k, at in enumerate(rng.integers(len(paths), size=(number, 2))):
        chosen = tuple(rng.permutation(len(views.sphere))[:OUTLIER_VIEWS].tolist())
        sensor = "mix" if sensed and (k // len(FAMILIES)) % 2 else None
        family, seed_of_it = FAMILIES[k % len(FAMILIES)], k + seed * number
        outliers.append(OutlierViews(*place, family, paths[at[0]], paths[at[1]], chosen, seed_of_it, sensor))
    return outliers


def known_features(item: KnownViews) -> NDArray[np.float32]:
    """Features of stored views in which anything is seen, (views, F)."""
    store, recogniser = _open(item.store, item.card)
    seen = np.any(store.depth(item.row) > 0, axis=(1, 2))
    views = np.array([view for view in item.views if seen[view]][: item.wanted], np.int64)
    if not len(views):
        return NONE
    return recogniser.features(from_store(recogniser.card.input, store, item.row, views))


def outlier_features(item: OutlierViews) -> NDArray[np.float32]:
    """Features of views of a synthetic outlier, (views, F); none if it cannot be made, or is not seen."""
    store, recogniser = _open(item.store, item.card)
    try:
        mesh = load_mesh(item.mesh)
        other = load_mesh(item.other) if item.family == "joined" else mesh
        mesh = synthetic_outlier(item.family, mesh, other, np.random.default_rng(item.seed))
    except MeshError:  # a mesh of the folder that cannot be read, or a part without area
        return NONE
    if item.sensor is None:
        camera: Camera = SimulatedCamera(mesh, store.attributes.size, store.sphere.distance)
    else:
        camera = SensedCamera(mesh, item.sensor, np.random.default_rng([item.seed, 1]))
    observations = [camera.observe(store.sphere.poses[view]) for view in item.views]
    kept = [o for o in observations if o.seen]
    return recogniser.features(from_observations(recogniser.card.input, kept)) if kept else NONE


def features_of(
    function: Callable[[Any], NDArray[np.float32]],
    items: Sequence[Any],
    workers: int | None,
    track: Track,
    what: str,
) -> list[NDArray[np.float32]]:
    """What a function gives for each item, in their order, computed side by side."""
    features = dict.fromkeys(items, NONE)

    def work() -> Iterator[int]:
        for done, (item, result) in enumerate(each(function, items, workers), 1):
            if isinstance(result, WorkerDied):
                raise DatasetError(f"{what}: {result}")
            features[item] = result
            yield done

    track(work(), len(items), what)
    return [features[item] for item in items]


@lru_cache(maxsize=1)
def _open(store: str, card: str) -> tuple[ViewStore, Recogniser]:
    return ViewStore.open(Path(store)), Recogniser(card, threads=1)
