"""Record a scene for the Rerun viewer."""

from __future__ import annotations

from pathlib import Path
from uuid import uuid4

import numpy as np

from nextview.checks import extras
from nextview.errors import UsageError
from nextview.figures.style import ACCENT, GREY, INK, rgb
from nextview.files import new_file
from nextview.scene.objects import UNKNOWN_NAME, SceneObject
from nextview.scene.scene import Scene
from nextview.viewers.scene_shapes import colour_of, name_of, placed_shape, seen_points

with extras():
    import rerun as rr
    import rerun.blueprint as rrb

FRAME_TIMELINE = "frame"
LABEL_ABOVE = 0.02  # metres, height of a name above its object
RECORDED_FRUSTUM = 0.08  # metres, size of a camera frustum


class SceneRecorder:
    """Recorder of a scene; call it with the scene after each frame.

    On the timeline ``frame`` the file contains, in the world frame and in metres:

    - ``world/camera``: pose, pinhole and depth of the last frame; ``world/cameras/K`` for frame K,
      and ``world/way`` between them.
    - ``world/seen/K``: the points of frame K above the table.
    - ``world/objects/N``: the registered scan of object N, or the hull of an unknown object's
      points, and ``world/objects/N/name``. Cleared once the object is gone.
    - ``world/next``: the next view.
    - ``belief/N NAME``: the belief in each name of an object over the frames.
    - ``log``: each frame in words.

    The file can be read at any time; it is complete after ``close``. If frames were added to the
    scene before the first call, the objects are those after the last of them.

    Args:
        path: of the file, .rrd.

    Raises:
        UsageError: the name does not end in .rrd, or the file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        if Path(path).suffix != ".rrd":
            raise UsageError(f"{path}: a recording for Rerun is called .rrd")
        self._stream = rr.RecordingStream("nextview", recording_id=uuid4())
        try:
            self._stream.save(path, default_blueprint=scene_blueprint())
        except (OSError, RuntimeError, ValueError) as error:
            raise UsageError(f"{path}: cannot be written ({error})") from None
        self._stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._frames = 0
        self._shown: set[int] = set()
        self._open = True

    def __call__(self, scene: Scene) -> None:
        """Record the changes of a scene."""
        if not self._open:
            return

        for number in range(self._frames, len(scene.frames)):
            self._stream.set_time(FRAME_TIMELINE, sequence=number + 1)
            self._log_frame(scene, number)
        if len(scene.frames) == self._frames:
            return

        self._frames = len(scene.frames)
        objects = scene.objects

        for thing in objects:
            self._log_object(thing)
        for number in self._shown - {thing.number for thing in objects}:
            self._stream.log(f"world/objects/{number}", rr.Clear(recursive=True))
        self._shown = {thing.number for thing in objects}
        self._log_next(scene)
        self._log_text(scene)
        self._stream.flush()

    def close(self) -> None:
        """Complete the file; nothing more can be written."""
        if self._open:
            self._stream.disconnect()
        self._open = False

    def _log_frame(self, scene: Scene, number: int) -> None:
        """Record a camera in its pose, its depth and points, and the camera path so far."""
        frame = scene.frames[number]
        pose = frame.camera_to_world
        height, width = frame.shape
        place = rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])
        pinhole = rr.Pinhole(
            image_from_camera=frame.intrinsics,
            resolution=(width, height),
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=RECORDED_FRUSTUM,
        )
        for name in (f"world/cameras/{number + 1}", "world/camera"):
            self._stream.log(name, place, pinhole)
        self._stream.log("world/camera/depth", rr.DepthImage(frame.depth, meter=1.0))

        points = seen_points(scene, number)
        cloud = rr.Points3D(points, colors=rgb(GREY), radii=0.0008)
        self._stream.log(f"world/seen/{number + 1}", cloud)
        way = np.stack(
            [each.camera_to_world[:3, 3] for each in scene.frames[: number + 1]]
        )
        self._stream.log(
            "world/way",
            rr.LineStrips3D([way], colors=rgb(INK), radii=0.001),
        )

    def _log_object(self, thing: SceneObject) -> None:
        """Record an object in its pose, its name, and the belief in it."""
        name = f"world/objects/{thing.number}"
        shape = placed_shape(thing)
        if shape is None:
            self._stream.log(name, rr.Clear(recursive=False))
        else:
            vertices, faces = shape
            colours = np.tile([*rgb(colour_of(thing)), 255], (len(vertices), 1)).astype(
                np.uint8
            )
            mesh = rr.Mesh3D(
                vertex_positions=vertices,
                triangle_indices=faces,
                vertex_colors=colours,
            )
            self._stream.log(name, mesh)

        top = thing.place + np.array([0, 0, thing.size[2] / 2 + LABEL_ABOVE])
        label = rr.Points3D(
            [top],
            labels=[name_of(thing)],
            colors=rgb(colour_of(thing)),
            radii=0.002,
        )
        self._stream.log(f"{name}/name", label)
        if thing.name != UNKNOWN_NAME:
            entity = rr.escape_entity_path_part(f"{thing.number} {thing.name}")
            self._stream.log(f"belief/{entity}", rr.Scalars(thing.confidence))

    def _log_next(self, scene: Scene) -> None:
        """Record the next view; none once the scene is done."""
        target = None if scene.done else scene.target
        places = np.zeros((0, 3)) if target is None else target[None, :3, 3]
        self._stream.log(
            "world/next",
            rr.Points3D(places, colors=rgb(ACCENT), radii=0.012),
        )

    def _log_text(self, scene: Scene) -> None:
        """Record a description of the scene after the last frame."""
        for thing in scene.objects:
            self._stream.log("log", rr.TextLog(repr(thing), level=rr.TextLogLevel.INFO))


def record_scene(scene: Scene, path: str | Path, overwrite: bool = False) -> None:
    """Write the current state of a scene as a recording for the Rerun viewer.

    Args:
        scene: with at least one frame.
        path: of the file, .rrd.
        overwrite: whether to replace an existing file.

    Raises:
        UsageError: the file name has another suffix.
        ResultsError: the file exists, or cannot be written.
    """
    with new_file(Path(path), overwrite) as part:
        recorder = SceneRecorder(part)
        recorder(scene)
        recorder.close()


def scene_blueprint() -> rrb.Blueprint:
    """Return the initial layout of the viewer."""
    table = rrb.Spatial3DView(origin="world", name="table")
    depth = rrb.Spatial2DView(origin="world/camera", name="last frame")
    belief = rrb.TimeSeriesView(origin="belief", name="belief over the frames")
    log = rrb.TextLogView(origin="log")
    right = rrb.Vertical(depth, belief, log, row_shares=[3, 3, 2])
    return rrb.Blueprint(
        rrb.Horizontal(table, right, column_shares=[3, 2]),
        rrb.TimePanel(timeline=FRAME_TIMELINE),
        collapse_panels=True,
    )
