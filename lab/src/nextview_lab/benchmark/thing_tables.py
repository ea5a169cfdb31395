"""Summarise the benchmark of things: measures, intervals and tests."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nextview.session.result import SUSPICIOUS
from nextview.session.system import UNKNOWN_ALPHA
from nextview.types import Float, Index
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
from nextview_lab.benchmark.confusable import Alikeness
from nextview_lab.benchmark.results import ComparedTables
from nextview_lab.benchmark.statistics import exchange_p, interval, resample_families
from nextview_lab.benchmark.thing_episodes import EPISODE_SPHERE
from nextview_lab.benchmark.thing_policies import CEILINGS
from nextview_lab.benchmark.thing_runs import EpisodeRuns, ThingSettings, policies_in
from nextview_lab.extras import extras

with extras():
    import pandas as pd


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
