"""Leaderboard of classes: at one threshold, after numbers of views, and conclusions."""

from collections.abc import Mapping, Sequence
from typing import Any

from nextview_lab.benchmark.board_page import Board, Column, WrittenTable, written
from nextview_lab.benchmark.class_tables import ClassTables
from nextview_lab.benchmark.comparison import (
    ALL,
    SIGNIFICANT,
    Tables,
    significant,
    too_few,
    values_of,
)
from nextview_lab.benchmark.entries import is_oracle
from nextview_lab.extras import extras

with extras():
    import pandas as pd

# with fewer objects, or wider intervals of differences in accuracy, a warning is given
FEW_OBJECTS = 200
WIDE_INTERVAL = 0.03


def headline_threshold(thresholds: Sequence[float]) -> float:
    """Return the threshold used in reports: 0.97, the library's default, or the closest one."""
    return min(thresholds, key=lambda t: abs(t - 0.97))


def leaderboard(tables: ClassTables, threshold: float) -> list[Any]:
    """List the policies at one threshold, the most accurate first and oracles last.

    Args:
        tables: of the benchmark.
        threshold: of the belief.

    Returns:
        Rows with policy, accuracy, its 95 % interval (low, high), class_accuracy, n_views, travel
        (grid cells, over all episodes), difference and p_holm to the reference (NaN for the
        reference itself), and differs, whether the difference is significant.
    """
    rows = tables.measures.query("set == @ALL and threshold == @threshold")
    table = rows.pivot(index="policy", columns="measure", values="value")
    table = table.join(
        rows[rows["measure"] == "accuracy"].set_index("policy")[["low", "high"]]
    )
    tests = accuracy_tests(tables, threshold).set_index("policy")
    table = table.join(tests[["difference", "p_holm"]]).reset_index()
    table = table.rename(columns={"travel_all": "travel"}).assign(
        differs=table["p_holm"] < SIGNIFICANT
    )
    return sorted(
        table.itertuples(index=False), key=lambda s: (is_oracle(s.policy), -s.accuracy)
    )


def promised_risks(tables: ClassTables, risks: Mapping[str, float]) -> list[Any]:
    """Compare guaranteed error rates with actual ones, for realisable policies.

    Args:
        tables: of the benchmark.
        risks: thresholds by guaranteed error rate.

    Returns:
        Rows with policy, risk, threshold, error among the episodes that reached the threshold, its
        interval (low, high), the share of these episodes (confident), and whether the guarantee is
        violated significantly (broken).
    """
    rows = []
    for risk, threshold in risks.items():
        values = values_of(tables.measures, ALL, threshold)
        for policy in dict.fromkeys(policy for policy, _, _ in values):
            # the upper limit of the accuracy is the lower limit of the error
            right, high, low = values[policy, "confident_accuracy", 0]
            share = values[policy, "confident", 0][0]
            row = (policy, float(risk), threshold, 1 - right, 1 - low, 1 - high, share)
            rows += [] if is_oracle(policy) else [row]
    columns = ["policy", "risk", "threshold", "error", "low", "high", "confident"]
    table = pd.DataFrame(rows, columns=columns)
    return list(
        table.assign(broken=table["low"] > table["risk"]).itertuples(index=False)
    )


def nothing_differs(
    tables: ClassTables,
    threshold: float,
    reference: str,
) -> str | None:
    """Return a sentence if no realisable policy differs significantly from the reference.

    Args:
        tables: of the benchmark.
        threshold: of the belief.
        reference: name of the reference policy.

    Returns:
        The sentence; None if some policy differs.
    """
    tests = _robot_tests(tables, threshold)
    if tests.empty or (tests["p_holm"] < SIGNIFICANT).any():
        return None
    return (
        f"No policy that a robot could follow differs significantly from {reference} in accuracy at"
        f" threshold {threshold:g} (every p after Holm's correction is {SIGNIFICANT} or more)."
    )


def too_few_objects(tables: Tables, threshold: float, objects: int) -> str | None:
    """Return a warning if there are too few objects to compare policies.

    Args:
        tables: of the benchmark.
        threshold: of the belief.
        objects: number of objects.

    Returns:
        The warning; None if there are enough.
    """
    hopeless = too_few(accuracy_tests(tables))
    if hopeless:
        return hopeless[ALL]

    tests = _robot_tests(tables, threshold)
    # NaN without comparisons
    half = float((tests["high"] - tests["low"]).median() / 2)
    if objects >= FEW_OBJECTS and not half > WIDE_INTERVAL:
        return None
    unclear = (
        ""
        if half != half
        else f" and differences in accuracy are known to ±{100 * half:.1f} points"
    )
    what = (
        f"Too few objects to tell: there are {objects:,}{unclear}. Take no order of the policies"
        " from this"
    )
    return f"{what}; it wants at least {FEW_OBJECTS} objects and ±{100 * WIDE_INTERVAL:g} points."


def accuracy_tests(tables: Tables, threshold: float | None = None) -> "pd.DataFrame":
    """Return the tests of accuracy at one threshold; by default at all of them."""
    t = tables.tests.query("set == @ALL and views == 0 and measure == 'accuracy'")
    return t if threshold is None else t[t["threshold"] == threshold]


def _robot_tests(tables: Tables, threshold: float) -> "pd.DataFrame":
    tests = accuracy_tests(tables, threshold)
    return tests[~tests["policy"].map(is_oracle).astype(bool)]


def after_views_table(tables: Tables) -> WrittenTable | None:
    """Return the results after fixed numbers of views as text; None if there are none."""
    after = tables.measures.query("set == @ALL and views > 0")
    counts = [int(k) for k in after["views"].unique()]
    columns = [Column(f"{k} view{'s' * (k > 1)}", ("accuracy",), k) for k in counts]
    for what, measure in (("travel", "travel"), ("of the gap", "share_of_gap")):
        columns += [Column(f"{what} at {k}", (measure,), k, 2) for k in counts]
    board = Board(f"points over {tables.reference}: tests.csv", ALL, tuple(columns))
    stars = significant(tables, ALL)
    named = {column.heading: column for column in columns}
    return written(tables, board, named, stars) if counts else None
