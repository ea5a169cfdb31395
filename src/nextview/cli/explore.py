"""``nextview explore``: show an object, its views and their values in the browser."""

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from nextview.checks import check_extras, number_of
from nextview.cli.common_options import EpisodeOptions, Unit
from nextview.cli.progress import console

if TYPE_CHECKING:
    from nextview.viewers.exploration import Exploration


def explore(
    path: Path | None = None,
    /,
    looking: EpisodeOptions = EpisodeOptions(),
    compare: str | None = None,
    sensor: str | None = None,
    start: int | None = None,
    up: Literal["y", "z"] | None = None,
    unit: Unit | None = None,
    seed: int = 0,
    host: str = "127.0.0.1",
    port: int = 8080,
    browser: bool = True,
) -> None:
    """Explore objects in the browser: click on views to take them, or let a policy choose.

    Candidate views are coloured by the value that the policy assigns to them. Images, local maps
    and beliefs are updated at once. Two policies can run side by side, on noise-free renders or
    with a simulated sensor.

    Args:
        path: mesh file, or folder of meshes or of class folders; by default the sample objects.
        looking: Models and policies. More views can be taken after the end of an episode.
        compare: second policy, which runs side by side with the first.
        sensor: simulated depth camera: kinect, stereo, tof, scanner, setup, wrist or none, or
            NAME:STRENGTH.
        start: index of the first view; by default random.
        up: up axis of the mesh files; by default z, and y for GLB.
        unit: unit of length of the mesh files; if it is given, size counts as evidence.
        seed: seed of the first view, the policies and the sensor errors.
        host: address at which the page is served; 0.0.0.0 makes it reachable from other machines.
        port: port of the page; if it is taken, the next free one is used.
        browser: by default the page is opened in a browser.
    """
    check_extras("explore")
    from nextview.viewers.exploration import Exploration, shown_objects

    options = dict(vars(looking))
    policies = [options.pop("policy"), *([] if compare is None else [compare])]
    shown = shown_objects(path, up, unit)
    serve(
        Exploration(shown, policies, sensor, start, seed, **options),
        host,
        port,
        browser,
    )


def serve(exploration: "Exploration", host: str, port: int, browser: bool) -> None:
    """Serve the page of an exploration until it is stopped.

    Args:
        exploration: what the page shows.
        host: address at which the page is served.
        port: port of the page; if it is taken, the next free one is used.
        browser: whether the page is opened in a browser.
    """
    from nextview.viewers.page import Page

    page = Page(exploration, host, port)
    console.print(
        f"{page.address} shows {number_of(len(page.exploration.objects), 'object')};"
        " Ctrl-C ends it"
    )
    if host not in ("127.0.0.1", "localhost", "::1"):
        console.print(
            "Everybody who reaches this address may drive the page.",
            style="yellow",
        )
    screen = (
        sys.platform in ("darwin", "win32")
        or os.environ.get("DISPLAY")
        or os.environ.get("WAYLAND_DISPLAY")
    )
    if (
        browser and screen
    ):  # without a display, a text browser might start in the terminal
        import webbrowser

        webbrowser.open(page.address)
    try:
        page.server.sleep_forever()
    finally:
        page.stop()
