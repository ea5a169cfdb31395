"""The benchmark of next views of taught things: from scans to a folder of tables, resumable.

A folder of results holds ``episodes``, all that was sensed and verified, a folder for each episode;
``runs``, what each policy made of it, a small file for each; the record ``benchmark.json``, which
says how it was run; and the tables and figures, which every run writes anew.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from zlib import crc32

import msgspec
import numpy as np

from nextview.benchmark.confusable import how_alike
from nextview.benchmark.thing_episodes import (
    EPISODE_SPHERE,
    Occlusion,
    Setting,
    ThingEpisode,
)
from nextview.benchmark.thing_policies import THING_POLICIES, policies_of
from nextview.benchmark.thing_replay import EpisodeRuns, ThingRun, policies_in, run
from nextview.benchmark.thing_results import write_results
from nextview.benchmark.thing_tables import Compared, ThingTables, summarise_things
from nextview.checks import number, whole
from nextview.data import pool
from nextview.data.progress import TrackProgress, silently
from nextview.errors import DatasetError, ResultsError, UsageError
from nextview.files import check_new, command, only_one, read_record, write_record
from nextview.geometry.mesh import UNITS, Mesh, load_mesh
from nextview.policies.base import Policy
from nextview.recognition.model_card import find_models
from nextview.simulation.sensor import sensor_named
from nextview.teaching.learn import learn_things
from nextview.teaching.thing_sources import find_things
from nextview.teaching.thing_views import TeachingOptions
from nextview.things.memory import TaughtRecogniser
from nextview.things.taught import TaughtThings

EPISODES_FILE = "episodes.json"  # how the episodes of a folder are shown
MEMORY = "memory"  # folder of what is taught, where no models are given


@dataclass(frozen=True)
class ThingSettings:
    """Conditions, policies and statistics.

    Attributes:
        models: name or folder of the memory that knows the scans; by default they are taught first,
            into OUT/memory.
        sensor: simulated depth camera, NAME or NAME:STRENGTH, see nextview render --help.
        occlusion: "none" shows things alone, "half" and "heavy" among boxes that leave half and a
            third of them visible.
        draws: episodes per thing, each with another rotation and first view.
        views: numbers of views after which the policies are compared; episodes have the largest.
        policies: names, or MODULE:CLASS for your own; all by default. Only missing results are
            computed; your own policies always run again.
        threshold: belief from which an answer counts as confident.
        repeats: runs of the policy random in each episode.
        unit: unit of length of the scan files.
        families: things whose names are equal up to the first _, such as variants of one scan, are
            resampled together in the bootstrap.
        samples: number of bootstrap samples.
        seed: seed of rotations, boxes, first views, noise and random policies.
    """

    models: str | None = None
    sensor: str = "wrist"
    occlusion: Occlusion = "none"
    draws: int = 1
    views: tuple[int, ...] = (1, 2, 3, 5)
    policies: tuple[str, ...] = THING_POLICIES
    threshold: float = 0.97
    repeats: int = 2
    unit: str = "m"
    families: bool = False
    samples: int = 10_000
    seed: int = 0

    def check(self) -> None:
        """See that it makes sense, before any work is done.

        Raises:
            UsageError: a number, a unit or a sensor that there is none of.
        """
        for value, what in ((self.draws, "draws"), (self.repeats, "repeats")):
            whole(value, f"the number of {what}", 1)
        whole(self.samples, "the samples of the bootstrap", 100)
        if not self.views or list(self.views) != sorted(set(self.views)):
            raise UsageError("the numbers of views ascend, as in --views 1 2 3 5")
        whole(self.views[0], "a number of views", 1, len(EPISODE_SPHERE))
        whole(self.views[-1], "a number of views", 2, len(EPISODE_SPHERE))
        if number(self.threshold, "the threshold", 0) >= 1:
            raise UsageError(f"a threshold is below 1, not {self.threshold}")
        if self.unit not in UNITS:
            raise UsageError(f"the unit is {', '.join(UNITS)}, not {self.unit}")
        if not self.policies:
            raise UsageError("no policy is compared; leave --policies out for all")
        sensor_named(self.sensor)


class _Made(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the episodes of a folder are shown: those of another run fit only if all is the same."""

    memory_sha256: str
    sensor: str
    occlusion: str
    views: int
    repeats: int
    seed: int


