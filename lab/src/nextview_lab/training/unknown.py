"""Fit the novelty score of a recogniser to views of its known objects."""

import logging
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.random import Generator

from nextview.data.folders import Entry, left_out_phrases, list_dataset
from nextview.data.pool import WorkerDied, each
from nextview.data.progress import TrackProgress, silently
from nextview.errors import DatasetError, MeshError
from nextview.geometry.mesh import load_mesh
from nextview.geometry.viewsphere import look_at_origin
from nextview.recognition.inference import Features
from nextview.recognition.network_input import from_observations
from nextview.recognition.novelty import Novelty, as_stored, novelty_path
from nextview.sensing.observation import Camera, Observation
from nextview.simulation.sensed_camera import SensedCamera
from nextview.simulation.sensor import sensor_named
from nextview.simulation.simulated import SimulatedCamera
from nextview.types import Float, Float32, Index
from nextview_lab.data.rendering import Deform
from nextview_lab.training.fitting_set import card_to_fit

REMEMBERED_VIEWS = 3
"""Stored views of each known object in its original shape, and as many of a stretched copy."""
CALIBRATION_VIEWS = 5
"""Views of each held-out object, for each deformation, through the sensor and without one."""
MAX_ELEVATION = np.radians(75.0)
"""Views are drawn between the horizontal plane and this elevation."""
DEFORMATIONS = (Deform(rotated=True), Deform(stretch=0.25, rotated=True))
"""Real objects are not aligned with the axes of a dataset, and few have the proportions of one of
its meshes.
"""
QUANTILES_FITTED = 201  # number of quantiles
VIEWS_PER_BATCH = 20

_log = logging.getLogger("nextview")


@dataclass(frozen=True)
class FittedUnknown:
    """Result of ``fit_unknown``.

    Attributes:
        objects: number of objects with stored views.
        held_out: number of other objects, on which the score was calibrated.
        left_out: number of meshes left out; the log gives names and reasons.
    """

    objects: int
    held_out: int
    left_out: int = 0


def fit_unknown(
    meshes: Path,
    card: Path,
    sensor: str = "wrist",
    seed: int = 0,
    workers: int | None = None,
    track: TrackProgress = silently,
) -> FittedUnknown:
    """Fit the detection of objects of unknown classes, at a chosen false-alarm rate.

    The novelty score of a view is its distance to the nearest stored views of the training objects.
    The scores of known classes are measured on the objects that the card lists as held out. All
    objects are rotated about the vertical at random; half of them are stretched. The stored views
    are written to NAME.novelty.safetensors next to the card, and their SHA-256 to the card. An
    interrupted run starts over.

    Args:
        meshes: folder of the meshes that the recogniser was trained on; its test split is not used.
        card: card of the recogniser.
        sensor: simulated depth camera for half of the calibration views, NAME or NAME:STRENGTH.
        seed: seed of all random numbers.
        workers: number of processes; by default one per core.
    """
    sensor_named(sensor)  # raises an error before any work is done
    with card_to_fit(card) as (model, write):
        entries = [
            e
            for e in list_dataset(meshes)
            if e.split != "test" and e.label in model.classes
        ]
        look = partial(_looked_at, frozenset(model.held_out), sensor, seed)
        seen: dict[Entry, Float32] = {}
        left_out: list[tuple[Path, str]] = []

        def work() -> Iterator[int]:
            for done, (entry, views) in enumerate(each(look, entries, workers), 1):
                if isinstance(views, str | WorkerDied):
                    left_out.append((entry.path, str(views)))
                else:
                    seen[entry] = views
                yield done

        track(work(), len(entries), f"views of {meshes.name}")
        for phrase in left_out_phrases(left_out):
            _log.warning("left out: %s", phrase)
        known = [seen[e] for e in entries if e in seen and e.name not in model.held_out]
        held_out = [e for e in entries if e in seen and e.name in model.held_out]
        if not known or not held_out:
            raise DatasetError(
                f"{meshes}: holds no object that {card} was trained on, or none that it calls"
                " held out"
            )

        labels = np.array([model.classes.index(e.label) for e in held_out])
        novelty = fit_novelty(
            np.concatenate(known),
            np.stack([seen[e] for e in held_out]),
            labels,
        )
        about = (
            f"{len(known)} objects of the training split, calibrated on {len(held_out)} others,"
            " turned at random and half of them stretched, half of the views through the sensor"
            f" {sensor}"
        )
        # An interruption between the two files leaves a card without a score, not one with a wrong
        # hash.
        write("novelty", "nothing, the fit was cut off", [], novelty_sha256="")
        write(
            "novelty",
            about,
            [],
            novelty_sha256=novelty.save(novelty_path(model.path), overwrite=True),
        )
    return FittedUnknown(len(known), len(held_out), len(left_out))


