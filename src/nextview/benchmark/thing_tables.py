"""What the policies of a benchmark of things come to: measures, intervals and tests."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nextview.benchmark.confusable import Alikeness
from nextview.benchmark.statistics import (
    by_family,
    exchange_p,
    holm,
    interval,
    resample_families,
    sign_flip_p,
)
from nextview.benchmark.thing_episodes import EPISODE_SPHERE
from nextview.benchmark.thing_policies import CEILINGS
from nextview.benchmark.thing_replay import EpisodeRuns, ThingRun
from nextview.checks import extras
from nextview.session.result import SUSPICIOUS
from nextview.session.system import UNKNOWN_ALPHA
from nextview.types import Float, Index, Mask

with extras():
    import pandas as pd


ALL = "all"
CONFUSABLE = "confusable half"
FAR_END = 0.95  # quantile of the error of the pose
FAR_POSE = "pose error, 95 %"
POSE_AFTER = 2  # views, after which the error of the pose is tested


@dataclass(frozen=True)
class Compared:
    """How runs are compared.

    Attributes:
        policies: in the order of the tables.
        views: after how many views.
        threshold: belief from which a thing is surely recognised.
        families: whether things whose names begin alike, up to the first _, are drawn together.
        samples: of the bootstrap.
        reference: the policy that the others are compared with.
    """

    policies: tuple[str, ...]
    views: tuple[int, ...]
    threshold: float
    families: bool
    samples: int
    reference: str = "random"


@dataclass(frozen=True)
class ThingTables:
    """The tables of a benchmark of things.

    Attributes:
        measures: "things" (all, or the confusable half), "policy", "measure", "views" (0 for a
            measure of whole episodes), "value", and its 95 % interval, "low" and "high".
        tests: of the differences to the reference: the same columns with "difference", "low",
            "high", "p" (see ``statistics.exchange_p``), "families", by which p was found, and
            "p_holm", corrected over all rows.
        alike: the things: "thing", "most_alike", "distance" (radii), "confusable".
        episodes: how many there are of all things.
        reference: the policy that the others are compared with.
        chosen: how it was chosen, in a sentence; "" where it was named.
    """

    measures: "pd.DataFrame"
    tests: "pd.DataFrame"
    alike: "pd.DataFrame"
    episodes: int
    reference: str
    chosen: str = ""


@dataclass(frozen=True, eq=False)
class _Runs:
    """The runs of one policy.

    Attributes:
        things: whose they are, (R,) int64.
        weight: of each: together 1 for each thing, (R,).
        right: after each view, (R, K) float64.
        sure: whether it was ever confident, as a session without ``Recognition.doubt`` is: it
            believes, and the residual is no worse than that of known things, (R,) float64.
        wrong: whether it was confident and wrong, (R,) float64.
        until: views until it was confident; all if it never was, (R,).
        travel: radians on the sphere up to each view, (R, K).
        pose: error, millimetres, (R, K); NaN where the thing was not named right.
        decision: seconds of each choice.
        verification: seconds of each verification of all views.
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
        """Put runs side by side, each with the number of its thing.

        Args:
            runs: pairs of a thing's number and a run.
            threshold: belief from which on a run is confident.
        """
        things = np.array([thing for thing, _ in runs])
        right = np.array([each.right for _, each in runs], np.float64)
        believed = np.array([each.confidence for _, each in runs], np.float64)
        explained = np.array([each.p_value for _, each in runs], np.float64)
        # False where it is not known
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

    def mean(self, values: Float, drawn: Float) -> Float:
        """Mean over things of a value of each run, in each sample of things, (S,).

        Args:
            values: of each run, (R,).
            drawn: how often each sample holds each thing, (S, things).
        """
        weights = drawn[:, self.things] * self.weight
        return np.asarray(weights @ values / weights.sum(1), np.float64)

    def in_families(self, values: Float, family: Index) -> Float:
        """Sum in each family of the means of its things, (F,).

        Args:
            values: of each run, (R,).
            family: number of each thing's family, (T,).
        """
        weighted = (values * self.weight)[:, None]
        return by_family(weighted, family[self.things])[:, 0]

    def quantile(self, values: Float, drawn: Float, share: float) -> Float:
        """Quantile of the known values of runs, in each sample of things, (S,).

        Args:
            values: of each run, (R,); NaN where it is not known.
            drawn: how often each sample holds each thing, (S, things).
            share: of the runs that lie below, 0 to 1.
        """
        known = ~np.isnan(values)
        if not known.any():
            return np.full(len(drawn), np.nan)
        order = np.flatnonzero(known)[np.argsort(values[known])]
        weights = np.cumsum((drawn[:, self.things] * self.weight)[:, order], axis=1)
        first = (weights >= share * weights[:, -1:]).argmax(1)
        return np.asarray(values[order][first], np.float64)


