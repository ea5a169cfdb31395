"""Compare policies by one long table of episodes: measures, intervals and tests.

A row of the table is what a policy had in one episode, after a number of views or at the end. All
benchmarks make such a table, and all measures are ratios of sums over the objects of its rows.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np

from nextview.types import Float, Index, Mask
from nextview_lab.benchmark import statistics as st
from nextview_lab.benchmark.text_tables import Board, Column, WrittenTable
from nextview_lab.extras import extras

with extras():
    import pandas as pd

ALL = "all"  # the set of all objects
# significance level of differences after Holm's correction
SIGNIFICANT = 0.05
CELL = ["policy", "threshold", "views"]  # columns that say of what a row is
ONE = "one"  # column of ones, the denominator of means over episodes


class Key(NamedTuple):
    """Identifies a number.

    Attributes:
        policy: its name.
        threshold: of the belief, at which episodes stop; None without a threshold.
        views: number of views; 0 for whole episodes.
        measure: its name.
    """

    policy: str
    threshold: float | None
    views: int
    measure: str


MEASURE_COLUMNS = ["set", *Key._fields, "value", "low", "high"]
TEST_COLUMNS = ["set", *Key._fields, "reference", "difference", "low", "high", "p"]
TEST_COLUMNS += ["families"]


@dataclass(frozen=True)
class Tables:
    """The results of a benchmark. Intervals are 95 % bootstrap intervals, ``low`` to ``high``.

    Attributes:
        measures: one number per row, with the columns MEASURE_COLUMNS; "set" names the set of
            objects.
        tests: differences to a reference policy, with the columns TEST_COLUMNS and "p_holm":
            p-values of a sign-flip test (``statistics.sign_flip_p``) over "families" families of
            objects, and the p-values after Holm's correction over all tests of one question.
        reference: the policy with which the others are compared.
    """

    measures: "pd.DataFrame"
    tests: "pd.DataFrame"
    reference: str

    def policies(self) -> list[str]:
        """Policies in their order."""
        return list(self.measures["policy"].unique())

    def frames(self) -> dict[str, "pd.DataFrame"]:
        """Return all tables by name."""
        there = vars(self).items()
        return {name: table for name, table in there if isinstance(table, pd.DataFrame)}


# by measure: columns of its numerator and of its denominator
Ratios = Mapping[str, tuple[str, str]]


@dataclass(frozen=True, eq=False)
class Counted:
    """M measures of policies on N objects, each a ratio of sums over the objects.

    Attributes:
        keys: of the measures.
        top: numerators, (N, M) float64.
        bottom: denominators, (N, M) float64.
        families: family index of each object, (N,) int64; families are resampled as a whole.
    """

    keys: tuple[Key, ...]
    top: Float
    bottom: Float
    families: Index

    @classmethod
    def of(
        cls, episodes: "pd.DataFrame", after: Ratios, ends: Ratios, families: Index
    ) -> Self:
        """Count the measures of a long table of episodes.

        Args:
            episodes: columns CELL; "object", the same objects in every cell; and those of the
                measures. Several episodes of an object are averaged.
            after: measures of rows after a number of views.
            ends: measures of whole episodes, whose "views" is 0.
            families: family index of each object, in their order, (N,).
        """
        keys = []
        tops = []
        bottoms = []
        cells = episodes.groupby(CELL, sort=False, dropna=False)
        cell: Any
        for cell, rows in cells:
            policy, threshold, views = cell
            ratios = after if views else ends
            columns = list(dict.fromkeys(sum(ratios.values(), ())))
            means = rows.groupby("object")[columns].mean()
            at = None if np.isnan(threshold) else float(threshold)
            for measure, (top, bottom) in ratios.items():
                keys.append(Key(policy, at, int(views), measure))
                tops.append(means[top].to_numpy(np.float64))
                bottoms.append(means[bottom].to_numpy(np.float64))
        return cls(tuple(keys), np.stack(tops, 1), np.stack(bottoms, 1), families)

    def only(self, measures: Sequence[str]) -> Self:
        """Select measures by name."""
        kept = [i for i, key in enumerate(self.keys) if key.measure in measures]
        keys = tuple(self.keys[i] for i in kept)
        return replace(
            self, keys=keys, top=self.top[:, kept], bottom=self.bottom[:, kept]
        )

    def among(self, objects: Mask) -> Self:
        """Select objects, by a mask, (N,) bool."""
        return replace(
            self,
            top=self.top[objects],
            bottom=self.bottom[objects],
            families=self.families[objects],
        )

    def measures(
        self,
        name: str,
        weights: Float,
        labels: Index | None = None,
    ) -> "pd.DataFrame":
        """Return the measures with their intervals.

        Args:
            name: of the set of objects.
            weights: bootstrap weight of each object in each sample, (S, N).
            labels: class of each object, (N,), for means over classes; None for sums over objects.
        """
        value, drawn = st.estimate(self.top, self.bottom, weights, labels)
        numbers = np.stack([value, *st.interval(drawn)], 1).tolist()
        rows = [(*key, *row) for key, row in zip(self.keys, numbers, strict=True)]
        return measures_of(name, rows)

    def tests(
        self,
        name: str,
        weights: Float,
        reference: str,
        tested: Callable[[Key], bool],
    ) -> "pd.DataFrame":
        """Return the differences to a reference policy.

        Args:
            name: of the set of objects.
            weights: bootstrap weight of each object in each sample, (S, N).
            reference: the policy; its measures have the same denominators.
            tested: selects the measures to compare.
        """
        place = {key: i for i, key in enumerate(self.keys)}
        pairs = [
            (place[key], place[rival])
            for key in self.keys
            if key.policy != reference and tested(key)
            if (rival := key._replace(policy=reference)) in place
        ]
        if not pairs:
            return tests_of(name, reference, [])

        own, theirs = np.array(pairs).T
        apart = self.top[:, own] - self.top[:, theirs]
        value, drawn = st.estimate(apart, self.bottom[:, own], weights)
        p = st.sign_flip_p(st.by_family(apart, self.families))
        numbers = np.stack([value, *st.interval(drawn), p], 1).tolist()
        count = int(self.families.max()) + 1
        rows = [
            (self.keys[i], *row, count) for i, row in zip(own, numbers, strict=True)
        ]
        return tests_of(name, reference, rows)


def measures_of(name: str, rows: Sequence[tuple]) -> "pd.DataFrame":
    """Return measures of a set as a table.

    Args:
        name: of the set.
        rows: policy, threshold, views, measure, value, low and high of each.
    """
    table = pd.DataFrame([(name, *row) for row in rows], columns=MEASURE_COLUMNS)
    return table.astype({"threshold": "float64"})


def tests_of(name: str, reference: str, rows: Sequence[tuple]) -> "pd.DataFrame":
    """Return tests in a set as a table.

    Args:
        name: of the set.
        reference: the policy with which the others are compared.
        rows: key, difference, low, high, p and number of families of each.
    """
    given = [(name, *key, reference, *rest) for key, *rest in rows]
    return pd.DataFrame(given, columns=TEST_COLUMNS).astype({"threshold": "float64"})


def tested_by(measures: Sequence[str]) -> Callable[[Key], bool]:
    """Select measures to compare with the reference; the first view of all policies is the same.

    Args:
        measures: their names.
    """
    return lambda key: key.measure in measures and key.views != 1


def corrected(
    tests: Sequence["pd.DataFrame"],
    bound: Callable[[str], bool] | None = None,
) -> "pd.DataFrame":
    """Apply one Holm correction to the tests of one question and add "p_holm".

    Args:
        tests: of the question.
        bound: selects policies that know the truth; as upper bounds, they are not tested.
    """
    table = pd.concat(tests, ignore_index=True)
    if bound is not None:
        table["p"] = table["p"].mask(table["policy"].map(bound).astype(bool))
    return table.assign(p_holm=st.holm(table["p"].to_numpy(np.float64)))


def too_few(tests: "pd.DataFrame") -> str:
    """Return a warning if no difference could be significant; "" if one could.

    Args:
        tests: that are corrected together, of one set of objects.
    """
    tested = tests[tests["p"].notna()]
    if tested.empty:
        return ""
    families = int(tested["families"].iloc[0])
    # two-sided sign flips of n families have p-values of 2^(1 - n) and more
    wanted = families
    while (
        wanted < st.EXACT_FAMILIES and len(tested) * 2.0 ** (1 - wanted) >= SIGNIFICANT
    ):
        wanted += 1
    if wanted == families:
        return ""
    return (
        f"Too few to tell: no p-value of {families} is below {2.0 ** (1 - families):.2g}, and"
        f" {len(tested)} tests are corrected together, so that no difference can be significant; it"
        f" takes {wanted} or more."
    )


def values_of(
    measures: "pd.DataFrame", threshold: float | None = None
) -> dict[tuple[str, str, int], Any]:
    """Return value, low and high over all objects, by policy, measure and number of views.

    Args:
        measures: of the benchmark, see ``Tables``.
        threshold: of the belief; None for measures without a threshold.
    """
    some = measures[measures["set"] == ALL]
    at = some["threshold"]
    some = some[at.isna() if threshold is None else at == threshold]
    keys = zip(some["policy"], some["measure"], some["views"], strict=True)
    numbers = some[["value", "low", "high"]].to_numpy(np.float64).tolist()
    return dict(zip(keys, map(tuple, numbers), strict=True))


def significant(tables: Tables) -> set[tuple[str, str, int]]:
    """Return policy, measure and number of views of the significant differences.

    Args:
        tables: of the benchmark.
    """
    some = tables.tests[tables.tests["p_holm"] < SIGNIFICANT]
    return set(zip(some["policy"], some["measure"], some["views"], strict=True))


def written(
    tables: Tables,
    board: Board,
    columns: Mapping[str, Column],
    marked: Iterable[tuple[str, str, int]] = (),
) -> WrittenTable:
    """Return a board as text: a row for each policy that has all of its numbers.

    Args:
        tables: of the benchmark.
        board: the table.
        columns: of the table, by heading.
        marked: policy, measure and views of the numbers marked with a star.
    """
    values = values_of(tables.measures)
    stars = set(marked)

    def shown(policy: str, measure: str, column: Column) -> str:
        value = values[policy, measure, column.views][0]
        star = "*" * ((policy, measure, column.views) in stars)
        return "-" if np.isnan(value) else f"{value:.{column.digits}f}{star}"

    rows = tuple(
        (
            policy,
            *(
                ", ".join(shown(policy, m, c) for m in c.measures)
                for c in columns.values()
            ),
        )
        for policy in tables.policies()
        if all(
            (policy, m, c.views) in values for c in columns.values() for m in c.measures
        )
    )
    return WrittenTable(board.title, ("policy", *columns), rows)
