"""Look at one thing: its surface and symmetries, and the features of its views where they count."""

import zlib
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from nextview.captured.bag import is_bag
from nextview.captured.camera import CapturedCamera
from nextview.captured.check import summary
from nextview.captured.folders import is_capture, read_capture
from nextview.captured.frames import Capture
from nextview.captured.turntable import read_turntable
from nextview.checks import one_of, whole
from nextview.errors import DatasetError, ObservationError
from nextview.geometry.mesh import UNITS, Y_UP, Mesh, is_y_up, load_mesh, mesh_warnings
from nextview.geometry.observation import Camera, Observation
from nextview.geometry.resting import resting_poses, rotated
from nextview.geometry.viewsphere import (
    ViewSphere,
    angle_between,
    direction_of,
    look_at_origin,
)
from nextview.recognition.inference import Features
from nextview.recognition.model_card import Symmetry
from nextview.recognition.network_input import from_observations
from nextview.recognition.novelty import unit
from nextview.sensing.tabletop import LOWEST_TOP
from nextview.simulation.sensed_camera import SensedCamera
from nextview.simulation.sensor import sensor_named
from nextview.simulation.simulated import SimulatedCamera
from nextview.teaching.symmetries import named_symmetries
from nextview.things.fusion import fuse
from nextview.things.memory import AZIMUTHS, RINGS, joined
from nextview.things.surface import FINEST_ERROR, Surface
from nextview.things.symmetry import find_near_symmetries, find_symmetries
from nextview.types import Float, Float32

Arrays = dict[str, NDArray]
HELD_OUT = 8  # views of each thing that are not remembered
SETUP = 8  # views that share the errors of one setup: a wrong centre, a wrong size
VIEWS_PER_BATCH = 20
# a captured view teaches what the thing looks like from no farther than this
NEAR_CAPTURED = np.radians(30)
MEMORY_GRID = ViewSphere(RINGS, AZIMUTHS)
# poses of views through the sensor
SENSED = MEMORY_GRID.poses.reshape(len(RINGS), AZIMUTHS, 4, 4)[::2, ::2].reshape(
    -1,
    4,
    4,
)
# of a thing's arrays: a phrase about the frames that were not used; it is not remembered
LEFT_OUT = "left_out"
# of a thing's arrays: whether it is known only as it stands, (1,) bool
UPRIGHT = "upright"
# of a thing's arrays: its surface, if its size is known
VERTICES = "vertices"
FACES = "faces"
SYMMETRIES = "symmetries"  # and the axis and order of each of its symmetries, (S, 4)
NEAR_SYMMETRIES = "near_symmetries"  # and of each near symmetry
# of the radius: a camera stands farther from a large thing, and measures it less exactly
COARSER = 0.002
EmbeddingParts = Iterator[Float32]  # of embeddings, (.., F) each, in order


