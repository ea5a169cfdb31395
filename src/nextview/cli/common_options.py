"""Options shared by several commands: models and policy, object and camera, figure files."""

import os
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from nextview.captured.bag import At
from nextview.checks import one_line
from nextview.cli.progress import console
from nextview.errors import UsageError
from nextview.files import LONGEST_PATH, check_new
from nextview.geometry.mesh import MAX_FACES, load_mesh, mesh_warnings
from nextview.sensing.observation import Camera
from nextview.session.session import FrameCamera
from nextview.session.system import is_frames, simulated

Unit = Literal["mm", "cm", "inch", "foot", "m"]


Three = tuple[float, float, float]
FIGURE_ENDINGS = (".png", ".pdf", ".svg")


@dataclass(frozen=True)
class EpisodeOptions:
    """Models, policy and stopping rule.

    Attributes:
        models: name of bundled models (modelnet10, ycb), or folder of your own models.
        policy: policy that chooses the next view: gain (predicted gain minus weighted travel; the
            default), discriminate (the default for taught things), MAP, MAP-peak or MAP-sphere-peak
            for a map of the models (lem, lcm), random, random-all, furthest, unidirectional,
            spread, spread-local, the card of a learned policy (.json), or MODULE:CLASS.
        threshold: stop as soon as the belief in one class reaches this value; it applies after the
            first view and decreases with every further view.
        risk: stop so that at most this share of the episodes that end early have a wrong answer;
            replaces the threshold.
        max_views: largest number of views in an episode.
        stopping: stopping rule of your own, MODULE:NAME (docs/add_a_policy.md).
        recogniser: recogniser of your own, MODULE:NAME (docs/add_a_recogniser.md).
        viewpoints: candidate viewpoints: 40 or 12 views on rings, rings:0,30,60x12 (elevations in
            degrees x views per ring), or fibonacci:60 (spread evenly over the upper hemisphere).
        unknown: significance level of the test for unknown objects: an object with a smaller
            p-value is called unknown. The default of 0.02 also rejects one known object in 50. A
            rate that no p-value of the models can be below is refused. Objects of a size that their
            class never has are unknown too. 0 always names a class.
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
    """The object and the camera.

    Attributes:
        up: up axis of a mesh file; by default z, and y for GLB. For captured frames also a
            direction in the world frame; by default z, and for 7-Scenes the normal of the support
            plane.
        unit: unit of length of a mesh file; if it is given, size counts as evidence.
        sensor: simulated depth camera: kinect, stereo, tof, scanner, setup, wrist or none, or
            NAME:STRENGTH (docs/your_camera.md); by default renders are free of noise.
        max_faces: largest number of triangles in a mesh; also limits the file to 60 bytes per
            triangle.
        largest_part: keep only the largest connected part of a mesh, without tables or loose
            pieces.
        point: for captured frames: point near the object, world frame, metres.
        box: for captured frames: upright bounding box of the object: its low and its high corner,
            metres (heights along --up), or a JSON file with low, high and axes.
        object_id: for BOP folders with several objects: number of the object.
        intrinsics: for captured frames: FX FY CX CY in pixels, a file with the pinhole matrix, or
            a camera file of ROS, librealsense or Open3D (JSON or YAML).
        depth_scale: for captured frames: metres per unit of the depth images, such as 0.001 for
            millimetres; by default read from the folder.
        depth_topic: for ROS 2 bags with several depth topics: the topic to read.
        world_frame: for ROS 2 bags: tf frame of the world, z up; by default the root of the tree.
        at: for ROS 2 bags of a static camera: the image to use: first (the default), last, or the
            number of seconds after the first message of the bag.
        raw: for captured frames: use the depth without denoising.
        by_shape: for captured frames: ignore the size of the object, as for toys and models.
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
    at: At = None
    raw: bool = False
    by_shape: bool = False

    def camera(self, path: Path, seed: int) -> Camera | FrameCamera:
        """Create a camera in front of the object of a mesh file or of captured frames.

        Args:
            path: of the mesh file, or of the folder, bag or image of captured frames.
            seed: of the simulated sensor errors.

        Returns:
            The camera.

        Raises:
            UsageError: an option does not apply to this kind of input.
        """
        check_there(path)
        folder = is_frames(path)
        of_meshes = ("unit", "sensor", "max_faces", "largest_part")
        for field in fields(self)[1:]:
            if (field.name in of_meshes) == folder and getattr(
                self,
                field.name,
            ) != field.default:
                option = field.name.replace("_", "-")
                kind = "mesh files" if folder else "captured views"
                raise UsageError(f"{path}: --{option} is for {kind}, and this is none")

        if folder:
            return self._captured(path)
        if isinstance(self.up, tuple):
            raise UsageError(
                f"{path}: the up axis of a mesh file is y or z, not {self.up}"
            )

        mesh = load_mesh(path, self.up, self.unit, self.max_faces, self.largest_part)
        for sentence in mesh_warnings(mesh):
            console.print(f"{path}: {sentence}", style="yellow", soft_wrap=True)
        return simulated(mesh, self.sensor, seed)

    def _captured(self, folder: Path) -> FrameCamera:
        from nextview.captured.camera import camera_of
        from nextview.captured.folders import read_capture

        capture = read_capture(
            folder,
            self.intrinsics,
            self.object_id,
            self.depth_scale,
            self.depth_topic,
            self.world_frame,
            self.at,
        )
        capture = capture.at_one_moment
        console.print(f"{capture!r}")
        return camera_of(
            capture,
            self.up,
            self.point,
            self.box,
            not self.raw,
            not self.by_shape,
        )


def check_there(path: Path) -> None:
    """Check that a path exists, before its options are checked.

    Args:
        path: of a file or folder.

    Raises:
        UsageError: there is no such file or folder.
    """
    if not os.path.exists(path):  # Path.exists raises an error if a name is too long
        shown = one_line(str(path), LONGEST_PATH)
        raise UsageError(f"{shown}: no such file or folder")


def say_written(*paths: Path | None) -> None:
    """Print the paths of the written files to standard error.

    Args:
        paths: of the files; None for files that were not requested.
    """
    for path in paths:
        if path is not None:
            console.print(f"wrote {path}", soft_wrap=True)


def check_file(
    path: Path | None,
    overwrite: bool,
    kinds: tuple[str, ...] = FIGURE_ENDINGS,
) -> None:
    """Check the path of an output file before any work is done.

    Args:
        path: of the file; None for no file.
        overwrite: whether an existing file may be replaced.
        kinds: allowed suffixes.

    Raises:
        ResultsError: the file cannot be written.
        UsageError: the suffix is not allowed.
    """
    if path is not None:
        check_new(path, overwrite)
        if path.suffix.lower() not in kinds:
            raise UsageError(f"{path}: the name ends in {' or '.join(kinds)}")
