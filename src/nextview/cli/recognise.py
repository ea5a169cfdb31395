"""``nextview recognise``: look at one mesh until it is clear what it is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from nextview.mesh_format import MAX_FACES

if TYPE_CHECKING:
    from nextview.mesh import Mesh

Unit = Literal["mm", "cm", "inch", "foot", "m"]
"""The keys of ``mesh.UNITS``, without the time that it takes to import them."""


def recognise(
    mesh: tyro.conf.Positional[Path],
    /,
    models: str = "modelnet10",
    policy: str | None = None,
    threshold: float = 0.97,
    risk: float | None = None,
    max_views: int = 5,
    unknown: float = 0.0,
    start: int | None = None,
    up: Literal["y", "z"] | None = None,
    unit: Unit | None = None,
    max_faces: int = MAX_FACES,
    seed: int = 0,
    figure: Path | None = None,
    json: bool = False,
    timing: bool = False,
) -> None:
    """Recognise the object in a mesh file by next best views, and show where it looked and why.

    Args:
        mesh: OFF, OBJ, PLY, STL or GLB file of one object that stands upright.
        models: bundled models by name, or a folder with models of your own.
        policy: how the next view is chosen: gain (the predicted gain of a view less its weighted travel; the default),
            lem, lem-peak, lcm, lcm-peak, random, random-all, furthest, unidirectional, spread, spread-local, another
            learned one, the card of one (.json), or MODULE:CLASS for your own.
        threshold: stop when the belief in one class reaches this after one view, less after several.
        risk: instead, stop at the lowest threshold at which at most this share of those who stop early is wrong.
        max_views: stop after so many views.
        unknown: say "unknown" of an object that looks as strange as at most this share of the objects of known
            classes (0.05: so one in 20 of these is taken for unknown); 0 always names a class. Ends with status 0 too.
        start: first view, 0 to 39 (ring * 8 + azimuth step); drawn by the seed if not given.
        up: the file's up axis; z if not given, but y for GLB.
        unit: the file's unit of length, if it is known: how large an object is says something of its class.
        max_faces: refuse a mesh of more triangles, or a file of more than 60 bytes for each of these.
        seed: decides the first view and whatever the policy draws.
        figure: write a picture of the episode to this file (PNG, PDF or SVG).
        json: print JSON instead of a table.
        timing: also print where the time went, from the start of the process.
    """
    from nextview.mesh import load_mesh

    options = {"policy": policy, "threshold": threshold, "risk": risk, "max_views": max_views, "unknown": unknown}
    show(lambda: load_mesh(mesh, up, unit, max_faces), mesh.name, models, options, start, seed, figure, json, timing)


def show(
    load: Callable[[], Mesh],
    name: str,
    models: str,
    options: dict,
    start: int | None,
    seed: int,
    figure: Path | None,
    json: bool = False,
    timing: bool = False,
) -> None:
    """Recognise what ``load`` returns and print the episode; ``options`` are those of ``nextview.load``."""
    from nextview import system
    from nextview.cameras.simulated import SimulatedCamera
    from nextview.cli.episode_table import as_json, print_episode
    from nextview.cli.timing import Stopwatch
    from nextview.errors import ObservationError

    watch = Stopwatch()
    watch.lap("importing")
    camera = SimulatedCamera(load())
    watch.lap("building the scene")
    opened = system.load(models, **options)
    session = opened.session(start, seed)
    watch.lap("loading the models")
    while not session.done:
        seen = camera.observe(session.pose)
        watch.lap("looking")
        session.update(seen)
        watch.lap("thinking")
    result = session.result
    if not result.seen:
        raise ObservationError(
            f"{name}: there is no answer, for nothing of the mesh is seen from any of {len(result.views)} views; "
            "is it made of a few small parts far apart?"
        )
    if json:
        print(as_json(result))
    else:
        print_episode(result, name, opened.policy_name)
    if timing:
        watch.show()
    if figure:
        result.plot(figure, name)
