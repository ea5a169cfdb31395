"""Look at one thing: its surface and symmetries, and the features of its views where they count."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
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
from nextview.geometry.observation import Observation
from nextview.geometry.resting import resting_poses, rotated
from nextview.geometry.viewsphere import (
    look_at_origin,
)
from nextview.recognition.model_card import Symmetry
from nextview.sensing.tabletop import LOWEST_TOP
from nextview.simulation.sensor import sensor_named
from nextview.simulation.simulated import SimulatedCamera
from nextview.teaching.symmetries import named_symmetries
from nextview.teaching.view_features import (
    MEMORY_GRID,
    Arrays,
    features_captured,
    features_of,
    without_features,
)
from nextview.things.fusion import fuse
from nextview.things.surface import FINEST_ERROR, Surface
from nextview.things.symmetry import find_near_symmetries, find_symmetries
from nextview.types import Float

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
        views = features_of(lying, name, how.sensor, how.seed, threads)

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
        views = features_captured(seen)

    return {
        **views,
        UPRIGHT: np.array([True]),
        "rotations": found.axes[None].astype(np.float32),
        "radii": np.array([found.radius], np.float32),
        "pictures": _picture(seen[0]),
        **({} if surface is None else of_surface(surface)),
        **_said(camera.left_out, len(capture.frames) + len(capture.unreadable)),
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