@dataclass(frozen=True)
class TeachingOptions:
    """How things are taught.

    Attributes:
        unit: unit of length of the mesh files; with it, size counts as evidence, and things are
            recognised by their geometry.
        up: up axis of the mesh files; by default z, and y for GLB.
        upright: the things only stand as in their files; by default they may also lie.
        sensor: camera that will look at the things: kinect, stereo, setup, wrist or none, or
            NAME:STRENGTH.
        largest_part: keep only the largest connected part of each mesh.
        any_size: accept things of very different sizes.
        one_class: things that are all in one folder are one class; --add assumes this.
        symmetry: symmetries of things for which they shall not be found, in the axes of their
            files: NAME=none, NAME=z (any angle), NAME=z:6 (order 6), NAME=z:4,x:2, NAME=1/0/1:2,
            NAME=ball.
        turntable: the depth frames have no poses: the camera stood still, and the thing made one
            full turn in equal steps, counter-clockwise (ccw) or clockwise (cw) seen from above;
            camera-intrinsics.txt is beside them.
        depth_scale: for captured frames: metres per step of the depth images, such as 0.001 for
            millimetres; by default as their files say.
        depth_topic: for ROS 2 bags with several topics of depth images: the topic.
        world_frame: for ROS 2 bags: tf frame of the world, z up; by default the root of the tree.
        seed: seed of all random draws.
    """

    unit: Literal["mm", "cm", "inch", "foot", "m"] | None = None
    up: Literal["y", "z"] | None = None
    upright: bool = False
    sensor: str = "wrist"
    largest_part: bool = False
    any_size: bool = False
    one_class: bool = False
    symmetry: tuple[str, ...] = ()
    turntable: Literal["ccw", "cw"] | None = None
    depth_scale: float | None = None
    depth_topic: str | None = None
    world_frame: str | None = None
    seed: int = 0

    def check(self) -> None:
        """Refuse, before anything is taught, what every thing would be refused for.

        Raises:
            UsageError: a value that makes no sense.
        """
        sensor_named(self.sensor)
        named_symmetries(self.symmetry)
        whole(self.seed, "the seed", most=2**63 - 1)
        one_of(self.unit, (None, *UNITS), "the unit")
        one_of(self.up, (None, "y", "z"), "the up axis")
        one_of(self.turntable, (None, "ccw", "cw"), "the way that the turntable turned")


def teach(
    path: Path,
    name: str,
    how: TeachingOptions,
    threads: int = 1,
    features: bool = True,
) -> Arrays:
    """Look at one thing, and note what is to be remembered of it.

    Args:
        path: a mesh file, or a folder or a bag of captured frames.
        name: of the thing; with the seed it decides all random draws.
        how: how it is looked at.
        threads: that work side by side.
        features: whether the features of its views are remembered even if its geometry is known.

    Returns:
        Arrays by the names of the fields of ``things.memory.Memory``. If its size is known, also
        its surface in the frame of its file, metres: VERTICES, (V, 3) float32, FACES, (F, 3) int32,
        SYMMETRIES and NEAR_SYMMETRIES. Where some of the frames were not used, a phrase about them
        under LEFT_OUT.

    Raises:
        MeshError, DatasetError, ObservationError: why it cannot be looked at, in one sentence.
    """
    if path.is_dir() or is_bag(path):
        return _of_capture(_captured(path, how), name, features)

    mesh = load_mesh(path, how.up, how.unit, largest_part=how.largest_part)
    rotations = np.eye(3)[None]
    views = without_features(len(rotations))
    if features or mesh.metres is None:
        rotations = rotations if how.upright else resting_poses(mesh)
        lying = [mesh, *(rotated(mesh, rotation) for rotation in rotations[1:])]
        views = features_of(lying, name, how, threads)

    to_mesh = Y_UP if is_y_up(path, how.up) else np.eye(3)
    return {
        **views,
        UPRIGHT: np.array([how.upright]),
        "rotations": (rotations @ to_mesh).astype(np.float32),
        "radii": np.array([np.nan if mesh.metres is None else mesh.metres], np.float32),
        "doubts": np.frombuffer(
            "\n".join([*mesh_warnings(mesh), *_flatness(mesh, how.upright)]).encode(),
            np.uint8,
        ),
        "pictures": _picture(
            SimulatedCamera(mesh, 64).observe(
                look_at_origin(np.radians(25), np.radians(35))
            )
        ),
        **_surface(mesh, to_mesh),
    }


def without_features(poses: int) -> Arrays:
    """The arrays of a thing in so many resting poses of which no views are remembered."""
    return {
        "views": np.zeros((poses, len(RINGS), AZIMUTHS, 0), np.float16),
        "held_out": np.zeros((0, 0), np.float16),
        "held_out_views": np.zeros((0, 2), np.float32),
    }


