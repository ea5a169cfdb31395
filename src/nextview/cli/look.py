"""``nextview look``: name and locate all known things in captured frames of a table."""

import json
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.table import Table

from nextview.captured.bag import At
from nextview.captured.camera import UP
from nextview.captured.check import check_capture
from nextview.captured.folders import Capture, read_capture
from nextview.captured.still_moments import still_moments
from nextview.checks import check_extras
from nextview.cli.common_options import Three, check_file, say_written
from nextview.cli.progress import Terminal, console, track
from nextview.errors import ObservationError, UsageError
from nextview.files import new_file
from nextview.geometry.axes import upright_axes
from nextview.scene.report import (
    REPORT_COLUMNS,
    changes_in_words,
    doubts_of,
    row_of,
    scene_as_json,
)
from nextview.scene.scene import Look, Scene
from nextview.sensing.object_frame import Box
from nextview.session.result_json import plain
from nextview.session.system import load
from nextview.types import Float

WHOLE_NAME = 40  # letters of the longest name that is not folded in the table


@dataclass(frozen=True)
class LookOptions:
    """Known things, frames and region.

    Attributes:
        models: name of a bundled memory, or folder of your own memory; several are combined.
        intrinsics: FX FY CX CY in pixels, a file with the pinhole matrix, or a camera file of ROS,
            librealsense or Open3D (JSON or YAML); by default read from the folder.
        depth_scale: metres per unit of the depth images, such as 0.001 for millimetres; by default
            read from the folder.
        depth_topic: for ROS 2 bags with several depth topics: the topic to read.
        world_frame: for ROS 2 bags: tf frame of the world, z up; by default the root of the tree.
        at: for ROS 2 bags of a static camera: use one image: first, last, or the number of seconds
            after the first message of the bag; by default those at which the scene has changed.
        up: up axis of the world, or a direction; by default that of the layout, or the normal of
            the support plane.
        region: upright box that limits the search: its low and its high corner, metres (heights
            along --up).
        frames: number of frames to use, evenly spread over the recording; for cameras that stand
            still, over the moments at which the scene has changed.
    """

    models: str | tuple[str, ...] = "ycb"
    intrinsics: tuple[float, float, float, float] | Path | None = None
    depth_scale: float | None = None
    depth_topic: str | None = None
    world_frame: str | None = None
    at: At = None
    up: str | Three | None = None
    region: tuple[float, float, float, float, float, float] | None = None
    frames: int = 6


@dataclass(frozen=True)
class LookOutput:
    """Files and output.

    Attributes:
        figure: write a figure of the last frame and a top view of the table to this file (PNG, PDF
            or SVG).
        explorer: write an interactive 3D view of the scene to this file (.html).
        record: write a recording for the Rerun viewer to this file (.rrd).
        json: print JSON instead of a table.
        overwrite: replace existing files.
    """

    figure: Path | None = None
    explorer: Path | None = None
    record: Path | None = None
    json: bool = False
    overwrite: bool = False


def look(
    path: Path,
    /,
    looking: LookOptions = LookOptions(),
    output: LookOutput = LookOutput(),
) -> None:
    """Name and locate all known things on a table, in captured depth frames.

    Each object is printed with its pose and its belief. Objects that match no known thing are
    listed as unknown, with size and position. Frames that contradict the others are left out.

    Args:
        path: folder of captured depth images with poses (BOP, TUM RGB-D, 7-Scenes, YCB-Video,
            GraspNet, organised PCD clouds, or depth images with camera intrinsics), a ROS 2 bag, or
            a single depth image (.png) or cloud (.pcd).
    """
    check_file(output.figure, output.overwrite)
    check_file(output.explorer, output.overwrite, (".html",))
    check_file(output.record, output.overwrite, (".rrd",))
    check_extras(
        *(["explore"] if output.explorer else []),
        *(["record"] if output.record else []),
    )
    if looking.frames < 1:
        raise UsageError(f"at least one frame is looked at, not {looking.frames}")
    read = read_capture(
        path,
        looking.intrinsics,
        depth_scale=looking.depth_scale,
        depth_topic=looking.depth_topic,
        world_frame=looking.world_frame,
        at=looking.at,
    )
    capture, left_out = check_capture(read, masked=False)
    console.print(f"{capture!r}")
    models = looking.models if isinstance(looking.models, str) else list(looking.models)
    system = load(models)
    scene = Scene(system, *_where(capture, looking))

    with ExitStack() as recorded:
        recorder = None
        if output.record is not None:
            from nextview.viewers.scene_recording import SceneRecorder

            part = recorded.enter_context(new_file(output.record, output.overwrite))
            recorder = SceneRecorder(part)
            recorded.callback(recorder.close)
        looks = _look_at_frames(scene, capture, looking.frames, left_out, recorder)
        if not scene.frames:
            raise ObservationError(
                f"{path}: no frame can be used: {next(iter(left_out.values()))}"
            )

    if output.json:
        print(json.dumps(plain(scene_as_json(scene, looks, left_out)), indent=1))
    else:
        print_scene(scene, path.name)
    remarked = {remark.name for remark in scene.remarks}
    first = next((name for name, one in looks.items() if one.taken), "")
    for name, one in looks.items():
        if capture.stands and name != first:
            for sentence in changes_in_words(one):
                console.print(f"{name}: {sentence}")
        for ended, whole in one.joined:
            console.print(f"{name}: {ended} turned out to be a part of {whole}")
        for warning in one.warnings:
            if warning.name not in remarked:
                console.print(
                    f"{name}: warning ({warning.name}): {warning.message}",
                    soft_wrap=True,
                )
    for name, reason in left_out.items():
        console.print(f"left out: {name}: {reason}", style="yellow", soft_wrap=True)
    if output.figure is not None:
        with new_file(output.figure, output.overwrite) as part:
            scene.plot(part, path.name)
    if output.explorer is not None:
        from nextview.viewers.scene_page import write_scene_page

        write_scene_page(scene, output.explorer, path.name, output.overwrite)
    say_written(output.figure, output.explorer, output.record)


