"""Options of several commands: who looks, what is looked at, and files of pictures."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import numpy as np

from nextview.cli.progress import console
from nextview.errors import UsageError
from nextview.files import check_new
from nextview.geometry.mesh import MAX_FACES, load_mesh, mesh_warnings
from nextview.geometry.observation import Camera
from nextview.session.session import FrameCamera
from nextview.session.system import is_frames, simulated

Unit = Literal["mm", "cm", "inch", "foot", "m"]
Three = tuple[float, float, float]
PICTURES = (".png", ".pdf", ".svg")


@dataclass(frozen=True)
class EpisodeOptions:
    """Who looks, and when it ends.

    Attributes:
        models: bundled models by name, or a folder with models of your own.
        policy: chooses the next view: gain (the predicted gain of a view less its weighted travel;
            the default), MAP, MAP-peak or MAP-sphere-peak for a map of the models (lem, lcm),
            discriminate (the default of taught things), random, random-all, furthest,
            unidirectional, spread, spread-local, the card of a learned one (.json), or
            MODULE:CLASS.
        threshold: stop when the belief in one class reaches this after one view, less after
            several.
        risk: instead, stop at the lowest threshold at which at most this share of those who stop
            early is wrong.
        max_views: stop after so many views.
        stopping: MODULE:NAME of a stopping rule of your own, docs/add_a_policy.md.
        recogniser: MODULE:NAME of a recogniser of your own, docs/add_a_recogniser.md.
        viewpoints: where the camera may look from: 40 or 12 views, rings:0,30,60x12 (elevations in
            degrees by views on each ring), or fibonacci:60 (spread evenly over the upper half).
        unknown: say "none of these" of an object that is as novel as at most this share of the
            objects of known classes (0.02, the default: one in 50 of these is called unknown), or
            of a size that the class never has; 0 always names a class.
    """

    models: str = "modelnet10"
    policy: str | None = None
    threshold: float = 0.97
    risk: float | None = None
    max_views: int = 5
    stopping: str | None = None
    recogniser: str | None = None
    viewpoints: str = "40"
    unknown: float | None = None


@dataclass(frozen=True)
class ObjectOptions:
    """What is looked at.

    Attributes:
        up: a mesh file's up axis; z if not given, but y for GLB. Of a folder, also a direction in
            its world; z if not given, but the normal of the support plane for 7-Scenes.
        unit: a mesh file's unit of length: the size of an object says something of its class.
        sensor: look at a mesh through a sensor with all its errors: kinect, stereo, setup, wrist or
            none, or NAME:STRENGTH (docs/your_camera.md); clean renders if not given.
        max_faces: refuse a mesh of more triangles, or a file of more than 60 bytes for each of
            these.
        largest_part: of a mesh file, leave out all that is not connected to its largest part, such
            as a plate or loose pieces of a scan.
        point: of a folder: near the object that is meant, metres, in the capture's world.
        box: of a folder: the upright box into which the object just fits, its low and its high
            corner, metres (heights along --up), or a JSON file with low, high and axes.
        object_id: of a BOP folder with several objects: the one that is meant.
        intrinsics: of a folder: FX FY CX CY, pixels, or a file with them: the pinhole matrix, or
            what ROS, librealsense or Open3D wrote (JSON or YAML).
        depth_scale: of a folder: metres that one step of the depth images stands for, if not as its
            files say; 0.001 for millimetres.
        depth_topic: of a ROS 2 bag with several topics of depth images.
        world_frame: of a ROS 2 bag: the frame of tf that is the world, z up; the root of the tree
            if not given.
        raw: of a folder: take the depth as it is, without denoising.
        by_shape: of a folder: the object's size says nothing of its class, as with toys.
    """

    up: Literal["y", "z"] | Three | None = None
    unit: Unit | None = None
    sensor: str | None = None
    max_faces: int = MAX_FACES
    largest_part: bool = False
    point: Three | None = None
    box: tuple[float, float, float, float, float, float] | Path | None = None
    object_id: int | None = None
    intrinsics: tuple[float, float, float, float] | Path | None = None
    depth_scale: float | None = None
    depth_topic: str | None = None
    world_frame: str | None = None
    raw: bool = False
    by_shape: bool = False

    def camera(self, path: Path, seed: int) -> Camera | FrameCamera:
        """Create a camera in front of the object of a mesh file or of captured frames.

        Args:
            path: of the mesh file, or of the folder, the bag or the image.
            seed: of the sensor's errors.

        Returns:
            The camera.

        Raises:
            UsageError: an option does not apply to this kind of input.
        """
        folder = is_frames(path)
        of_meshes = ("unit", "sensor", "max_faces", "largest_part")
        for field in fields(self)[1:]:
            if (field.name in of_meshes) == folder and getattr(self, field.name) != field.default:
                option = field.name.replace("_", "-")
                kind = "mesh files" if folder else "captured views"
                raise UsageError(f"{path}: --{option} is for {kind}, and this is none")

        if folder:
            return self._captured(path)
        if isinstance(self.up, tuple):
            raise UsageError(f"{path}: the up axis of a mesh file is y or z, not {self.up}")

        mesh = load_mesh(path, self.up, self.unit, self.max_faces, self.largest_part)
        for sentence in mesh_warnings(mesh):
            console.print(f"{path}: {sentence}", style="yellow", soft_wrap=True)
        return simulated(mesh, self.sensor, seed)

    def _captured(self, folder: Path) -> FrameCamera:
        from nextview.captured.camera import UP, CapturedCamera
        from nextview.captured.folders import read_box, read_capture
        from nextview.sensing.object_frame import Box, upright_axes

        capture = read_capture(
            folder,
            self.intrinsics,
            self.object_id,
            self.depth_scale,
            self.depth_topic,
            self.world_frame,
        )
        console.print(f"{capture!r}")
        up = UP[self.up] if isinstance(self.up, str) else self.up
        box = read_box(self.box) if isinstance(self.box, Path) else None
        if isinstance(self.box, tuple):
            upwards = up or capture.up
            if upwards is None:
                raise UsageError(
                    f"{folder}: a box is upright, and in this layout nothing tells where up is:"
                    " give --up"
                )
            box = Box(np.array(self.box[:3]), np.array(self.box[3:]), upright_axes(upwards))
        return CapturedCamera(capture, up, self.point, box, not self.raw, not self.by_shape)


def check_file(path: Path | None, overwrite: bool, kinds: tuple[str, ...] = PICTURES) -> None:
    """Check a file that is to be written, before any work is done.

    Args:
        path: of the file; None for no file.
        overwrite: whether an existing file may be replaced.
        kinds: suffixes that the name may have.

    Raises:
        ResultsError: the file cannot be written.
        UsageError: the name has another suffix.
    """
    if path is not None:
        check_new(path, overwrite)
        if path.suffix.lower() not in kinds:
            raise UsageError(f"{path}: the name ends in {' or '.join(kinds)}")
