"""The benchmark of next views of taught things: from scans to a folder of results, resumable."""

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from nextview.data import pool
from nextview.data.progress import TrackProgress, silently
from nextview.errors import DatasetError
from nextview.files import command, only_one
from nextview.geometry.mesh import load_mesh
from nextview.geometry.viewsphere import rotation_z
from nextview.session.result import SUSPICIOUS
from nextview.session.system import UNKNOWN_ALPHA
from nextview.teaching.learn import learn_things
from nextview.teaching.thing_sources import find_things
from nextview.teaching.thing_views import TeachingOptions
from nextview.things.surface import Surface
from nextview.types import Float, Index, Mask
from nextview_lab.benchmark.board_page import Board, Column
from nextview_lab.benchmark.comparison import (
    ALL,
    ONE,
    Counted,
    Key,
    corrected,
    measures_of,
    tests_of,
)
from nextview_lab.benchmark.jobs import check_place, check_same, run_jobs
from nextview_lab.benchmark.results import ComparedTables, write_compared
from nextview_lab.benchmark.statistics import exchange_p, interval, resample_families
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

COMPARED_SURFACE_POINTS = 300  # sampled points of each surface
AZIMUTHS_TRIED = 16  # tried rotations about the vertical
RADII_APART = 1.25  # ratio of radii above which two things are not alike


@dataclass(frozen=True, eq=False)
class Alikeness:
    """Similarity of things.

    Attributes:
        names: of the things.
        nearest: name of the most similar other thing; its own name if no other one has a similar
            size.
        distance: mean distance of the two surfaces at the best azimuth, in mean radii, (T,)
            float64; infinity if no other one has a similar size.
    """

    names: tuple[str, ...]
    nearest: tuple[str, ...]
    distance: Float

    @property
    def confusable(self) -> Mask:
        """Half of the things with the most similar counterparts, (T,) bool."""
        rank = np.argsort(np.argsort(self.distance, kind="stable"), kind="stable")
        return rank < len(self.names) // 2

    def of(self, names: Collection[str]) -> "Alikeness":
        """Select some of the things; the nearest of each may be another one.

        Args:
            names: of the selected things.
        """
        rows = [row for row, name in enumerate(self.names) if name in names]
        some = tuple(self.names[row] for row in rows)
        nearest = tuple(self.nearest[row] for row in rows)
        return Alikeness(some, nearest, self.distance[rows])


def distances_between(surfaces: Sequence[Surface]) -> Float:
    """Compare the surfaces of things in the orientation of their files.

    Args:
        surfaces: of T things.

    Returns:
        Mean distance of two surfaces at the best azimuth, as a share of their mean radius, (T, T)
        float64; infinity if their sizes differ, and on the diagonal.
    """
    rng = np.random.default_rng(0)
    points = [surface.sample(COMPARED_SURFACE_POINTS, rng) for surface in surfaces]
    points = [cloud - (cloud.max(0) + cloud.min(0)) / 2 for cloud in points]
    trees = [cKDTree(cloud) for cloud in points]
    radii = np.array([surface.radius for surface in surfaces])
    turns = rotation_z(2 * np.pi * np.arange(AZIMUTHS_TRIED) / AZIMUTHS_TRIED)

    apart = np.full((len(surfaces), len(surfaces)), np.inf)
    for first, second in zip(*np.triu_indices(len(surfaces), 1), strict=True):
        larger = max(radii[first], radii[second])
        if larger > RADII_APART * min(radii[first], radii[second]):
            continue
        turned = points[first] @ turns.swapaxes(1, 2)
        there = np.asarray(trees[second].query(turned)[0]).mean(1)
        back = np.asarray(trees[first].query(points[second] @ turns)[0]).mean(1)
        mean = (radii[first] + radii[second]) / 2
        apart[first, second] = apart[second, first] = ((there + back) / 2).min() / mean
    return apart


def how_alike(surfaces: Sequence[Surface]) -> Alikeness:
    """Find the most similar other thing of each thing, see ``distances_between``.

    Args:
        surfaces: of the things.

    Returns:
        The similarity of the things.
    """
    apart = distances_between(surfaces)
    distance = apart.min(1)
    own = np.arange(len(apart))
    nearest = np.where(np.isfinite(distance), apart.argmin(1), own)
    names = tuple(surface.name for surface in surfaces)
    return Alikeness(names, tuple(names[k] for k in nearest), distance)


CONFUSABLE = "confusable half"
TITLES = {ALL: "All things", CONFUSABLE: "The confusable half"}
FAR_END = 0.95  # quantile of the pose error
FAR_POSE = "pose error, 95 %"
POSE_AFTER = 2  # number of views after which the pose error is tested
QUANTILES = {"median": 0.5, "95 %": FAR_END}
# measures after a number of views, and of whole episodes: columns of the long table
AFTER = {"accuracy": ("right", ONE), "travel, rad": ("travel", ONE)}
ENDS = {
    "views until confident": ("until", ONE),
    "travel until confident, rad": ("travel", ONE),
    "confident": ("confident", ONE),
    "wrong, of the confident": ("wrong", "confident"),
}


