"""When a scene says that it is done: what is left unknown, unseen or wrong at that moment.

    python -m benchmarks.machine_parts PARTS            # generated parts, millimetres
    nextview learn PARTS taught --unit mm
    python -m benchmarks.ends PARTS OUT.jsonl --models taught --unit mm [--draws 20] [--seed 1]
    python -m benchmarks.ends SCANS OUT.jsonl --place bin [--draws 1]

The world is that of ``benchmarks/staged_things.py``, which shares no code with nextview: one thing
alone on a table, as it falls, or in a bin with four others. A scene looks at it, first from a
random view and then from its own targets, until it is done. It segments the frames by itself; for a
bin, ``region`` is its inside. The poses of the camera are wrong by ``--arm-error``, along and about
each axis. Targets are above 20 degrees.

Printed is how many scenes were done before the largest number of views, and of these in how many
the thing is named right, is unknown, has a wrong name, or belongs to no object; how many are done
without any object; the frames that it took, and those that were refused, all of them false alarms:
another one is taken from a random place. OUT.jsonl gets a line for each scene; those that it
holds are not run again.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import trimesh
import tyro

import nextview
from benchmarks.shared import names_to_stage, results
from benchmarks.staged_things import (
    CAMERA_MATRIX,
    ENOUGH_PIXELS,
    Bools,
    Float,
    as_told,
    camera_at,
    camera_distance,
    looked,
    scan_of,
    staged,
    true_pose,
)
from nextview.cli.exit_status import orderly_end
from nextview.errors import ObservationError
from nextview.scene.scene import Scene
from nextview.sensing import Box, Frame

BIN_INSIDE = Box((-0.2, -0.15, -0.02), (0.2, 0.15, 0.25))
LOWEST = np.sin(np.radians(20))  # of the directions of targets
MOST_FRAMES = 8
METRES = {"m": 1.0, "mm": 0.001}
FIELDS = ("place", "thing", "draw", "seed")  # by which a line of the results is known
End = Literal["right", "unknown", "wrong", "no object"]


def look_until_done(
    scene: Scene,
    world: tuple[Any, Any],
    aim: Float,
    distance: float,
    arm_error: tuple[float, float],
    rng: np.random.Generator,
) -> tuple[list[Bools], list[str]]:
    """Show a world to a scene until it is done.

    Returns:
        Pixels of the thing in each frame that was used, and why others were refused.
    """
    model, data = world
    masks: list[Bools] = []
    refused: list[str] = []

    def anywhere() -> Float:
        return camera_at(aim, rng.uniform(0, 360), rng.uniform(35, 65), distance)

    pose = anywhere()
    while len(refused) < MOST_FRAMES:
        depth, mask = looked(model, data, pose, rng)
        frame = Frame(depth, CAMERA_MATRIX, as_told(pose, arm_error, rng))
        try:
            look = scene.update(frame)
        except ObservationError as error:
            refused.append(str(error))
            pose = anywhere()
            continue
        if look.taken:
            masks.append(mask)
        else:
            refused.append(str(look.warnings[0]))
        target = scene.target
        if scene.done or target is None:
            break
        pose = target if look.taken else anywhere()
    return masks, refused


def end_of(scene: Scene, masks: Sequence[Bools], name: str) -> End:
    """What the object that shows most of the thing is called."""
    shown = {
        one.number: sum(
            np.count_nonzero(pixels & masks[k]) for k, pixels in one.pixels.items()
        )
        for one in scene.objects
    }
    best = max(shown, key=lambda number: shown[number], default=None)
    if best is None or shown[best] < ENOUGH_PIXELS / 4:
        return "no object"
    found = next(one for one in scene.objects if one.number == best)
    if found.name == name:
        return "right"
    return "unknown" if found.pose is None else "wrong"


def watched(
    system: nextview.System,
    folder: Path,
    arm_error: tuple[float, float],
    asked: tuple[Literal["alone", "bin"], str, int, int],
) -> dict[str, Any]:
    """Stage a thing and look until the scene is done.

    Args:
        system: that knows the things.
        folder: of the scans, in metres.
        arm_error: standard deviations of the camera's poses along and about each axis, mm, degrees.
        asked: values of ``FIELDS``.

    Returns:
        What is written of it; only that it has no end if the thing does not stay there.
    """
    place, name, draw, seed = asked
    rng = np.random.default_rng([seed, draw, place == "bin", *name.encode()])
    found = staged(place, str(folder), name, rng)
    if found is None:
        return {"end": None}
    world, _ = found
    scan = scan_of(str(folder), name)
    true = true_pose(world[1])
    middle = true[:3, :3] @ scan.bounds.mean(0) + true[:3, 3]
    aim = np.array([0.0, 0, 0.04]) if place == "bin" else middle
    distance = 0.6 if place == "bin" else camera_distance(scan)

    scene = Scene(
        system,
        region=BIN_INSIDE if place == "bin" else None,
        distance=distance,
        reachable=lambda pose: bool(-pose[2, 2] > LOWEST),
    )
    masks, refused = look_until_done(scene, world, aim, distance, arm_error, rng)
    return {
        "end": end_of(scene, masks, name),
        "frames": len(masks),
        "objects": len(scene.objects),
        "settled": scene.done and len(scene.frames) < MOST_FRAMES,
        "refused": refused,
        "open": [repr(one) for one in scene.open],
        "pixels": [int(np.count_nonzero(mask)) for mask in masks],
    }


def summary(lines: Sequence[dict[str, Any]]) -> str:
    """The table."""
    shown = [line for line in lines if line["end"] is not None]
    done = [line for line in shown if line["settled"]]
    heads = ["scenes", "done before the last view", "named right", "unknown"]
    heads += ["wrong name", "no object", "no object at all", "frames, mean", "refused"]
    ends = [line["end"] for line in done]
    cells = [len(shown), len(done), ends.count("right"), ends.count("unknown")]
    cells += [ends.count("wrong"), ends.count("no object")]
    cells.append(sum(line["objects"] == 0 for line in done))
    frames = f"{np.mean([line['frames'] for line in shown]):.2f}" if shown else "-"
    refused = str(sum(len(line["refused"]) for line in shown))
    row = " | ".join([*map(str, cells), frames, refused])
    return f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|\n| {row} |"


def main(
    scans: tyro.conf.Positional[Path],
    output: tyro.conf.Positional[Path],
    place: Literal["alone", "bin"] = "alone",
    draws: int = 20,
    most: int = 0,
    seed: int = 1,
    models: str = "ycb",
    unit: Literal["m", "mm"] = "m",
    unknown: float = 0.02,
    arm_error: tuple[float, float] = (3.0, 0.3),
) -> None:
    """Look at things until a scene is done, and count what is left unknown.

    Args:
        scans: folder of the scans, NAME.ply.
        output: a line of JSON for each scene; those that it holds are not run again.
        place: where the thing is.
        draws: how often each thing is shown.
        most: number of scenes, of things in a random order; 0 for all.
        seed: of everything random.
        models: memory that was taught with the scans.
        unit: of the scans.
        unknown: significance level of the test for unknown objects.
        arm_error: standard deviations of the camera's poses along and about each axis, mm, degrees.

    Raises:
        UsageError: there are no scans.
    """
    names = names_to_stage(scans)
    system = nextview.load(models, unknown=unknown, max_views=MOST_FRAMES)
    asked = [(place, name, draw, seed) for draw in range(draws) for name in names]
    order = np.random.default_rng(seed).permutation(len(asked))
    asked = [asked[k] for k in order][: most or None]
    with TemporaryDirectory() as folder:
        for name in names:
            scan = trimesh.load_mesh(scans / f"{name}.ply", process=False)
            scan.apply_scale(METRES[unit])
            scan.export(Path(folder) / f"{name}.ply")
        run = partial(watched, system, Path(folder), arm_error)
        print(summary(results(output, FIELDS, asked, run, "scenes")))


if __name__ == "__main__":
    with orderly_end("the scenes that were done are kept"):
        tyro.cli(main)
