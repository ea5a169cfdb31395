"""The results of a benchmark and of an evaluation as tables in the terminal."""

from __future__ import annotations

from math import isfinite
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

from nextview.benchmark.entries import is_oracle
from nextview.benchmark.evaluation import Evaluation
from nextview.benchmark.leaderboard import (
    SIGNIFICANT,
    headline_threshold,
    leaderboard,
    level_rows,
    nothing_differs,
    promised_risks,
    too_few,
)
from nextview.benchmark.page import Number, numbers
from nextview.benchmark.run import Results
from nextview.cli.progress import Terminal
from nextview.errors import EntryError


def print_results(found: Results) -> None:
    """Print the leaderboard; then what failed is an error."""
    print_leaderboard(found)
    if found.settings["failures"]:
        raise EntryError("\n".join(found.settings["failures"].values()))


def print_leaderboard(results: Results) -> None:
    """Print the policies under the headline threshold, what may be concluded from them, and what was promised."""
    tables, reference = results.tables, results.settings["reference"]
    console = Terminal()
    if not tables.sweep.empty:
        at = headline_threshold(results.settings["thresholds"])
        console.print(_policies(leaderboard(tables, at), at, reference))
        console.print(f"* differs from {reference} in accuracy: p after Holm's correction is below {SIGNIFICANT}")
        for sentence in (nothing_differs(tables, at, reference), too_few(tables, at, len(results.predictions))):
            if sentence:
                console.print(sentence)
    levels = level_rows(tables)
    for level in levels:
        console.print(_level(level, reference))
    if levels:
        console.print(f"* differs from {reference}: p after one correction for all of these is below {SIGNIFICANT}")
    if promised := promised_risks(tables):
        console.print(_risks(promised))


def _table(title: str, *columns: str) -> Table:
    """In 80 columns; only a long name of a policy is folded."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=0, pad_edge=False)
    table.add_column("policy", overflow="fold", min_width=20)
    for column in columns:
        table.add_column(column, justify="right", no_wrap=True)
    return table


def _policies(board: list[Any], threshold: float, reference: str) -> Table:
    title = f"threshold {threshold:g}; in brackets 95 % intervals; points over {reference}"
    table = _table(title, "accuracy", "class\nmean", "views", "travel\ncells", f"over\n{reference}", "p")
    for i, s in enumerate(board):
        oracle, over, p = is_oracle(s.policy), "", ""
        if oracle and i > 0 and not is_oracle(board[i - 1].policy):
            table.add_section()
            table.add_row("oracles:", style="dim")
        if s.p_holm == s.p_holm:  # not the reference
            over = f"{round(100 * s.difference, 1) + 0.0:+.1f}"
            p = ("< 0.001" if s.p_holm < 0.001 else f"{s.p_holm:.3f}") + (" *" if s.differs else "  ")
        accuracy = f"{s.accuracy:.3f} ({s.low:.3f}-{s.high:.3f})", f"{s.class_accuracy:.3f}"
        style = "dim" if oracle else "bold" if s.differs else None
        table.add_row(s.policy, *accuracy, f"{s.n_views:.2f}", f"{s.travel:.2f}", over, p, style=style)
    return table


def _level(policies: list[tuple[str, list[Any]]], reference: str) -> Table:
    first = policies[0][1]
    scenes = f"{first[0].scenes} scene{'s' * (first[0].scenes > 1)}"
    columns = [f"{row.n_views} view{'s' * (row.n_views > 1)}".rjust(12) for row in first]
    table = _table(f"{first[0].level} clutter, {scenes}: accuracy, and points over {reference}", *columns)
    for policy, rows in policies:
        cells = []
        for row in rows:
            compared = row.n_views > 1 and row.difference == row.difference  # after one view nothing is chosen
            over = f" {round(100 * row.difference, 1) + 0.0:+5.1f}" if compared else ""
            cells.append(f"{row.accuracy:.3f}{over}{'*' * (row.p_holm < SIGNIFICANT)}")
        table.add_row(policy, *cells, style="dim" if is_oracle(policy) else None)
    return table


def _risks(risks: list[Any]) -> Table:
    title = "promised error rates of those who stop early, and measured ones"
    table = _table(title, "  promised", "  threshold", "measured", "  stopped early")
    for r in risks:
        measured = f"{100 * r.error:.1f} % ({100 * r.low:.1f}-{100 * r.high:.1f})"
        early = f"{100 * r.confident:.1f} %" + (" broken" if r.broken else "")
        table.add_row(r.policy, f"{100 * r.risk:g} %", f"{r.threshold:.4g}", measured, early)
    return table


def print_evaluation(found: Evaluation) -> None:
    """Print the scores of the recogniser and of each map."""
    console = Terminal()
    console.print(_recogniser_table(found))
    for name in found.maps["map"].unique():
        console.print(_map_table(found, name))
    for name, why in found.left_out.items():
        console.print(f"{name}: {why}")


def _recogniser_table(found: Evaluation) -> Table:
    """Accuracy of each class and of all, from one view and from all views fused."""
    views = int(found.accuracy["n_views"].max())
    shown = Table("share of right answers", "objects", "one view", f"all {views} views")
    right = numbers(found.accuracy, "n_views", "label", "measure")
    objects = found.accuracy.groupby(["label", "measure"])["objects"].first()
    labels = [label for label in found.accuracy["label"].unique() if label]
    lines = [(label.replace("_", " "), label, "accuracy") for label in labels]
    lines += [("mean of classes", "", "class_accuracy"), ("mean of objects", "", "accuracy")]
    lines += [("  without duplicates", "", "clean_accuracy")]
    if "shape_accuracy" in set(found.accuracy["measure"]):
        lines += [("  size not known", "", "shape_accuracy")]
    for heading, label, measure in lines:
        cells = (_cell(right[n_views, label, measure], 3) for n_views in (1, views))
        shown.add_row(heading, str(objects[label, measure]), *cells, end_section=label == labels[-1])
    published = right[1, "", "accuracy"].published
    if isfinite(published):
        shown.add_row("  published", "", f"{published:.3f}")
    return shown


def _map_table(found: Evaluation, name: str) -> Table:
    """Scores of a map over objects and classes, beside the published ones and the baselines."""
    measures = {"mse": "MSE", "d0": "d = 0", "d_le_1": "d <= 1", "d_lt_2": "d < 2", "regret": "regret"}
    scores = numbers(found.maps[(found.maps["map"] == name) & (found.maps["label"] == "")], "by", "measure")
    baselines = [by for by in found.maps["by"].unique() if by != "network"]
    printed = any(isfinite(score.published) for score in scores.values())
    caption = "published: squared error over objects, peaks over classes (table 4)" if printed else None
    shown = Table(name.upper(), "mean of objects", "of classes", "published", *baselines, caption=caption)
    shown.columns[1].no_wrap = True
    for measure, heading in measures.items():
        digits = 4 if measure == "mse" else 3
        over_objects, over_classes = scores["network", measure], scores["network", f"class_{measure}"]
        published = over_objects.published if measure == "mse" else over_classes.published
        rest = [over_classes.value, published, *(scores[by, measure].value for by in baselines)]
        cells = (f"{value:.{digits}f}" if isfinite(value) else "-" for value in rest)
        shown.add_row(heading, _cell(over_objects, digits), *cells)
    return shown


def _cell(number: Number, digits: int) -> Text:
    """A number and its interval."""
    if not isfinite(number.value):
        return Text("-")
    interval = f" {number.low:.{digits}f}-{number.high:.{digits}f}" if number.high > number.low else ""
    return Text.assemble(f"{number.value:.{digits}f}", (interval, "dim"))
