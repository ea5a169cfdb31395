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
    """Print how often the recogniser is right, and how good each map is; its page says more."""
    console, right = Terminal(), numbers(found.accuracy, "n_views", "label", "measure")
    views = int(found.accuracy["n_views"].max())
    lines = {"mean of objects": "accuracy", "without duplicates": "clean_accuracy", "size not known": "shape_accuracy"}
    shown = Table("share of right answers", "one view", f"all {views} views")
    for heading, measure in (lines | {"mean of classes": "class_accuracy"}).items():
        if (1, "", measure) in right:
            shown.add_row(heading, *(_cell(right[n_views, "", measure], 3) for n_views in (1, views)))
    console.print(shown)
    headings = {"mse": "MSE", "d0": "d = 0", "d_le_1": "d <= 1", "d_lt_2": "d < 2", "regret": "regret"}
    maps = found.maps[(found.maps["by"] == "network") & (found.maps["label"] == "")]
    scores, shown = numbers(maps, "map", "measure"), Table("mean of objects", *headings.values())
    for name in maps["map"].unique():
        shown.add_row(name.upper(), *(_cell(scores[name, each], 4 if each == "mse" else 3) for each in headings))
    if len(maps):
        console.print(shown)
    for name, why in found.left_out.items():
        console.print(f"{name}: {why}")


def _cell(number: Number, digits: int) -> Text:
    """A number and its interval."""
    if not isfinite(number.value):
        return Text("-")
    interval = f" {number.low:.{digits}f}-{number.high:.{digits}f}" if number.high > number.low else ""
    return Text.assemble(f"{number.value:.{digits}f}", (interval, "dim"))
