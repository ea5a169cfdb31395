"""Recognise objects in rooms: by the aim of the camera alone, by a point or by a mask, through a
good and a poor camera.

    nextview-lab scenes ModelNet10 rooms --levels room --split train --scenes 60
    python -m nextview_lab.studies.room rooms ModelNet10 OUT.jsonl

    nextview-lab scenes YCB tables --levels room --unit m --scenes 40
    python -m nextview_lab.studies.room tables YCB OUT.jsonl --models ycb --by point mask

Each room is looked at from its first view on, with all defaults, until the session is done. By
"pose" nothing is said but where the camera is and that it is aimed at the object. The point lies
beside the object's centre by a fiftieth of the camera's distance, one standard deviation along each
horizontal axis. The mask is two pixels too wide. Frames are 16-bit millimetres, and their poses are
right. The good camera is the sensor "stereo", like a RealSense D435 (standard deviation of the
depth 0.6 mm at 0.4 m); the poor one, "stereo:2", has twice its errors: noise, edges, holes, flying
pixels.

OUT.jsonl gets a line for each episode; episodes that it holds are not run again. Printed is, for
each way and camera, the share that is named right (95 % Wilson interval), called unknown, named
wrong with confidence; the share without any frame that was taken in; the share whose radius is
within 15 % of the truth; and the views taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal, get_args
from zlib import crc32

import numpy as np
import tyro
from scipy.ndimage import binary_dilation

import nextview
from nextview import System
from nextview.cli.exit_status import orderly_end
from nextview.errors import DatasetError, ObservationError, UsageError
from nextview.sensing import Frame, ObservedObject
from nextview.simulation.sensor import Sensor, sensor_named
from nextview_lab.studies.shared import markdown, results, share
from nextview_lab.worlds.scene import TargetScene, build_scene
from nextview_lab.worlds.scene_cameras import RoomCamera
from nextview_lab.worlds.scene_layout import SceneLayout

By = Literal["pose", "point", "mask"]
Asked = tuple[str, int, str, str, By]  # values of FIELDS

FIELDS = ("models", "seed", "room", "sensor", "by")  # by which a line is known
POINT_OFF = 0.02  # standard deviation of the point, as a part of the camera's distance
MASK_WIDER = 2  # pixels
MOST_LOOKS = 8  # frames of an episode, those that are refused among them
SAME_SIZE = 0.15  # relative error of the radius up to which the size is right


@lru_cache(maxsize=1)
def system_of(models: str) -> System:
    """A system, loaded once for each process."""
    return nextview.load(models, threads=1)


@lru_cache(maxsize=1)
def room_of(file: Path, meshes: Path) -> tuple[SceneLayout, TargetScene]:
    """A room, built once for the episodes in it."""
    layout = SceneLayout.load(file)
    return layout, build_scene(layout, meshes)


def episode(rooms: Path, meshes: Path, asked: Asked) -> dict[str, Any]:
    """Run an episode.

    Args:
        rooms: folder of the rooms.
        meshes: folder of their meshes.
        asked: values of ``FIELDS``.

    Returns:
        What is written of it.
    """
    models, seed, file, name, by = asked
    layout, room = room_of(rooms / file, meshes)
    sensor = sensor_named(name)
    if not isinstance(sensor, Sensor):
        raise UsageError(f"{name}: a camera in a room is one sensor, no mix")
    camera = RoomCamera(room, sensor, seed)

    pose = layout.first_pose
    distance = float(np.linalg.norm(pose[:3, 3]))
    rng = np.random.default_rng([seed, crc32(layout.name.encode())])
    point = np.append(rng.normal(0, POINT_OFF * distance, 2), 0.0)
    thing = ObservedObject(point=point) if by == "point" else ObservedObject()
    session = system_of(models).session(object=thing, distance=distance)
    session.reachable = camera.reachable

    looks = 0
    while not session.done and looks < MOST_LOOKS:
        frame, shown = camera.look(pose)
        mask = binary_dilation(shown, iterations=MASK_WIDER) if by == "mask" else None
        looks += 1
        try:
            session.update(
                Frame(frame.depth, frame.intrinsics, pose, mask=mask, pixel_centre=0.5)
            )
        # UsageError: what was found is larger than the distance at which to stand
        except (ObservationError, UsageError):
            if not session.views:
                break
            session.failed()
        if session.target is not None:
            pose = session.target

    views = len(session.views)
    line: dict[str, Any] = {"label": layout.label, "views": views}
    if views:
        result = session.result
        assert session.object is not None
        line |= {
            "answer": result.answer,
            "confident": bool(result.confident),
            "unknown": bool(result.unknown),
            "ratio": session.object.object_frame.radius / camera.metres,
        }
    return line


def row(some: Sequence[dict[str, Any]]) -> list[str]:
    """The cells of some episodes."""
    total = len(some)
    right = [one.get("answer") == one["label"] for one in some]
    shares = (
        [one.get("unknown", False) for one in some],
        [
            one.get("confident", False) and not good
            for one, good in zip(some, right, strict=True)
        ],
        [not one["views"] for one in some],
        [abs(one.get("ratio", np.inf) - 1) <= SAME_SIZE for one in some],
    )
    cells = [f"{np.mean(share):.3f}" for share in shares]
    return [
        share(sum(right), total),
        *cells,
        f"{np.mean([one['views'] for one in some]):.2f}",
    ]


def main(
    rooms: tyro.conf.Positional[Path],
    meshes: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    by: tuple[By, ...] = get_args(By),
    sensors: tuple[str, ...] = ("stereo", "stereo:2"),
    models: str = "modelnet10",
    seed: int = 0,
    workers: int = 1,
) -> None:
    """Recognise the objects in some rooms, and print how it went.

    Args:
        rooms: folder that nextview-lab scenes --levels room drew.
        meshes: folder of the meshes that they are made of.
        out: JSON lines, continued if it exists.
        by: how the object is said.
        sensors: cameras, NAME or NAME:STRENGTH.
        models: bundled models, or a folder with some.
        seed: of points and of noise.
        workers: processes; 0 to work in this one.
    """
    files = sorted(
        path.relative_to(rooms).as_posix()
        for path in rooms.rglob("*.json")
        if not path.name.startswith(".")
    )
    if not files:
        raise DatasetError(
            f"{rooms}: holds no rooms; nextview-lab scenes --levels room draws some"
        )
    ways = [(sensor, way) for sensor in sensors for way in by]
    asked = [(models, seed, file, *way) for file in files for way in ways]
    run = partial(episode, rooms, meshes)
    found = results(out, FIELDS, asked, run, "episodes", workers)
    columns = (
        "camera, by",
        "right",
        "unknown",
        "confident and wrong",
        "no frame taken in",
        "radius within 15 %",
        "views",
    )
    rows = []
    for sensor, way in ways:
        some = [one for one in found if (one["sensor"], one["by"]) == (sensor, way)]
        rows.append([f"{sensor}, {way}", *row(some)])
    print(markdown(columns, rows))


if __name__ == "__main__":
    with orderly_end("the episodes that were done are kept"):
        tyro.cli(main)
