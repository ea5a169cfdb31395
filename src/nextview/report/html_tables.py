"""The tables of the report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nextview.benchmark.entries import is_oracle
from nextview.benchmark.leaderboard import level_rows, promised_risks
from nextview.benchmark.published import COLUMNS, published_threshold
from nextview.benchmark.results import Results
from nextview.measures.map_names import LEM
from nextview.report.elements import NONE, Cell, Table, cell, label, numbers, percent

KNOWING = ("best", "worst", "high", "low", "true")
"""How the names of fixed views begin that are chosen by a truth no robot has."""


def p_value(p: float) -> str:
    """A p-value as it is written."""
    return NONE if np.isnan(p) else "< 0.001" if p < 0.001 else f"{p:.3f}"


def points(difference: float) -> str:
    """A difference in percentage points, never minus zero."""
    return f"{round(100 * difference, 1) + 0.0:+.1f}"


def named(policy: str, *small: str) -> Cell:
    """A policy's name, marked if it knows what a robot cannot."""
    return Cell(policy, small, oracle=is_oracle(policy) or policy.split("-")[0] in KNOWING)


def overview(results: Results, threshold: float) -> Table:
    """All policies under one threshold: table 5 of the thesis, with what it lacked."""
    found = numbers(results.tables.summary, "policy", "threshold", "measure")
    tests = results.tables.tests.query("threshold == @threshold and measure == 'accuracy'")
    tested = dict(
        zip(
            tests["policy"],
            tests[["difference", "low", "high", "p_holm", "mcnemar_holm"]].to_numpy(float).tolist(),
            strict=True,
        )
    )
    measures = {"accuracy": 3, "clean_accuracy": 3, "class_accuracy": 3}
    measures |= {"n_views": 2, "travel_all": 2, "travel_moved": 2, "arc_all": 2}
    rows = []
    for policy in results.tables.sweep["policy"].unique():
        row: list[Cell | str] = [named(policy)]
        row += [cell(found[policy, threshold, measure], digits) for measure, digits in measures.items()]
        if policy in tested:
            difference, low, high, p, paired = tested[policy]
            row.append(Cell(points(difference), (f"{points(low)} … {points(high)}",)))
            row += [p_value(p), p_value(paired)]
        else:
            row += ["reference", NONE, NONE]
        rows.append(row)
    head = [
        "policy", "accuracy", "without duplicates", "class accuracy", "views", "travel, all", "travel, moved",
        "arc, rad", "points over reference", "p, boot\u00adstrap", "p, Mc\u00adNemar",
    ]  # fmt: skip
    caption = f"Every policy at threshold {threshold:g}. Small print: 95\u00a0% intervals. p-values are Holm-corrected."
    return Table(head, rows, caption)


def calibration(results: Results, policies: Sequence[str]) -> Table:
    """What a threshold is worth: how many reach it, and how many of these are right."""
    found = numbers(results.tables.summary, "policy", "threshold", "measure")
    thresholds = results.settings["thresholds"]

    def value(policy: str, threshold: float) -> Cell:
        share = found[policy, threshold, "confident"].value
        return cell(found[policy, threshold, "confident_accuracy"], below=f"of {percent(share, 0)}")

    rows: list[list[Cell | str]] = [
        [named(policy), *(value(policy, threshold) for threshold in thresholds)] for policy in policies
    ]
    caption = "Share of right answers among the episodes that reached the threshold, and how many did."
    return Table(["policy", *(f"{t:g}" for t in thresholds)], rows, caption)


def risks(results: Results) -> Table | None:
    """Promised and measured error rates; None if none were promised."""
    rows: list[list[Cell | str]] = [
        [
            named(row.policy),
            percent(row.risk),
            f"{row.threshold:.4g}",
            Cell(percent(row.error), (f"{100 * row.low:.1f} {NONE} {percent(row.high)}",)),
            percent(row.confident),
        ]
        for row in promised_risks(results.tables)
    ]
    caption = "Promised error rates of those who stop early, and measured ones."
    return Table(["policy", "promised", "threshold", "measured", "stopped early"], rows, caption) if rows else None