@dataclass(frozen=True)
class _Job:
    """One episode, and the policies that are replayed in it."""

    models: str
    scan: Path
    unit: str
    thing: int
    draw: int
    setting: Setting
    views: int
    repeats: int
    policies: tuple[str, ...]
    out: Path

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.thing:04d}_{self.draw:02d}"

    @property
    def scan_name(self) -> str:
        """Of the thing."""
        return self.scan.stem

    @property
    def runs_file(self) -> Path:
        """Where its runs are written."""
        return self.out / "runs" / f"{self.name}.json"


def benchmark_things(
    scans: Path,
    out: Path,
    settings: ThingSettings = ThingSettings(),
    workers: int | None = None,
    track: TrackProgress = silently,
) -> ThingTables:
    """Compare next-view policies on taught things, from scans to tables.

    The scans are taught first, unless --models names a memory that contains them. Each thing is
    shown at its true size through a simulated sensor, and all policies continue from the same first
    view. Each view is rendered once and each set of views is verified once. Both are stored in OUT:
    an interrupted run resumes, and one more policy is replayed in seconds.

    A policy of your own, MODULE:CLASS, is made with the viewpoints. With needs = ("outlook",) it
    receives the leading hypotheses (things in poses), their beliefs and their surfaces; with
    "joint", the belief by features in things and azimuths.

    Args:
        scans: folder of the scans.
        out: folder of the results; an existing one is continued.
        workers: number of processes; by default one for each core; 0 uses this process.
        track: follows the work.

    Raises:
        UsageError: settings that make no sense.
        DatasetError: there is no scan of a thing.
        ResultsError: OUT holds the results of other settings.
    """
    settings.check()
    scans = Path(scans)
    out = Path(out)
    _check_place(out)
    pool.count(workers)
    found = {thing.name: thing.path for thing in find_things(scans, out).things}
    with only_one(out):
        models = _taught(scans, out, settings, workers, track)
        things = opened(models)
        if not set(things.names) & set(found):
            raise DatasetError(
                f"{scans}: holds no scan of anything that {models} knows"
            )
        policies_of(settings.policies, things)  # says what is wrong with a name
        _check_same(out, settings, things)

        jobs = _jobs(models, found, out, settings, things)
        left = [job for job in map(_left, jobs) if job is not None]
        steps = pool.counted(work, left, len(jobs), lambda job: job.name, workers)
        next(steps)
        track((done for done, _ in steps), len(jobs), "episodes")

        runs = [
            read_record(job.runs_file, EpisodeRuns, "runs", ResultsError)
            for job in jobs
        ]
        alike = how_alike(things).of({job.scan_name for job in jobs})
        how = Compared(
            policies_in(runs),
            settings.views,
            settings.threshold,
            settings.families,
            settings.samples,
        )
        tables = summarise_things(runs, alike, how)
        made = asdict(settings) | {"command": command(), "scans": str(scans)}
        write_results(out, tables, made)
    return tables


def _check_place(out: Path) -> None:
    """See that a folder is new, or holds results of this benchmark."""
    check_new(out, overwrite=True, folder=True)
    if not out.is_dir() or (out / EPISODES_FILE).is_file() or (out / MEMORY).is_dir():
        return
    strange = [path.name for path in out.iterdir() if not path.name.startswith(".")]
    if strange:
        raise ResultsError(
            f"{out}: holds {strange[0]}, and no results of this benchmark"
        )


def _taught(
    scans: Path,
    out: Path,
    settings: ThingSettings,
    workers: int | None,
    track: TrackProgress,
) -> str:
    """The memory of the scans, taught if it is not there."""
    if settings.models is not None:
        return settings.models
    memory = out / MEMORY
    if not memory.exists():
        how = TeachingOptions(unit=settings.unit, sensor=settings.sensor)  # type: ignore[arg-type]
        learn_things(scans, memory, how, workers=workers, track=track)
    return str(memory)