def features_of(
    lying: Sequence[Mesh],
    name: str,
    how: TeachingOptions,
    threads: int = 1,
) -> Arrays:
    """Render a thing in its resting poses, and compute the features of its views.

    Args:
        lying: the mesh in each of them.
        name: of the thing; with the seed it decides all random draws.
        how: how it is looked at.
        threads: that work side by side.

    Returns:
        The arrays views, held_out and held_out_views of ``things.memory.Memory``.
    """
    rng = np.random.default_rng([how.seed, zlib.crc32(name.encode())])
    directions = (
        np.arcsin(rng.uniform(0, np.sin(np.radians(RINGS[-1])), HELD_OUT)),
        rng.uniform(0, 2 * np.pi, HELD_OUT),
    )
    with ThreadPoolExecutor(threads) as pool:
        # Of any of its resting poses: things lie in practice, and calibration and the rate of
        # strangers follow these.
        shown_pose = lying[int(rng.integers(len(lying)))]
        held_out = _sensed(
            pool,
            shown_pose,
            look_at_origin(*directions),
            how.sensor,
            rng,
        )
        clean = [_clean(pool, each) for each in lying]
        sensed = [_sensed(pool, each, SENSED, how.sensor, rng) for each in lying]
        around = [_around(*both) for both in zip(clean, sensed, strict=True)]
        shown = np.concatenate(list(held_out))
    return {
        "views": np.stack(around).astype(np.float16),
        "held_out": shown.astype(np.float16),
        "held_out_views": np.stack(directions, 1).astype(np.float32),
    }


def _flatness(mesh: Mesh, upright: bool) -> Iterator[str]:
    """A sentence where a thing can lie so flat that depth does not show it."""
    if mesh.metres is None:
        return
    down = np.linalg.eigh(np.cov(mesh.vertices.T))[1][:, 0]  # lies on its flattest side
    if upright:
        down = np.array([0.0, 0.0, 1.0])
    height = float(np.ptp(mesh.vertices @ down)) * mesh.radius
    if height < LOWEST_TOP:
        yield (
            f"it is {1000 * height:.2g} mm high where it lies flat, and on a table nothing lower"
            f" than {1000 * LOWEST_TOP:.2g} mm is found by its depth: it is found only where it"
            " stands or is held; how often it is named right is of views that show it alone"
        )


def _captured(path: Path, how: TeachingOptions) -> Capture:
    """The frames of a folder or a bag."""
    if is_bag(path):
        return read_capture(
            path,
            depth_scale=how.depth_scale,
            depth_topic=how.depth_topic,
            world_frame=how.world_frame,
        )
    if is_capture(path):
        return read_capture(path, depth_scale=how.depth_scale)
    if how.turntable is None:
        raise DatasetError(
            f"{path}: its frames have no poses; --turntable ccw or cw says how the thing turned"
        )
    return read_turntable(path, how.turntable)


def _surface(mesh: Mesh, to_mesh: Float) -> Arrays:
    """Return the surface of a mesh in the axes of its file; nothing without a unit."""
    if mesh.metres is None:
        return {}

    whole = Surface.from_mesh(mesh, mesh.name)
    in_file = replace(whole, vertices=(whole.vertices @ to_mesh).astype(np.float32))
    return of_surface(in_file, max(FINEST_ERROR, COARSER * mesh.metres))


def of_surface(whole: Surface, error: float = 0.0) -> Arrays:
    """What is remembered of a surface: itself and its symmetries.

    Args:
        whole: the surface as it was scanned, which its symmetries are those of.
        error: metres by which it may be off where it is simplified; 0 keeps it.
    """
    surface = whole.simplified(error) if error else whole
    return {
        VERTICES: surface.vertices,
        FACES: surface.faces,
        SYMMETRIES: rows_of(find_symmetries(whole)),
        NEAR_SYMMETRIES: rows_of(find_near_symmetries(whole)),
    }


def rows_of(symmetries: Sequence[Symmetry]) -> Float:
    """Symmetries as an array, axis and order of each, (S, 4) float64."""
    rows = [(*one.axis, one.order) for one in symmetries]
    return np.array(rows, np.float64).reshape(-1, 4)


