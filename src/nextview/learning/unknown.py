"""Notice objects of no known class: synthetic outliers, a novelty score, and the fit of it to a recogniser."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

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
from nextview.data.splits import deduplicate
from nextview.data.store import ViewStore
from nextview.errors import DatasetError, MeshError
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
Features = NDArray[np.float32]

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
    first, step = np.arange(len(profile) - 1)[:, None] * sides, np.arange(sides)
    low, after = (first + step).ravel(), (first + (step + 1) % sides).ravel()
    corners = [low, after, after + sides], [low, after + sides, low + sides]
    return vertices, np.concatenate([np.stack(corner, 1) for corner in corners]).astype(np.int32)


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
    """A novelty score, standardised and calibrated on objects that the recogniser was not trained on.

    ``known`` and ``outliers`` are features of views, (rows, F); ``held_out`` those of objects, (objects, views, F).
    """
    middle, directions, _ = principal_components(known, DISTANCE_DIRECTIONS)
    kept = rng.permutation(len(known))[:NEIGHBOURS]
    hidden, hidden_bias, output, output_bias = fit_perceptron(known, labels, outliers, rng)
    raw = Novelty(
        middle=middle.astype(np.float32),
        directions=_as_stored(directions),
        neighbours=_as_stored(unit((known[kept] - middle) @ directions)),
        hidden=_as_stored(hidden),
        hidden_bias=(hidden_bias + middle @ hidden).astype(np.float32),  # the middle is taken from features first
        output=output.astype(np.float32),
        output_bias=output_bias.astype(np.float32),
        standard=np.array([[0, 1], [0, 1]], np.float32),
        quantiles=np.zeros((1, 2), np.float32),
        objects=np.array([len(held_out)]),
    )
    rows = held_out.reshape(-1, held_out.shape[-1])
    parts = raw.parts(rows)
    ready = replace(raw, standard=np.stack([parts.mean(0), parts.std(0)], 1).astype(np.float32))
    scores = ready.scores(rows).reshape(held_out.shape[:2])
    return replace(ready, quantiles=quantiles(scores, held_out_labels, n_views))


def _as_stored(table: NDArray[np.floating]) -> NDArray[np.float32]:
    """Rounded as ``Novelty.save`` rounds, so that what is calibrated is what is read."""
    return in_half(table).astype(np.float32)


def principal_components(rows: Float, most: int) -> tuple[Float, Float, Float]:
    """Middle (F,), directions (F, D) and variances along these (D,) of the largest components, in descending order."""
    middle, f = rows.mean(0), rows.shape[1]
    centred = rows - middle
    variances, directions = eigh(centred.T @ centred / len(rows), subset_by_index=[max(0, f - most), f - 1])
    kept = variances > 1e-6 * variances.max()
    return middle, directions[:, kept][:, ::-1], variances[kept][::-1]


def fit_perceptron(
    known: Float, labels: NDArray[np.int64], outliers: Float, rng: np.random.Generator
) -> tuple[Float, Float, Float, Float]:
    """A perceptron with one hidden layer of tanh that is above zero for outliers."""
    rows = np.concatenate([known, outliers])
    middle, directions, variances = principal_components(rows, PERCEPTRON_DIRECTIONS)
    whiten = directions / np.sqrt(variances)
    rows = ((rows - middle) @ whiten).astype(np.float32)
    truth = np.repeat([0.0, 1.0], [len(known), len(outliers)]).astype(np.float32)
    count = np.bincount(labels)
    of_known = 1 / count[labels] / (count > 0).sum()
    weights = np.concatenate([of_known, np.full(len(outliers), 1 / len(outliers))]).astype(np.float32) / 2
    d = rows.shape[1]

    def layers(parameters: Float) -> tuple[Float, Float, Float, Float]:
        first, bias, second, last = np.split(parameters, np.cumsum([d * HIDDEN, HIDDEN, HIDDEN]))
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
    row: int
    name: str
    views: tuple[int, ...]
    wanted: int


@dataclass(frozen=True)
class OutlierViews:
    """Views of a synthetic outlier, made of two meshes, from the viewpoints and at the size of a store."""

    store: str
    family: str
    meshes: tuple[str, str]
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
        learned, held_out = (dict(zip(*part, strict=True)) for part in _known(views, model, card))
        known = _draw(views, learned, LEARNED_VIEWS, rng)
        judging = _draw(views, held_out, HELD_OUT_VIEWS, rng)
        if sensed:
            known += _draw(ViewStore.open(sensed[0]), learned, LEARNED_VIEWS, rng)
            judging += _draw(ViewStore.open(sensed[1]), held_out, HELD_OUT_VIEWS, rng)
        synthetic = _outliers(views, meshes, model, (outliers, seed, sensed is not None), rng)
        see = partial(features_of, card, workers, track)
        novel = [rows for rows in see(outlier_features, synthetic, "synthetic outliers") if len(rows)]
        if not novel:
            raise DatasetError(f"{meshes}: no outlier could be made of its meshes")
        ordinary = see(known_features, known, "objects that it was trained on")
        others = see(known_features, judging, "held-out objects")
        enough = [k for k, rows in enumerate(others) if len(rows) == HELD_OUT_VIEWS]
        novelty = fit_novelty(
            np.concatenate([rows for rows in ordinary if len(rows)]),
            np.repeat([learned[item.name] for item in known], [len(rows) for rows in ordinary]),
            np.concatenate(novel),
            np.stack([others[k] for k in enough]),
            np.array([held_out[judging[k].name] for k in enough]),
            rng,
        )
        about = f"{len(learned)} objects of the training split and {len(novel)} synthetic outliers, calibrated on "
        about += f"{len(held_out)} others" + ", clean and through sensors" * (sensed is not None)
        # Killed between the two files, this leaves a card without a score, not one with the hash of another.
        write("novelty", "nothing, the fit was cut off", [views], novelty_sha256="")
        write("novelty", about, [views], novelty_sha256=novelty.save(novelty_path(model.path), overwrite=True))
    return FittedUnknown(len(learned), len(novel), len(held_out))


def _known(views: ViewStore, model: ModelCard, card: Path) -> list[tuple[list[str], list[int]]]:
    """Names and labels of the objects that a recogniser was trained on, and of those held out."""
    labels = np.array([model.classes.index(c) if c in model.classes else -1 for c in views.classes])[views.labels]
    usable = np.flatnonzero(views.done & (views.splits != "test") & (labels >= 0))
    aside = np.isin(np.array(views.names)[usable], model.held_out)
    learned, held_out = usable[~aside], usable[aside]
    if len(learned) == 0 or len(held_out) == 0:
        raise DatasetError(f"{views.path}: holds no object that {card} was trained on, or none that it calls held out")
    parts = learned, deduplicate(views, held_out)
    return [([views.names[i] for i in part], labels[part].tolist()) for part in parts]


def _draw(store: ViewStore, names: Iterable[str], wanted: int, rng: np.random.Generator) -> list[KnownViews]:
    """Views in random order of those of some objects that a store holds."""
    row = {store.names[i]: i for i in np.flatnonzero(store.done).tolist()}
    there, path = [name for name in names if name in row], str(store.path.absolute())
    if not there:
        raise DatasetError(f"{store.path}: holds none of the objects to fit to")
    n = len(store.sphere)
    return [KnownViews(path, row[name], name, tuple(rng.permutation(n).tolist()), wanted) for name in there]


def _outliers(
    views: ViewStore, meshes: Path, model: ModelCard, options: tuple[int, int, bool], rng: np.random.Generator
) -> list[OutlierViews]:
    """So many synthetic outliers from a seed, every second one through sensors if wanted."""
    number, seed, sensed = options
    entries = [e for e in list_dataset(meshes) if e.split in ("train", "") and e.name not in model.held_out]
    if not entries:
        raise DatasetError(f"{meshes}: holds no mesh to make outliers of")
    paths, outliers = [str(e.path.absolute()) for e in entries], []
    for k, (one, other) in enumerate(rng.integers(len(paths), size=(number, 2))):
        chosen = tuple(rng.permutation(len(views.sphere))[:OUTLIER_VIEWS].tolist())
        sensor = "mix" if sensed and (k // len(FAMILIES)) % 2 else None
        place, family = str(views.path.absolute()), FAMILIES[k % len(FAMILIES)]
        outliers.append(OutlierViews(place, family, (paths[one], paths[other]), chosen, k + seed * number, sensor))
    return outliers


def known_features(card: str, item: KnownViews) -> Features:
    """Features of stored views in which anything is seen, (views, F)."""
    store, recogniser = _open(item.store, card)
    seen = np.any(store.depth(item.row) > 0, axis=(1, 2))
    views = np.array([view for view in item.views if seen[view]][: item.wanted], np.int64)
    if not len(views):
        return NONE
    return recogniser.features(from_store(recogniser.card.input, store, item.row, views))


def outlier_features(card: str, item: OutlierViews) -> Features:
    """Features of views of a synthetic outlier, (views, F); none if it cannot be made, or is not seen."""
    store, recogniser = _open(item.store, card)
    try:
        mesh, *others = map(load_mesh, item.meshes if item.family == "joined" else item.meshes[:1])
        mesh = synthetic_outlier(item.family, mesh, (others or [mesh])[0], np.random.default_rng(item.seed))
    except MeshError:  # a mesh of the folder that cannot be read, or a part without area
        return NONE
    if item.sensor is None:
        camera: Camera = SimulatedCamera(mesh, store.attributes.size, store.sphere.distance)
    else:
        camera = SensedCamera(mesh, item.sensor, np.random.default_rng([item.seed, 1]))
    kept = [o for view in item.views if (o := camera.observe(store.sphere.poses[view])).seen]
    return recogniser.features(from_observations(recogniser.card.input, kept)) if kept else NONE


def features_of(
    card: Path, workers: int | None, track: Track, function: Callable[..., Features], items: Sequence[Any], what: str
) -> list[Features]:
    """What a function of a card and an item gives for each item, in their order, computed side by side."""
    features = dict.fromkeys(items, NONE)

    def work() -> Iterator[int]:
        for done, (item, result) in enumerate(each(partial(function, str(card.absolute())), items, workers), 1):
            if isinstance(result, WorkerDied):
                raise DatasetError(f"{what}: {result}")
            features[item] = result
            yield done

    track(work(), len(items), what)
    return [features[item] for item in items]


@lru_cache(maxsize=1)
def _open(store: str, card: str) -> tuple[ViewStore, Recogniser]:
    return ViewStore.open(Path(store)), Recogniser(card, threads=1)
