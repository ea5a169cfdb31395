"""Tables with several things each: what is found and named after one, two and four frames.

    python benchmarks/tables.py OUT.jsonl SCANS STRANGERS [--tables 100] [--seed 0]
        [--by target fixed random] [--network CARD]

SCANS holds the scans of the things that the memory knows, in metres, by their names; STRANGERS a
folder of meshes, a folder a class, none of which it knows. On each simulated table stand 6 to 10
things in resting poses, 0 to 10 cm apart, one of them a stranger of the size of such things. A
camera 0.6 m from the middle of the table looks through the wrist sensor, with errors of its poses
and of the vertical. The first view is drawn; the others are chosen by ``--by``:

- fixed: a quarter of a circle on, at the same elevation;
- random: any candidate view;
- target: ``Scene.target``.

``--network`` names the card of a network of ``nextview train segmentation`` in place of the bundled
one.

OUT gets a line a table, and the tables that it holds already are not looked at again: a run that
was stopped goes on. Printed is, after 1, 2 and 4 frames, the share of the things that were found
and named right (recall), the share of the names that are right (precision; the stranger's name and
names of pieces count as wrong), the same for names that are confident, the share of the right ones
whose ADD-S is below a tenth of their diameter, in the world and in the frame of the last camera
that saw them, and the share of strangers that are called unknown.

Where several ways are given, the paired differences of the things named right after two and after
four frames are printed too, and of the frames until ``Scene.done`` (five where four were not
enough), with a test by random sign flips over tables.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.progress import track
from scipy.spatial import cKDTree

import nextview
from nextview.benchmark.statistics import sign_flip_p
from nextview.errors import ObservationError, UsageError
from nextview.geometry.mesh import Mesh, load_mesh
from nextview.geometry.resting import resting_poses
from nextview.scene.objects import UNKNOWN_NAME, SceneObject
from nextview.scene.scene import Scene
from nextview.segmentation.instances import LearnedSegmenter, Segmenter
from nextview.sensing.frame import Frame
from nextview.simulation.sensor import SENSORS
from nextview.simulation.tables import SimulatedTable, TableCamera, poses_around

Float = NDArray[np.float64]
By = Literal["fixed", "random", "target"]

COUNTED = (1, 2, 4)  # frames after which is counted
COMPARED = (2, 4)  # frames after which ways are compared
FEWEST_THINGS = 6
MOST_THINGS = 10
MOST_DRAWN = 20  # draws of one table, until all things fit on it
DISTANCE = 0.6  # metres
ELEVATIONS = (30.0, 60.0)  # degrees, of the first view
CENTRE = np.array([0, 0, 0.03])
STRANGER_RADII = (0.04, 0.10)  # metres
STRANGER = "stranger"
POINTS = 1000  # of a scan, for ADD-S
CLOSE = 0.1  # of the diameter


@dataclass
class Counts:
    """What was counted on some tables after so many frames.

    Attributes:
        things: taught things on the tables.
        named: objects with a name.
        right: things that were named right.
        sure: objects with a confident name.
        sure_right: things that were named right with confidence.
        close: of those named right, ADD-S is small in the world.
        close_in_camera: the same in the frame of the last camera that saw the thing.
        strangers: strangers that were found.
        unknown: strangers that were found and called unknown.
        seconds: of CPU for the last frame.
    """

    things: int = 0
    named: int = 0
    right: int = 0
    sure: int = 0
    sure_right: int = 0
    close: int = 0
    close_in_camera: int = 0
    strangers: int = 0
    unknown: int = 0
    seconds: float = 0.0


@lru_cache(maxsize=512)
def mesh_of(path: Path, radius: float | None = None) -> Mesh:
    """A scan in metres, or a mesh of no unit that gets a radius, metres."""
    if radius is None:
        return replace(load_mesh(path, unit="m"), name=path.stem)
    return replace(
        load_mesh(path),
        radius=radius,
        centre=np.zeros(3),
        name=STRANGER,
        unit="m",
    )


@lru_cache(maxsize=512)
def rests_of(name: str, radius: float, path: Path) -> Float:
    """Rotations of a mesh into its resting poses."""
    mesh = mesh_of(path) if name != STRANGER else mesh_of(path, radius)
    return resting_poses(mesh)


def draw_table(
    scans: Sequence[Path],
    strangers: Sequence[Path],
    rng: np.random.Generator,
) -> SimulatedTable:
    """A table with 6 to 10 things, the last of them a stranger.

    What does not fit on the table is drawn again.

    Raises:
        UsageError: MOST_DRAWN draws do not fit.
    """
    for _ in range(MOST_DRAWN - 1):
        with suppress(UsageError):
            return _draw(scans, strangers, rng)
    return _draw(scans, strangers, rng)


def _draw(
    scans: Sequence[Path],
    strangers: Sequence[Path],
    rng: np.random.Generator,
) -> SimulatedTable:
    count = int(rng.integers(FEWEST_THINGS, MOST_THINGS + 1))
    paths = [scans[k] for k in rng.choice(len(scans), count - 1, replace=False)]
    meshes = [mesh_of(path) for path in paths]
    paths.append(strangers[int(rng.integers(len(strangers)))])
    meshes.append(mesh_of(paths[-1], float(rng.uniform(*STRANGER_RADII))))

    where = {id(mesh): path for mesh, path in zip(meshes, paths, strict=True)}
    order = [meshes[k] for k in rng.permutation(len(meshes))]
    return SimulatedTable.draw(
        order,
        rng,
        resting=lambda mesh: rests_of(mesh.name, mesh.radius, where[id(mesh)]),
    )


class Looking:
    """A table under way: the frames so far, and what each of their pixels truly shows."""

    def __init__(
        self,
        system: nextview.System,
        camera: TableCamera,
        segmentation: Segmenter | None = None,
    ) -> None:
        self.scene = Scene(system, segmentation=segmentation)
        self.camera = camera
        self.owners: list[NDArray[np.int64]] = []
        self.cameras: list[tuple[Float, Float]] = []
        self.seconds = 0.0

    def look(self, pose: Float) -> None:
        """Take a frame from a pose."""
        frame: Frame = self.camera.frame(pose)
        begun = time.process_time()
        try:
            taken = self.scene.update(frame).taken
        except ObservationError:
            taken = False
        self.seconds = time.process_time() - begun
        if taken:
            self.owners.append(self.camera.owner)
            self.cameras.append((pose, self.camera.true_pose))

    def truth(self, thing: SceneObject) -> int:
        """Which thing most pixels of an object show, -1 for none."""
        votes = np.zeros(len(self.camera.table.things) + 1, np.int64)
        for frame, mask in thing.pixels.items():
            votes += np.bincount(self.owners[frame][mask] + 1, minlength=len(votes))
        return int(votes.argmax()) - 1

    def count(self) -> Counts:
        """What was found by now."""
        things = self.camera.table.things
        counts = Counts(things=len(things) - 1, seconds=self.seconds)
        right: dict[int, SceneObject] = {}
        unknown_stranger = named_stranger = False
        for found in self.scene.objects:
            number = self.truth(found)
            name = things[number].name if number >= 0 else ""
            if name == STRANGER:
                unknown_stranger |= found.name == UNKNOWN_NAME
                named_stranger |= found.name != UNKNOWN_NAME
            if found.name == UNKNOWN_NAME:
                continue
            counts.named += 1
            counts.sure += found.confident
            if found.name == name and number not in right:
                right[number] = found
                counts.right += 1
                counts.sure_right += found.confident
        for number, found in right.items():
            counts.close += self._add_s(number, found, in_camera=False) < CLOSE
            counts.close_in_camera += self._add_s(number, found, in_camera=True) < CLOSE
        counts.strangers = int(unknown_stranger or named_stranger)
        counts.unknown = int(unknown_stranger and not named_stranger)
        return counts

    def _add_s(self, number: int, found: SceneObject, in_camera: bool) -> float:
        """Mean distance of the true surface's points from the found one, diameters."""
        thing = self.camera.table.things[number]
        points = thing.vertices[:: max(1, len(thing.vertices) // POINTS)]
        pose = found.pose
        assert pose is not None
        true = self.camera.lean @ thing.pose
        if in_camera:
            frame = max(found.pixels)
            believed, really = self.cameras[frame]
            pose = pose.copy()
            shifts = found.candidates[0].displacements
            if len(shifts) == len(found.pixels):
                pose[:3, 3] += shifts[sorted(found.pixels).index(frame)]
            pose = np.linalg.inv(believed) @ pose
            true = np.linalg.inv(really) @ thing.pose
        diameter = float(np.linalg.norm(np.ptp(points, axis=0)))
        placed = points @ pose[:3, :3].T + pose[:3, 3]
        there = points @ true[:3, :3].T + true[:3, 3]
        return float(cKDTree(placed).query(there)[0].mean()) / diameter


def look_at_table(
    system: nextview.System,
    table: SimulatedTable,
    seed: tuple[int, int],
    by: By,
    segmentation: Segmenter | None = None,
) -> tuple[dict[str, Counts], int]:
    """Look at a table from four views.

    Args:
        system: that knows the things.
        table: with the things.
        seed: of the errors and of the views.
        by: how views are chosen.
        segmentation: that tells the things; None for the bundled network.

    Returns:
        What was found after each number of frames that is counted; and after how many frames the
        scene was done, one more than were taken where it was not.
    """
    rng = np.random.default_rng([*seed, 1])
    camera = TableCamera(table, SENSORS["wrist"], rng)
    looking = Looking(system, camera, segmentation)
    choose = np.random.default_rng([*seed, 2])
    azimuth = choose.uniform(0, 2 * np.pi)
    elevation = np.radians(choose.uniform(*ELEVATIONS))
    pose = poses_around(np.array([azimuth]), elevation, DISTANCE, CENTRE)[0]

    found = {}
    done = max(COUNTED) + 1
    for number in range(1, max(COUNTED) + 1):
        looking.look(pose)
        if looking.scene.done:
            done = min(done, number)
        if number in COUNTED:
            found[str(number)] = looking.count()
        if by == "fixed":
            turned = np.array([azimuth + number * np.pi / 2])
            pose = poses_around(turned, elevation, DISTANCE, CENTRE)[0]
        elif by == "random":
            others = poses_around(
                choose.uniform(0, 2 * np.pi, 1),
                np.radians(choose.uniform(*ELEVATIONS)),
                DISTANCE,
                CENTRE,
            )
            pose = others[0]
        else:
            target = looking.scene.target
            pose = pose if target is None else target
    return found, done


def summed(lines: Iterable[dict], frames: int) -> Counts:
    """The counts of some tables together."""
    total = Counts()
    for line in lines:
        for name, value in line["counts"][str(frames)].items():
            setattr(total, name, getattr(total, name) + value)
    return total


def table_of(lines: Sequence[dict]) -> str:
    """The results as a table in Markdown."""
    head = (
        "frames",
        "recall",
        "precision",
        "recall, confident",
        "precision, confident",
        "ADD-S < 0.1 d, world",
        "camera",
        "strangers unknown",
        "s of CPU for the last frame",
    )
    rows = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for frames in COUNTED:
        sums = summed(lines, frames)
        shares = (
            (sums.right, sums.things),
            (sums.right, sums.named),
            (sums.sure_right, sums.things),
            (sums.sure_right, sums.sure),
            (sums.close, sums.right),
            (sums.close_in_camera, sums.right),
            (sums.unknown, sums.strangers),
        )
        cells = [f"{a / max(b, 1):.3f} ({a}/{b})" for a, b in shares]
        cells.append(f"{sums.seconds / max(len(lines), 1):.2f}")
        rows.append(f"| {frames} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


def comparison(lines: Sequence[dict]) -> str:
    """Things named right, and frames until done: target against the others, paired by table."""
    said = []
    for frames in COMPARED:
        right = {
            (one["by"], one["table"]): one["counts"][str(frames)]["right"]
            for one in lines
        }
        said += _differences(right, f"things named right a table after {frames} frames")
    done = {(one["by"], one["table"]): one["done"] for one in lines}
    return "\n".join(said + _differences(done, "frames until done"))


def _differences(values: dict[tuple[By, int], int], what: str) -> list[str]:
    """Lines on the differences of target to the other ways, given what was counted by way and
    table.
    """
    said = []
    for other in ("random", "fixed"):
        both = sorted(
            table for by, table in values if by == other and ("target", table) in values
        )
        if not both:
            continue
        difference = np.array([values["target", k] - values[other, k] for k in both])
        p_value = sign_flip_p(difference[:, None])[0]
        said.append(
            f"target less {other}: {difference.mean():+.2f} {what}, {len(both)} tables,"
            f" p = {p_value:.4f}"
        )
    return said


def main(
    out: tyro.conf.Positional[Path],
    scans: tyro.conf.Positional[Path],
    strangers: tyro.conf.Positional[Path],
    tables: int = 100,
    seed: int = 0,
    by: tuple[By, ...] = ("fixed",),
    models: str = "ycb",
    network: Path | None = None,
) -> None:
    """Look at tables, and print what was found.

    Args:
        out: file of results, a line a table; it is added to.
        scans: folder of the scans.
        strangers: folder of meshes of other things, a folder a class.
        tables: how many.
        seed: of the draw of tables.
        by: ways in which views are chosen, each on every table.
        models: memory of the things.
        network: card of a segmentation network; None for the bundled one.
    """
    lines = (
        [json.loads(line) for line in out.read_text().splitlines()]
        if out.exists()
        else []
    )
    of_scans = sorted(path for path in scans.iterdir() if path.is_file())
    of_strangers = sorted(path for path in strangers.rglob("*") if path.is_file())
    if not of_scans or not of_strangers:
        raise UsageError(f"{strangers if of_scans else scans}: holds no mesh")

    system = nextview.load(models, threads=2)
    learned = None if network is None else LearnedSegmenter(network)
    told_by = None if network is None else str(network)
    lines = [line for line in lines if line.get("network") == told_by]
    done = {(line["seed"], line["table"], line["by"]) for line in lines}
    with out.open("a") as written:
        for number in track(range(tables), description="Tables"):
            left = [one for one in by if (seed, number, one) not in done]
            if not left:
                continue
            drawn = np.random.default_rng([seed, number])
            table = draw_table(of_scans, of_strangers, drawn)
            for one in left:
                seeds = (seed, number)
                counts, after = look_at_table(system, table, seeds, one, learned)
                line = {"seed": seed, "table": number, "by": one, "done": after}
                line["network"] = told_by
                line["counts"] = {
                    frames: asdict(found) for frames, found in counts.items()
                }
                written.write(json.dumps(line, default=int) + "\n")
                written.flush()
                lines.append(line)

    lines = [line for line in lines if line["seed"] == seed and line["table"] < tables]
    for one in by:
        mine = [line for line in lines if line["by"] == one]
        print(f"{len(mine)} tables, views by {one}")
        print(table_of(mine))
    print(comparison(lines))


if __name__ == "__main__":
    tyro.cli(main)
