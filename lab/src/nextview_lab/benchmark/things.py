"""The benchmark of next views of taught things: from scans to a folder of results, resumable."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from nextview.checks import number_of
from nextview.data import pool
from nextview.data.progress import TrackProgress, silently
from nextview.errors import DatasetError
from nextview.files import command, only_one
from nextview.session.result import SUSPICIOUS
from nextview.session.system import UNKNOWN_ALPHA
from nextview.teaching.learn import learn_things
from nextview.teaching.thing_sources import find_things
from nextview.teaching.thing_views import TeachingOptions
from nextview_lab.benchmark.comparison import (
    ALL,
    ONE,
    Counted,
    corrected,
    measures_of,
    tested_by,
)
from nextview_lab.benchmark.jobs import check_place, check_same, run_jobs
from nextview_lab.benchmark.results import ComparedTables, write_compared
from nextview_lab.benchmark.statistics import resample_families
from nextview_lab.benchmark.text_tables import Board, Column
from nextview_lab.benchmark.thing_episodes import EPISODE_SPHERE, KnownThings
from nextview_lab.benchmark.thing_policies import (
    BEST_BLIND,
    BLIND_RULES,
    CEILINGS,
    OF_MEMORIES,
    THING_POLICIES,
    policies_of,
)
from nextview_lab.benchmark.thing_runs import (
    EpisodeRuns,
    ThingJob,
    ThingSettings,
    policies_in,
    things_of,
    work,
)
from nextview_lab.extras import extras

with extras():
    import pandas as pd

QUANTILES = {"median": 0.5, "95 %": 0.95}
# measures after a number of views, and of whole episodes: columns of the long table
AFTER = {"accuracy": ("right", ONE), "travel, rad": ("travel", ONE)}
ENDS = {
    "views until confident": ("until", ONE),
    "travel until confident, rad": ("travel", ONE),
    "confident": ("confident", ONE),
    "wrong, of the confident": ("wrong", "confident"),
}
TESTED = ("accuracy", "views until confident")


def _episodes(runs: Sequence[EpisodeRuns], threshold: float) -> "pd.DataFrame":
    """Return the long table of all runs.

    A run is confident, like a session without ``Recognition.joint_doubt``, where the belief has
    reached the threshold and the residual is not suspicious.

    Args:
        runs: of all episodes.
        threshold: belief from which a run is confident.

    Returns:
        One row for each number of views: "right", "travel", radians, "pose", the error in
        millimetres, NaN if the thing was not named correctly, and the CPU time "decision", seconds.
        And one for each whole run, with 0 views: "until", the number of
        views until it was confident, all of them if it never was, the "travel" until then, whether
        it was "confident", and "wrong" then.
    """
    rows: list[dict] = []
    for each, policy, run in (
        (one, policy, run)
        for one in runs
        for policy, several in one.runs.items()
        for run in several
    ):
        cell = {"policy": policy, "threshold": np.nan, "thing": each.thing, ONE: 1.0}
        explained = np.array(run.p_value, np.float64)
        # False if it is not known
        suspicious = explained < SUSPICIOUS * UNKNOWN_ALPHA
        sure = (np.array(run.confidence) >= threshold) & ~suspicious
        last = int(sure.argmax()) if sure.any() else len(sure) - 1
        arcs = EPISODE_SPHERE.arc[run.views[:-1], run.views[1:]]
        travel = np.append(0.0, np.cumsum(arcs))
        ends = {"until": last + 1, "travel": travel[last], "confident": sure[last]}
        ends["wrong"] = sure[last] and not run.right[last]
        rows.append(cell | {"views": 0} | ends)

        after = {
            "views": range(1, len(run.views) + 1),
            "right": run.right,
            "travel": travel,
            "pose": run.pose_error,
            "decision": [*run.decision, None],
        }
        columns = zip(*after.values(), strict=True)
        rows += [cell | dict(zip(after, values, strict=True)) for values in columns]
    return pd.DataFrame(rows).astype({"pose": "float64", "decision": "float64"})


def summarise_things(
    runs: Sequence[EpisodeRuns],
    how: ThingSettings,
    chosen: str = "",
) -> ComparedTables:
    """Compare policies over all things, with one Holm correction over all tests.

    Args:
        runs: of all episodes.
        how: views, threshold, families, samples and reference.
        chosen: a sentence on how the reference was selected; "" if it was named.

    Returns:
        The tables.
    """
    policies = list(policies_in(runs))
    episodes = _episodes(runs, how.threshold)
    episodes = episodes[episodes["policy"].isin(policies)]
    things = list(dict.fromkeys(one.thing for one in runs))
    episodes = episodes.assign(object=episodes["thing"].map(things.index))
    bodies = [name.partition("_")[0] if how.families else name for name in things]
    family = np.asarray(np.unique(np.array(bodies), return_inverse=True)[1])
    weights = resample_families(family, how.samples, np.random.default_rng(0))
    kept = episodes[episodes["views"].isin([0, *how.views])]
    counted = Counted.of(kept, AFTER, ENDS, family)
    found = [counted.measures(ALL, weights), _poses(kept), _times(episodes)]
    tests = counted.tests(ALL, weights, how.reference, tested_by(TESTED))
    known = how.reference in CEILINGS
    return ComparedTables(
        _by_policy(pd.concat(found, ignore_index=True), policies),
        corrected(
            [_by_policy(tests, policies)], lambda policy: known or policy in CEILINGS
        ),
        how.reference,
        (
            Board(
                "All things: share named right after views",
                _columns(how.views),
                number_of(len(things), "thing"),
            ),
        ),
        chosen,
    )


def _by_policy(table: "pd.DataFrame", policies: list[str]) -> "pd.DataFrame":
    """Sort the rows of a table by policy."""
    place = table["policy"].map(policies.index)
    return table.iloc[np.argsort(place.to_numpy(), kind="stable")]


def _columns(views: tuple[int, ...]) -> tuple[Column, ...]:
    """Return the columns of the tables."""
    last = views[-1]
    right = [Column(f"right after {k}", ("accuracy",), k, short=f"{k}") for k in views]
    poses = [
        Column(
            f"pose error after {k}, mm: median, 95 %",
            ("pose error, median", "pose error, 95 %"),
            k,
            1,
        )
        for k in views
        if k > 1
    ]
    until = "views until confident"
    way = "travel until confident, rad"
    wrong = "wrong, of the confident"
    spent = ("decision, ms, median", "decision, ms, 95 %")
    return (
        *right,
        Column(until, (until,), 0, 2, until),
        Column("confident", ("confident",)),
        Column(wrong, (wrong,), short="wrong"),
        Column(f"travel to view {last}, rad", ("travel, rad",), last, 2, "travel, rad"),
        Column(way, (way,), 0, 2),
        *poses,
        Column("choice, ms of CPU: median, 95 %", spent, 0, 0, "choice, ms of CPU"),
    )


def _times(episodes: "pd.DataFrame") -> "pd.DataFrame":
    """Return the time of a choice of all policies, milliseconds, without intervals."""
    rows = [
        (policy, None, 0, f"decision, ms, {which}", 1000 * value, np.nan, np.nan)
        for policy, times in episodes.groupby("policy", sort=False)["decision"]
        for which, value in zip(
            QUANTILES, times.quantile([*QUANTILES.values()]), strict=True
        )
    ]
    return measures_of(ALL, rows)


def _poses(episodes: "pd.DataFrame") -> "pd.DataFrame":
    """Return quantiles of the pose errors, without intervals; all things have one weight."""
    rows = []
    after = episodes[episodes["views"] > 0]
    for (policy, views), some in after.groupby(["policy", "views"], sort=False):
        weights = 1 / some.groupby("object")["object"].transform("size")
        known = some["pose"].notna()
        values = np.full(len(QUANTILES), np.nan)
        if known.any():
            values = np.quantile(
                some["pose"][known],
                [*QUANTILES.values()],
                weights=weights[known],
                method="inverted_cdf",
            )
        rows += [
            (policy, None, views, f"pose error, {which}", value, np.nan, np.nan)
            for which, value in zip(QUANTILES, values, strict=True)
        ]
    return measures_of(ALL, rows)


CHOOSING = "choosing"  # folder of the episodes in which the best blind rule is selected
MEMORY = "memory"  # folder of the taught memory, if no models are given


def benchmark_things(
    scans: Path,
    out: Path,
    settings: ThingSettings = ThingSettings(),
    workers: int | None = None,
    track: TrackProgress = silently,
) -> ComparedTables:
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
        tables = summarise_things(runs, settings, chosen)
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
