"""The benchmark of next views of taught things: from scans to a folder of tables, resumable.

A folder of results holds ``episodes``, all that was sensed and verified, a folder for each episode;
``runs``, what each policy made of it, a small file for each; the record ``benchmark.json``, which
says how it was run; and the tables and figures, which every run writes anew.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from nextview.benchmark.confusable import Alikeness, how_alike
from nextview.benchmark.own_things import OwnThings
from nextview.benchmark.thing_episodes import (
    EPISODE_SPHERE,
    Occlusion,
    Setting,
)
from nextview.benchmark.thing_jobs import ThingJob, things_of, work
from nextview.benchmark.thing_policies import (
    BEST_BLIND,
    BLIND_RULES,
    OF_MEMORIES,
    THING_POLICIES,
    policies_of,
)
from nextview.benchmark.thing_replay import EpisodeRuns, policies_in
from nextview.benchmark.thing_results import write_results
from nextview.benchmark.thing_tables import Compared, ThingTables, summarise_things
from nextview.checks import number, whole
from nextview.data import pool
from nextview.data.progress import TrackProgress, silently
from nextview.errors import DatasetError, ResultsError, UsageError
from nextview.files import check_new, command, only_one, read_record, write_record
from nextview.geometry.mesh import UNITS, load_mesh
from nextview.simulation.sensor import sensor_named
from nextview.teaching.learn import learn_things
from nextview.teaching.thing_sources import find_things
from nextview.teaching.thing_views import TeachingOptions
from nextview.things.surface import Surface
from nextview.things.taught import TaughtThings

EPISODES_FILE = "episodes.json"  # how the episodes of a folder are shown
ALIKE_FILE = "alike.json"  # how alike the things of the memory are
CHOOSING = "choosing"  # folder of the episodes in which the best blind rule is chosen
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
        policies: names, or MODULE:CLASS for your own; by default all that the recogniser
            allows. Only missing results are computed; your own policies always run again.
        reference: policy that the others are compared with; it always takes part. "best-blind" is
            the rule that ignores the images (random, spread, furthest, fixed or ring) and is best
            after the first view in other episodes of the same things.
        choose_seed: seed of these other episodes.
        recogniser: MODULE:NAME of your own in the place of the memory; its classes are the things,
            and nothing is taught. Policies that go by a memory's hypotheses do not take part.
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
    policies: tuple[str, ...] = ()
    reference: str = "random"
    choose_seed: int = 1
    recogniser: str | None = None
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

        if self.reference == BEST_BLIND and self.choose_seed == self.seed:
            raise UsageError(
                "the best blind rule is chosen in other episodes than it is compared in: give"
                f" --choose-seed another value than --seed, {self.seed}"
            )
        if self.recogniser is not None and self.models is not None:
            raise UsageError("a recogniser of your own takes no --models")
        sensor_named(self.sensor)


class _Made(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the episodes of a folder are shown: those of another run fit only if all is the same."""

    memory_sha256: str
    recogniser: str
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
    asked = settings
    scans = Path(scans)
    out = Path(out)
    _check_place(out)
    pool.count(workers)
    found = {thing.name: thing.path for thing in find_things(scans, out).things}
    with only_one(out):
        models = _taught(scans, out, settings, workers, track)
        things = things_of(models, settings.recogniser)
        if not set(things.names) & set(found):
            knows = settings.recogniser or models
            raise DatasetError(f"{scans}: holds no scan of anything that {knows} knows")
        settings = replace(settings, policies=_allowed(settings, things))
        policies_of(settings.policies, things)  # says what is wrong with a name

        chosen = ""
        if settings.reference == BEST_BLIND:
            others = replace(
                settings,
                policies=BLIND_RULES,
                seed=settings.choose_seed,
            )
            jobs = _jobs(models, found, out / CHOOSING, others, things)
            rule, chosen = best_blind(
                _replayed(jobs, others, things, workers, track),
                settings,
            )
            named = dict.fromkeys([rule, *settings.policies])
            settings = replace(settings, reference=rule, policies=tuple(named))

        jobs = _jobs(models, found, out, settings, things)
        runs = _replayed(jobs, settings, things, workers, track)
        names = {job.scan_name for job in jobs}
        alike = _alike(out, _surfaces(things, found, settings)).of(names)
        how = Compared(
            policies_in(runs),
            settings.views,
            settings.threshold,
            settings.families,
            settings.samples,
            settings.reference,
        )
        tables = replace(summarise_things(runs, alike, how), chosen=chosen)
        made = asdict(asked) | {
            "policies": settings.policies,
            "compared_with": settings.reference,
            "chosen": chosen,
            "command": command(),
            "scans": str(scans),
        }
        write_results(out, tables, made)
    return tables


