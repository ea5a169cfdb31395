"""``nextview demo``: recognise a sample object, and draw the episode."""

from pathlib import Path
from typing import Literal

from nextview.cli.common_options import check_file
from nextview.cli.recognise import Output, show
from nextview.data.samples import sample_mesh
from nextview.session.system import load, simulated

DEMO_PICTURE = Path("nextview_demo.png")


def demo(
    shape: Literal["table", "chair", "monitor"] = "table",
    start: int = 33,
    figure: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Recognise a sample object that ships with nextview, and draw the episode.

    Args:
        shape: the sample object.
        start: index of the first view, 0 to 39.
        figure: file of the picture; by default nextview_demo.png, which is replaced.
        overwrite: replace an existing picture of another name.
    """
    output = Output(figure, overwrite=overwrite)
    if figure is None:  # the name is the demo's own: a second demo draws over the first
        output = Output(DEMO_PICTURE, overwrite=True)
    check_file(output.figure, output.overwrite)
    system = load()
    camera = simulated(sample_mesh(shape))
    session = system.session_with(camera, start)
    show(session, camera, f"the sample {shape}", system.policy_name, output)
