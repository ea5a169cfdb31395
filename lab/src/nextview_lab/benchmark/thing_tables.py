"""Summarise the benchmark of things: measures, intervals and tests."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nextview.session.result import SUSPICIOUS
from nextview.session.system import UNKNOWN_ALPHA
from nextview.types import Float, Index
from nextview_lab.benchmark.comparison import (
    ALL,
    Counted,
    Key,
    corrected,
    measures_of,
    tests_of,
)
from nextview_lab.benchmark.confusable import Alikeness
from nextview_lab.benchmark.results import Board, Column, ComparedTables
from nextview_lab.benchmark.statistics import exchange_p, interval, resample_families
from nextview_lab.benchmark.thing_episodes import EPISODE_SPHERE
from nextview_lab.benchmark.thing_policies import CEILINGS
from nextview_lab.benchmark.thing_runs import (
    EpisodeRuns,
    ThingRun,
    ThingSettings,
    policies_in,
)
from nextview_lab.extras import extras

with extras():
    import pandas as pd


CONFUSABLE = "confusable half"
TITLES = {ALL: "All things", CONFUSABLE: "The confusable half"}
FAR_END = 0.95  # quantile of the pose error
FAR_POSE = "pose error, 95 %"
POSE_AFTER = 2  # number of views after which the pose error is tested


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


@dataclass(frozen=True, eq=False)
class _Runs:
    """The runs of one policy.

    Attributes:
        things: thing of each run, (R,) int64.
        weight: of each run, 1 in total for each thing, (R,).
        right: after each view, (R, K) float64.
        sure: whether it was ever confident, like a session without ``Recognition.joint_doubt``: the
            belief reached the threshold, and the residual is not suspicious, (R,) float64.
        wrong: whether it was confident and wrong, (R,) float64.
        until: number of views until it was confident; all of them if it never was, (R,).
        travel: radians on the sphere up to each view, (R, K).
        pose: error, millimetres, (R, K); NaN if the thing was not named correctly.
        decision: seconds per choice.
        verification: seconds per verification of all views.
    """

    things: Index
    weight: Float
    right: Float
    sure: Float
    wrong: Float
    until: Float
    travel: Float
    pose: Float
    decision: Float
    verification: Float

    @classmethod
    def of(cls, runs: Sequence[tuple[int, ThingRun]], threshold: float) -> "_Runs":
        """Combine runs, each with the number of its thing.

        Args:
            runs: pairs of a thing's number and a run.
            threshold: belief from which a run is confident.
        """
        things = np.array([thing for thing, _ in runs])
        right = np.array([each.right for _, each in runs], np.float64)
        believed = np.array([each.confidence for _, each in runs], np.float64)
        explained = np.array([each.p_value for _, each in runs], np.float64)
        # False if it is not known
        suspicious = explained < SUSPICIOUS * UNKNOWN_ALPHA
        sure = (believed >= threshold) & ~suspicious
        ever = sure.any(1)
        last = np.where(ever, sure.argmax(1), sure.shape[1] - 1)
        rows = np.arange(len(runs))
        arcs = [EPISODE_SPHERE.arc[each.views[:-1], each.views[1:]] for _, each in runs]
        travel = np.concatenate([np.zeros((len(runs), 1)), np.cumsum(arcs, axis=1)], 1)

        return cls(
            things=things,
            weight=1 / np.bincount(things)[things],
            right=right,
            sure=np.asarray(ever, np.float64),
            wrong=(ever & (right[rows, last] == 0)).astype(np.float64),
            until=last + 1.0,
            travel=travel,
            pose=np.array([each.pose_error for _, each in runs], np.float64),
            decision=np.concatenate([each.decision for _, each in runs]),
            verification=np.array([each.verification[-1] for _, each in runs]),
        )

    def mean(self, values: Float) -> Float:
        """Return the mean of a value over the runs of each thing, (T,).

        Args:
            values: of each run, (R,).
        """
        return np.bincount(self.things, values * self.weight).astype(np.float64)

    def quantile(self, values: Float, drawn: Float, share: float) -> Float:
        """Return the quantile of the valid values in each bootstrap sample of things, (S,).

        Args:
            values: of each run, (R,); NaN if not known.
            drawn: bootstrap weight of each thing in each sample, (S, things).
            share: level of the quantile, 0 to 1.
        """
        known = ~np.isnan(values)
        if not known.any():
            return np.full(len(drawn), np.nan)
        order = np.flatnonzero(known)[np.argsort(values[known])]
        weights = np.cumsum((drawn[:, self.things] * self.weight)[:, order], axis=1)
        first = (weights >= share * weights[:, -1:]).argmax(1)
        return np.asarray(values[order][first], np.float64)


def _sums(runs: _Runs, policy: str, views: tuple[int, ...]) -> dict[Key, tuple]:
    """Return the measures of one policy that are means over things, as sums for each thing."""
    right = {k: runs.mean(runs.right[:, k - 1]) for k in views}
    one = np.ones(len(right[views[0]]))
    found = {Key(policy, None, k, "accuracy"): (right[k], one) for k in views}
    for k in views:
        way = runs.mean(runs.travel[:, k - 1])
        found[Key(policy, None, k, "travel, rad")] = (way, one)

    rows = np.arange(len(runs.things))
    way = runs.travel[rows, runs.until.astype(np.int64) - 1]
    sure = runs.mean(runs.sure)
    whole = {
        "views until confident": (runs.mean(runs.until), one),
        "travel until confident, rad": (runs.mean(way), one),
        "confident": (sure, one),
        "wrong, of the confident": (runs.mean(runs.wrong), sure),
    }
    return found | {Key(policy, None, 0, name): both for name, both in whole.items()}


def _far(runs: _Runs, views: tuple[int, ...], drawn: Float) -> dict[tuple, Float]:
    """Return quantiles of the pose error in bootstrap samples of the things, (S, T): each (S,)."""
    return {
        (f"pose error, {name}", k): runs.quantile(runs.pose[:, k - 1], drawn, share)
        for k in views
        for share, name in ((0.5, "median"), (FAR_END, "95 %"))
    }


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
    groups = {ALL: np.ones(len(alike.names), bool), CONFUSABLE: alike.confusable}
    measures: list[pd.DataFrame] = []
    tests: list[pd.DataFrame] = []
    boards = []

    for name, mine in groups.items():
        things = [alike.names[k] for k in np.flatnonzero(mine)]
        if not things:
            continue
        number = {thing: k for k, thing in enumerate(things)}
        some = [each for each in runs if each.thing in number]
        family = _families(things, how)
        weights = resample_families(family, how.samples, rng)
        together = {
            policy: _Runs.of(
                [(number[e.thing], run) for e in some for run in e.runs[policy]],
                how.threshold,
            )
            for policy in policies_in(runs)
        }
        sums: dict[Key, tuple] = {}
        for policy, own in together.items():
            sums |= _sums(own, policy, how.views)
        counted = Counted.of(sums, family)
        poses = _poses(name, together, family, weights, how)
        found = [counted.measures(name, weights), poses[0], _times(name, together)]
        apart = [counted.tests(name, weights, how.reference, _is_tested), poses[1]]
        measures.append(_by_policy(found, list(together)))
        tests.append(_by_policy(apart, list(together)))
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
        _as_table(alike),
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


def _times(name: str, runs: dict[str, _Runs]) -> "pd.DataFrame":
    """Return the run times of all policies, milliseconds, without intervals."""
    quantiles: list[tuple[str, Callable[[Float], float]]] = [
        ("median", lambda times: float(np.median(times))),
        ("95 %", lambda times: float(np.quantile(times, FAR_END))),
    ]
    rows = []
    for policy, own in runs.items():
        for what, times in (
            ("decision", own.decision),
            ("verification", own.verification),
        ):
            rows += [
                (policy, None, 0, f"{what}, ms, {which}", 1000 * of(times))
                for which, of in quantiles
            ]
    return measures_of(name, [(*row, np.nan, np.nan) for row in rows])


def _poses(
    name: str,
    runs: dict[str, _Runs],
    family: Index,
    weights: Float,
    how: ThingSettings,
) -> tuple["pd.DataFrame", "pd.DataFrame"]:
    """Return measures and tests of the pose error, which are quantiles instead of means.

    Args:
        name: of the set of things.
        runs: of all policies.
        family: of each thing, (T,).
        weights: bootstrap weight of each thing in each sample, (S, T).
        how: settings of the comparison.
    """
    # the first sample is the original set
    drawn = np.concatenate([np.ones((1, len(family))), weights])
    found = {policy: _far(own, how.views, drawn) for policy, own in runs.items()}
    rows = [
        (policy, None, k, measure, values[0], *_ends(values))
        for policy, all_of_one in found.items()
        for (measure, k), values in all_of_one.items()
    ]
    tests = []
    reference = runs.get(how.reference)
    if reference is not None and POSE_AFTER in how.views:
        for policy, own in runs.items():
            if policy == how.reference:
                continue
            both = (found[one][FAR_POSE, POSE_AFTER] for one in (policy, how.reference))
            apart = np.subtract(*both)
            key = Key(policy, None, POSE_AFTER, FAR_POSE)
            p = _pose_p(own, reference, family)
            count = int(family.max()) + 1
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


def _pose_p(own: _Runs, reference: _Runs, family: Index) -> float:
    """Return the p-value of the difference in the quantile of the pose error."""
    errors = np.concatenate([one.pose[:, POSE_AFTER - 1] for one in (own, reference)])
    weights = np.concatenate([own.weight, reference.weight])
    order = np.argsort(errors)[: np.count_nonzero(~np.isnan(errors))]
    whose = np.repeat([1.0, -1.0], [len(own.things), len(reference.things)])[order]
    families = family[np.concatenate([own.things, reference.things])][order]

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


def _as_table(alike: Alikeness) -> "pd.DataFrame":
    return pd.DataFrame(
        {
            "thing": alike.names,
            "most_alike": alike.nearest,
            "distance": alike.distance,
            "confusable": alike.confusable,
        }
    )
