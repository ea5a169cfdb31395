"""``nextview recognise``: look at one object until it is clear what it is."""

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
        figure: write a picture of the episode to this file (PNG, PDF or SVG).
        record: write a recording of the episode for the Rerun viewer to this file (.rrd).
        json: print JSON instead of a table.
        overwrite: replace these files if they exist.
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
    any_orientation: bool = False,
) -> None:
    """Recognise an object from as few views as needed, and show the views and the beliefs.

    The object is in a mesh file, or in captured depth images with poses: a ROS 2 bag, or a folder
    in the layout of BOP, TUM RGB-D, 7-Scenes or a RealSense recorder. For each requested view the
    nearest captured one is used. The object is selected by the masks of the frames; otherwise by
    --box; otherwise it is the thing on the support plane that is nearest to --point, or at which
    the first camera points.

    Args:
        path: OFF, OBJ, PLY, STL or GLB file of one object that stands upright; or a folder or
            a bag of captured views, or one depth image (.png).
        more: more objects; with --json each is printed on its own line.
        start: index of the first view, 0 to 39 for the 40 views (ring * 8 + azimuth step); by
            default random.
        seed: seed of the first view, the policy and the sensor errors.
        any_orientation: the object is a taught thing in any orientation: held, leaning or thrown.
    """
    if more and (output.figure or output.record):
        raise UsageError(
            "--figure and --record are of one object; give them with one file or folder"
        )

    check_file(output.figure, output.overwrite)
    check_file(output.record, output.overwrite, (".rrd",))
    system = load(**vars(looking))

    failed = []
    for one in (path, *more):
        name = (
            one.name if source.sensor is None else f"{one.name} through {source.sensor}"
        )
        try:
            camera = source.camera(one, seed)
            session = system.session_with(camera, start, seed, any_orientation)
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
    """Recognise what a camera sees, print the episode and write the requested files.

    Args:
        session: recognises the object.
        camera: in front of the object.
        name: of the object.
        policy: name of what chooses the views.
        output: what is to be written.
        indent: of the JSON text, in spaces; None for one line.

    Raises:
        ObservationError: nothing of the object is seen from any view.
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
