"""The benchmark of tables with several things: from scans to a folder of results, resumable."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from nextview.data import pool
from nextview.data.progress import TrackProgress, silently
from nextview.errors import UsageError
from nextview.files import command, only_one
from nextview.scene.view_policies import SCENE_POLICIES
from nextview.things.memory import open_memory
from nextview_lab.benchmark.board_page import Board, Column
from nextview_lab.benchmark.comparison import ALL, ONE, Counted, Key, corrected
from nextview_lab.benchmark.jobs import check_place, check_same, run_jobs
from nextview_lab.benchmark.results import ComparedTables, write_compared
from nextview_lab.benchmark.statistics import resample
from nextview_lab.benchmark.table_runs import (
    MOST_THINGS,
    TableJob,
    TableRuns,
    TableSettings,
    meshes_in,
    work_at_table,
)
from nextview_lab.extras import extras

with extras():
    import pandas as pd

# by measure: numerator, denominator, and heading in narrow tables
SHARES = {
    "recall": ("right", "things", "recall"),
    "precision": ("right", "named", "precision"),
    "recall, confident": ("sure_right", "things", "confident recall"),
    "precision, confident": ("sure_right", "sure", "confident precision"),
    "ADD-S < 0.1 d, world": ("close", "right", ""),
    "ADD-S < 0.1 d, camera": ("close_in_camera", "right", ""),
    "strangers unknown": ("unknown", "strangers", "strangers unknown"),
}
AFTER = {name: (top, bottom) for name, (top, bottom, _) in SHARES.items()}
AFTER["CPU, s"] = ("seconds", ONE)
COUNTS = tuple(dict.fromkeys(column for pair in AFTER.values() for column in pair))
ENDS = {"frames until done": ("done", ONE)}


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
    of a fragment is wrong); the same for confident names; the share of correctly named things with
    a good pose (ADD-S below a tenth of the diameter), in the world and in the frame of the last
    camera; and the share of strangers called unknown. An interrupted run resumes.

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
    tests = counted.tests(ALL, weights, settings.reference, _is_compared)
    things = sum(each.runs[policies[0]].counts[0]["things"] for each in runs)
    about = f"{len(runs)} tables, {things:g} known things"
    return ComparedTables(
        counted.measures(ALL, weights),
        corrected([tests]),
        settings.reference,
        tuple(
            Board(f"After {k} frame{'s' * (k > 1)}", ALL, _columns(k), about)
            for k in settings.views
        ),
        "",
    )


def _is_compared(key: Key) -> bool:
    """Return True if a measure is compared with the reference; the first view is the same."""
    if key.measure == "recall":
        return key.views > 1
    return key.measure == "frames until done"


def _columns(k: int) -> tuple[Column, ...]:
    """Return the columns after a number of frames."""
    until = "frames until done"
    shares = [
        Column(name, (name,), k, short=short) for name, (_, _, short) in SHARES.items()
    ]
    spent = Column("CPU for the last frame, s", ("CPU, s",), k, 2)
    return (*shares, Column(until, (until,), 0, 2, "until done"), spent)
