"""The benchmark of tables with several things: from scans to a folder of results, resumable."""

import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path

import msgspec
import numpy as np

from nextview.checks import whole
from nextview.data import pool
from nextview.data.progress import TrackProgress, silently
from nextview.errors import ObservationError, UsageError
from nextview.files import command, only_one
from nextview.geometry.mesh import Mesh, load_mesh
from nextview.geometry.resting import resting_poses
from nextview.scene.objects import UNKNOWN_NAME, SceneObject
from nextview.scene.scene import Scene
from nextview.scene.view_policies import (
    SCENE_POLICIES,
    VIEW_ELEVATIONS,
    NamedPolicy,
    ScenePolicy,
)
from nextview.segmentation.instances import LearnedSegmenter, Segmenter
from nextview.sensing.frame import Frame
from nextview.session.system import System, load
from nextview.simulation.sensor import SENSORS
from nextview.things.memory import open_memory
from nextview.types import Float, Index
from nextview_lab.benchmark.comparison import ALL, ONE, Counted, corrected, tested_by
from nextview_lab.benchmark.jobs import Job, Settings, check_place, check_same, run_jobs
from nextview_lab.benchmark.results import ComparedTables, write_compared
from nextview_lab.benchmark.statistics import resample
from nextview_lab.benchmark.text_tables import Board, Column
from nextview_lab.extras import extras
from nextview_lab.worlds.tables import SimulatedTable, TableCamera, poses_around

with extras():
    import pandas as pd

FEWEST_THINGS = 6
MOST_THINGS = 10
MOST_DRAWN = 20  # attempts to draw a table on which all objects fit
CAMERA_FROM_TABLE = 0.6  # metres from the centre of the table
TABLE_CENTRE = np.array([0, 0, 0.03])  # metres
STRANGER_RADII = (0.04, 0.10)  # metres
STRANGER = "stranger"


