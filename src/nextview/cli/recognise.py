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
    viewpoints: str = "40",
    start: int | None = None,
    up: Literal["y", "z"] | None = None,
    unit: Unit | None = None,
    max_faces: int = MAX_FACES,
    seed: int = 0,
    sensor: str | None = None,
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
        viewpoints: where the camera may look from: 40 or 12 views, rings:0,30,60x12 (elevations in degrees by views on
            each ring), or fibonacci:60 (spread evenly over the upper half).
        start: first view; of the 40, 0 to 39 (ring * 8 + azimuth step); drawn by the seed if not given.
        up: the file's up axis; z if not given, but y for GLB.
        unit: the file's unit of length, if it is known: how large an object is says something of its class.
        max_faces: refuse a mesh of more triangles, or a file of more than 60 bytes for each of these.
        seed: decides the first view, whatever the policy draws and the errors of a sensor.
        sensor: look through a sensor with all its errors: kinect, stereo, setup, wrist or none, or NAME:STRENGTH
            (docs/your_camera.md); clean renders if not given.
        figure: write a picture of the episode to this file (PNG, PDF or SVG).
        json: print JSON instead of a table.
        timing: also print where the time went, from the start of the process.
    """
    from nextview.mesh import load_mesh

    options = {"policy": policy, "threshold": threshold, "risk": risk, "max_views": max_views, "viewpoints": viewpoints}
    name = mesh.name if sensor is None else f"{mesh.name} through {sensor}"
    show(lambda: load_mesh(mesh, up, unit, max_faces), name, models, options, start, seed, figure, json, timing, sensor)


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
    sensor: str | None = None,
) -> None:
    """Recognise what ``load`` returns and print the episode; ``options`` are those of ``nextview.load``."""
    from nextview import system
    from nextview.cli.episode_table import as_json, print_episode
    from nextview.cli.timing import Stopwatch
    from nextview.errors import ObservationError

    watch = Stopwatch()
    watch.lap("importing")
    camera = system.simulated(load(), sensor, seed)
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
    if result.answer is None:
        why = "is it made of a few small parts far apart?" if sensor is None else "are the sensor's errors too strong?"
        raise ObservationError(
            f"{name}: there is no answer, for nothing of the mesh is seen from any of {len(result.views)} views; {why}"
        )
    if json:
        print(as_json(result))
    else:
        print_episode(result, name, opened.policy_name)
    if timing:
        watch.show()
    if figure:
        result.plot(figure, name)
