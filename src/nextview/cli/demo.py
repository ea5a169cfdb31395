"""``nextview demo``: recognise a bundled sample object."""

from __future__ import annotations

from pathlib import Path
from typing import Literal


def demo(
    shape: Literal["table", "chair", "monitor"] = "table", start: int = 33, figure: Path = Path("nextview_demo.png")
) -> None:
    """Recognise a sample object that ships with nextview, and draw the episode.

    Args:
        shape: which one.
        start: first view, 0 to 39.
        figure: where to write the picture.
    """
    from nextview.cameras.simulated import SimulatedCamera
    from nextview.cli.progress import console
    from nextview.cli.show import show
    from nextview.data.samples import sample_mesh

    def camera() -> SimulatedCamera:
        return SimulatedCamera(sample_mesh(shape))

    show(camera, f"the sample {shape}", "modelnet10", {}, start, seed=0, figure=figure)
    console.print(f"The picture is in {figure}; now try your own: nextview recognise MESH --figure out.png")
