"""Print the results of benchmarks as tables in the terminal."""

from dataclasses import replace
from typing import Any

from nextview.cli.progress import Terminal
from nextview_lab.benchmark import class_tables as board
from nextview_lab.benchmark.class_tables import ClassResults
from nextview_lab.benchmark.comparison import SIGNIFICANT, significant, written
from nextview_lab.benchmark.results import ComparedTables
from nextview_lab.benchmark.text_tables import WrittenTable, points
from nextview_lab.cli.printing import print_tables
from nextview_lab.errors import EntryError


def print_classes(results: ClassResults) -> None:
    """Print the policies at the headline threshold, and the conclusions of the tests.

    Then raise an error if any policy failed.
    """
    tables = results.tables
    reference = results.settings["reference"]
    terminal = Terminal()

    if tables.choosing():
        at = board.headline_threshold(results.settings["thresholds"])
        print_tables([_policies(board.leaderboard(tables, at), at, reference)])
        terminal.print(
            f"* differs from {reference} in accuracy: p after Holm's correction is below"
            f" {SIGNIFICANT}"
        )
        few = board.too_few_objects(tables, at, len(results.predictions))
        for sentence in (board.nothing_differs(tables, at, reference), few):
            if sentence:
                terminal.print(sentence)

    if after := board.after_views_table(tables):
        print_tables([after])
    for r in board.promised_risks(tables, results.settings["risks"]):
        if r.broken:
            wrong = (
                f"of the episodes that stopped at {r.threshold:.4g}, {100 * r.error:.1f} % are"
                " wrong"
            )
            terminal.print(
                f"{r.policy}: {wrong}; at most {100 * r.risk:g} % was promised."
            )
    if results.settings["failures"]:
        raise EntryError("; ".join(results.settings["failures"].values()))


def _policies(rows: list[Any], threshold: float, reference: str) -> WrittenTable:
    """Return the policies as text."""
    texts = []
    for s in rows:
        over = ""
        p = ""
        if s.p_holm == s.p_holm:  # not the reference
            over = points(s.difference)
            small = "< 0.001" if s.p_holm < 0.001 else f"{s.p_holm:.3f}"
            p = small + " *" * s.differs
        texts.append(
            (
                s.policy,
                f"{s.accuracy:.3f} ({s.low:.3f}-{s.high:.3f})",
                f"{s.class_accuracy:.3f}",
                f"{s.n_views:.2f}",
                f"{s.travel:.2f}",
                over,
                p,
            )
        )
    return WrittenTable(
        f"threshold {threshold:g}; in brackets 95 % intervals; points over {reference}",
        ("policy", "accuracy", "class mean", "views", "travel, cells", "over", "p"),
        tuple(texts),
    )


def print_compared(found: ComparedTables) -> None:
    """Print a table for each board, in 80 columns, and the conclusions of the tests."""
    terminal = Terminal()
    stars = significant(found)
    for each in found.boards:
        columns = {
            name: replace(column, measures=column.measures[:1])
            for name, column in each.narrow().items()
        }
        text = written(found, each, columns, stars)
        print_tables([replace(text, title=f"{each.title}; {each.about}")])
    terminal.print(
        f"* differs from {found.reference}: p after Holm's correction is below {SIGNIFICANT}"
    )
    for sentence in found.sentences():
        terminal.print(sentence)
