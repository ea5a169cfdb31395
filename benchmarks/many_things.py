"""A thousand things made by rule from scans: how long a frame takes among them, and how often it
is right.

    python -m benchmarks.many_things make YCB THINGS [--count 1000] [--seed 0]
    nextview learn THINGS MEMORY --unit m --upright
    python -m benchmarks.many_things measure THINGS MEMORY [--frames 100] [--seed 1]
        [--save FOLDER]

``make`` writes a PLY file a thing, metres. The first ones are the scans of the folder YCB
themselves. All others are scans in turn, each stretched along its x, y and z by factors of its own,
drawn between 0.7 and 1.4, evenly in the logarithm. The seed decides them. A thing is called by the
number of its round and its scan, as 03_mug.

``measure`` shows things drawn from those that the memory knows, each in the pose that it was taught
in, at its true size, with an azimuth, a viewpoint and errors of the sensor of their own. It prints
the seconds that the memory takes to load and the peak of memory, and after one and two views: the
share that is named right by outline and size alone and with the geometry, the share that is wrong
with a belief of 0.97 and more, the share of the right ones whose pose is right (ADD-S below a tenth
of the diameter), and the seconds of CPU from a frame to the decision. A first frame of all is not
counted.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
import tyro
from numpy.typing import NDArray
from rich.progress import track
from scipy.spatial import cKDTree
from tyro.extras import subcommand_cli_from_dict

from nextview.cli.exit_status import orderly_end
from nextview.errors import UsageError
from nextview.files import new_folder, read_record, write_record
from nextview.geometry.mesh import load_mesh
from nextview.geometry.observation import Observation
from nextview.geometry.resting import rotated
from nextview.geometry.viewsphere import look_at_origin, rotation_z
from nextview.simulation.sensed_camera import SensedCamera
from nextview.things.memory import (
    TaughtRecogniser,
)
from nextview.things.surface import Surface
from nextview.things.taught import TaughtThings
from nextview.things.verifier import Verified

Float = NDArray[np.float64]

LEAST_STRETCH = 0.7
MOST_STRETCH = 1.4

VIEWS = (1, 2)
HIGHEST = np.radians(72.0)  # elevation of a view
CONFIDENT = 0.97
POINTS = 1000  # of a surface, for ADD-S
COLUMNS = (
    "views",
    "by outline and size",
    "verified",
    "sure and wrong",
    "ADD-S < 0.1 d",
    "s of CPU: median, 95 %, worst",
)


def make(
    scans: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    count: int = 1000,
    seed: int = 0,
) -> None:
    """Write things made by rule from scans.

    Args:
        scans: folder of scans, metres.
        out: folder to write.
        count: how many things.
        seed: of the factors that the scans are stretched by.
    """
    files = sorted(path for path in scans.iterdir() if path.is_file())
    if not files:
        raise UsageError(f"{scans}: holds no scan")

    rng = np.random.default_rng(seed)
    bounds = np.log([LEAST_STRETCH, MOST_STRETCH])
    with new_folder(out, overwrite=False) as part:
        for number in track(range(count), "things"):
            turn, which = divmod(number, len(files))
            factors = np.exp(rng.uniform(*bounds, 3)) if turn else np.ones(3)
            file = files[which]
            surface = Surface.from_mesh(load_mesh(file, unit="m"), file.stem)
            stretched = trimesh.Trimesh(
                surface.vertices * factors,
                surface.faces,
                process=False,
            )
            stretched.export(part / f"{turn:02d}_{file.stem}.ply")
    print(f"{count} things in {out}")


@dataclass(frozen=True)
class Outcome:
    """What was found of a thing after some views.

    Attributes:
        views: after how many.
        by_outline: whether outline and size alone name it right.
        right: whether it is named right with its geometry.
        confidence: belief in the answer.
        add_s: mean distance of the surface's points, diameters; None where the name is wrong.
        seconds: of CPU for the last frame and the decision.
    """

    views: int
    by_outline: bool
    right: bool
    confidence: float
    add_s: float | None
    seconds: float


@dataclass(frozen=True)
class Found:
    """What was found of one thing.

    Attributes:
        outcomes: after one view and after two.
    """

    outcomes: tuple[Outcome, ...]


def measure(
    things: tyro.conf.Positional[Path],
    models: tyro.conf.Positional[Path],
    frames: int = 100,
    seed: int = 1,
    sensor: str = "wrist",
    save: Path | None = None,
) -> None:
    """Show some of the things, and recognise them among all.

    Args:
        things: folder that ``make`` wrote.
        models: folder of the memory.
        frames: how many things are shown.
        seed: of which are shown, and how.
        sensor: what the views are taken with.
        save: folder in which what was found is kept, and looked for: one for each MODELS, seed
            and sensor.
    """
    begun = time.perf_counter()
    recogniser = TaughtRecogniser(models / "memory.json", threads=1)
    known = TaughtThings.of(recogniser)
    assert known is not None
    loaded = time.perf_counter() - begun

    drawn = np.random.default_rng(seed).permutation(len(known.names))[:frames]
    outcomes: list[Outcome] = []
    shown(known, things, int(drawn[0]), sensor, np.random.default_rng(seed))
    for thing in track(drawn.tolist(), "things shown"):
        file = None if save is None else save / f"{known.names[thing]}.json"
        if file is not None and file.exists():
            outcomes += read_record(file, Found, "what was found of a thing").outcomes
            continue
        found = shown(
            known,
            things,
            thing,
            sensor,
            np.random.default_rng([seed, thing]),
        )
        outcomes += found
        if file is not None:
            write_record(file, Found(tuple(found)))

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(
        f"{len(known.names)} things; loaded in {loaded:.1f} s; at most {peak:.2f} GB of memory"
    )
    print(*table(outcomes), sep="\n")


def shown(
    known: TaughtThings,
    things: Path,
    thing: int,
    sensor: str,
    rng: np.random.Generator,
) -> list[Outcome]:
    """Show a thing, and recognise it after one view and after two."""
    mesh = load_mesh(things / f"{known.names[thing]}.ply", unit="m")
    turn = rotation_z(rng.uniform(0, 2 * np.pi))
    standing = rotated(mesh, turn)
    camera = SensedCamera(standing, sensor, rng.spawn(1)[0])
    frame = camera.object_frame
    true_pose = np.eye(4)
    true_pose[:3, :3] = frame.axes @ turn
    from_centre = -(turn @ mesh.centre + standing.centre) - frame.centre
    true_pose[:3, 3] = frame.axes @ from_centre

    elevations = np.arcsin(rng.uniform(0, np.sin(HIGHEST), 2 * max(VIEWS)))
    observations: list[Observation] = []
    outcomes = []
    for pose in look_at_origin(elevations, rng.uniform(0, 2 * np.pi, len(elevations))):
        observation = camera.observe(pose)
        if not observation.seen:
            continue
        observations.append(observation)
        begun = time.process_time()
        found = known(observations)
        seconds = time.process_time() - begun
        outcomes.append(
            outcome(known, found, thing, true_pose, len(observations), seconds)
        )
        if len(observations) == max(VIEWS):
            break
    return outcomes


def outcome(
    known: TaughtThings,
    found: Verified,
    thing: int,
    true_pose: Float,
    views: int,
    seconds: float,
) -> Outcome:
    """Compare what was found with the truth."""
    answer = int(found.belief.argmax())
    apart = None
    if answer == thing:
        surface = known.verifier.caster.surfaces[thing]
        pose = found.poses[int(np.flatnonzero(found.things == thing)[0])]
        points = surface.sample(POINTS, np.random.default_rng(0))
        there = cKDTree(points @ true_pose[:3, :3].T + true_pose[:3, 3])
        distances = there.query(points @ pose[:3, :3].T + pose[:3, 3])[0]
        apart = float(distances.mean()) / surface.diameter
    return Outcome(
        views,
        int(found.by_outline.argmax()) == thing,
        answer == thing,
        float(found.belief.max()),
        apart,
        seconds,
    )


def table(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """The results as lines of a table."""
    yield f"| {' | '.join(COLUMNS)} |"
    yield "|---" * len(COLUMNS) + "|"
    for views in VIEWS:
        some = [one for one in outcomes if one.views == views]
        seconds = np.array([one.seconds for one in some])
        posed = [one.add_s < 0.1 for one in some if one.add_s is not None]
        wrong = [not one.right and one.confidence >= CONFIDENT for one in some]
        cells = (
            f"{views}",
            f"{np.mean([one.by_outline for one in some]):.3f}",
            f"{np.mean([one.right for one in some]):.3f}",
            f"{np.mean(wrong):.3f}",
            f"{np.mean(posed):.3f}" if posed else "-",
            f"{np.median(seconds):.2f}, {np.quantile(seconds, 0.95):.2f}, {seconds.max():.2f}",
        )
        yield f"| {' | '.join(cells)} |"


def main() -> None:
    """Run one of the stages."""
    subcommand_cli_from_dict({"make": make, "measure": measure})


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        main()