@lru_cache(maxsize=1)
def opened(models: str) -> TaughtThings:
    """The things of a memory whose geometry is known.

    Raises:
        UsageError: it knows the geometry of none.
    """
    recogniser = TaughtRecogniser(find_models(models).recogniser, threads=1)
    things = TaughtThings.of(recogniser)
    if things is None:
        raise UsageError(
            f"{models}: knows the geometry of no thing; teach it with --unit"
        )
    return things


def _check_same(out: Path, settings: ThingSettings, things: TaughtThings) -> None:
    """See that episodes which are there are of the same memory, sensor and seed."""
    made = _Made(
        memory_sha256=things.recogniser.card.sha256,
        sensor=settings.sensor,
        occlusion=settings.occlusion,
        views=settings.views[-1],
        repeats=settings.repeats,
        seed=settings.seed,
    )
    file = out / EPISODES_FILE
    if not file.exists():
        write_record(file, made)
        return

    before = read_record(file, _Made, "a record of episodes", ResultsError)
    for name in _Made.__struct_fields__:
        old, new = getattr(before, name), getattr(made, name)
        if old != new:
            what = name.removesuffix("_sha256")
            raise ResultsError(
                f"{out}: its episodes are of another {what} ({old}, not {new}); give another folder"
            )


def _jobs(
    models: str,
    scans: dict[str, Path],
    out: Path,
    settings: ThingSettings,
    things: TaughtThings,
) -> list[_Job]:
    """All episodes of a run."""
    setting = Setting(settings.sensor, settings.occlusion, settings.seed)

    return [
        _Job(
            models=models,
            scan=scans[name],
            unit=settings.unit,
            thing=thing,
            draw=draw,
            setting=setting,
            views=settings.views[-1],
            repeats=settings.repeats,
            policies=settings.policies,
            out=out,
        )
        for draw in range(settings.draws)
        for thing, name in enumerate(things.names)
        if name in scans
    ]


def _left(job: _Job) -> _Job | None:
    """The job with the policies that are not done; None if all are. Your own are done anew."""
    if not job.runs_file.exists():
        return job
    done = read_record(job.runs_file, EpisodeRuns, "runs", ResultsError).runs
    left = tuple(name for name in job.policies if name not in done or ":" in name)
    return replace(job, policies=left) if left else None


def work(job: _Job) -> None:
    """Replay the policies of a job, and write down what they made of it."""
    things = opened(job.models)
    chosen = policies_of(job.policies, things)
    folder = job.out / "episodes" / job.name
    episode = ThingEpisode(
        things,
        partial(_mesh, job.scan, job.unit),
        job.thing,
        job.draw,
        job.setting,
        folder,
    )
    runs: dict[str, list[ThingRun]] = {}
    if job.runs_file.exists():
        runs |= read_record(job.runs_file, EpisodeRuns, "runs", ResultsError).runs
    # Foresight verifies what others need, too.
    for name in sorted(job.policies, key=lambda name: name != "foresight"):
        runs[name] = replayed(episode, name, chosen[name], job)
    episode.save()
    job.runs_file.parent.mkdir(parents=True, exist_ok=True)
    done = EpisodeRuns(things.names[job.thing], job.draw, runs)
    write_record(job.runs_file, done, overwrite=True)


def _mesh(scan: Path, unit: str) -> Mesh:
    return load_mesh(scan, unit=unit)


def replayed(
    episode: ThingEpisode,
    name: str,
    make: Callable[[ThingEpisode], Policy],
    job: _Job,
) -> list[ThingRun]:
    """The runs of one policy in one episode.

    Args:
        episode: what is sensed and verified.
        name: of the policy.
        make: the policy for an episode.
        job: starts, views and rules of all episodes.
    """
    rng = np.random.default_rng(
        (job.setting.seed, job.thing, job.draw, crc32(name.encode()))
    )
    times = job.repeats if name == "random" else 1
    return [run(episode, make(episode), job.views, rng) for _ in range(times)]