def _looked_at(
    held_out: frozenset[str],
    sensor: str,
    seed: int,
    entry: Entry,
) -> Float32 | str:
    """Return embeddings of views of a mesh, or the reason why there are none.

    For a held-out object, of each deformation through the sensor, then of each without one,
    (2 deformations, views, F). For any other, noise-free views, (deformations, views, F).
    """
    rng = np.random.default_rng([seed, zlib.crc32(entry.name.encode())])
    try:
        mesh = load_mesh(entry.path)
    except MeshError as error:
        return str(error).removeprefix(f"{entry.path}: ")

    objects = [deform(mesh, seed, entry.name) for deform in DEFORMATIONS]
    cameras: list[Camera] = [SimulatedCamera(thing) for thing in objects]
    wanted = REMEMBERED_VIEWS
    if entry.name in held_out:
        sensed = [SensedCamera(thing, sensor, rng) for thing in objects]
        cameras = [*sensed, *cameras]
        wanted = CALIBRATION_VIEWS

    found = []
    for camera in cameras:
        views = _random_views(camera, wanted, rng)
        if len(views) < wanted:
            return "it is seen from too few directions"
        found.append(views)
    return np.stack(found)


def _random_views(camera: Camera, wanted: int, rng: Generator) -> Float32:
    """Return embeddings of views from random directions, (views, F).

    There are fewer if the object is often not visible.
    """
    tries = 4 * wanted
    elevations = rng.uniform(0, MAX_ELEVATION, tries)
    azimuths = rng.uniform(0, 2 * np.pi, tries)
    views = map(camera.observe, look_at_origin(elevations, azimuths))
    seen = list(islice((view for view in views if view.seen), wanted))
    return _embeddings(seen) if seen else np.zeros((0, 0), np.float32)


@lru_cache(maxsize=1)
def _features() -> Features:
    return Features(threads=1)


def _embeddings(views: list[Observation]) -> Float32:
    """Return the embeddings of views of one camera, unit vectors, (B, F)."""
    network = _features()
    inputs = from_observations(network.card.input, views)
    starts = range(0, len(inputs), VIEWS_PER_BATCH)
    return np.concatenate([network(inputs[k : k + VIEWS_PER_BATCH]) for k in starts])


def fit_novelty(
    known: Float32,
    held_out: Float32,
    labels: Index,
    n_views: int = CALIBRATION_VIEWS,
) -> Novelty:
    """Return a novelty score of views, calibrated on objects that are not among the known ones.

    Args:
        known: embeddings of views to store, (..., F).
        held_out: embeddings of views of N other objects, (N, conditions, views, F); the first half
            of the conditions through a sensor, the others without sensor errors.
        labels: classes of these N objects, (N,).
        n_views: largest number of views of an object for which the mean score is calibrated.
    """
    rows = as_stored(known.reshape(-1, known.shape[-1]))
    plain = np.array([[0, 1], [0, 1]], np.float32)
    raw = Novelty(np.zeros((1, 2), np.float32), np.array([len(held_out)]), rows, plain)
    scores = np.stack(
        [
            raw.scores(views.reshape(-1, rows.shape[1])).reshape(views.shape[:-1])
            for views in held_out
        ]
    )

    objects, conditions, views = scores.shape
    # through a sensor, and without one
    ways = scores.reshape(objects, 2, conditions // 2 * views)
    standard = np.stack([ways.mean((0, 2)), ways.std((0, 2))], 1).astype(np.float32)

    of_condition = standard[np.repeat([0, 1], conditions // 2)]
    scores = (scores - of_condition[:, :1]) / of_condition[:, 1:]
    rows_of_scores = scores.transpose(1, 0, 2).reshape(-1, views)
    table = quantiles(rows_of_scores, np.tile(labels, conditions), n_views)
    return replace(raw, standard=standard, quantiles=table)


def quantiles(scores: Float, labels: Index, n_views: int) -> Float32:
    """Return quantiles of the mean score over several views, with classes weighted evenly.

    Args:
        scores: of the views of each object, (N, V).
        labels: class of each object, (N,) int64.
        n_views: largest number of views.

    Returns:
        Quantiles, (views, QUANTILES_FITTED) float32, ascending.
    """
    count = np.bincount(labels)
    share_of = 1 / count[labels]
    levels = []
    for n in range(1, min(n_views, scores.shape[1]) + 1):
        draws = scores.shape[1] // n
        means = scores[:, : draws * n].reshape(len(scores), draws, n).mean(2)
        order = np.argsort(means, axis=None)
        weight = np.repeat(share_of, draws)[order]
        share = (np.cumsum(weight) - weight / 2) / weight.sum()
        levels.append(
            np.interp(np.linspace(0, 1, QUANTILES_FITTED), share, means.ravel()[order])
        )
    return np.array(levels, np.float32)
