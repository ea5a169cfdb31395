"""Leaderboard at one threshold, significant differences, and too few objects."""

from collections.abc import Sequence
from typing import Any

from nextview.benchmark.entries import is_oracle
from nextview.benchmark.statistics import EXACT_FAMILIES, target_families
from nextview.benchmark.summary import Tables
from nextview.checks import extras

with extras():
    import pandas as pd

# a difference is called one when its p-value after Holm's correction is below this
SIGNIFICANT = 0.05
# with fewer objects, or wider intervals of differences in accuracy, little can be told
FEW_OBJECTS = 200
WIDE_INTERVAL = 0.03


def headline_threshold(thresholds: Sequence[float]) -> float:
    """The threshold that reports speak of: 0.97, the library's default, or the one next to it."""
    return min(thresholds, key=lambda t: abs(t - 0.97))


def leaderboard(tables: Tables, threshold: float) -> list[Any]:
    """List the policies at one threshold, the most accurate first and oracles last.

    Args:
        tables: of the benchmark.
        threshold: of the belief.

    Returns:
        Rows with policy, accuracy, its 95 % interval (low, high), class_accuracy, n_views, travel
        (grid cells, over all episodes), difference and p_holm to the reference (NaN for the
        reference itself), and differs, whether the difference is significant.
    """
    rows = tables.summary[tables.summary["threshold"] == threshold]
    table = rows.pivot(index="policy", columns="measure", values="value")
    table = table.join(
        rows[rows["measure"] == "accuracy"].set_index("policy")[["low", "high"]]
    )
    table = table.join(
        _tests(tables, threshold).set_index("policy")[["difference", "p_holm"]]
    ).reset_index()
    table = table.rename(columns={"travel_all": "travel"}).assign(
        differs=table["p_holm"] < SIGNIFICANT
    )
    return sorted(
        table.itertuples(index=False), key=lambda s: (is_oracle(s.policy), -s.accuracy)
    )


def promised_risks(tables: Tables) -> list[Any]:
    """Return the rows of ``Tables.risks``, and whether a guarantee is broken beyond chance."""
    return list(
        tables.risks.assign(
            broken=tables.risks["low"] > tables.risks["risk"]
        ).itertuples(index=False)
    )


def level_rows(tables: Tables) -> list[list[tuple[str, list[Any]]]]:
    """The rows of ``Tables.levels`` by level and policy, those that no robot could follow last."""
    found = []
    for _, rows in tables.levels.groupby("level", sort=False):
        policies = [
            (str(name), list(mine.itertuples()))
            for name, mine in rows.groupby("policy", sort=False)
        ]
        found.append(sorted(policies, key=lambda policy: is_oracle(policy[0])))
    return found


def level_differences(tables: Tables, reference: str) -> str | None:
    """Return a sentence that names the policies that differ significantly in scenes.

    Args:
        tables: of the benchmark.
        reference: name of the reference policy.

    Returns:
        The sentence; None if no policy of a robot differs.
    """
    found = [
        f"{policy} by {100 * row.difference:+.1f} points after {row.n_views} views under"
        f" {row.level} clutter"
        for policies in level_rows(tables)
        for policy, rows in policies
        for row in rows
        if not is_oracle(policy) and row.p_holm < SIGNIFICANT
    ]
    return (
        f"With no threshold, significantly different from {reference}: {'; '.join(found)}."
        if found
        else None
    )


def nothing_differs(tables: Tables, threshold: float, reference: str) -> str | None:
    """Return a sentence if no policy of a robot differs significantly from the reference.

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


def too_few(tables: Tables, threshold: float, names: Sequence[str]) -> str | None:
    """Return a warning if there are too few objects to compare policies.

    Args:
        tables: of the benchmark.
        threshold: of the belief.
        names: of the objects.

    Returns:
        The warning; None if there are enough.
    """
    families = int(target_families(names).max()) + 1
    corrected = int((tables.tests["measure"] == "accuracy").sum())
    if hopeless := too_few_families(families, corrected):
        return hopeless

    objects = len(names)
    tests = _robot_tests(tables, threshold)
    # NaN if nothing was compared
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


def too_few_families(families: int, tests: int) -> str | None:
    """Return a warning if no difference, however clear, could be significant.

    Args:
        families: number of families.
        tests: how many tests are corrected together.

    Returns:
        The sentence; None if there are enough families.
    """
    wanted = families
    while wanted < EXACT_FAMILIES and tests * 2.0 ** (1 - wanted) >= SIGNIFICANT:
        wanted += 1
    if wanted == families:
        return None
    return (
        f"Too few to tell: no p-value of {families} is below {2.0 ** (1 - families):.2g}, and"
        f" {tests} tests are corrected together, so that no difference can be significant; it"
        f" takes {wanted} or more."
    )


def _tests(tables: Tables, threshold: float) -> pd.DataFrame:
    t = tables.tests
    return t[(t["threshold"] == threshold) & (t["measure"] == "accuracy")]


def _robot_tests(tables: Tables, threshold: float) -> pd.DataFrame:
    tests = _tests(tables, threshold)
    return tests[~tests["policy"].map(is_oracle).astype(bool)]
