"""The benchmark of next views of taught things: from scans to a folder of results, resumable."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from nextview.data import pool
from nextview.data.progress import TrackProgress, silently
from nextview.errors import DatasetError
from nextview.files import command, only_one
from nextview.geometry.mesh import load_mesh
from nextview.teaching.learn import learn_things
from nextview.teaching.thing_sources import find_things
from nextview.teaching.thing_views import TeachingOptions
from nextview.things.surface import Surface
from nextview_lab.benchmark.confusable import how_alike
from nextview_lab.benchmark.jobs import check_place, check_same, run_jobs
from nextview_lab.benchmark.known_things import KnownThings
from nextview_lab.benchmark.results import write_compared
from nextview_lab.benchmark.thing_policies import (
    BEST_BLIND,
    BLIND_RULES,
    OF_MEMORIES,
    THING_POLICIES,
    policies_of,
)
from nextview_lab.benchmark.thing_runs import (
    EpisodeRuns,
    ThingJob,
    ThingSettings,
    things_of,
    work,
)
from nextview_lab.benchmark.thing_tables import ThingTables, summarise_things

CHOOSING = "choosing"  # folder of the episodes in which the best blind rule is selected
MEMORY = "memory"  # folder of the taught memory, if no models are given


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
    view. An interrupted run resumes, and a further policy takes part in the same episodes.

    A policy of your own, MODULE:CLASS, is created with the viewpoints. With needs = ("outlook",) it
    receives the leading hypotheses (things in poses), their beliefs and their surfaces.

    Args:
        scans: folder of the scans.
        out: folder of the results; an existing one is continued.
        workers: number of processes; by default one per core; 0 uses this process.
        track: callable that shows progress.

    Raises:
        UsageError: settings are invalid.
        DatasetError: there is no scan of a thing.
        ResultsError: OUT contains the results of other settings.
    """
    settings.check()
    asked = settings
    scans = Path(scans)
    out = Path(out)
    check_place(out, MEMORY)
    pool.count(workers)
    found = {thing.name: thing.path for thing in find_things(scans, out).things}
    with only_one(out):
        models = _taught(scans, out, settings, workers, track)
        things = things_of(models, settings.recogniser)
        if not set(things.names) & set(found):
            knows = settings.recogniser or models
            raise DatasetError(f"{scans}: holds no scan of anything that {knows} knows")
        settings = replace(settings, policies=_allowed(settings, things))
        policies_of(settings.policies, things)  # raises an error for an invalid name

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
        names = {job.scan.stem for job in jobs}
        alike = how_alike(_surfaces(things, found, settings)).of(names)
        tables = summarise_things(runs, alike, settings, chosen)
        made = asdict(asked) | {
            "policies": settings.policies,
            "compared_with": settings.reference,
            "chosen": chosen,
            "command": command(),
            "scans": str(scans),
        }
        write_compared(out, tables, made, "accuracy", "named right")
    return tables


def _allowed(
    settings: ThingSettings,
    things: KnownThings,
) -> tuple[str, ...]:
    """Return the included policies: the reference, and the requested ones."""
    own = things.memory is None
    all_of_them = [name for name in THING_POLICIES if not (own and name in OF_MEMORIES)]
    first = [] if settings.reference == BEST_BLIND else [settings.reference]
    return tuple(dict.fromkeys([*first, *(settings.policies or all_of_them)]))


def _replayed(
    jobs: list[ThingJob],
    settings: ThingSettings,
    things: KnownThings,
    workers: int | None,
    track: TrackProgress,
) -> list[EpisodeRuns]:
    """Return the runs of all episodes; missing ones are computed."""
    made = {
        "memory_sha256": "" if things.memory is None else things.memory.card.sha256,
        "recogniser": settings.recogniser or "",
        "sensor": settings.sensor,
        "occlusion": settings.occlusion,
        "views": settings.views[-1],
        "repeats": settings.repeats,
        "seed": settings.seed,
    }
    check_same(jobs[0].out, made)
    anew = settings.recogniser is not None
    return run_jobs(work, jobs, EpisodeRuns, workers, track, anew)


def best_blind(
    runs: Sequence[EpisodeRuns],
    settings: ThingSettings,
) -> tuple[str, str]:
    """Return the blind rule that names most things correctly after the first view.

    Args:
        runs: of other episodes than those of the comparison.
        settings: with the numbers of views.

    Returns:
        The rule, with ties in the order of BLIND_RULES, and a sentence about it.
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
    things: KnownThings,
    scans: dict[str, Path],
    settings: ThingSettings,
) -> list[Surface]:
    """Return the surfaces of all taught things, or else of the scans."""
    if things.memory is not None:
        return list(things.memory.library.caster.surfaces)
    return [
        Surface.from_mesh(load_mesh(scans[name], unit=settings.unit), name)
        for name in things.names
        if name in scans
    ]


def _taught(
    scans: Path,
    out: Path,
    settings: ThingSettings,
    workers: int | None,
    track: TrackProgress,
) -> str:
    """Return the memory of the scans, taught if it does not exist; "" if none is needed."""
    if settings.recogniser is not None:
        return ""
    if settings.models is not None:
        return settings.models
    memory = out / MEMORY
    if not memory.exists():
        how = TeachingOptions(unit=settings.unit, sensor=settings.sensor)  # type: ignore[arg-type]
        learn_things(scans, memory, how, workers=workers, track=track)
    return str(memory)


def _jobs(
    models: str,
    scans: dict[str, Path],
    out: Path,
    settings: ThingSettings,
    things: KnownThings,
) -> list[ThingJob]:
    """Return all episodes of a run."""
    return [
        ThingJob(
            settings,
            out,
            f"{thing:04d}_{draw:02d}",
            settings.policies,
            models,
            scans[name],
            thing,
            draw,
        )
        for draw in range(settings.draws)
        for thing, name in enumerate(things.names)
        if name in scans
    ]