class TableRun(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Results of one policy on one table.

    Attributes:
        counts: by name, after each compared number of frames, see ``Looking.count``.
        done: number of frames after which the scene was done; one more than were taken if it was
            not.
    """

    counts: list[dict[str, float]]
    done: int


class TableRuns(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Results of all policies on one table.

    Attributes:
        table: its number.
        runs: by policy.
    """

    table: int
    runs: dict[str, TableRun]


@dataclass(frozen=True)
class TableSettings(Settings):
    """Tables, policies and statistics.

    Attributes:
        models: name or folder of the memory that was taught the scans.
        network: card of a network of nextview-lab train segmentation; by default the bundled one.
        tables: number of tables.
        policies: target uses the view with the most expected information, random any candidate view
            at 30 to 60 degrees elevation, and fixed the candidate nearest to a quarter turn ahead.
            Your own policy, MODULE:NAME, is a function of what may be looked at and what the scene
            knows; see docs/add_a_policy.md. Only missing results are computed; your own policies
            always run again.
    """

    models: str = "ycb"
    network: Path | None = None
    tables: int = 100
    views: tuple[int, ...] = (1, 2, 4)
    policies: tuple[str, ...] = tuple(SCENE_POLICIES)

    def check(self) -> None:
        """Check the settings before any work is done.

        Raises:
            UsageError: a number is invalid.
            PolicyError: there is no such policy, or it cannot be made.
        """
        for name in (self.reference, *self.policies):
            NamedPolicy.of(name)
        whole(self.tables, "the number of tables", 1)
        super().check()


@dataclass(frozen=True)
class TableJob(Job):
    """One table, and the policies to run on it.

    Attributes:
        scans: folder of the scans of the things, metres.
        strangers: folder of meshes of other objects.
        table: number of the table.
    """

    scans: Path
    strangers: Path
    table: int


@lru_cache(maxsize=1)
def opened_models(
    models: str,
    network: Path | None,
) -> tuple[System, Segmenter | None]:
    """Load the system, and the segmentation; None for the bundled network.

    Args:
        models: name or folder of the memory.
        network: card of another segmentation network.
    """
    segmenter = None if network is None else LearnedSegmenter(network)
    return load(models, threads=1), segmenter


@lru_cache(maxsize=2)
def meshes_in(folder: Path) -> tuple[Path, ...]:
    """Return the mesh files in a folder and its subfolders, sorted.

    Raises:
        UsageError: there is none.
    """
    files = tuple(sorted(path for path in folder.rglob("*") if path.is_file()))
    if not files:
        raise UsageError(f"{folder}: holds no mesh")
    return files


def work_at_table(job: TableJob) -> None:
    """Run the policies of a job on its table, and write the results."""
    before = job.earlier(TableRuns)
    runs = {} if before is None else before.runs
    drawn = np.random.default_rng([job.settings.seed, job.table])
    table = draw_table(meshes_in(job.scans), meshes_in(job.strangers), drawn)
    for policy in job.policies:
        runs[policy] = look_at_table(job, table, policy)
        job.write(TableRuns(job.table, runs))


@lru_cache(maxsize=512)
def mesh_of(path: Path, radius: float | None = None) -> Mesh:
    """Load a scan in metres, or a mesh without unit, which is scaled.

    Args:
        path: of the mesh file.
        radius: of a mesh without unit, metres; None for a scan.
    """
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
    """Return the rotations of a mesh to its resting poses.

    Args:
        name: of the thing; STRANGER for a mesh without unit.
        radius: of the thing, metres.
        path: of the mesh file.

    Returns:
        (P, 3, 3) float64.
    """
    mesh = mesh_of(path) if name != STRANGER else mesh_of(path, radius)
    return resting_poses(mesh)


def draw_table(
    scans: Sequence[Path],
    strangers: Sequence[Path],
    rng: np.random.Generator,
) -> SimulatedTable:
    """Draw a table with 6 to 10 objects, the last of them a stranger.

    A table on which the objects do not fit is drawn again.

    Args:
        scans: files of the taught things.
        strangers: files of other meshes.
        rng: source of all random numbers.

    Raises:
        UsageError: MOST_DRAWN attempts failed.
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
    """A run on one table: the frames so far, with the true object of each pixel.

    Attributes:
        scene: estimated scene.
        camera: over the table.
        owners: true object of each pixel, -1 for none, (H, W) int64, by frame.
        seconds: CPU time of the last frame.
    """

    def __init__(
        self,
        camera: TableCamera,
        system: System,
        segmentation: Segmenter | None = None,
        policy: str | ScenePolicy = "random",
        rng: np.random.Generator | None = None,
    ) -> None:
        """Start without frames.

        Args:
            camera: over the table.
            system: with the taught things.
            segmentation: of the frames; None for the bundled network.
            policy: of the scene.
            rng: source of the policy's random numbers; seed 0 by default.
        """
        self.scene = Scene(system, segmentation=segmentation, policy=policy, rng=rng)
        self.camera = camera
        self.owners: list[Index] = []
        self.seconds = 0.0

    def look(self, pose: Float) -> Frame:
        """Take a frame from a pose, and return it."""
        frame = self.camera.frame(pose)
        begun = time.process_time()
        try:
            taken = self.scene.update(frame).taken
        except ObservationError:
            taken = False
        self.seconds = time.process_time() - begun
        if taken:
            self.owners.append(self.camera.owner)
        return frame

    def truth(self, thing: SceneObject) -> int:
        """Return the true object of most pixels of a found object, -1 for none."""
        votes = np.zeros(len(self.camera.table.things) + 1, np.int64)
        for frame, mask in thing.pixels.items():
            votes += np.bincount(self.owners[frame][mask] + 1, minlength=len(votes))
        return int(votes.argmax()) - 1

    def count(self) -> dict[str, float]:
        """Count the results so far.

        Returns:
            The numbers of: "things", taught ones on the table; "named", found objects with a name;
            "right", correctly named things; "sure" and "sure_right", the same for confident names;
            "strangers", found strangers, and "unknown", strangers called unknown. And "seconds",
            the CPU time of the last frame.
        """
        things = self.camera.table.things
        counts = Counter[str]()
        right: set[int] = set()
        of_stranger: set[bool] = set()  # whether the stranger has a name

        for found in self.scene.objects:
            number = self.truth(found)
            name = things[number].name if number >= 0 else ""
            named = found.name != UNKNOWN_NAME
            if name == STRANGER:
                of_stranger.add(named)
            counts["named"] += named
            counts["sure"] += named and found.confident
            if named and found.name == name and number not in right:
                right.add(number)
                counts["sure_right"] += found.confident

        of_all = {
            "things": len(things) - 1,
            "right": len(right),
            "strangers": bool(of_stranger),
            "unknown": of_stranger == {False},
            "seconds": self.seconds,
        }
        return {name: float(value) for name, value in {**counts, **of_all}.items()}


def look_at_table(job: TableJob, table: SimulatedTable, policy: str) -> TableRun:
    """Run one policy on a table.

    Args:
        job: seeds and views of all policies.
        table: with the objects.
        policy: of the scene, a name of SCENE_POLICIES or MODULE:NAME.

    Raises:
        PolicyError: a policy of one's own failed.
    """
    how: TableSettings = job.settings
    rng = np.random.default_rng([how.seed, job.table, 1])
    camera = TableCamera(table, SENSORS["wrist"], rng)
    choose = np.random.default_rng([how.seed, job.table, 2])
    azimuth = choose.uniform(0, 2 * np.pi)
    elevation = np.radians(choose.uniform(*VIEW_ELEVATIONS))
    around = np.array([azimuth])
    pose = poses_around(around, elevation, CAMERA_FROM_TABLE, TABLE_CENTRE)[0]
    system, segmentation = opened_models(how.models, how.network)
    looking = Looking(camera, system, segmentation, policy, choose)

    counts = []
    done = how.views[-1] + 1
    for number in range(1, done):
        looking.look(pose)
        if looking.scene.done:
            done = min(done, number)
        if number in how.views:
            counts.append(looking.count())
        target = looking.scene.target if number < how.views[-1] else None
        pose = pose if target is None else target
    return TableRun(counts, done)


# by measure: numerator, denominator, and heading in narrow tables
SHARES = {
    "recall": ("right", "things", "recall"),
    "precision": ("right", "named", "precision"),
    "recall, confident": ("sure_right", "things", "confident recall"),
    "precision, confident": ("sure_right", "sure", "confident precision"),
    "strangers unknown": ("unknown", "strangers", "strangers unknown"),
}
AFTER = {name: (top, bottom) for name, (top, bottom, _) in SHARES.items()}
AFTER["CPU, s"] = ("seconds", ONE)
COUNTS = tuple(dict.fromkeys(column for pair in AFTER.values() for column in pair))
ENDS = {"frames until done": ("done", ONE)}
TESTED = ("recall", "frames until done")


def benchmark_tables(
    scans: Path,
    strangers: Path,
    out: Path,
    settings: TableSettings = TableSettings(),
    workers: int | None = None,
    track: TrackProgress = silently,
) -> ComparedTables:
    """Compare next-view policies on simulated tables with several things each.

    Each table has 6 to 10 objects at true size in resting poses; one of them is a stranger. The
    results give, after each number of frames: the share of the things that was found and named
    correctly (recall); the share of the names that is correct (precision; a name of the stranger or
    of a fragment is wrong); the same for confident names; and the share of strangers called
    unknown. An interrupted run resumes.

    All policies choose among the same candidate views, all around the scene at the distance of the
    last camera.

    Args:
        scans: folder of the scans of things that the memory was taught, metres, with the same
            names.
        strangers: folder of meshes of other objects.
        out: folder of the results; an existing one is continued.
        workers: number of processes; by default one per core; 0 uses this process.
        track: callable that shows progress.

    Raises:
        UsageError: settings are invalid, or a folder has no meshes.
        PolicyError: there is no such policy, or one of your own fails.
        ResultsError: OUT contains the results of other settings.
    """
    settings.check()
    scans = Path(scans)
    strangers = Path(strangers)
    out = Path(out)
    check_place(out)
    pool.count(workers)
    least = MOST_THINGS - 1  # one is a stranger
    if len(meshes_in(scans)) < least:
        raise UsageError(
            f"{scans}: holds {len(meshes_in(scans))} scans; a table takes up to {least}"
        )

    policies = tuple(dict.fromkeys([settings.reference, *settings.policies]))
    shown = {
        "memory_sha256": open_memory(settings.models)[0].sha256,
        "network": str(settings.network or ""),
        "scans": len(meshes_in(scans)),
        "strangers": len(meshes_in(strangers)),
        "kind of views": "candidates of the scene",  # earlier: on a circle, by two policies
        "views": list(settings.views),
        "seed": settings.seed,
    }
    jobs = [
        TableJob(settings, out, f"{table:04d}", policies, scans, strangers, table)
        for table in range(settings.tables)
    ]
    with only_one(out):
        check_same(out, shown)
        runs = run_jobs(work_at_table, jobs, TableRuns, workers, track)
        names = dict.fromkeys([*SCENE_POLICIES, *policies])
        there = [name for name in names if all(name in e.runs for e in runs)]
        tables = summarise_tables(runs, there, settings)
        made = asdict(settings) | {
            "network": shown["network"],
            "policies": there,
            "command": command(),
            "scans": str(scans),
            "strangers": str(strangers),
        }
        write_compared(out, tables, made, "recall", "found and named right")
    return tables


def summarise_tables(
    runs: Sequence[TableRuns],
    policies: Sequence[str],
    settings: TableSettings,
) -> ComparedTables:
    """Compare policies over all tables, with one Holm correction over all tests.

    Args:
        runs: of all tables.
        policies: in the order of the results.
        settings: views, reference, samples and seed.
    """
    rows = []
    for policy in policies:
        for each in runs:
            run = each.runs[policy]
            for views, counts in (
                *zip(settings.views, run.counts, strict=True),
                (0, {}),
            ):
                cell = {"policy": policy, "threshold": np.nan, "views": views}
                known = {"object": each.table, ONE: 1.0, "done": run.done}
                rows.append(cell | dict.fromkeys(COUNTS, 0.0) | known | counts)
    families = np.arange(len(runs))
    counted = Counted.of(pd.DataFrame(rows), AFTER, ENDS, families)
    weights = resample(
        len(runs), settings.samples, np.random.default_rng(settings.seed)
    )
    tests = counted.tests(ALL, weights, settings.reference, tested_by(TESTED))
    things = sum(each.runs[policies[0]].counts[0]["things"] for each in runs)
    about = f"{len(runs)} tables, {things:g} known things"
    return ComparedTables(
        counted.measures(ALL, weights),
        corrected([tests]),
        settings.reference,
        tuple(
            Board(f"After {k} frame{'s' * (k > 1)}", _columns(k), about)
            for k in settings.views
        ),
        "",
    )


def _columns(k: int) -> tuple[Column, ...]:
    """Return the columns after a number of frames."""
    until = "frames until done"
    shares = [
        Column(name, (name,), k, short=short) for name, (_, _, short) in SHARES.items()
    ]
    spent = Column("CPU for the last frame, s", ("CPU, s",), k, 2)
    return (*shares, Column(until, (until,), 0, 2, "until done"), spent)
