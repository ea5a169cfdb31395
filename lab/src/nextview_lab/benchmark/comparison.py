"""Compare policies: one format of measures and tests for all benchmarks."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nextview.types import Float, Index
from nextview_lab.benchmark import statistics as st
from nextview_lab.benchmark.sums import SIGNIFICANT, Key, Sums, too_few_families
from nextview_lab.extras import extras

with extras():
    import pandas as pd

ALL = "all"  # the set of all objects

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


class Counted(Sums):
    """The same sums, whose measures and differences are rows of ``Tables``."""

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
        numbers = self.estimates(weights, labels)
        return measures_of(name, [(*key, *number) for key, number in numbers.items()])

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
        found = self.differences(weights, reference, tested)
        return tests_of(name, reference, [(*one, self.family_count) for one in found])


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


def too_few(tests: "pd.DataFrame") -> dict[str, str]:
    """Return warnings for sets in which no difference could be significant.

    Args:
        tests: that are corrected together.

    Returns:
        A sentence for each set with too few families of objects, by name.
    """
    tested = tests[tests["p"].notna()]
    found = {}
    for name, rows in tested.groupby("set", sort=False):
        sentence = too_few_families(int(rows["families"].iloc[0]), len(tested))
        if sentence is not None:
            found[str(name)] = sentence
    return found


def values_of(
    tables: Tables,
    name: str,
    threshold: float | None = None,
) -> dict[tuple[str, str, int], Any]:
    """Return value, low and high by policy, measure and number of views.

    Args:
        tables: of the benchmark.
        name: of the set of objects.
        threshold: of the belief; None for measures without a threshold.
    """
    some = tables.measures[tables.measures["set"] == name]
    at = some["threshold"]
    some = some[at.isna() if threshold is None else at == threshold]
    keys = zip(some["policy"], some["measure"], some["views"], strict=True)
    numbers = some[["value", "low", "high"]].to_numpy(np.float64).tolist()
    return dict(zip(keys, map(tuple, numbers), strict=True))


def significant(tables: Tables, name: str) -> set[tuple[str, str, int]]:
    """Return policy, measure and number of views of the significant differences in a set.

    Args:
        tables: of the benchmark.
        name: of the set of objects.
    """
    tests = tables.tests
    some = tests[(tests["set"] == name) & (tests["p_holm"] < SIGNIFICANT)]
    return set(zip(some["policy"], some["measure"], some["views"], strict=True))
