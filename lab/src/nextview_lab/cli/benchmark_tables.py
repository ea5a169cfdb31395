"""Print benchmark and evaluation results as tables in the terminal."""

from dataclasses import replace
from math import isfinite
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

from nextview.cli.progress import Terminal
from nextview_lab.benchmark import leaderboard as board
from nextview_lab.benchmark.class_tables import ClassResults
from nextview_lab.benchmark.comparison import SIGNIFICANT, significant
from nextview_lab.benchmark.entries import is_oracle
from nextview_lab.benchmark.evaluation import Evaluation
from nextview_lab.benchmark.page import Number, numbers
from nextview_lab.benchmark.results import Board, ComparedTables, board_rows, markdown
from nextview_lab.errors import EntryError


def print_classes(found: ClassResults) -> None:
    """Print the leaderboard, then raise an error if any policy failed."""
    print_leaderboard(found)
    if found.settings["failures"]:
        raise EntryError("; ".join(found.settings["failures"].values()))


def print_leaderboard(results: ClassResults) -> None:
    """Print the policies at the headline threshold, and the conclusions of the tests."""
    tables = results.tables
    reference = results.settings["reference"]
    console = Terminal()

    if not tables.sweep.empty:
        at = board.headline_threshold(results.settings["thresholds"])
        console.print(_policies(board.leaderboard(tables, at), at, reference))
        console.print(
            f"* differs from {reference} in accuracy: p after Holm's correction is below"
            f" {SIGNIFICANT}"
        )
        few = board.too_few_objects(tables, at, len(results.predictions))
        for sentence in (board.nothing_differs(tables, at, reference), few):
            if sentence:
                console.print(sentence)

    after = board.after_views_rows(tables)
    if not after.empty:
        print(markdown(after.columns, after.itertuples(index=False)), end="")
    if sentence := board.level_differences(tables, reference):
        console.print(sentence)

    for r in board.promised_risks(tables, results.settings["risks"]):
        if r.broken:
            wrong = (
                f"of the episodes that stopped at {r.threshold:.4g}, {100 * r.error:.1f} % are"
                " wrong"
            )
            console.print(
                f"{r.policy}: {wrong}; at most {100 * r.risk:g} % was promised."
            )


def _policies(rows: list[Any], threshold: float, reference: str) -> Table:
    """Lay out the policies in 80 columns; only long policy names are folded."""
    title = (
        f"threshold {threshold:g}; in brackets 95 % intervals; points over {reference}"
    )
    table = Table(
        title=title,
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=0,
        pad_edge=False,
    )
    table.add_column("policy", overflow="fold", min_width=20)

    for column in (
        "accuracy",
        "class\nmean",
        "views",
        "travel\ncells",
        f"over\n{reference}",
        "p",
    ):
        table.add_column(column, justify="right", no_wrap=True)
    for i, s in enumerate(rows):
        oracle = is_oracle(s.policy)
        over = ""
        p = ""
        if oracle and i > 0 and not is_oracle(rows[i - 1].policy):
            table.add_section()
            table.add_row("oracles:", style="dim")
        if s.p_holm == s.p_holm:  # not the reference
            over = f"{round(100 * s.difference, 1) + 0.0:+.1f}"
            p = ("< 0.001" if s.p_holm < 0.001 else f"{s.p_holm:.3f}") + (
                " *" if s.differs else "  "
            )
        accuracy = (
            f"{s.accuracy:.3f} ({s.low:.3f}-{s.high:.3f})",
            f"{s.class_accuracy:.3f}",
        )
        style = "bold" if s.differs else None
        if oracle:
            style = "dim"
        table.add_row(
            s.policy,
            *accuracy,
            f"{s.n_views:.2f}",
            f"{s.travel:.2f}",
            over,
            p,
            style=style,
        )

    return table


def print_compared(found: ComparedTables) -> None:
    """Print a table for each board, in 80 columns, and the conclusions of the tests."""
    console = Terminal()
    for each in found.boards:
        console.print(_compared(found, each))
    console.print(
        f"* differs from {found.reference}: p after Holm's correction is below {SIGNIFICANT}"
    )
    for sentence in found.sentences():
        console.print(sentence)


def _compared(found: ComparedTables, shown: Board) -> Table:
    table = Table(title=shown.title, caption=shown.about, box=box.SIMPLE_HEAD)
    table.add_column("policy", no_wrap=True)
    columns = [
        replace(column, measures=column.measures[:1]) for column in shown.narrow()
    ]
    for column in columns:
        table.add_column(column.short, justify="right")
    for cells in board_rows(found, shown, columns, significant(found, shown.name)):
        table.add_row(*cells)
    return table


def print_evaluation(found: Evaluation) -> None:
    """Print the accuracy of the recogniser and the scores of each map.

    The HTML page of the evaluation shows more.
    """
    console = Terminal()
    right = numbers(found.accuracy, "n_views", "label", "measure")
    views = int(found.accuracy["n_views"].max())
    lines = {
        "mean of objects": "accuracy",
        "without duplicates": "clean_accuracy",
        "size not known": "shape_accuracy",
    }

    shown = Table("share of right answers", "one view", f"all {views} views")
    for heading, measure in (lines | {"mean of classes": "class_accuracy"}).items():
        if (1, "", measure) in right:
            shown.add_row(
                heading,
                *(_cell(right[n_views, "", measure], 3) for n_views in (1, views)),
            )
    console.print(shown)

    headings = {
        "mse": "MSE",
        "d0": "d = 0",
        "d_le_1": "d <= 1",
        "d_lt_2": "d < 2",
        "regret": "regret",
    }

    maps = found.maps[(found.maps["by"] == "network") & (found.maps["label"] == "")]
    scores = numbers(maps, "map", "measure")
    names = maps["map"].unique()
    shown = Table("mean of objects", *(name.upper() for name in names))
    for measure, heading in headings.items():
        shown.add_row(
            heading,
            *(
                _cell(scores[name, measure], 4 if measure == "mse" else 3)
                for name in names
            ),
        )
    if len(names):
        console.print(shown)

    for name, why in found.left_out.items():
        console.print(f"{name}: {why}")


def _cell(number: Number, digits: int) -> Text:
    if not isfinite(number.value):
        return Text("-")
    interval = (
        f" {number.low:.{digits}f}-{number.high:.{digits}f}"
        if number.high > number.low
        else ""
    )
    return Text.assemble(f"{number.value:.{digits}f}", (interval, "dim"))
