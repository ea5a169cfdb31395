"""Learn to notice objects of no known class: what objects of the known ones look like, and how novel others of them."""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.data.folders import Entry, list_dataset
from nextview.data.pool import WorkerDied, each
from nextview.data.progress import Track, silently
from nextview.errors import DatasetError, MeshError
from nextview.geometry.mesh import load_mesh
from nextview.geometry.viewsphere import ViewSphere
from nextview.learning.fitting_set import card_to_fit
from nextview.learning.teaching import embeddings
from nextview.recognition.novelty import Novelty, novelty_path
from nextview.simulation.sensed_camera import SensedCamera
from nextview.simulation.simulated import SimulatedCamera

Float32 = NDArray[np.float32]
LEARNED_VIEWS, HELD_OUT_VIEWS = 2, 5
"""Views of each object without a sensor's errors, and as many through it."""
LEVELS = 201  # of the quantiles


@dataclass(frozen=True)
class FittedUnknown:
    """What ``fit_unknown`` fitted to."""

    objects: int
    held_out: int


def fit_unknown(
    meshes: Path,  # folder of the meshes that the recogniser was trained on; those of the test split are left out
    card: Path,  # of the recogniser
    sensor: str = "wrist",  # through which half of the views are taken, see simulation.sensor.sensor_named
    seed: int = 0,  # of all that is drawn
    workers: int | None = None,  # processes; one for each core by default
    track: Track = silently,
) -> FittedUnknown:
    """Teach a recogniser to notice objects of no class that it knows, at a false-alarm rate that can be chosen.

    It remembers views of its training objects, and how novel views of the objects are that its card calls held out. The
    novelty score goes into NAME.novelty.safetensors beside the card, and its SHA-256 into the card. When stopped, it
    begins anew.
    """
    with card_to_fit(card) as (model, write):
        entries = [e for e in list_dataset(meshes) if e.split != "test" and e.label in model.classes]
        look = partial(_looked_at, frozenset(model.held_out), sensor, seed)
        seen: dict[Entry, Float32] = {}

        def work() -> Iterator[int]:
            for done, (entry, views) in enumerate(each(look, entries, workers), 1):
                if not isinstance(views, WorkerDied) and len(views):
                    seen[entry] = views
                yield done

        track(work(), len(entries), f"views of {meshes.name}")
        known = [seen[e] for e in entries if e in seen and e.name not in model.held_out]
        held_out = [e for e in entries if e in seen and e.name in model.held_out]
        if not known or not held_out:
            raise DatasetError(f"{meshes}: holds no object that {card} was trained on, or none that it calls held out")
        labels = np.array([model.classes.index(e.label) for e in held_out])
        novelty = fit_novelty(np.concatenate(known, 1), np.stack([seen[e] for e in held_out]), labels)
        about = f"{len(known)} objects of the training split, calibrated on {len(held_out)} others, half of the views "
        about += f"through the sensor {sensor}"
        # Killed between the two files, this leaves a card without a score, not one with the hash of another.
        write("novelty", "nothing, the fit was cut off", [], novelty_sha256="")
        write("novelty", about, [], novelty_sha256=novelty.save(novelty_path(model.path), overwrite=True))
    return FittedUnknown(len(known), len(held_out))


def _looked_at(held_out: frozenset[str], sensor: str, seed: int, entry: Entry) -> Float32:
    """Embeddings of views of a mesh through a sensor, and without one, (2, views, F); none if it cannot be seen."""
    rng = np.random.default_rng([seed, zlib.crc32(entry.name.encode())])
    wanted, poses = HELD_OUT_VIEWS if entry.name in held_out else LEARNED_VIEWS, ViewSphere.named("40").poses
    try:
        mesh = load_mesh(entry.path)
    except MeshError:
        return np.zeros((0, 0, 0), np.float32)
    found = []
    for camera in (SensedCamera(mesh, sensor, rng), SimulatedCamera(mesh)):
        views = (camera.observe(poses[view]) for view in rng.permutation(len(poses))[: 4 * wanted])
        kept = [view for view, _ in zip((v for v in views if v.seen), range(wanted), strict=False)]
        if len(kept) < wanted:
            return np.zeros((0, 0, 0), np.float32)
        found.append(embeddings(kept))
    return np.stack(found)


def fit_novelty(known: Float32, held_out: Float32, labels: NDArray[np.int64], n_views: int = 5) -> Novelty:
    """A novelty score of views, calibrated on objects that are not among the known ones.

    ``known`` are embeddings of views through a sensor and without one, (2, rows, F), ``held_out`` those of N objects,
    (N, 2, views, F), ``labels`` the classes of these, (N,).
    """
    rows = known.reshape(-1, known.shape[-1]).astype(np.float16).astype(np.float32)  # as they are stored
    raw = Novelty(np.zeros((1, 2), np.float32), np.array([len(held_out)]), rows, np.array([[0, 1], [0, 1]], np.float32))
    scores = np.stack([raw.scores(views.reshape(-1, rows.shape[1])).reshape(views.shape[:-1]) for views in held_out])
    standard = np.stack([scores.mean((0, 2)), scores.std((0, 2))], 1).astype(np.float32)
    scores = (scores - standard[:, :1]) / standard[:, 1:]
    table = quantiles(np.concatenate([scores[:, 0], scores[:, 1]]), np.tile(labels, 2), n_views)
    return replace(raw, standard=standard, quantiles=table)


def quantiles(scores: NDArray[np.float64], labels: NDArray[np.int64], n_views: int) -> Float32:
    """Quantiles of the mean score over 1 to ``n_views`` views, classes weighted evenly: (views, LEVELS), ascending."""
    count = np.bincount(labels)
    share_of, levels = 1 / count[labels], []
    for n in range(1, min(n_views, scores.shape[1]) + 1):
        draws = scores.shape[1] // n
        means = scores[:, : draws * n].reshape(len(scores), draws, n).mean(2)
        order = np.argsort(means, axis=None)
        weight = np.repeat(share_of, draws)[order]
        share = (np.cumsum(weight) - weight / 2) / weight.sum()
        levels.append(np.interp(np.linspace(0, 1, LEVELS), share, means.ravel()[order]))
    return np.array(levels, np.float32)
