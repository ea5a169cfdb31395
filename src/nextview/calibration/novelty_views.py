"""Features of the views to which a novelty score is fitted: of known objects and of made-up ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.calibration.outliers import make_up
from nextview.cameras.sensors import SensedCamera
from nextview.cameras.simulated import SimulatedCamera
from nextview.data.pool import WorkerDied, each
from nextview.data.store import ViewStore
from nextview.errors import DatasetError, MeshError
from nextview.mesh import load_mesh
from nextview.models.inference import Recogniser
from nextview.models.network_input import from_observations, from_store
from nextview.observation import Camera
from nextview.tracking import Track

Known = tuple[str, str, int, tuple[int, ...], int]
"""Store, card of the recogniser, object, all its views in some order, and how many of them are wanted."""
MadeUp = tuple[str, str, str, str, str, tuple[int, ...], int, str | None]
"""Store whose viewpoints and image size count, card, family, mesh to begin with and another, views, seed, sensor."""


def known_features(item: Known) -> NDArray[np.float32]:
    """Features of the first few stored views of one object in which anything is seen, (views, F)."""
    store, card, i, order, wanted = item
    opened, recogniser = _open(store, card)
    seen = np.any(opened.depth(i) > 0, axis=(1, 2))
    views = np.array([view for view in order if seen[view]][:wanted], np.int64)
    if not len(views):
        return np.zeros((0, 0), np.float32)
    return recogniser.features(from_store(recogniser.card.input, opened, i, views))


def made_up_features(item: MadeUp) -> NDArray[np.float32]:
    """Features of some views of a made-up object, (views, F); (0, F) where nothing came of it, or nothing is seen."""
    store, card, family, one, other, views, seed, sensor = item
    opened, recogniser = _open(store, card)
    try:
        first = load_mesh(one)
        mesh = make_up(family, first, load_mesh(other) if family == "joined" else first, np.random.default_rng(seed))
    except MeshError:  # a mesh of the folder that cannot be read, or a part without area
        return np.zeros((0, 0), np.float32)
    if sensor is None:
        camera: Camera = SimulatedCamera(mesh, opened.group.attrs["size"], opened.sphere.distance)
    else:
        camera = SensedCamera(mesh, sensor, np.random.default_rng([seed, 1]))
    observations = [camera.observe(opened.sphere.poses[view]) for view in views]
    kept = [o for o in observations if o.seen]
    if not kept:
        return np.zeros((0, 0), np.float32)
    return recogniser.features(from_observations(recogniser.card.input, kept))


def features_of(
    function: Callable[[Any], NDArray[np.float32]],
    items: Sequence[Any],
    workers: int | None,
    progress: Track,
    what: str,
) -> list[NDArray[np.float32]]:
    """What a function gives for each item, in the order of the items, worked out side by side.

    Raises:
        DatasetError: a process died, twice.
    """
    row = {item: k for k, item in enumerate(items)}
    found: list[NDArray[np.float32]] = [np.zeros((0, 0), np.float32)] * len(items)

    def work() -> Iterator[int]:
        for done, (item, features) in enumerate(each(function, items, workers), 1):
            if isinstance(features, WorkerDied):
                raise DatasetError(f"{what}: {features}")
            found[row[item]] = features
            yield done

    progress(work(), len(items), what)
    return found


@lru_cache(maxsize=1)
def _open(store: str, card: str) -> tuple[ViewStore, Recogniser]:
    return ViewStore.open(Path(store)), Recogniser(card, threads=1)
