"""``nextview recognise``: look at one object, a mesh or captured views, until it is clear what it is."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from nextview.mesh_format import MAX_FACES

if TYPE_CHECKING:
    from nextview.observation import Camera
    from nextview.session import FrameCamera

Unit = Literal["mm", "cm", "inch", "foot", "m"]
"""The keys of ``mesh.UNITS``, without the time that it takes to import them."""
Three = tuple[float, float, float]


def recognise(
    path: tyro.conf.Positional[Path],
    /,
    models: str = "modelnet10",
    policy: str | None = None,
    threshold: float = 0.97,
    risk: float | None = None,
    max_views: int = 5,
    viewpoints: str = "40",
    unknown: float = 0.0,
    start: int | None = None,
    up: Literal["y", "z"] | Three | None = None,
    unit: Unit | None = None,
    max_faces: int = MAX_FACES,
    point: Three | None = None,
    box: tuple[float, float, float, float, float, float] | Path | None = None,
    object_id: int | None = None,
    intrinsics: tuple[float, float, float, float] | Path | None = None,
    raw: bool = False,
    any_size: bool = False,
    seed: int = 0,
    sensor: str | None = None,
    figure: Path | None = None,
    record: Path | None = None,
    json: bool = False,
    timing: bool = False,
) -> None:
    """Recognise an object by next best views, and show where it looked and why.

    The object is in a mesh file, or in a folder of captured depth images with poses in the layout of BOP, TUM RGB-D or
    7-Scenes. Of these the view nearest to the one asked for answers. The object is what the masks show; else what lies
    in the box; else the thing on the support plane that is nearest to the point, or the largest.

    Args:
        path: OFF, OBJ, PLY, STL or GLB file of one object that stands upright; or a folder of captured views.
        models: bundled models by name, or a folder with models of your own.
        policy: how the next view is chosen: gain (the predicted gain of a view less its weighted travel; the default),
            MAP, MAP-peak or MAP-sphere-peak for a map of the models (lem, lcm), random, random-all, furthest,
            unidirectional, spread, spread-local, another learned one, the card of one (.json), or MODULE:CLASS for your
            own.
        threshold: stop when the belief in one class reaches this after one view, less after several.
        risk: instead, stop at the lowest threshold at which at most this share of those who stop early is wrong.
        max_views: stop after so many views.
        viewpoints: where the camera may look from: 40 or 12 views, rings:0,30,60x12 (elevations in degrees by views on
            each ring), or fibonacci:60 (spread evenly over the upper half).
        unknown: say "unknown" of an object that looks as strange as at most this share of the objects of known
            classes (0.05: so one in 20 of these is taken for unknown); 0 always names a class. Ends with status 0 too.
        start: first view; of the 40, 0 to 39 (ring * 8 + azimuth step); drawn by the seed if not given.
        up: a mesh file's up axis; z if not given, but y for GLB. Of a folder, also a direction in its world; z if not
            given, but the normal of the support plane for 7-Scenes.
        unit: a mesh file's unit of length, if it is known: how large an object is says something of its class.
        max_faces: refuse a mesh of more triangles, or a file of more than 60 bytes for each of these.
        point: of a folder: near the object that is meant, metres, in the capture's world.
        box: of a folder: the upright box into which the object just fits, its low and its high corner, metres (heights
            along --up), or a JSON file with low, high and axes.
        object_id: of a BOP folder with several objects: the one that is meant.
        intrinsics: of a folder: FX FY CX CY, pixels, or a file with the pinhole matrix.
        raw: of a folder: take the depth as it is, without denoising.
        any_size: of a folder: the object's size says nothing of its class, as with toys.
        seed: decides the first view, whatever the policy draws and the errors of a sensor.
        sensor: look at a mesh through a sensor with all its errors: kinect, stereo, setup, wrist or none, or
            NAME:STRENGTH (docs/your_camera.md); clean renders if not given.
        figure: write a picture of the episode to this file (PNG, PDF or SVG).
        record: write the episode to this file (.rrd), for the Rerun viewer.
        json: print JSON instead of a table.
        timing: also print where the time went, from the start of the process.
    """
    from nextview.cli.show import show
    from nextview.errors import UsageError

    options = {"policy": policy, "threshold": threshold, "risk": risk, "max_views": max_views, "viewpoints": viewpoints}
    options["unknown"] = unknown
    if path.is_dir():
        if unit is not None:
            raise UsageError(f"{path}: --unit is for mesh files; a folder of captured views has lengths of its own")
        if sensor is not None:
            raise UsageError(f"{path}: --sensor is for mesh files; captured views have the errors of their own")

        def make() -> Camera | FrameCamera:
            from nextview.cli.captured_folder import captured_camera

            return captured_camera(path, up, point, box, object_id, intrinsics, raw, any_size)
    else:
        captured = {"point": point, "box": box, "object-id": object_id, "intrinsics": intrinsics}
        captured |= {"raw": raw or None, "any-size": any_size or None}
        for name, value in captured.items():
            if value is not None:
                raise UsageError(f"{path}: --{name} is for folders of captured views, and this is none")
        if isinstance(up, tuple):
            raise UsageError(f"{path}: the up axis of a mesh file is y or z, not {up}")

        def make() -> Camera | FrameCamera:
            from nextview.mesh import load_mesh
            from nextview.system import simulated

            return simulated(load_mesh(path, up, unit, max_faces), sensor, seed)

    name = path.name if sensor is None else f"{path.name} through {sensor}"
    show(make, name, models, options, start, seed, figure, json, timing, record)
