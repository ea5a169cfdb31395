"""``nextview recognise`` and ``nextview demo``: look at one object until it is clear what it is."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from nextview.cli.episode_table import episode_as_json, print_episode
from nextview.cli.progress import console
from nextview.cli.sources import PICTURES, Looking, Source
from nextview.errors import ObservationError, UsageError
from nextview.files import check_new, new_file
from nextview.session.system import System, load


@dataclass(frozen=True)
class Output:
    """What is made of it.

    Attributes:
        figure: write a picture of the episode to this file (PNG, PDF or SVG).
        record: write the episode to this file (.rrd), for the Rerun viewer.
        json: print JSON instead of a table.
        overwrite: replace these files if they exist.
    """

    figure: Path | None = None
    record: Path | None = None
    json: bool = False
    overwrite: bool = False

    def check(self) -> None:
        """Refuse files that cannot be written, before any work."""
        for file, kinds in ((self.figure, PICTURES), (self.record, (".rrd",))):
            if file is not None:
                check_new(file, self.overwrite)
                if file.suffix.lower() not in kinds:
                    raise UsageError(f"{file}: the name ends in {' or '.join(kinds)}")


def recognise(
    path: Path,
    /,
    source: Source = Source(),
    looking: Looking = Looking(),
    output: Output = Output(),
    start: int | None = None,
    seed: int = 0,
) -> None:
    """Recognise an object by next best views, and show where it looked and why.

    The object is in a mesh file, or in a folder of captured depth images with poses in the layout of BOP, TUM RGB-D or
    7-Scenes. Of these the view nearest to the one asked for answers. The object is what the masks show; else what lies
    in the box; else the thing on the support plane that is nearest to the point, or the largest.

    Args:
        path: OFF, OBJ, PLY, STL or GLB file of one object that stands upright; or a folder of captured views.
        source: what is looked at.
        looking: who looks, and when it ends.
        output: what is made of it.
        start: first view; of the 40, 0 to 39 (ring * 8 + azimuth step); drawn by the seed if not given.
        seed: decides the first view, whatever the policy draws and the errors of a sensor.
    """
    output.check()
    name = path.name if source.sensor is None else f"{path.name} through {source.sensor}"
    show(source.camera(path, seed), name, load(**vars(looking)), output, start, seed)


def demo(
    shape: Literal["table", "chair", "monitor"] = "table",
    start: int = 33,
    figure: Path = Path("nextview_demo.png"),
    overwrite: bool = False,
) -> None:
    """Recognise a sample object that ships with nextview, and draw the episode.

    Args:
        shape: which one.
        start: first view, 0 to 39.
        figure: where to write the picture.
        overwrite: replace the picture if it exists.
    """
    from nextview.data.samples import sample_mesh
    from nextview.simulation.simulated import SimulatedCamera

    output = Output(figure, overwrite=overwrite)
    output.check()
    show(SimulatedCamera(sample_mesh(shape)), f"the sample {shape}", load(), output, start)


def show(camera: Any, name: str, system: System, output: Output, start: int | None, seed: int = 0) -> None:
    """Recognise what a camera sees, print the episode and write what is asked for."""
    session = system.session_with(camera, start, seed)
    with ExitStack() as recorded:
        if output.record is not None:
            from nextview.viewers.recording import Recorder

            recorder = Recorder(recorded.enter_context(new_file(output.record, output.overwrite)))
            recorded.callback(recorder.close)
            session.observers.append(recorder)
        result = session.run(camera)
    if not result.seen:
        why = "is it made of a few small parts far apart, or are a sensor's errors too strong?"
        nothing = f"there is no answer, for nothing of it is seen from any of {len(result.views)} views"
        raise ObservationError(f"{name}: {nothing}; {why}")
    frames = [taken.frame.name for taken in getattr(camera, "taken", ())]
    if output.json:
        print(episode_as_json(result, frames))
    else:
        print_episode(result, name, system.policy_name, frames)
    for frame, reason in getattr(camera, "left_out", {}).items():
        console.print(f"left out: {frame}: {reason}", style="yellow")
    if output.figure is not None:
        with new_file(output.figure, output.overwrite) as part:
            result.plot(part, name)
