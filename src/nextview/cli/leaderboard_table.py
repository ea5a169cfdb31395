"""The results of a benchmark as a table in the terminal."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table

from nextview.benchmark.leaderboard import (
    SIGNIFICANT,
    LevelRow,
    PromisedRisk,
    Standing,
    headline_threshold,
    is_oracle,
    leaderboard,
    level_rows,
    nothing_differs,
    promised_risks,
    too_few,
)
from nextview.benchmark.results import Results


def print_leaderboard(results: Results) -> None:
    """Print the policies under the headline threshold, what may be concluded from them, and what was promised."""
    tables, reference = results.tables, results.settings["reference"]
    console = Console(highlight=False)
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


def _table(title: str) -> Table:
    """In 80 columns; only a long name of a policy is folded."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=0, pad_edge=False)
    table.add_column("policy", overflow="fold", min_width=20)
    return table


def _policies(board: list[Standing], threshold: float, reference: str) -> Table:
    title = f"threshold {threshold:g}; in brackets 95 % intervals; points over {reference}"
    table = _table(title)
    for column in ("accuracy", "class\nmean", "views", "travel\ncells", f"over\n{reference}", "p"):
        table.add_column(column, justify="right", no_wrap=True)
    for i, s in enumerate(board):
        oracle, difference, p = is_oracle(s.policy), "", ""
        if oracle and i > 0 and not is_oracle(board[i - 1].policy):
            table.add_section()
            table.add_row("oracles:", style="dim")
        if s.p_holm == s.p_holm:  # not the reference
            difference = f"{round(100 * s.difference, 1) + 0.0:+.1f}"
            p = ("< 0.001" if s.p_holm < 0.001 else f"{s.p_holm:.3f}") + (" *" if s.differs else "  ")
        table.add_row(
            s.policy,
            f"{s.accuracy:.3f} ({s.low:.3f}-{s.high:.3f})",
            f"{s.class_accuracy:.3f}",
            f"{s.n_views:.2f}",
            f"{s.travel:.2f}",
            difference,
            p,
            style="dim" if oracle else "bold" if s.differs else None,
        )
    return table


def _level(rows: list[LevelRow], reference: str) -> Table:
    counts = [n_views for n_views, _ in rows[0].cells]
    worlds = f"{rows[0].worlds} world{'s' * (rows[0].worlds > 1)}"
    table = _table(f"{rows[0].level} clutter, {worlds}: accuracy, and points over {reference}")
    for k in counts:
        table.add_column(f"{k} view{'s' * (k > 1)}", no_wrap=True, min_width=12 if k > 1 else None)
    for row in rows:
        cells = []
        for k, cell in row.cells:
            compared = k > 1 and cell.difference == cell.difference  # after one view nothing is chosen
            over = f" {round(100 * cell.difference, 1) + 0.0:+5.1f}" if compared else ""
            cells.append(f"{cell.accuracy:.3f}{over}{'*' * (cell.p_holm < SIGNIFICANT)}")
        table.add_row(row.policy, *cells, style="dim" if is_oracle(row.policy) else None)
    return table


def _risks(risks: list[PromisedRisk]) -> Table:
    title = "promised error rates of those who stop early, and measured ones"
    table = _table(title)
    for column in ("  promised", "  threshold", "measured", "  stopped early"):
        table.add_column(column, justify="right", no_wrap=True)
    for r in risks:
        table.add_row(
            r.policy,
            f"{100 * r.risk:g} %",
            f"{r.threshold:.4g}",
            f"{100 * r.error:.1f} % ({100 * r.low:.1f}-{100 * r.high:.1f})",
            f"{100 * r.confident:.1f} %" + (" broken" if r.broken else ""),
        )
    return table
