"""How much a second view of a table can bring: the target, random views, and the best of them.

    python -m benchmarks.second_views SCANS STRANGERS OUT.jsonl [--tables 20] [--seed 1]

Tables, camera and first views are those of ``nextview-lab benchmark tables``. From the state after
the first frame a scene looks once at its target, and once at each of some random candidates of 30
to 60 degrees elevation, every time as if it had not looked at the others. The best of the random
views by the truth is then looked at once more, with other noise: the first look chose it and
contains the luck of its noise, the second one does not. Printed are the things that are named
right, a table: after the first frame, after the target, after a random view (mean), and after the
best view, first and again. "Again" is what a rule can expect that knows of each view how it turned
out. OUT.jsonl gets a line for each table; those that it holds are not run again.
"""

from __future__ import annotations

from copy import copy
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.shared import markdown, results
from nextview.cli.exit_status import orderly_end
from nextview.scene.view_policies import VIEW_ELEVATIONS
from nextview.simulation.sensor import SENSORS
from nextview.types import Float
from nextview_lab.benchmark.statistics import sign_flip_p
from nextview_lab.benchmark.table_runs import (
    CAMERA_FROM_TABLE,
    TABLE_CENTRE,
    Looking,
    draw_table,
    meshes_in,
    opened_models,
)
from nextview_lab.worlds.tables import TableCamera, poses_around


def looked_from(before: Looking, pose: Float, seed: tuple[int, ...]) -> float:
    """Things named right after one more frame, which the given state does not notice."""
    first = before.camera
    camera = TableCamera(first.table, first.sensor, np.random.default_rng(seed))
    camera.lean = first.lean
    after = copy(before)
    after.scene = copy(before.scene)
    after.camera = camera
    after.owners = list(before.owners)
    after.cameras = list(before.cameras)
    after.look(pose)
    return after.count()["right"]


def second_views(
    asked: tuple[int, int],
    scans: Path,
    strangers: Path,
    views: int,
    models: str,
) -> dict[str, Any]:
    """Look at a table twice, each time from another second view: a line of the output."""
    seed, number = asked
    table = draw_table(
        meshes_in(scans), meshes_in(strangers), np.random.default_rng(asked)
    )
    camera = TableCamera(table, SENSORS["wrist"], np.random.default_rng([*asked, 1]))
    rng = np.random.default_rng([*asked, 2])
    around = np.array([rng.uniform(0, 2 * np.pi)])
    elevation = np.radians(rng.uniform(*VIEW_ELEVATIONS))
    system, _ = opened_models(models, None)
    looking = Looking(camera, system, policy="target")
    looking.look(poses_around(around, elevation, CAMERA_FROM_TABLE, TABLE_CENTRE)[0])
    line = {"things": len(table.things) - 1, "first": looking.count()["right"]}
    poses = looking.scene.targets
    if not len(poses):
        stays = line["first"]
        return {**line, "target": stays, "random": [stays], "again": stays}
    steepness = np.degrees(np.arcsin(-poses[:, 2, 2]))
    low, high = VIEW_ELEVATIONS
    usual = np.flatnonzero((steepness >= low) & (steepness <= high))
    chosen = rng.choice(usual, min(views, len(usual)), replace=False)
    found = [looked_from(looking, poses[k], (seed, number, int(k))) for k in chosen]
    target = looked_from(looking, poses[0], (seed, number, 0))
    best = int(chosen[int(np.argmax(found))])
    again = looked_from(looking, poses[best], (seed, number, best, 1))
    return {**line, "target": target, "random": found, "again": again}


def summary(lines: list[dict[str, Any]]) -> str:
    """The table, and the differences from random views."""
    random = np.array([np.mean(line["random"]) for line in lines])
    best = np.array([max(line["random"]) for line in lines])
    target = np.array([line["target"] for line in lines])
    first = np.array([line["first"] for line in lines])
    again = np.array([line["again"] for line in lines])
    things = np.array([line["things"] for line in lines])
    rows = [
        [name, f"{value.mean():.2f}", f"{value.sum() / things.sum():.3f}"]
        for name, value in {
            "the first frame": first,
            "a random second view": random,
            "the target": target,
            "the best of the random views, by the truth": best,
            "that view again, with other noise": again,
        }.items()
    ]
    said = [markdown(["after", "named right, a table", "recall"], rows)]
    for name, value in (("target", target), ("again", again)):
        off = value - random
        p = float(sign_flip_p(off[:, None])[0])
        said.append(
            f"{name} less random: {off.mean():+.2f} things a table, {len(lines)} tables,"
            f" p = {p:.4f}"
        )
    return "\n".join(said)


def main(
    scans: tyro.conf.Positional[Path],
    strangers: tyro.conf.Positional[Path],
    output: tyro.conf.Positional[Path],
    tables: int = 20,
    views: int = 8,
    seed: int = 1,
    models: str = "ycb",
) -> None:
    """Compare second views of simulated tables: the target, random ones, and the best of these.

    Args:
        scans: folder of the scans that the memory knows, metres.
        strangers: folder of other meshes.
        output: a line of JSON for each table; those that it holds are not run again.
        tables: number of tables.
        views: random second views of each table.
        seed: of the tables and views.
        models: memory of the things.
    """
    asked = [(seed, number) for number in range(tables)]
    look = partial(
        second_views, scans=scans, strangers=strangers, views=views, models=models
    )
    print(summary(results(output, ("seed", "table"), asked, look, "Tables")))


if __name__ == "__main__":
    with orderly_end("the tables that were done are kept"):
        tyro.cli(main)
