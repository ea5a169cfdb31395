"""The benchmark of next views of taught things: from scans to a folder of tables, resumable.

A folder of results holds ``episodes``, all that was sensed and verified, a folder for each episode;
``runs``, what each policy made of it, a small file for each; the record ``benchmark.json``, which
says how it was run; and the tables and figures, which every run writes anew.
"""

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from nextview.benchmark.confusable import Alikeness, how_alike
from nextview.benchmark.thing_episodes import (
    EPISODE_SPHERE,
    Occlusion,
    Setting,
)
from nextview.benchmark.thing_jobs import ThingJob, opened, work
from nextview.benchmark.thing_policies import THING_POLICIES, policies_of
from nextview.benchmark.thing_replay import EpisodeRuns, policies_in
from nextview.benchmark.thing_results import write_results
from nextview.benchmark.thing_tables import Compared, ThingTables, summarise_things
from nextview.checks import number, whole
from nextview.data import pool
from nextview.data.progress import TrackProgress, silently
from nextview.errors import DatasetError, ResultsError, UsageError
from nextview.files import check_new, command, only_one, read_record, write_record
from nextview.geometry.mesh import UNITS
from nextview.simulation.sensor import sensor_named
from nextview.teaching.learn import learn_things
from nextview.teaching.thing_sources import find_things
from nextview.teaching.thing_views import TeachingOptions
from nextview.things.taught import TaughtThings

EPISODES_FILE = "episodes.json"  # how the episodes of a folder are shown
ALIKE_FILE = "alike.json"  # how alike the things of the memory are
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
        reference: policy that the others are compared with; it always takes part.
        threshold: belief from which an answer counts as confident, unless the thing is explained
            worse than nine in ten known ones: then a session goes on, too.
        repeats: runs of the policy random in each episode.
        unit: unit of length of the scan files.
        families: things whose names are equal up to the first _, such as variants of one scan,
            count as one in intervals and p-values.
        samples: number of bootstrap samples.
        seed: seed of rotations, boxes, first views, noise and random policies.
    """

    models: str | None = None
    sensor: str = "wrist"
    occlusion: Occlusion = "none"
    draws: int = 1
    views: tuple[int, ...] = (1, 2, 3, 5)
    policies: tuple[str, ...] = THING_POLICIES
    reference: str = "random"
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
    named = dict.fromkeys([settings.reference, *settings.policies])
    settings = replace(settings, policies=tuple(named))
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
        alike = _alike(out, things).of({job.scan_name for job in jobs})
        how = Compared(
            policies_in(runs),
            settings.views,
            settings.threshold,
            settings.families,
            settings.samples,
            settings.reference,
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


class _Alike(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How alike the things of a memory are, see ``Alikeness``.

    Attributes:
        nearest: name of the thing that is most like each.
        distance: of the two surfaces; None for infinity.
    """

    nearest: tuple[str, ...]
    distance: tuple[float | None, ...]


def _alike(out: Path, things: TaughtThings) -> Alikeness:
    """How alike the things are. It takes seconds, and is the same for all runs of a folder."""
    file = out / ALIKE_FILE
    if not file.exists():
        found = how_alike(things)
        distance = [
            apart if apart < np.inf else None for apart in found.distance.tolist()
        ]
        write_record(file, _Alike(found.nearest, tuple(distance)))
        return found

    kept = read_record(file, _Alike, "how alike things are", ResultsError)
    distances = np.array(
        [np.inf if apart is None else apart for apart in kept.distance]
    )
    return Alikeness(things.names, kept.nearest, distances)


def _jobs(
    models: str,
    scans: dict[str, Path],
    out: Path,
    settings: ThingSettings,
    things: TaughtThings,
) -> list[ThingJob]:
    """All episodes of a run."""
    setting = Setting(settings.sensor, settings.occlusion, settings.seed)

    return [
        ThingJob(
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


def _left(job: ThingJob) -> ThingJob | None:
    """The job with the policies that are not done; None if all are. Your own are done anew."""
    if not job.runs_file.exists():
        return job
    done = read_record(job.runs_file, EpisodeRuns, "runs", ResultsError).runs
    left = tuple(name for name in job.policies if name not in done or ":" in name)
    return replace(job, policies=left) if left else None
