"""Who leads under one threshold, which differences can be told from chance, and when there are too few objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import pandas as pd

from nextview.benchmark.entries import is_oracle
from nextview.benchmark.summary import Tables

SIGNIFICANT = 0.05
"""A difference is called one when its p-value after Holm's correction is below this."""
FEW_OBJECTS, WIDE = 200, 0.03
"""With fewer objects, or intervals of differences in accuracy that reach farther to either side, little can be told."""


def headline_threshold(thresholds: Sequence[float]) -> float:
    """The threshold that reports speak of: 0.97, the library's default, or the one next to it."""
    return min(thresholds, key=lambda t: abs(t - 0.97))


class Standing(NamedTuple):
    """A policy under one threshold; difference and p_holm, to the reference, are NaN for the reference itself.

    Accuracy has a 95 % interval, low to high; travel is in grid cells, over all episodes.
    """

    policy: str
    accuracy: float
    low: float
    high: float
    class_accuracy: float
    n_views: float
    travel: float
    difference: float
    p_holm: float

    @property
    def differs(self) -> bool:
        """Whether its accuracy differs significantly from that of the reference."""
        return self.p_holm < SIGNIFICANT


def leaderboard(tables: Tables, threshold: float) -> list[Standing]:
    """The policies under one threshold, the most accurate first and those that no robot could follow last."""
    rows = tables.summary[tables.summary["threshold"] == threshold]
    table = rows.pivot(index="policy", columns="measure", values="value")
    table = table.join(rows[rows["measure"] == "accuracy"].set_index("policy")[["low", "high"]])
    table = table.join(_tests(tables, threshold).set_index("policy")[["difference", "p_holm"]]).reset_index()
    columns = ["policy", "accuracy", "low", "high", "class_accuracy", "n_views", "travel_all", "difference", "p_holm"]
    standings = [Standing(*row) for row in table[columns].to_numpy(object).tolist()]
    return sorted(standings, key=lambda s: (is_oracle(s.policy), -s.accuracy))


class PromisedRisk(NamedTuple):
    """An error rate that was promised of those who stop early, and the measured one with its 95 % interval."""

    policy: str
    risk: float
    threshold: float
    error: float
    low: float
    high: float
    confident: float

    @property
    def broken(self) -> bool:
        """Whether more were wrong than was promised, and chance does not explain it: the whole interval lies above."""
        return self.low > self.risk


def promised_risks(tables: Tables) -> list[PromisedRisk]:
    """Every promise that was put to the test."""
    return [PromisedRisk(*row) for row in tables.risks.to_numpy(object).tolist()]


class LevelCell(NamedTuple):
    """A policy in the worlds of one level after some views; difference and what follows are NaN for the reference."""

    accuracy: float
    low: float
    high: float
    travel: float
    difference: float
    difference_low: float
    difference_high: float
    p_holm: float


class LevelRow(NamedTuple):
    """A policy in the worlds of one level; its cells by the number of views."""

    level: str
    worlds: int
    policy: str
    cells: list[tuple[int, LevelCell]]


def level_rows(tables: Tables) -> list[list[LevelRow]]:
    """The policies at each level, those that no robot could follow last; nothing where the objects are no worlds."""
    found: list[list[LevelRow]] = []
    for level, rows in tables.levels.groupby("level", sort=False):
        policies = []
        for policy, mine in rows.groupby("policy", sort=False):
            values = mine[list(LevelCell._fields)].to_numpy(float).tolist()
            cells = [(int(k), LevelCell(*row)) for k, row in zip(mine["n_views"], values, strict=True)]
            policies.append(LevelRow(str(level), int(mine["worlds"].iloc[0]), str(policy), cells))
        found.append(sorted(policies, key=lambda row: is_oracle(row.policy)))
    return found


def level_differences(tables: Tables, reference: str) -> str | None:
    """A sentence that names the policies of a robot that differ in worlds after so many views; None if none does."""
    found = [
        f"{row.policy} by {100 * cell.difference:+.1f} points after {n_views} views under {row.level} clutter"
        for rows in level_rows(tables)
        for row in rows
        for n_views, cell in row.cells
        if not is_oracle(row.policy) and cell.p_holm < SIGNIFICANT
    ]
    return f"With no threshold, significantly different from {reference}: {'; '.join(found)}." if found else None


def nothing_differs(tables: Tables, threshold: float, reference: str) -> str | None:
    """A sentence where no policy that a robot could follow differs from the reference in accuracy; else None."""
    tests = _robot_tests(tables, threshold)
    if tests.empty or (tests["p_holm"] < SIGNIFICANT).any():
        return None
    return (
        f"No policy that a robot could follow differs significantly from {reference} in accuracy at threshold "
        f"{threshold:g} (every p after Holm's correction is {SIGNIFICANT} or more)."
    )


def too_few(tables: Tables, threshold: float, objects: int) -> str | None:
    """A warning where there are too few objects to tell policies apart; else None.

    That is so with fewer than ``FEW_OBJECTS``, or where the intervals of the differences in accuracy between the
    policies that a robot could follow and the reference reach, in the median, more than ``WIDE`` to either side.
    """
    tests = _robot_tests(tables, threshold)
    half = float((tests["high"] - tests["low"]).median() / 2)  # NaN if nothing was compared
    if objects >= FEW_OBJECTS and not half > WIDE:
        return None
    doubt = "" if half != half else f" and differences in accuracy are known to ±{100 * half:.1f} points"
    return (
        f"Too few objects to tell: there are {objects:,}{doubt}. Take no order of the policies from this; it wants "
        f"at least {FEW_OBJECTS} objects and ±{100 * WIDE:g} points."
    )


def _tests(tables: Tables, threshold: float) -> pd.DataFrame:
    """Of the accuracy against the reference."""
    t = tables.tests
    return t[(t["threshold"] == threshold) & (t["measure"] == "accuracy")]


def _robot_tests(tables: Tables, threshold: float) -> pd.DataFrame:
    tests = _tests(tables, threshold)
    return tests[~tests["policy"].map(is_oracle).astype(bool)]
