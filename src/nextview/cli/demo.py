"""``nextview demo``: a bundled table; ``nextview demo-episode``: one sample object."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from nextview.captured.bundled_table import (
    BUNDLED_TABLE,
    TRUTH_FILE,
    NamedPlace,
    compared_with_truth,
)
from nextview.captured.folders import read_capture
from nextview.cli.common_options import check_file, say_written
from nextview.cli.look import print_scene
from nextview.cli.progress import Terminal, track
from nextview.cli.recognise import Output, show
from nextview.data.samples import sample_mesh
from nextview.files import new_folder
from nextview.scene.objects import UNKNOWN_NAME
from nextview.scene.scene import Scene
from nextview.session.system import load, simulated
from nextview.viewers.scene_card import write_picture_page

DEMO_FOLDER = Path("nextview_demo")
DEMO_PICTURE = Path("nextview_demo.png")


def demo(out: Path | None = None, overwrite: bool = False) -> None:
    """Name and locate everything on a table, in a bundled recording of three depth frames.

    Seven YCB objects and a toy that was not taught lie on a simulated table. A wrist camera
    captures three frames, with depth noise and pose errors. The command registers the 78 bundled
    YCB scans to the frames and prints names and poses, followed by the ground truth. The table was
    not selected by the result, so some names may be wrong. It takes about 9 s of CPU time.

    It writes table.png, table.html for the browser, and the folder recording, an example of the
    layout for your own frames: nextview look nextview_demo/recording gives the same table.

    Args:
        out: output folder; by default nextview_demo, whose files are replaced.
        overwrite: replace files in a folder of your own.
    """
    folder = DEMO_FOLDER if out is None else out
    with new_folder(folder, overwrite or out is None) as part:
        copied = shutil.ignore_patterns(TRUTH_FILE)
        shutil.copytree(BUNDLED_TABLE, part / "recording", ignore=copied)
        scene = _bundled_scene()
        print_scene(scene, "the bundled recording")
        for line in compared_with_truth(_named_places(scene), scene.system.classes):
            Terminal().print(line)
        scene.plot(part / "table.png", "bundled recording")
        write_picture_page(scene, part / "table.html", part / "table.png")
    say_written(folder / "table.png", folder / "table.html", folder / "recording")


def _bundled_scene() -> Scene:
    """Build the scene of the bundled frames, as ``nextview look`` does."""
    capture = read_capture(BUNDLED_TABLE)
    scene = Scene(load("ycb"), capture.up)

    def each() -> Iterator[int]:
        for done, captured in enumerate(capture.frames, 1):
            scene.update(captured.read(masked=False))
            yield done

    track(each(), len(capture.frames), "looking at frames")
    return scene


def _named_places(scene: Scene) -> list[NamedPlace]:
    """Return the names and positions of all objects."""
    return [
        NamedPlace(
            None if one.name == UNKNOWN_NAME else one.name,
            one.confident,
            one.place,
        )
        for one in scene.objects
    ]


def demo_episode(
    shape: Literal["table", "chair", "monitor"] = "table",
    start: int = 33,
    figure: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Recognise a piece of sample furniture that ships with nextview, and draw the episode.

    A simulated camera moves around one object. The figure shows the views, the belief after each
    view, and the value of each candidate view.

    Args:
        shape: the sample object.
        start: index of the first view, 0 to 39.
        figure: file of the figure; by default nextview_demo.png, which is always replaced.
        overwrite: replace an existing file that was named with --figure.
    """
    output = Output(figure, overwrite=overwrite)
    if figure is None:  # the default file may be replaced by every run
        output = Output(DEMO_PICTURE, overwrite=True)
    check_file(output.figure, output.overwrite)
    system = load()
    camera = simulated(sample_mesh(shape))
    session = system.session_with(camera, start)
    show(session, camera, f"the sample {shape}", system.policy_name, output)
