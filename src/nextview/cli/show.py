"""Recognise what a camera sees, and show the episode: for ``nextview recognise`` and ``nextview demo``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nextview.observation import Camera
    from nextview.session import FrameCamera


def show(
    make_camera: Callable[[], Camera | FrameCamera],
    name: str,
    models: str,
    options: dict[str, Any],
    start: int | None,
    seed: int,
    figure: Path | None,
    json: bool = False,
    timing: bool = False,
    record: Path | None = None,
) -> None:
    """Recognise what a camera sees and print the episode; ``options`` are those of ``nextview.load``."""
    from contextlib import ExitStack

    from nextview import system
    from nextview.cli.episode_table import as_json, print_episode
    from nextview.cli.progress import console
    from nextview.cli.timing import Stopwatch
    from nextview.errors import ObservationError
    from nextview.outputs import written_whole

    watch = Stopwatch()
    watch.lap("importing")
    camera = make_camera()
    watch.lap("building the scene")
    opened = system.load(models, **options)
    session = opened.session_with(camera, start, seed)
    watch.lap("loading the models")
    with ExitStack() as recorded:
        if record is not None:
            from nextview.report.recording import Recorder

            recorder = Recorder(recorded.enter_context(written_whole(record)))
            recorded.callback(recorder.close)
            session.observers.append(recorder)
        result = session.run(camera, watch.lap)
    if not result.seen:
        raise ObservationError(
            f"{name}: there is no answer, for nothing of it is seen from any of {len(result.views)} views; "
            "is it made of a few small parts far apart, or are a sensor's errors too strong?"
        )
    frames = [taken.frame.name for taken in getattr(camera, "taken", ())]
    if json:
        print(as_json(result, frames))
    else:
        print_episode(result, name, opened.policy_name, frames)
    for frame, reason in getattr(camera, "left_out", {}).items():
        console.print(f"left out: {frame}: {reason}", style="yellow", highlight=False)
    if timing:
        watch.show()
    if figure:
        result.plot(figure, name)