def levels(results: Results) -> list[Table]:
    """Of worlds: accuracy and travel after so many views, a table a level; none where the objects are no worlds."""
    found = []
    for rows in level_rows(results.tables):
        counts = [n_views for n_views, _ in rows[0].cells]
        head = ["policy", *(f"{k} view{'s' * (k > 1)}" for k in counts)]
        head += [f"travel, {k} views" for k in counts if k > 1]
        body: list[list[Cell | str]] = []
        for row in rows:
            line: list[Cell | str] = [named(row.policy)]
            for k, at in row.cells:
                small = [f"{at.low:.3f} {NONE} {at.high:.3f}"]
                if k > 1 and not np.isnan(at.difference):  # after one view nothing is chosen
                    around = f"{points(at.difference_low)} … {points(at.difference_high)}"
                    p = p_value(at.p_holm)
                    small += [f"{points(at.difference)} ({around})", f"p {p}"]
                line.append(Cell(f"{at.accuracy:.3f}", tuple(small)))
            body.append([*line, *(f"{at.travel:.2f}" for k, at in row.cells if k > 1)])
        caption = (
            f"{rows[0].level.capitalize()} clutter, {rows[0].worlds} worlds: accuracy after a fixed number of views, "
            "whatever is believed. Small print: 95\u00a0% intervals, points over "
            f"{results.settings['reference']} with theirs, and p-values with one Holm correction for all levels, "
            "policies and numbers of views. Travel is in grid cells."
        )
        found.append(Table(head, body, caption))
    return found


def per_class(results: Results, measure: str, fallback: float) -> Table:
    """Tables 8 and 9 (40 classes: 10 and 11), each policy at the threshold of its published column.

    Of worlds nothing is published; there all policies that a robot could follow are at the same threshold.
    """
    found = numbers(results.tables.per_class, "policy", "threshold", "label", "measure")
    overall = numbers(results.tables.summary, "policy", "threshold", "measure")
    thresholds = results.settings["thresholds"]
    ran = set(results.tables.sweep["policy"])
    worlds = not results.tables.levels.empty
    at = {name: fallback for name in results.tables.sweep["policy"].unique() if worlds and not is_oracle(name)}
    for name in () if worlds else (LEM, *COLUMNS):
        wanted = published_threshold(name) or 0.99
        if name in ran:
            at[name] = wanted if wanted in thresholds else fallback
    digits = 3 if measure == "accuracy" else 2
    rows: list[list[Cell | str]] = []
    for of_class in sorted(results.tables.per_class["label"].unique()):
        cells = (cell(found.get((name, t, of_class, measure)), digits) for name, t in at.items())
        rows.append([label(of_class), *cells])
    over = "objects" if measure == "accuracy" else "episodes"
    for heading, of in (("mean of classes", f"class_{measure}"), (f"mean of {over}", measure)):
        rows.append([heading, *(cell(overall.get((name, t, of)), digits) for name, t in at.items())])
    head: list[Cell | str] = ["class", *(named(name, f"at {t:g}") for name, t in at.items())]
    what = "Accuracy" if measure == "accuracy" else "Travel in grid cells, over the episodes that moved,"
    if worlds:
        return Table(head, rows, f"{what} by class.")
    ten = len(results.predictions.classes) <= 10
    number = {"accuracy": 8 if ten else 10, "travel_moved": 9 if ten else 11}[measure]
    return Table(head, rows, f"{what} by class, as table {number} of the thesis, whose numbers stand last in a cell.")


def five_views(results: Results) -> Table | None:
    """Tables 3 and 12: views settled beforehand; None if there are none."""
    found = numbers(results.tables.per_class, "policy", "threshold", "label", "measure")
    overall = numbers(results.tables.summary, "policy", "threshold", "measure")
    policies = [name for name, threshold, measure in overall if threshold is None and measure == "accuracy"]
    if not policies:
        return None
    rows: list[list[Cell | str]] = []
    for of_class in sorted(results.tables.per_class["label"].unique()):
        cells = (cell(found.get((name, None, of_class, "accuracy"))) for name in policies)
        rows.append([label(of_class), *cells])
    for heading, measure, digits in (
        ("mean of classes", "class_accuracy", 3),
        ("mean of objects", "accuracy", 3),
        ("views", "n_views", 0),
        ("travel, cells", "travel_all", 1),
    ):
        rows.append([heading, *(cell(overall[name, None, measure], digits) for name in policies)])
    caption = "Fixed views, no threshold, as tables 3 and 12. The published numbers are of a network for 40 classes."
    return Table(["class", *map(named, policies)], rows, caption)
