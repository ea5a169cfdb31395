"""``nextview explore``: an object, the views of it and what policies value them at, in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro


def explore(
    path: tyro.conf.Positional[Path | None] = None,
    /,
    policy: str | None = None,
    compare: str | None = None,
    models: str = "modelnet10",
    threshold: float = 0.97,
    max_views: int = 5,
    viewpoints: str = "40",
    sensor: str | None = None,
    start: int | None = None,
    up: Literal["y", "z"] | None = None,
    seed: int = 0,
    host: str = "127.0.0.1",
    port: int = 8080,
    browser: bool = True,
) -> None:
    """Look at objects in the browser: click where to look from, or let a policy walk, and see what it believes.

    Candidate views are coloured by what the policy values them at. Images, local maps and belief follow at once. Two
    policies walk side by side, with clean renders or through a sensor with its errors.

    Args:
        path: a mesh file; a folder of meshes, or of class folders of them; a view store. The sample objects if not
            given.
        policy: how the next view is chosen, as in nextview recognise.
        compare: another policy, to walk beside it.
        models: bundled models by name, or a folder with models of your own.
        threshold: the belief at which an episode would stop; exploring goes on.
        max_views: the number of views at which it would.
        viewpoints: where the camera may look from, as in nextview recognise.
        sensor: look through a sensor with all its errors: kinect, stereo, setup, wrist or none, or NAME:STRENGTH.
        start: where policies look first; drawn by the seed if not given.
        up: the up axis of mesh files; z if not given, but y for GLB.
        seed: decides the first view, whatever a policy draws and the errors of a sensor.
        host: address to serve the page at; 0.0.0.0 lets other machines see and drive it.
        port: of the page; the next free one if it is taken.
        browser: open the page in this machine's browser, where it has a screen.
    """
    import viser  # noqa: F401  # so that what is missing is said before models are opened

    from nextview.cli.progress import console
    from nextview.explorer.exploration import Exploration
    from nextview.explorer.page import Page
    from nextview.explorer.shown_object import shown_objects

    policies = [policy] if compare is None else [policy, compare]
    options = {"threshold": threshold, "max_views": max_views, "viewpoints": viewpoints}
    exploration = Exploration(shown_objects(path, up), policies, sensor, start, seed, models=models, **options)
    page = Page(exploration, host, port)
    console.print(f"{page.address} shows {len(exploration.objects)} objects; Ctrl-C ends it", highlight=False)
    if browser and has_screen():
        import webbrowser

        webbrowser.open(page.address)
    try:
        page.server.sleep_forever()
    finally:
        page.stop()


def has_screen() -> bool:
    """Whether a window can be shown: else a browser would open in the terminal."""
    import os
    import sys

    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