# by measure and number of views, a value a sample
Sampled = dict[tuple[str, int], Float]


def _sampled(runs: _Runs, views: tuple[int, ...], drawn: Float) -> Sampled:
    """All measures of one policy in samples of the things, (S, T): each (S,).

    The first sample is the things themselves.
    """
    found: Sampled = {}
    for k in views:
        found["accuracy", k] = runs.mean(runs.right[:, k - 1], drawn)
        found["travel, rad", k] = runs.mean(runs.travel[:, k - 1], drawn)
        for share, name in ((0.5, "median"), (FAR_END, "95 %")):
            found[f"pose error, {name}", k] = runs.quantile(
                runs.pose[:, k - 1],
                drawn,
                share,
            )

    rows = np.arange(len(runs.things))
    way = runs.travel[rows, runs.until.astype(np.int64) - 1]
    sure = runs.mean(runs.sure, drawn)
    found["views until confident", 0] = runs.mean(runs.until, drawn)
    found["travel until confident, rad", 0] = runs.mean(way, drawn)
    found["confident", 0] = sure
    found["wrong, of the confident", 0] = runs.mean(runs.wrong, drawn) / np.where(
        sure > 0,
        sure,
        np.nan,
    )
    return found


def summarise_things(
    runs: Sequence[EpisodeRuns],
    alike: Alikeness,
    how: Compared,
) -> ThingTables:
    """Compare policies over all things, and over the confusable half of them.

    Args:
        runs: of all episodes.
        alike: which things are most alike.
        how: what is compared.

    Returns:
        The tables.
    """
    rng = np.random.default_rng(0)
    number = {name: k for k, name in enumerate(alike.names)}
    groups = {ALL: np.ones(len(alike.names), bool), CONFUSABLE: alike.confusable}
    rows: list[tuple] = []
    tests: list[tuple] = []

    for things, chosen in groups.items():
        some = [each for each in runs if chosen[number[each.thing]]]
        if not some:
            continue
        family = _families(chosen, alike.names, how)
        drawn = _drawn(chosen, family, how, rng)
        sampled: dict[str, Sampled] = {}
        together: dict[str, _Runs] = {}
        for policy in how.policies:
            own = [(number[e.thing], run) for e in some for run in e.runs[policy]]
            together[policy] = _Runs.of(own, how.threshold)
            sampled[policy] = _sampled(together[policy], how.views, drawn)
            rows += [(things, policy, *row) for row in _rows(sampled[policy])]
            rows += [(things, policy, *row) for row in _times(together[policy])]
        p_values = _p_values(together, family, how)
        tests += [(things, *row) for row in _differences(sampled, p_values, how)]

    return ThingTables(
        pd.DataFrame(
            rows,
            columns=["things", "policy", "measure", "views", "value", "low", "high"],
        ),
        _corrected(tests),
        _as_table(alike),
        len(runs),
        how.reference,
    )


def _families(chosen: Mask, names: Sequence[str], how: Compared) -> Index:
    """The number of the family of each thing, (T,) int64; -1 for those that are not chosen."""
    bodies = [name.partition("_")[0] if how.families else name for name in names]
    family = np.full(len(names), -1)
    family[chosen] = np.unique(np.array(bodies)[chosen], return_inverse=True)[1]
    return family


