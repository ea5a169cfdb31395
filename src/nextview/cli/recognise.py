"""``nextview recognise``: recognise one object from as few views as needed."""

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nextview.checks import check_extras
from nextview.cli.common_options import (
    EpisodeOptions,
    ObjectOptions,
    check_file,
    say_written,
)
from nextview.cli.episode_table import print_episode
from nextview.cli.progress import console
from nextview.errors import NextviewError, ObservationError, UsageError
from nextview.files import new_file
from nextview.session.result_json import episode_as_json
from nextview.session.session import Session
from nextview.session.system import load


@dataclass(frozen=True)
class Output:
    """Files and output.

    Attributes:
        figure: write a figure of the episode to this file (PNG, PDF or SVG).
        record: write a recording of the episode for the Rerun viewer to this file (.rrd).
        json: print JSON instead of a table.
        overwrite: replace existing files.
    """

    figure: Path | None = None
    record: Path | None = None
    json: bool = False
    overwrite: bool = False


def recognise(
    path: Path,
    more: tuple[Path, ...] = (),
    /,
    source: ObjectOptions = ObjectOptions(),
    looking: EpisodeOptions = EpisodeOptions(),
    output: Output = Output(),
    start: int | None = None,
    seed: int = 0,
) -> None:
    """Recognise an object from as few views as needed, and print the views and the beliefs.

    The input is a mesh file, which is rendered, or captured depth images with poses: a ROS 2 bag,
    or a folder in the layout of BOP, TUM RGB-D, 7-Scenes, YCB-Video, GraspNet or a RealSense
    recorder, or of organised PCD clouds. For each
    requested view the nearest captured view is used. The masks of the frames select the object; if
    there are none, --box does. Otherwise it is the object on the support plane nearest to --point,
    or nearest to the optical axis of the first camera.

    Args:
        path: OFF, OBJ, PLY, STL or GLB file of one upright object; or a folder or bag of captured
            views, or a single depth image (.png) or cloud (.pcd).
        more: further objects; with --json each is printed on its own line.
        start: index of the first view, 0 to 39 for the 40 views (ring * 8 + azimuth step); by
            default random.
        seed: seed of the first view, the policy and the sensor errors.
    """
    if more and (output.figure or output.record):
        raise UsageError(
            "--figure and --record are of one object; give them with one file or folder"
        )

    check_file(output.figure, output.overwrite)
    check_file(output.record, output.overwrite, (".rrd",))
    check_extras(*(["record"] if output.record else []))
    system = load(**vars(looking))

    failed = []
    for one in (path, *more):
        name = (
            one.name if source.sensor is None else f"{one.name} through {source.sensor}"
        )
        try:
            camera = source.camera(one, seed)
            session = system.session_with(camera, start, seed)
            show(session, camera, name, system.policy_name, output, None if more else 1)
        except NextviewError as error:
            if not more:
                raise
            failed.append(str(error))
            console.print(f"left out: {error}", style="yellow", soft_wrap=True)

    if failed:
        raise UsageError(f"{len(failed)} of {1 + len(more)} were left out, see above")


def show(
    session: Session,
    camera: Any,
    name: str,
    policy: str,
    output: Output,
    indent: int | None = 1,
) -> None:
    """Recognise the object in front of a camera, print the episode and write the requested files.

    Args:
        session: that recognises the object.
        camera: in front of the object.
        name: of the object.
        policy: name of the policy.
        output: requested files and format.
        indent: of the JSON text, in spaces; None for one line.

    Raises:
        ObservationError: the object is not visible in any view.
    """
    with ExitStack() as recorded:
        if output.record is not None:
            from nextview.viewers.recording import Recorder

            recorder = Recorder(
                recorded.enter_context(new_file(output.record, output.overwrite))
            )
            recorded.callback(recorder.close)
            session.observers.append(recorder)
        result = session.run(camera)
    if not result.seen:
        why = "is it made of a few small parts far apart, or are a sensor's errors too strong?"
        nothing = (
            "there is no answer, for nothing of it is seen from "
            f"any of {len(result.views)} views"
        )
        raise ObservationError(f"{name}: {nothing}; {why}")
    frames = [taken.frame.name for taken in getattr(camera, "taken", ())]
    if output.json:
        print(episode_as_json(result, name, frames, indent))
    else:
        print_episode(result, name, policy, frames)
    for frame, reason in getattr(camera, "left_out", {}).items():
        console.print(f"left out: {frame}: {reason}", style="yellow")
    if output.figure is not None:
        with new_file(output.figure, output.overwrite) as part:
            result.plot(part, name)
    say_written(output.figure, output.record)