def _allowed(
    settings: ThingSettings,
    things: TaughtThings | OwnThings,
) -> tuple[str, ...]:
    """The policies that take part: the reference if it has a name, and what was asked for."""
    own = isinstance(things, OwnThings)
    all_of_them = [name for name in THING_POLICIES if not (own and name in OF_MEMORIES)]
    first = [] if settings.reference == BEST_BLIND else [settings.reference]
    return tuple(dict.fromkeys([*first, *(settings.policies or all_of_them)]))


def _replayed(
    jobs: list[ThingJob],
    settings: ThingSettings,
    things: TaughtThings | OwnThings,
    workers: int | None,
    track: TrackProgress,
) -> list[EpisodeRuns]:
    """The runs of all episodes, of which those that are not there are replayed."""
    jobs[0].out.mkdir(parents=True, exist_ok=True)
    _check_same(jobs[0].out, settings, things)
    left = [job for job in map(_left, jobs) if job is not None]
    steps = pool.counted(work, left, len(jobs), lambda job: job.name, workers)
    next(steps)
    track((done for done, _ in steps), len(jobs), "episodes")
    return [
        read_record(job.runs_file, EpisodeRuns, "runs", ResultsError) for job in jobs
    ]


def best_blind(
    runs: Sequence[EpisodeRuns],
    settings: ThingSettings,
) -> tuple[str, str]:
    """The blind rule that names most right after the first view.

    Args:
        runs: of other episodes than those that it is compared in.
        settings: with the numbers of views.

    Returns:
        The rule, of equals the one that is named first in BLIND_RULES, and a sentence about it.
    """
    later = [k - 1 for k in settings.views if k > 1]
    shares = {
        rule: float(
            np.mean([np.array(one.right)[later] for e in runs for one in e.runs[rule]])
        )
        for rule in BLIND_RULES
    }
    best = max(BLIND_RULES, key=lambda rule: shares[rule])
    told = ", ".join(f"{rule} {share:.3f}" for rule, share in shares.items())
    after = ", ".join(str(k + 1) for k in later)
    return best, (
        f"The best blind rule is {best}: in other episodes, of seed {settings.choose_seed}, these"
        f" shares are named right (mean after {after} views): {told}."
    )


def _surfaces(
    things: TaughtThings | OwnThings,
    scans: dict[str, Path],
    settings: ThingSettings,
) -> list[Surface]:
    """The surfaces of all things that are known, or else of those that are shown."""
    if isinstance(things, TaughtThings):
        return list(things.verifier.caster.surfaces)
    return [
        Surface.from_mesh(load_mesh(scans[name], unit=settings.unit), name)
        for name in things.names
        if name in scans
    ]


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
    """The memory of the scans, taught if it is not there; "" if none is needed."""
    if settings.recogniser is not None:
        return ""
    if settings.models is not None:
        return settings.models
    memory = out / MEMORY
    if not memory.exists():
        how = TeachingOptions(unit=settings.unit, sensor=settings.sensor)  # type: ignore[arg-type]
        learn_things(scans, memory, how, workers=workers, track=track)
    return str(memory)


def _check_same(
    out: Path,
    settings: ThingSettings,
    things: TaughtThings | OwnThings,
) -> None:
    """See that episodes which are there are of the same memory, sensor and seed."""
    made = _Made(
        memory_sha256=things.recogniser.card.sha256
        if isinstance(things, TaughtThings)
        else "",
        recogniser=settings.recogniser or "",
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
        old = getattr(before, name)
        new = getattr(made, name)
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


def _alike(out: Path, surfaces: Sequence[Surface]) -> Alikeness:
    """How alike the things are. It takes seconds, and is the same for all runs of a folder."""
    file = out / ALIKE_FILE
    if not file.exists():
        found = how_alike(surfaces)
        distance = [
            apart if apart < np.inf else None for apart in found.distance.tolist()
        ]
        write_record(file, _Alike(found.nearest, tuple(distance)))
        return found

    kept = read_record(file, _Alike, "how alike things are", ResultsError)
    distances = np.array(
        [np.inf if apart is None else apart for apart in kept.distance]
    )
    names = tuple(surface.name for surface in surfaces)
    return Alikeness(names, kept.nearest, distances)


def _jobs(
    models: str,
    scans: dict[str, Path],
    out: Path,
    settings: ThingSettings,
    things: TaughtThings | OwnThings,
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
            recogniser=settings.recogniser,
        )
        for draw in range(settings.draws)
        for thing, name in enumerate(things.names)
        if name in scans
    ]


def _left(job: ThingJob) -> ThingJob | None:
    """The job with the policies that are not done; None if all are. Your own are done anew."""
    if not job.runs_file.exists() or job.recogniser is not None:
        return job
    done = read_record(job.runs_file, EpisodeRuns, "runs", ResultsError).runs
    left = tuple(name for name in job.policies if name not in done or ":" in name)
    return replace(job, policies=left) if left else None