def _drawn(
    chosen: Mask,
    family: Index,
    how: Compared,
    rng: np.random.Generator,
) -> Float:
    """How often each thing is drawn in each sample, (1 + S, T); in the first each once."""
    drawn = np.zeros((how.samples, len(family)))
    drawn[:, chosen] = resample_families(family[chosen], how.samples, rng)
    return np.concatenate([chosen[None].astype(np.float64), drawn])


def _rows(sampled: Sampled) -> list[tuple]:
    """Measure, views, value and interval of one policy."""
    found = []
    for (measure, views), values in sampled.items():
        low, high = interval(values[1:, None])
        found.append((measure, views, float(values[0]), float(low[0]), float(high[0])))
    return found


def _times(runs: _Runs) -> list[tuple]:
    """The times of one policy, milliseconds, as ``_rows``, without intervals."""
    quantiles: list[tuple[str, Callable[[Float], float]]] = [
        ("median", lambda times: float(np.median(times))),
        ("95 %", lambda times: float(np.quantile(times, FAR_END))),
    ]
    return [
        (f"{what}, ms, {name}", 0, 1000 * of(times), np.nan, np.nan)
        for what, times in (
            ("decision", runs.decision),
            ("verification", runs.verification),
        )
        for name, of in quantiles
    ]


def _differences(
    sampled: dict[str, Sampled],
    p_values: dict[tuple[str, str, int], tuple[float, int]],
    how: Compared,
) -> list[tuple]:
    """Differences to the reference: policy, measure, views, difference, interval, p, families."""
    if how.reference not in sampled:
        return []

    found = []
    for policy, own in sampled.items():
        if policy == how.reference:
            continue
        for (measure, views), values in own.items():
            if not _is_tested(measure, views):
                continue
            apart = values - sampled[how.reference][measure, views]
            low, high = interval(apart[1:, None])
            ends = (float(apart[0]), float(low[0]), float(high[0]))
            found.append(
                (policy, measure, views, *ends, *p_values[policy, measure, views])
            )
    return found


def _is_tested(measure: str, views: int) -> bool:
    """Whether a measure is compared with the reference's; the first view is the same."""
    if measure == FAR_POSE:
        return views == POSE_AFTER
    return (measure == "accuracy" and views > 1) or measure == "views until confident"


def _p_values(
    runs: dict[str, _Runs],
    family: Index,
    how: Compared,
) -> dict[tuple[str, str, int], tuple[float, int]]:
    """p-values by policy, measure and views, and by how many families each was found.

    They are NaN where one of the two policies knows the truth: a bound is no rival.

    Args:
        runs: of all policies.
        family: of each thing, see ``_families``.
        how: what is compared.
    """
    reference = runs.get(how.reference)
    if reference is None:
        return {}

    count = int(family.max()) + 1
    found = {}
    for policy, own in runs.items():
        if policy == how.reference:
            continue
        known = policy in CEILINGS or how.reference in CEILINGS
        means = [("views until confident", 0, own.until, reference.until)]
        means += [
            ("accuracy", k, own.right[:, k - 1], reference.right[:, k - 1])
            for k in how.views
        ]
        for measure, k, ours, theirs in means:
            sums = own.in_families(ours, family) - reference.in_families(theirs, family)
            p = np.nan if known else float(sign_flip_p(sums[:, None])[0])
            found[policy, measure, k] = (p, count)
        if POSE_AFTER in how.views:
            p = np.nan if known else _pose_p(own, reference, family)
            found[policy, FAR_POSE, POSE_AFTER] = (p, count)
    return found


def _pose_p(own: _Runs, reference: _Runs, family: Index) -> float:
    """The p-value of the difference of the far ends of the errors of the pose."""
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


def _corrected(tests: list[tuple]) -> "pd.DataFrame":
    """The tests as a table, with one correction over all of them."""
    columns = ["things", "policy", "measure", "views", "difference", "low", "high", "p"]
    table = pd.DataFrame(tests, columns=[*columns, "families"])
    return table.assign(p_holm=holm(table["p"].to_numpy(np.float64)))


def _as_table(alike: Alikeness) -> "pd.DataFrame":
    return pd.DataFrame(
        {
            "thing": alike.names,
            "most_alike": alike.nearest,
            "distance": alike.distance,
            "confusable": alike.confusable,
        }
    )
