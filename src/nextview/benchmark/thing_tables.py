"""What the policies of a benchmark of things come to: measures, intervals and tests."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nextview.benchmark.confusable import Alikeness
from nextview.benchmark.statistics import bootstrap_p, holm, interval, resample
from nextview.benchmark.thing_episodes import EPISODE_SPHERE
from nextview.benchmark.thing_policies import CEILINGS
from nextview.benchmark.thing_replay import EpisodeRuns, ThingRun
from nextview.checks import extras
from nextview.session.result import SUSPICIOUS
from nextview.session.system import UNKNOWN_ALPHA
from nextview.types import Float, Index, Mask

with extras():
    import pandas as pd


REFERENCE = "random"  # the policy that all others are compared with
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
    """

    policies: tuple[str, ...]
    views: tuple[int, ...]
    threshold: float
    families: bool
    samples: int


@dataclass(frozen=True)
class ThingTables:
    """The tables of a benchmark of things.

    Attributes:
        measures: "things" (all, or the confusable half), "policy", "measure", "views" (0 for a
            measure of whole episodes), "value", and its 95 % interval, "low" and "high".
        tests: of the differences to the policy random: the same columns with "difference", "low",
            "high", "p" and "p_holm", corrected over all rows.
        alike: the things: "thing", "most_alike", "distance" (radii), "confusable".
        episodes: how many there are of all things.
    """

    measures: "pd.DataFrame"
    tests: "pd.DataFrame"
    alike: "pd.DataFrame"
    episodes: int


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
        drawn = _drawn(chosen, alike.names, how, rng)
        sampled: dict[str, Sampled] = {}
        for policy in how.policies:
            own = [(number[e.thing], run) for e in some for run in e.runs[policy]]
            together = _Runs.of(own, how.threshold)
            sampled[policy] = _sampled(together, how.views, drawn)
            rows += [(things, policy, *row) for row in _rows(sampled[policy])]
            rows += [(things, policy, *row) for row in _times(together)]
        tests += [(things, *row) for row in _differences(sampled)]

    return ThingTables(
        pd.DataFrame(
            rows,
            columns=["things", "policy", "measure", "views", "value", "low", "high"],
        ),
        _corrected(tests),
        _as_table(alike),
        len(runs),
    )


def _drawn(
    chosen: Mask,
    names: Sequence[str],
    how: Compared,
    rng: np.random.Generator,
) -> Float:
    """How often each thing is drawn in each sample, (1 + S, T); in the first each once."""
    bodies = [name.partition("_")[0] if how.families else name for name in names]
    family = np.unique(np.array(bodies)[chosen], return_inverse=True)[1]
    drawn = np.zeros((how.samples, len(names)))
    drawn[:, chosen] = resample(int(family.max()) + 1, how.samples, rng)[:, family]
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


def _differences(sampled: dict[str, Sampled]) -> list[tuple]:
    """Differences to random: policy, measure, views, difference, interval and p-value."""
    if REFERENCE not in sampled:
        return []

    found = []
    for policy, own in sampled.items():
        if policy == REFERENCE:
            continue
        for (measure, views), values in own.items():
            if not _is_tested(measure, views):
                continue
            apart = values - sampled[REFERENCE][measure, views]
            low, high = interval(apart[1:, None])
            p = np.nan if policy in CEILINGS else _p_value(apart, measure)
            row = (float(apart[0]), float(low[0]), float(high[0]), p)
            found.append((policy, measure, views, *row))
    return found


def _is_tested(measure: str, views: int) -> bool:
    """Whether a measure is compared with that of random views; the first view is the same."""
    if measure == FAR_POSE:
        return views == POSE_AFTER
    return (measure == "accuracy" and views > 1) or measure == "views until confident"


def _p_value(apart: Float, measure: str) -> float:
    """Two-sided p-value of no difference: the difference itself, and its bootstrap samples.

    A quantile jumps from run to run, so that its samples are counted; the others are means, whose
    error is normal.
    """
    samples = apart[1:]
    if measure != FAR_POSE:
        return float(bootstrap_p(apart[:1], samples[:, None])[0])
    beyond = min(np.count_nonzero(samples <= 0), np.count_nonzero(samples >= 0))
    return min(1.0, 2 * (beyond + 1) / (len(samples) + 1))


def _corrected(tests: list[tuple]) -> "pd.DataFrame":
    """The tests as a table, with one correction over all of them."""
    columns = ["things", "policy", "measure", "views", "difference", "low", "high", "p"]
    table = pd.DataFrame(tests, columns=columns)
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