def _around(clean: EmbeddingParts, sensed: EmbeddingParts) -> Float32:
    """Return embeddings of the grid of views, (rings, azimuths, F).

    They are the mean of clean and sensed views.
    """
    ideal = np.concatenate(list(clean)).reshape(len(RINGS), AZIMUTHS, -1)
    through = np.zeros_like(ideal)
    # Between the rings and azimuths that are looked at through the sensor the embeddings are
    # interpolated.
    through[::2, ::2] = np.concatenate(list(sensed)).reshape(
        len(RINGS[::2]),
        AZIMUTHS // 2,
        -1,
    )
    through[::2, 1::2] = unit(through[::2, ::2] + np.roll(through[::2, ::2], -1, 1))
    through[1::2] = unit(through[:-1:2] + through[2::2])
    return joined(ideal, through)


def _clean(pool: ThreadPoolExecutor, mesh: Mesh) -> EmbeddingParts:
    """Embeddings of the views of the grid without errors."""
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
    """Embeddings of a mesh from poses, (B, 4, 4), through a sensor."""
    parts = np.split(poses, range(SETUP, len(poses), SETUP))
    cameras = (
        partial(SensedCamera, mesh, sensor, own) for own in rng.spawn(len(parts))
    )
    return pool.map(lambda camera, part: _seen(camera(), part), cameras, parts)


def _seen(camera: Camera, poses: Float) -> Float32:
    return embeddings([camera.observe(pose) for pose in poses])


def _of_capture(capture: Capture, name: str, features: bool) -> Arrays:
    """Return what captured frames show: the surface, and the features of the views if they count.

    Its surface, and its resting pose, are in the frame of the world in which it was captured.
    """
    camera = CapturedCamera(capture)
    camera.take_all(MEMORY_GRID.poses[0])
    seen = [view for view in camera.object.observations if view.seen]
    if not seen:
        raise ObservationError(f"{capture.folder}: none of its frames shows an object")

    found = camera.object.object_frame
    surface = fuse(camera.object.sightings, found.radius, name)
    views = without_features(1)
    if features or surface is None:
        views = _features_captured(seen)

    return {
        **views,
        UPRIGHT: np.array([True]),
        "rotations": found.axes[None].astype(np.float32),
        "radii": np.array([found.radius], np.float32),
        "pictures": _picture(seen[0]),
        **({} if surface is None else of_surface(surface)),
        **_said(camera.left_out, len(capture.frames) + len(capture.unreadable)),
    }


def _features_captured(seen: list[Observation]) -> Arrays:
    """Features of captured views, for each cell of the grid those of the nearest one.

    Every fourth view is held out.
    """
    directions = np.stack([direction_of(view.pose) for view in seen])
    each = embeddings(seen)
    kept = np.arange(len(seen)) % 4 < 3 if len(seen) > 4 else np.ones(len(seen), bool)
    arc = angle_between(MEMORY_GRID.directions[:, None], directions[kept][None])
    views = np.where(arc.min(1)[:, None] < NEAR_CAPTURED, each[kept][arc.argmin(1)], 0)

    # the views that are held out
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


def _said(left_out: Mapping[str, str], total: int) -> Arrays:
    """Which frames were left out and why, UTF-8 under LEFT_OUT; nothing if all were used."""
    if not left_out:
        return {}
    phrase = f"{len(left_out)} of {total} frames: {summary(left_out)}"
    return {LEFT_OUT: np.frombuffer(phrase.encode(), np.uint8)}


def _picture(view: Observation) -> NDArray[np.uint8]:
    """A view of a thing as a small picture, (64, 64) uint8."""
    from PIL import Image

    return np.asarray(Image.fromarray(view.picture).resize((64, 64)))


@lru_cache(maxsize=1)
def _features() -> Features:
    return Features(threads=1)


def embeddings(observations: list[Observation]) -> Float32:
    """Return embeddings of views from one camera, unit vectors, (B, F) float32.

    They are zero where nothing is seen.
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
