"""Arrays of one thing: its surface and symmetries, its size and a picture."""

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
from nextview.errors import DatasetError, ObservationError, option
from nextview.files import sha256_of
from nextview.geometry.mesh import UNITS, Y_UP, Mesh, is_y_up, load_mesh, mesh_warnings
from nextview.geometry.viewsphere import look_at_origin
from nextview.recognition.model_card import Symmetry
from nextview.sensing.observation import Observation
from nextview.sensing.tabletop import LOWEST_TOP
from nextview.simulation.sensor import sensor_named
from nextview.simulation.simulated import SimulatedCamera
from nextview.teaching.symmetries import named_symmetries
from nextview.teaching.thing_sources import is_of_frames
from nextview.things.fusion import fuse
from nextview.things.surface import FINEST_ERROR, Surface
from nextview.things.symmetry import find_near_symmetries, find_symmetries
from nextview.types import Float

Arrays = dict[str, NDArray]  # arrays of a thing by their names
# key of a phrase about unused frames, which does not enter the memory
LEFT_OUT = "left_out"
# key of a flag, (1,) bool: whether the thing is known in its upright pose only
UPRIGHT = "upright"
# key of the SHA-256 of its mesh file, (32,) uint8
CONTENT = "content"
# keys of its surface
VERTICES = "vertices"
FACES = "faces"
SYMMETRIES = "symmetries"  # axis and order of each symmetry, (S, 4)
NEAR_SYMMETRIES = "near_symmetries"  # axis and order of each near symmetry, (S, 4)
# error relative to the radius: cameras stand farther from large things and resolve less
COARSER = 0.002


@dataclass(frozen=True)
class TeachingOptions:
    """Meshes, camera and symmetries.

    Attributes:
        unit: unit of length of the mesh files, which need one; depth frames are in metres.
        up: up axis of the mesh files; by default z, and y for GLB.
        upright: the things stand only as in their files; by default they may also lie.
        sensor: camera that will look at the things: kinect, stereo, tof, scanner, setup, wrist or
            none, or NAME:STRENGTH.
        largest_part: keep only the largest connected part of each mesh.
        any_size: accept things of very different sizes.
        one_class: things that are all in one folder are one class; --add assumes this.
        symmetry: symmetries that replace the detected ones, in the axes of the files: NAME=none,
            NAME=z (any angle), NAME=z:6 (order 6), NAME=z:4,x:2, NAME=1/0/1:2, NAME=ball.
        turntable: the depth frames have no poses: the camera stood still, and the thing made one
            full turn in equal steps, counter-clockwise (ccw) or clockwise (cw) seen from above;
            camera-intrinsics.txt is beside them.
        depth_scale: metres per step of captured depth images, such as 0.001 for millimetres; by
            default from their files.
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
        """Refuse invalid options before anything is taught.

        Raises:
            UsageError: a value is invalid.
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
) -> Arrays:
    """Process one thing, and collect the arrays of its memory.

    Args:
        path: a mesh file, or a folder or a bag of captured frames.
        name: name of the thing.
        how: options of the teaching.

    Returns:
        Arrays by the names of the fields of ``things.memory.Memory``, one row each, and its surface
        in the frame of its file, metres: VERTICES, (V, 3) float32, FACES, (F, 3) int32, SYMMETRIES
        and NEAR_SYMMETRIES. Of a mesh file, its hash under CONTENT. If some of the frames were not
        used, a phrase about them under LEFT_OUT.

    Raises:
        MeshError, DatasetError, ObservationError: the reason why it cannot be taught, in one
            sentence.
    """
    if is_of_frames(path):
        return _of_capture(_captured(path, how), name)

    mesh = load_mesh(path, how.up, how.unit, largest_part=how.largest_part)
    to_mesh = Y_UP if is_y_up(path, how.up) else np.eye(3)
    return {
        UPRIGHT: np.array([how.upright]),
        CONTENT: np.frombuffer(bytes.fromhex(sha256_of(path)), np.uint8),
        "rotations": to_mesh[None].astype(np.float32),
        "radii": np.array([mesh.radius], np.float32),
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
    """A sentence for a thing that can lie too flat for a depth camera."""
    # normal of its flattest side
    down = np.linalg.eigh(np.cov(mesh.vertices.T))[1][:, 0]
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
    """Frames of a folder or a bag."""
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
            f"{path}: its frames have no poses; {option('turntable')} ccw or cw says how the thing"
            " turned"
        )
    return read_turntable(path, how.turntable)


def _surface(mesh: Mesh, to_mesh: Float) -> Arrays:
    """Surface of a mesh in the axes of its file."""
    whole = Surface.from_mesh(mesh, mesh.name)
    in_file = replace(whole, vertices=(whole.vertices @ to_mesh).astype(np.float32))
    return of_surface(in_file, max(FINEST_ERROR, COARSER * mesh.radius))


def of_surface(whole: Surface, error: float = 0.0) -> Arrays:
    """Arrays of a surface and its symmetries.

    Args:
        whole: the scanned surface, from which the symmetries are computed.
        error: tolerated error of the simplified surface, metres; 0 keeps the surface.

    Returns:
        VERTICES, FACES, SYMMETRIES and NEAR_SYMMETRIES.
    """
    surface = whole.simplified(error) if error else whole
    return {
        VERTICES: surface.vertices,
        FACES: surface.faces,
        SYMMETRIES: rows_of(find_symmetries(whole)),
        NEAR_SYMMETRIES: rows_of(find_near_symmetries(whole)),
    }


def rows_of(symmetries: Sequence[Symmetry]) -> Float:
    """Convert symmetries to an array.

    Args:
        symmetries: S symmetries.

    Returns:
        Axis and order of each, (S, 4) float64.
    """
    rows = [(*one.axis, one.order) for one in symmetries]
    return np.array(rows, np.float64).reshape(-1, 4)


def _of_capture(capture: Capture, name: str) -> Arrays:
    """Arrays of captured frames; the surface is in the world frame of the capture."""
    camera = CapturedCamera(capture)
    camera.take_all(look_at_origin(0.0, 0.0))
    seen = [view for view in camera.object.observations if view.seen]
    if not seen:
        raise ObservationError(f"{capture.folder}: none of its frames shows an object")

    found = camera.object.object_frame
    surface = fuse(camera.object.sightings, found.radius, name)
    if surface is None:
        raise ObservationError(
            f"{capture.folder}: its frames show too little of the object for a surface"
        )
    return {
        UPRIGHT: np.array([True]),
        "rotations": found.axes[None].astype(np.float32),
        "radii": np.array([found.radius], np.float32),
        "pictures": _picture(seen[0]),
        **of_surface(surface),
        **_said(camera.left_out, len(capture.frames) + len(capture.unreadable)),
    }


def _said(left_out: Mapping[str, str], total: int) -> Arrays:
    """A phrase about unused frames, UTF-8 under LEFT_OUT; nothing if all were used."""
    if not left_out:
        return {}
    phrase = f"{len(left_out)} of {total} frames: {summary(left_out)}"
    return {LEFT_OUT: np.frombuffer(phrase.encode(), np.uint8)}


def _picture(view: Observation) -> NDArray[np.uint8]:
    """A thumbnail of a view, (1, 64, 64) uint8."""
    from PIL import Image

    return np.asarray(Image.fromarray(view.picture).resize((64, 64)))[None]