def _look_at_frames(
    scene: Scene,
    capture: Capture,
    most: int,
    left_out: dict[str, str],
    recorder: Callable[[Scene], None] | None,
) -> dict[str, Look]:
    """Update a scene with the frames of a capture.

    Args:
        scene: to update.
        capture: with the frames.
        most: largest number of frames, evenly spread over the capture.
        left_out: reasons for the frames that were left out, by frame name; extended in place.
        recorder: called after each frame.

    Returns:
        The changes of each frame, by frame name.
    """
    looks: dict[str, Look] = {}
    moments = capture.moments
    kind = "frames"
    if capture.stands and len(moments) > 1:
        moments = still_moments(capture)
        kind = "frames at which the scene stands still and has changed"
    there = sum(len(together) for together in moments)
    at_once = max(1, most // len(capture.cameras))
    rows = np.unique(np.linspace(0, len(moments) - 1, at_once).round().astype(int))
    few = [captured for row in rows for captured in moments[row]]
    if len(few) < there:
        console.print(
            f"{len(few)} of the {there} {kind} are looked at, evenly spread; --frames {there} for"
            " all",
            soft_wrap=True,
        )

    def each() -> Any:
        for done, captured in enumerate(few, 1):
            try:
                looks[captured.name] = scene.update(captured.read(masked=False))
            except ObservationError as error:
                left_out[captured.name] = str(error)
            if recorder is not None:
                recorder(scene)
            yield done

    track(each(), len(few), "looking at frames")
    return looks


def _where(capture: Capture, looking: LookOptions) -> tuple[Float | None, Box | None]:
    """Return the up direction, (3,), and the search region."""
    given = looking.up if looking.up is not None else capture.up
    if isinstance(given, str):
        if given not in UP:
            raise UsageError(
                f"up is {', '.join(UP)} or a direction, three numbers, not {given!r}"
            )
        given = UP[given]
    up = None if given is None else np.array(given, np.float64)
    if looking.region is None:
        return up, None
    if up is None:
        raise UsageError(
            f"{capture.folder}: a region is upright, and in this layout nothing tells where up is:"
            " give --up"
        )

    low, high = np.array(looking.region[:3]), np.array(looking.region[3:])

    return up, Box(low, high, upright_axes(up))


def print_scene(scene: Scene, name: str) -> None:
    """Print a row for each object.

    Args:
        scene: with one frame at least.
        name: of the capture.
    """
    objects = scene.objects
    console = Terminal()
    remarks = [one.message for one in scene.remarks]
    if not objects:
        console.print(f"{name}: {'; '.join(remarks)}")
        return
    table = Table(box=box.SIMPLE, pad_edge=False, padding=0)
    frames = len(scene.frames)
    table.title = f"On the table in {name}, {frames} frame{'s' * (frames > 1)}"
    rows = [row_of(thing) for thing in objects]
    for column, *cells in zip(REPORT_COLUMNS, *rows, strict=True):
        longest = max(map(len, cells))
        table.add_column(
            column,
            justify="right" if column in ("", "frames") else "left",
            overflow="fold",
            no_wrap=column in ("name", "place, m") and longest <= WHOLE_NAME,
        )
    for row in rows:
        table.add_row(*row)

    console.print(table)
    for line in (*doubts_of(scene), *remarks):
        console.print(line)
