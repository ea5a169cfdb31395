"""Sessions for each object of a table, and a scene of all, in the same frames.

    python -m benchmarks.sessions_and_scenes SCANS STRANGERS OUT.jsonl [--tables 8] [--seed 1]

Tables, camera and first views are those of ``nextview-lab benchmark tables``; the next views are a
quarter circle on. A scene takes all frames. For each object with 100 pixels in the first frame a
session takes the same frames; it is given a point on the object: the measured point that is
nearest to their median. Both segment the frames themselves. Counted are right names and confident
wrong ones; for strangers any name, and confident ones. A session that has ended keeps its answer.
OUT.jsonl gets a line for each table; those that it holds are not run again.
"""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.shared import markdown, results
from nextview.cli.exit_status import orderly_end
from nextview.errors import ObservationError
from nextview.scene.objects import UNKNOWN_NAME
from nextview.scene.view_policies import VIEW_ELEVATIONS
from nextview.sensing import Frame, ObservedObject
from nextview.session.system import System
from nextview.simulation.sensor import SENSORS
from nextview.types import Float, Mask
from nextview_lab.benchmark.table_runs import (
    CAMERA_FROM_TABLE,
    STRANGER,
    TABLE_CENTRE,
    Looking,
    draw_table,
    meshes_in,
    opened_models,
)
from nextview_lab.worlds.tables import TableCamera, poses_around

FEWEST_PIXELS = 100  # of an object in the first frame
Answers = list[tuple[str, bool]]
"""After each frame: name, "" for none, and whether it is confident."""


def point_on(frame: Frame, own: Mask) -> Float:
    """The measured point of an object that is nearest to the median of all, (3,), metres.

    Args:
        frame: that shows the object.
        own: its pixels, (H, W) bool.
    """
    points = frame.positions(*np.nonzero(own & (frame.depth > 0)))
    return points[np.linalg.norm(points - np.median(points, 0), axis=1).argmin()]


def by_a_session(system: System, frames: list[Frame], point: Float) -> Answers:
    """What a session for the object at a point answers.

    Args:
        system: with the taught things.
        frames: in order.
        point: on the object, (3,), metres.
    """
    session = system.session(object=ObservedObject(point=point), distance=0.5)
    found: Answers = []
    for frame in frames:
        try:
            if not session.done:
                session.update(frame)
        except ObservationError:
            pass  # the object is not found in this frame
        result = session.result
        name = (result.answer or "") if session.views else ""
        found.append((name, bool(name) and result.confident))
    return found


def by_the_scene(looking: Looking) -> dict[int, tuple[str, bool]]:
    """Name and confidence of each object on the table, right ones first."""
    found: dict[int, tuple[str, bool]] = {}
    for one in looking.scene.objects:
        number = looking.truth(one)
        name = "" if one.name == UNKNOWN_NAME else one.name
        if number >= 0 and (
            number not in found or name == looking.camera.table.things[number].name
        ):
            found[number] = name, one.confident
    return found


def both(
    asked: tuple[int, int], scans: Path, strangers: Path, models: str, frames: int
) -> dict[str, Any]:
    """Look at a table by a scene and by sessions: a line of the output.

    Args:
        asked: seed and number of the table.
        scans: folder of the scans that the memory knows, metres.
        strangers: folder of other meshes.
        models: memory of the things.
        frames: of the table.
    """
    rng = np.random.default_rng(asked)
    table = draw_table(meshes_in(scans), meshes_in(strangers), rng)
    camera = TableCamera(table, SENSORS["wrist"], np.random.default_rng([*asked, 1]))
    rng = np.random.default_rng([*asked, 2])
    azimuth = rng.uniform(0, 2 * np.pi)
    elevation = np.radians(rng.uniform(*VIEW_ELEVATIONS))
    around = azimuth + np.pi / 2 * np.arange(frames)
    system, _ = opened_models(models, None)
    looking = Looking(camera, system)
    taken = []
    seconds = []
    by_scene = []
    owner = np.zeros((0, 0), np.int64)
    for pose in poses_around(around, elevation, CAMERA_FROM_TABLE, TABLE_CENTRE):
        taken.append(looking.look(pose))
        seconds.append(looking.seconds)
        by_scene.append(by_the_scene(looking))
        owner = owner if owner.size else camera.owner.copy()

    rows = []
    begun = time.process_time()
    for number, thing in enumerate(table.things):
        own = (owner == number) & (taken[0].depth > 0)
        if np.count_nonzero(own) >= FEWEST_PIXELS:
            answers = by_a_session(system, taken, point_on(taken[0], own))
            scene = [one.get(number, ("", False)) for one in by_scene]
            rows.append({"thing": thing.name, "session": answers, "scene": scene})
    spent = time.process_time() - begun
    return {"objects": rows, "scene_seconds": sum(seconds), "session_seconds": spent}


def summary(lines: list[dict[str, Any]], frames: int) -> str:
    """Counts after each frame, for sessions and for scenes.

    Args:
        lines: of the tables.
        frames: of each table.
    """
    objects = [one for line in lines for one in line["objects"]]
    known = [one for one in objects if one["thing"] != STRANGER]
    strangers = [one for one in objects if one["thing"] == STRANGER]
    rows = []
    for k in range(frames):
        for who in ("session", "scene"):
            named = [(one["thing"], *one[who][k]) for one in known]
            other = [one[who][k] for one in strangers]
            rows.append(
                [
                    k + 1,
                    who,
                    f"{sum(name == true for true, name, _ in named)} of {len(known)}",
                    sum(sure for _, _, sure in named),
                    sum(sure and name != true for true, name, sure in named),
                    f"{sum(bool(name) for name, _ in other)} of {len(strangers)}",
                    sum(sure for _, sure in other),
                ]
            )
    heads = ["frames", "by", "right", "confident", "confident and wrong"]
    heads += ["strangers named", "with confidence"]
    each = sum(line["session_seconds"] for line in lines) / len(objects) / frames
    all_of = sum(line["scene_seconds"] for line in lines) / len(lines) / frames
    time_of = f"CPU seconds a frame: session {each:.1f}, scene of all {all_of:.1f}"
    return "\n".join([markdown(heads, rows), time_of])


def main(
    scans: tyro.conf.Positional[Path],
    strangers: tyro.conf.Positional[Path],
    output: tyro.conf.Positional[Path],
    tables: int = 8,
    frames: int = 3,
    seed: int = 1,
    models: str = "ycb",
) -> None:
    """Compare sessions with a scene in the same frames.

    Args:
        scans: folder of the scans that the memory knows, metres.
        strangers: folder of other meshes.
        output: a line of JSON for each table; those that it holds are not run again.
        tables: number of tables.
        frames: of each table.
        seed: of the tables and views.
        models: memory of the things.
    """
    asked = [(seed, number) for number in range(tables)]
    look = partial(both, scans=scans, strangers=strangers, models=models, frames=frames)
    lines = results(output, ("seed", "table"), asked, look, "Tables")
    print(summary(lines, frames))


if __name__ == "__main__":
    with orderly_end("the tables that were done are kept"):
        tyro.cli(main)
