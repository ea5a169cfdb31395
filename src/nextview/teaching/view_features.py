"""Features of the views of things that geometry alone does not separate."""

import zlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from nextview.geometry.mesh import Mesh
from nextview.geometry.observation import Camera, Observation
from nextview.geometry.viewsphere import (
    ViewSphere,
    angle_between,
    direction_of,
    look_at_origin,
)
from nextview.recognition.inference import Features
from nextview.recognition.network_input import from_observations
from nextview.recognition.novelty import unit
from nextview.simulation.sensed_camera import SensedCamera
from nextview.simulation.simulated import SimulatedCamera
from nextview.things.memory import AZIMUTHS, RINGS, joined
from nextview.types import Float, Float32

Arrays = dict[str, NDArray]  # arrays of a thing by their names
HELD_OUT = 8  # held-out views of each thing
SETUP = 8  # views that share the errors of one setup, such as a wrong centre or size
VIEWS_PER_BATCH = 20
MEMORY_GRID = ViewSphere(RINGS, AZIMUTHS)
# largest angle between a cell of the grid and the captured view that fills it
NEAR_CAPTURED = np.radians(30)
# poses of the simulated views of the sensor
SENSED = MEMORY_GRID.poses.reshape(len(RINGS), AZIMUTHS, 4, 4)[::2, ::2].reshape(
    -1,
    4,
    4,
)
EmbeddingParts = Iterator[Float32]  # batches of embeddings, (.., F) each, in order


def without_features(poses: int) -> Arrays:
    """Placeholder arrays of a thing without stored views.

    Args:
        poses: number of resting poses.

    Returns:
        Empty arrays views, held_out and held_out_views of ``things.memory.Memory``.
    """
    return {
        "views": np.zeros((poses, len(RINGS), AZIMUTHS, 0), np.float16),
        "held_out": np.zeros((0, 0), np.float16),
        "held_out_views": np.zeros((0, 2), np.float32),
    }


def features_of(
    lying: Sequence[Mesh],
    name: str,
    sensor: str,
    seed: int,
    threads: int = 1,
) -> Arrays:
    """Render a thing in its resting poses, and compute the features of its views.

    Args:
        lying: the mesh in each resting pose.
        name: name of the thing; together with the seed it determines all random draws.
        sensor: camera of the views, see ``sensor_named``.
        seed: seed of all random draws.
        threads: number of threads.

    Returns:
        The arrays views, held_out and held_out_views of ``things.memory.Memory``.
    """
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    directions = (
        np.arcsin(rng.uniform(0, np.sin(np.radians(RINGS[-1])), HELD_OUT)),
        rng.uniform(0, 2 * np.pi, HELD_OUT),
    )
    with ThreadPoolExecutor(threads) as pool:
        # A random resting pose: things do lie in practice, and calibration and the false-alarm rate
        # for strangers depend on it.
        shown_pose = lying[int(rng.integers(len(lying)))]
        held_out = _sensed(
            pool,
            shown_pose,
            look_at_origin(*directions),
            sensor,
            rng,
        )
        clean = [_clean(pool, each) for each in lying]
        sensed = [_sensed(pool, each, SENSED, sensor, rng) for each in lying]
        around = [_around(*both) for both in zip(clean, sensed, strict=True)]
        shown = np.concatenate(list(held_out))
    return {
        "views": np.stack(around).astype(np.float16),
        "held_out": shown.astype(np.float16),
        "held_out_views": np.stack(directions, 1).astype(np.float32),
    }


def _around(clean: EmbeddingParts, sensed: EmbeddingParts) -> Float32:
    """Mean embeddings of clean and sensed views on the grid, (rings, azimuths, F)."""
    ideal = np.concatenate(list(clean)).reshape(len(RINGS), AZIMUTHS, -1)
    through = np.zeros_like(ideal)
    # Interpolate between the rings and azimuths of the sensed views.
    through[::2, ::2] = np.concatenate(list(sensed)).reshape(
        len(RINGS[::2]),
        AZIMUTHS // 2,
        -1,
    )
    through[::2, 1::2] = unit(through[::2, ::2] + np.roll(through[::2, ::2], -1, 1))
    through[1::2] = unit(through[:-1:2] + through[2::2])
    return joined(ideal, through)


def _clean(pool: ThreadPoolExecutor, mesh: Mesh) -> EmbeddingParts:
    """Embeddings of the noise-free views of the grid."""
    camera = SimulatedCamera(mesh)
    return pool.map(
        partial(_seen, camera),
        np.split(MEMORY_GRID.poses, len(MEMORY_GRID) // VIEWS_PER_BATCH),
    )


def _sensed(
    pool: ThreadPoolExecutor,
    mesh: Mesh,
    poses: Float,
    sensor: str,
    rng: Generator,
) -> EmbeddingParts:
    """Embeddings of views of a mesh through a sensor, from poses, (B, 4, 4)."""
    parts = np.split(poses, range(SETUP, len(poses), SETUP))
    cameras = (
        partial(SensedCamera, mesh, sensor, own) for own in rng.spawn(len(parts))
    )
    return pool.map(lambda camera, part: _seen(camera(), part), cameras, parts)


def _seen(camera: Camera, poses: Float) -> Float32:
    return embeddings([camera.observe(pose) for pose in poses])


def features_captured(seen: list[Observation]) -> Arrays:
    """Compute the features of captured views; each cell of the grid gets those of the nearest view.

    Args:
        seen: views that show the thing. Every fourth is held out.

    Returns:
        The arrays views, held_out and held_out_views of ``things.memory.Memory``.
    """
    directions = np.stack([direction_of(view.pose) for view in seen])
    each = embeddings(seen)
    kept = np.arange(len(seen)) % 4 < 3 if len(seen) > 4 else np.ones(len(seen), bool)
    arc = angle_between(MEMORY_GRID.directions[:, None], directions[kept][None])
    views = np.where(arc.min(1)[:, None] < NEAR_CAPTURED, each[kept][arc.argmin(1)], 0)

    # held-out views
    rest = np.flatnonzero(~kept) if not kept.all() else np.arange(len(seen))
    held_out = np.resize(rest, HELD_OUT)
    angles = np.stack(
        [np.arcsin(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])],
        1,
    )
    return {
        "views": views.reshape(1, len(RINGS), AZIMUTHS, -1).astype(np.float16),
        "held_out": each[held_out].astype(np.float16),
        "held_out_views": angles[held_out].astype(np.float32),
    }


@lru_cache(maxsize=1)
def _features() -> Features:
    return Features(threads=1)


def embeddings(observations: list[Observation]) -> Float32:
    """Embeddings of views of one camera; zero for a view that does not show the object.

    Args:
        observations: B views.

    Returns:
        Unit vectors, (B, F) float32.
    """
    network = _features()
    inputs = from_observations(network.card.input, observations)
    parts = [
        network(inputs[start : start + VIEWS_PER_BATCH])
        for start in range(0, len(inputs), VIEWS_PER_BATCH)
    ]
    return (
        np.concatenate(parts) * np.array([view.seen for view in observations])[:, None]
    )
