"""Moves and removals that a scene notices, and its false alarms, on simulated tables.

    python -m nextview_lab.studies.moves SCANS OUT.jsonl [--tables 44] [--still 15] [--seed 0]

SCANS is a folder with scans of the things that the memory knows, in metres, by their names. Six of
them stand on each table, 0 to 8 cm apart; a camera 0.55 to 0.7 m away sees them through the model
of a stereo sensor. After the first frame one of them, in turn a flat, a small and a large one, is
moved along the table by 3 to 150 mm, in turn, or is removed; two frames follow. On the still tables
nothing moves, and four frames follow. The camera stands still on every other table, has a name
there and one error of its pose; elsewhere it goes on by 25 to 70 degrees. The poses of half of the
tables with moves, and of all still ones, have an arm's errors: 3 mm and 0.3 degrees along and about
each axis, and 0.3 degrees of the vertical.

It is known which thing each pixel shows: this judges the comparison, not the segmentation.

A move counts if the thing was found in the first frame, and 350 of its pixels show it there and
would show its old place in the next frame. It is noticed if the next frame reports the object in
``moved`` or ``gone``. A false alarm is a frame that reports an object that stands. The position
error is the distance of the middle of the scan from the truth after the last frame, and a ghost is
a confident name more than 20 mm from where the thing is.

OUT.jsonl gets a line for each table. Tables that it contains are not run again, so a run that was
stopped goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray

import nextview
from nextview.cli.exit_status import orderly_end
from nextview.errors import UsageError
from nextview.geometry.mesh import Mesh
from nextview.scene.objects import SceneObject
from nextview.scene.scene import Look, Scene
from nextview.sensing.frame import Frame
from nextview.simulation.sensor import SENSORS
from nextview.types import Float
from nextview_lab.studies.shared import mesh_of, results, scans_in
from nextview_lab.worlds.scene import footprint, separation
from nextview_lab.worlds.tables import SimulatedTable, TableCamera, poses_around

MILLIMETRES = (3, 5, 8, 12, 20, 30, 50, 80, 100, 150, None)  # None: taken away
THINGS = 6
GAP = 0.08  # metres between neighbours, at most
MOST_DRAWN = 20  # draws of one table, until all things fit on it and one can be moved
TRIED_WAYS = 60  # directions in which a thing is moved
FREE = 0.002  # metres that it then is from others, at least
FLAT = 0.035  # metres: a flat thing is thinner
SMALL = 0.1  # metres: a small thing is shorter
FEWEST_PIXELS = 350  # that show a thing, or would
FRAMES_MOVED = 2  # after a move
FRAMES_STILL = 4
GHOST = 0.02  # metres that a confident pose is off where nothing of the name stands
CENTRE = np.array([0, 0, 0.03])
FIELDS = ("seed", "kind", "table")  # by which a line of the results is known


def kind_of(mesh: Mesh) -> int:
    """Whether a scan is of a flat thing, 0, a small one, 1, or a large one, 2."""
    sides = np.sort(np.ptp(mesh.vertices, axis=0)) * mesh.radius
    if sides[-1] < SMALL:
        return 1
    return 0 if sides[0] < FLAT else 2


def moved(
    table: SimulatedTable, row: int, metres: float, rng: np.random.Generator
) -> SimulatedTable | None:
    """A table after one of its things was moved along it; None where there is no room."""
    outlines = [footprint(thing.placed) for thing in table.things]
    others = [one for other, one in enumerate(outlines) if other != row]
    for _ in range(TRIED_WAYS):
        angle = rng.uniform(0, 2 * np.pi)
        motion = np.eye(4)
        motion[:2, 3] = metres * np.array([np.cos(angle), np.sin(angle)])
        there = outlines[row] + motion[:2, 3]
        if min(separation(there, other) for other in others) > FREE:
            things = list(table.things)
            things[row] = replace(things[row], pose=motion @ things[row].pose)
            return SimulatedTable(tuple(things))
    return None


def draw(
    meshes: Sequence[Mesh],
    number: int,
    millimetres: float | None,
    rng: np.random.Generator,
) -> tuple[SimulatedTable, int, SimulatedTable]:
    """A table, the row of one of its things, and the table after that was moved or taken away.

    Raises:
        UsageError: MOST_DRAWN draws do not fit.
    """
    of_kind = [mesh for mesh in meshes if kind_of(mesh) == number % 3]
    for _ in range(MOST_DRAWN):
        target = of_kind[int(rng.integers(len(of_kind)))]
        rest = [mesh for mesh in meshes if mesh is not target]
        chosen = [rest[k] for k in rng.choice(len(rest), THINGS - 1, replace=False)]
        order = [[*chosen, target][k] for k in rng.permutation(THINGS)]
        try:
            table = SimulatedTable.draw(order, rng, GAP)
        except UsageError:
            continue
        row = [thing.name for thing in table.things].index(target.name)
        if millimetres is None:
            rest_of = [thing for k, thing in enumerate(table.things) if k != row]
            return table, row, SimulatedTable(tuple(rest_of))
        after = moved(table, row, millimetres / 1000, rng)
        if after is not None:
            return table, row, after
    raise UsageError("no thing can be moved on the tables: take smaller ones")


class Watched:
    """A scene over a simulated table, and what is said of its objects."""

    def __init__(
        self,
        system: nextview.System,
        camera: TableCamera,
        view: np.random.Generator,
        standing: bool,
    ) -> None:
        self.camera = camera
        self.scene = Scene(system, segmentation=self.owners)
        self.view = view
        self.standing = standing
        self.stands_at: Float | None = None
        self.azimuth = view.uniform(0, 2 * np.pi)
        self.elevation = np.radians(view.uniform(35, 65))
        self.distance = float(view.uniform(0.55, 0.7))

    def owners(self, frame: Frame) -> NDArray[np.int64]:
        """Which thing each pixel of the last frame shows, 0 for none."""
        return self.camera.owner + 1

    def look(self) -> Look:
        """Take in another frame: of a standing camera, or of one that goes on by 25 to 70
        degrees."""
        around = np.array([self.azimuth])
        pose = poses_around(around, self.elevation, self.distance, CENTRE)[0]
        if not self.standing:
            return self.scene.update(self.camera.frame(pose))
        frame = self.camera.frame(pose if self.stands_at is None else self.stands_at)
        if self.stands_at is None:
            # the error of its pose remains what it is
            self.stands_at = self.camera.lean @ self.camera.true_pose
            self.camera.sensor = replace(self.camera.sensor, turned=0.0, moved=0.0)
        named = replace(frame, pose=pose, camera="fixed")
        return self.scene.update(named)

    def go_on(self) -> None:
        """Bring a camera that does not stand still to another place."""
        if not self.standing:
            step = np.radians(self.view.uniform(25, 70))
            self.azimuth += float(self.view.choice([-1, 1]) * step)

    def showing(self, row: int) -> SceneObject | None:
        """The object that shows most of a thing in the last frame; None if none does."""
        true = self.camera.owner == row
        last = len(self.scene.frames) - 1
        pixels = {
            one.number: np.count_nonzero(one.pixels[last] & true)
            for one in self.scene.objects
            if last in one.pixels
        }
        if not pixels or not max(pixels.values()):
            return None
        best = max(pixels, key=lambda number: pixels[number])
        return next(one for one in self.scene.objects if one.number == best)


def alarms(look: Look) -> list[int]:
    """Numbers of the objects that a frame reports as moved or gone."""
    return [*(move.number for move in look.moved), *look.gone]


def _centre(vertices: Float, pose: Float) -> Float:
    """Middle of a placed scan, which a symmetric thing keeps when it is turned, (3,)."""
    placed = vertices @ pose[:3, :3].T + pose[:3, 3]
    return (placed.min(0) + placed.max(0)) / 2


def watch_a_move(
    watched: Watched,
    row: int,
    after: SimulatedTable,
) -> dict[str, Any]:
    """Look at a table, of which a thing is moved or taken away after the first frame."""
    camera = watched.camera
    thing = camera.table.things[row]
    first = watched.look()
    shown = int(camera.shown[row])
    target = watched.showing(row)
    watched.go_on()

    # what the next view would show if nothing had moved
    copied = TableCamera(
        camera.table, replace(camera.sensor, turned=0.0, moved=0.0), watched.view
    )
    copied.lean = camera.lean
    around = np.array([watched.azimuth])
    copied.frame(poses_around(around, watched.elevation, watched.distance, CENTRE)[0])
    would_show = int(copied.shown[row])

    camera.change(after)
    found = []
    for _ in range(FRAMES_MOVED):
        found.append(watched.look())
        watched.go_on()
    number = None if target is None else target.number
    reported = [alarms(look) for look in found]
    line: dict[str, Any] = {
        "thing": thing.name,
        "named": None if target is None else target.name,
        "counts": number is not None
        and first.taken
        and min(shown, would_show) >= FEWEST_PIXELS,
        "noticed": number in reported[0],
        "taken": [look.taken for look in found],
        "false": sum(other != number for one in reported for other in one),
        "again": number in reported[1],
    }
    line |= _poses_after(watched, thing.name, number)
    return line


def _poses_after(watched: Watched, name: str, number: int | None) -> dict[str, Any]:
    """How far off the poses of what was moved are, metres."""
    true = watched.camera.truth.get(name)
    vertices = {one.name: one.vertices for one in watched.camera.table.things}
    ghosts = 0
    off = None
    for one in watched.scene.objects:
        if one.name != name or one.pose is None:
            continue
        error = np.inf
        if true is not None:
            apart = _centre(vertices[name], one.pose) - _centre(vertices[name], true)
            error = float(np.linalg.norm(apart))
        ghosts += bool(one.confident and error > GHOST)
        if one.number == number and true is not None:
            off = float(error)
    return {"ghosts": ghosts, "off": off}


def watch_still(watched: Watched) -> dict[str, Any]:
    """Look at a table on which nothing moves."""
    watched.look()
    found = []
    for _ in range(FRAMES_STILL):
        watched.go_on()
        found.append(watched.look())
    return {
        "taken": [look.taken for look in found],
        "alarms": [len(alarms(look)) for look in found],
    }


def watch(
    system: nextview.System,
    meshes: Sequence[Mesh],
    asked: tuple[int, str, int],
) -> dict[str, Any]:
    """Look at one table.

    Args:
        system: that knows the things.
        meshes: scans of the things, in metres.
        asked: values of ``FIELDS``: the seed of all draws, "moved" or "still", and the number of
            the table.

    Returns:
        What is written of it.
    """
    seed, kind, number = asked
    rng = np.random.default_rng([seed, number, kind == "still"])
    by = MILLIMETRES[number // 3 % len(MILLIMETRES)] if kind == "moved" else None
    table, row, after = draw(meshes, number, by, rng)
    sensor = SENSORS["stereo"]
    if kind == "still" or number % 4 >= 2:
        sensor = replace(sensor, tilt=0.3, turned=0.3, moved=0.003)
    camera = TableCamera(table, sensor, rng)
    standing = number % 2 == 0
    watched = Watched(system, camera, rng, standing)
    line = {"millimetres": by, "standing": standing, "errors": sensor.moved > 0}
    if kind == "moved":
        return line | watch_a_move(watched, row, after)
    return line | watch_still(watched)


def summary(lines: Sequence[dict[str, Any]]) -> str:
    """What was noticed, in words."""
    moves = [line for line in lines if line["kind"] == "moved"]
    counted = [line for line in moves if line["counts"]]
    said = []
    for by in MILLIMETRES:
        mine = [line for line in counted if line["millimetres"] == by]
        what = "taken away" if by is None else f"moved by {by} mm"
        said.append(f"{what}: {sum(one['noticed'] for one in mine)} of {len(mine)}")
    noticed = sum(line["noticed"] for line in counted)
    said.append(f"noticed: {noticed} of {len(counted)}, on {len(moves)} tables")
    frames = sum(len(line["taken"]) for line in moves)
    false = sum(line["false"] for line in moves)
    said.append(f"other objects reported beside a move: {false} in {frames} frames")
    said.append(f"confident of a ghost: {sum(line['ghosts'] for line in moves)} tables")
    off = [1000 * line["off"] for line in counted if line["off"] is not None]
    if off:
        said.append(
            f"pose after the last frame is off by {np.median(off):.1f} mm (median),"
            f" {max(off):.1f} mm at most"
        )
    still = [line for line in lines if line["kind"] == "still"]
    every = [count for line in still for count in line["alarms"]]
    alarmed = sum(count > 0 for count in every)
    said.append(f"still frames with a false alarm: {alarmed} of {len(every)}")
    taken = [one for line in lines for one in line["taken"]]
    said.append(f"frames left out: {taken.count(False)} of {len(taken)}")
    return "\n".join(said)


def main(
    scans: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    tables: int = 44,
    still: int = 15,
    seed: int = 0,
    models: str = "ycb",
) -> None:
    """Count the moves and removals that a scene notices, and its false alarms.

    Six things stand on each simulated table. After the first frame one of them is moved by 3 to
    150 mm, or removed; on the still tables nothing changes, but the poses have an arm's errors.
    Printed are the moves noticed in the next frame, by distance; false alarms; confident names of
    what is no longer there; and position errors.

    Args:
        scans: folder with scans of the things that the memory knows, in metres, by their names.
        out: file of results, a line for each table; tables that it contains are not run again.
        tables: number of tables with a move.
        still: number of tables without a move.
        seed: of the tables and cameras.
        models: memory of the things.

    Raises:
        UsageError: there are no scans, or no table with room for a move is found.
    """
    meshes = [mesh_of(path) for path in scans_in(scans).values()]
    system = nextview.load(models, max_views=20)
    asked = [(seed, "moved", number) for number in range(tables)]
    asked += [(seed, "still", number) for number in range(still)]
    print(
        summary(results(out, FIELDS, asked, partial(watch, system, meshes), "tables"))
    )


if __name__ == "__main__":
    with orderly_end("the tables that were done are kept"):
        tyro.cli(main)