@dataclass(frozen=True)
class ThingTables(ComparedTables):
    """The tables of a benchmark of things.

    The sets are ``all`` and the ``confusable half``. One Holm correction is applied to all tests.

    Attributes:
        things: the things: "thing", "most_alike", "distance" (radii), "confusable".
        episodes: total number of episodes.
    """

    things: "pd.DataFrame"
    episodes: int


def _episodes(runs: Sequence[EpisodeRuns], threshold: float) -> "pd.DataFrame":
    """Return the long table of all runs.

    A run is confident, like a session without ``Recognition.joint_doubt``, where the belief has
    reached the threshold and the residual is not suspicious.

    Args:
        runs: of all episodes.
        threshold: belief from which a run is confident.

    Returns:
        One row for each number of views: "right", "travel", radians, "pose", the error in
        millimetres, NaN if the thing was not named correctly, and the CPU times "decision" and
        "verification", seconds. And one for each whole run, with 0 views: "until", the number of
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
            "verification": run.verification,
        }
        columns = zip(*after.values(), strict=True)
        rows += [cell | dict(zip(after, values, strict=True)) for values in columns]
    return pd.DataFrame(rows).astype({"pose": "float64", "decision": "float64"})


def _pose_quantiles(rows: "pd.DataFrame", drawn: Float) -> dict[str, Float]:
    """Return quantiles of the valid pose errors in each bootstrap sample of things, (S,) each.

    Args:
        rows: of one policy after a number of views.
        drawn: bootstrap weight of each thing in each sample, (S, things).
    """
    things, errors, weight = _weighed(rows)
    known = ~np.isnan(errors)
    if not known.any():
        return dict.fromkeys(QUANTILES, np.full(len(drawn), np.nan))
    order = np.flatnonzero(known)[np.argsort(errors[known])]
    weights = np.cumsum((drawn[:, things] * weight)[:, order], axis=1)
    return {
        name: errors[order][(weights >= share * weights[:, -1:]).argmax(1)]
        for name, share in QUANTILES.items()
    }


def _weighed(rows: "pd.DataFrame") -> tuple[Index, Float, Float]:
    """Return thing, pose error and weight of each row, (R,); the weights of a thing sum to 1."""
    things = rows["object"].to_numpy()
    return things, rows["pose"].to_numpy(), 1 / np.bincount(things)[things]


def summarise_things(
    runs: Sequence[EpisodeRuns],
    alike: Alikeness,
    how: ThingSettings,
    chosen: str = "",
) -> ThingTables:
    """Compare policies over all things, and over the confusable half of them.

    Args:
        runs: of all episodes.
        alike: similarity of the things.
        how: views, threshold, families, samples and reference.
        chosen: a sentence on how the reference was selected; "" if it was named.

    Returns:
        The tables.
    """
    rng = np.random.default_rng(0)
    policies = list(policies_in(runs))
    episodes = _episodes(runs, how.threshold)
    episodes = episodes[episodes["policy"].isin(policies)]
    groups = {ALL: np.ones(len(alike.names), bool), CONFUSABLE: alike.confusable}
    measures: list[pd.DataFrame] = []
    tests: list[pd.DataFrame] = []
    boards = []

    for name, mine in groups.items():
        things = [alike.names[k] for k in np.flatnonzero(mine)]
        if not things:
            continue
        number = {thing: k for k, thing in enumerate(things)}
        some = episodes[episodes["thing"].isin(number)]
        some = some.assign(object=some["thing"].map(number))
        family = _families(things, how)
        weights = resample_families(family, how.samples, rng)
        kept = some[some["views"].isin([0, *how.views])]
        counted = Counted.of(kept, AFTER, ENDS, family)
        poses = _poses(name, some, family, weights, how)
        found = [counted.measures(name, weights), poses[0], _times(name, some)]
        apart = [counted.tests(name, weights, how.reference, _is_tested), poses[1]]
        measures.append(_by_policy(found, policies))
        tests.append(_by_policy(apart, policies))
        about = f"{len(things)} thing{'s' * (len(things) > 1)}"
        title = f"{TITLES[name]}: share named right after views"
        boards.append(Board(title, name, _columns(how.views), about))

    known = how.reference in CEILINGS
    return ThingTables(
        pd.concat(measures, ignore_index=True),
        corrected(tests, lambda policy: known or policy in CEILINGS),
        how.reference,
        tuple(boards),
        chosen,
        pd.DataFrame(
            {
                "thing": alike.names,
                "most_alike": alike.nearest,
                "distance": alike.distance,
                "confusable": alike.confusable,
            }
        ),
        len(runs),
    )


def _by_policy(parts: list["pd.DataFrame"], policies: list[str]) -> "pd.DataFrame":
    """Sort the rows of one set by policy."""
    table = pd.concat(parts, ignore_index=True)
    place = table["policy"].map(policies.index)
    return table.iloc[np.argsort(place.to_numpy(), kind="stable")]


def _columns(views: tuple[int, ...]) -> tuple[Column, ...]:
    """Return the columns of the tables."""
    last = views[-1]
    right = [Column(f"right after {k}", ("accuracy",), k, short=f"{k}") for k in views]
    poses = [
        Column(
            f"pose error after {k}, mm: median, 95 %",
            ("pose error, median", FAR_POSE),
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
        Column(until, (until,), 0, 2, "until confident"),
        Column("confident", ("confident",)),
        Column(wrong, (wrong,), short="wrong"),
        Column(f"travel to view {last}, rad", ("travel, rad",), last, 2, "travel"),
        Column(way, (way,), 0, 2),
        *poses,
        Column("choice, ms of CPU: median, 95 %", spent, 0, 0, "choice, ms of CPU"),
    )


def _families(names: Sequence[str], how: ThingSettings) -> Index:
    """Return the family index of each thing, (T,) int64."""
    bodies = [name.partition("_")[0] if how.families else name for name in names]
    return np.asarray(np.unique(np.array(bodies), return_inverse=True)[1])


def _times(name: str, episodes: "pd.DataFrame") -> "pd.DataFrame":
    """Return the run times of all policies, milliseconds, without intervals.

    That of a verification is of all views together.
    """
    last = episodes["views"] == episodes["views"].max()
    times = episodes.assign(verification=episodes["verification"].where(last))
    rows = [
        (policy, None, 0, f"{what}, ms, {which}", 1000 * value, np.nan, np.nan)
        for policy, own in times.groupby("policy", sort=False)
        for what in ("decision", "verification")
        for which, value in zip(
            QUANTILES, own[what].quantile([0.5, FAR_END]), strict=True
        )
    ]
    return measures_of(name, rows)


def _poses(
    name: str,
    episodes: "pd.DataFrame",
    family: Index,
    weights: Float,
    how: ThingSettings,
) -> tuple["pd.DataFrame", "pd.DataFrame"]:
    """Return measures and tests of the pose error, which are quantiles instead of means.

    Args:
        name: of the set of things.
        episodes: long table.
        family: of each thing, (T,).
        weights: bootstrap weight of each thing in each sample, (S, T).
        how: settings of the comparison.
    """
    # the first sample is the original set
    drawn = np.concatenate([np.ones((1, len(family))), weights])
    cells = {
        (str(policy), int(views)): rows
        for (policy, views), rows in episodes.groupby(["policy", "views"], sort=False)
        if views in how.views
    }
    found = {cell: _pose_quantiles(rows, drawn) for cell, rows in cells.items()}
    rows = [
        (policy, None, k, f"pose error, {which}", values[0], *_ends(values))
        for (policy, k), both in found.items()
        for which, values in both.items()
    ]
    tests = []
    theirs = how.reference, POSE_AFTER
    for policy, k in cells:
        if theirs not in cells or k != POSE_AFTER or policy == how.reference:
            continue
        apart = found[policy, k]["95 %"] - found[theirs]["95 %"]
        p = _pose_p(cells[policy, k], cells[theirs], family)
        count = int(family.max()) + 1
        key = Key(policy, None, k, FAR_POSE)
        tests.append((key, apart[0], *_ends(apart), p, count))
    return measures_of(name, rows), tests_of(name, how.reference, tests)


def _ends(values: Float) -> tuple[float, float]:
    """Return the interval of samples, without the first one."""
    low, high = interval(values[1:, None])
    return float(low[0]), float(high[0])


def _is_tested(key: Key) -> bool:
    """Return True if a measure is compared with the reference; the first view is the same."""
    if key.measure == "accuracy":
        return key.views > 1
    return key.measure == "views until confident"


def _pose_p(own: "pd.DataFrame", reference: "pd.DataFrame", family: Index) -> float:
    """Return the p-value of the difference in the quantile of the pose error."""
    both = _weighed(own), _weighed(reference)
    things, errors, weights = (np.concatenate(pair) for pair in zip(*both, strict=True))
    order = np.argsort(errors)[: np.count_nonzero(~np.isnan(errors))]
    whose = np.repeat([1.0, -1.0], [len(own), len(reference)])[order]
    families = family[things][order]

    def far(ours: Float) -> Float:
        """The far end of the errors of those runs that count as ours, (S,)."""
        below = np.cumsum(ours * weights[order], axis=1)
        first = (below >= FAR_END * below[:, -1:]).argmax(1)
        return np.where(below[:, -1] > 0, errors[order][first], np.nan)

    def difference(signs: Float) -> Float:
        ours = signs[:, families] * whose > 0
        return (far(ours) - far(~ours))[:, None]

    if not len(order):
        return np.nan
    return float(exchange_p(int(family.max()) + 1, difference)[0])


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
