"""``nextview recognise``: look at one mesh until it is clear what it is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from nextview.mesh_format import MAX_FACES

if TYPE_CHECKING:
    from nextview.cli.timing import Stopwatch
    from nextview.mesh import Mesh

Unit = Literal["mm", "cm", "inch", "foot", "m"]
"""The keys of ``mesh.UNITS``, without the time that it takes to import them."""


def recognise(
    mesh: tyro.conf.Positional[Path],
    /,
    policy: str = "gain",
    threshold: float = 0.97,
    risk: float | None = None,
    max_views: int = 5,
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
        policy: how the next view is chosen: gain (what a view is worth less its travel weight), lem, lem-peak, lcm,
            lcm-peak, random, random-all, furthest, unidirectional, spread, spread-local, another learned one that is
            bundled, or the card of one (.json).
        threshold: stop when the belief in one class reaches this after one view, less after several.
        risk: instead, stop at the lowest threshold at which at most this share of those who stop early is wrong.
        max_views: stop after so many views.
        start: first view, 0 to 39 (ring * 8 + azimuth step); drawn by the seed if not given.
        up: the file's up axis; z if not given, but y for GLB.
        unit: the file's unit of length, if it is known: how large an object is says something of its class.
        max_faces: refuse a mesh of more triangles, or a file of more than 60 bytes for each of these.
        seed: decides the first view and whatever the policy draws.
        figure: write a picture of the episode to this file (PNG, PDF or SVG).
        json: print JSON instead of a table.
        timing: also print where the time went, from the start of the process.
    """
    from nextview.cli.timing import Stopwatch

    watch = Stopwatch()
    from nextview.mesh import load_mesh

    def load() -> Mesh:
        return load_mesh(mesh, up, unit, max_faces)

    show(load, mesh.name, watch, policy, threshold, max_views, start, seed, figure, json, timing, risk)


def show(
    load: Callable[[], Mesh],
    name: str,
    watch: Stopwatch,
    policy: str = "gain",
    threshold: float = 0.97,
    max_views: int = 5,
    start: int | None = None,
    seed: int = 0,
    figure: Path | None = None,
    json: bool = False,
    timing: bool = False,
    risk: float | None = None,
) -> None:
    """Recognise what ``load`` returns and print the episode; the rest as for ``recognise``."""
    import numpy as np

    from nextview.belief import Stopping
    from nextview.cameras.simulated import SimulatedCamera
    from nextview.errors import ObservationError
    from nextview.models.inference import load_models
    from nextview.policies.registry import make_policy
    from nextview.session import Session
    from nextview.viewsphere import ViewSphere

    Stopping(threshold, max_views)  # says what is wrong with it
    sphere = ViewSphere.named("40")
    rng = np.random.default_rng(seed)
    drawn = int(rng.integers(len(sphere)))
    watch.lap("importing")
    camera = SimulatedCamera(load())
    watch.lap("building the scene")
    needs = make_policy(policy, sphere).needs
    models = load_models(needs)
    valleys = models.valley_classes(needs[0]) if needs else ()
    chosen = make_policy(policy, sphere, valleys, models.classes)
    calibration = models.recogniser.calibration
    stopping = Stopping(threshold, max_views, calibration.correlation)
    if risk is not None:
        stopping = Stopping(calibration.threshold(risk, max_views), max_views)
    session = Session(models, chosen, sphere, drawn if start is None else start, stopping, rng)
    watch.lap("loading the models")
    while not session.done:
        seen = camera.observe(session.pose)
        watch.lap("looking")
        session.update(seen)
        watch.lap("thinking")
    result = session.result
    if result.answer is None:
        raise ObservationError(
            f"{name}: there is no answer, for nothing of the mesh is seen from any of {len(result.views)} views; "
            "is it made of a few small parts far apart?"
        )

    from nextview.cli.episode_table import as_json, print_episode

    if json:
        print(as_json(result, sphere))
    else:
        print_episode(result, sphere, name, stopping)
    if timing:
        watch.show()
    if figure:
        from nextview.report.episode_figure import save_episode

        save_episode(result, sphere, figure, name)
