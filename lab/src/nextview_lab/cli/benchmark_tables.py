"""Print the results of benchmarks and evaluations as tables in the terminal."""

import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from math import isfinite
from typing import Any

from rich import box
from rich.cells import cell_len
from rich.table import Table

from nextview.checks import number_of
from nextview.cli.progress import Terminal, console
from nextview_lab.benchmark import class_tables as board
from nextview_lab.benchmark.board_page import WrittenTable, points, written
from nextview_lab.benchmark.bop import BopRun
from nextview_lab.benchmark.class_tables import ClassResults
from nextview_lab.benchmark.comparison import SIGNIFICANT, significant
from nextview_lab.benchmark.evaluation import Evaluation
from nextview_lab.benchmark.page import Number, numbers
from nextview_lab.benchmark.real import RealRun, real_table
from nextview_lab.benchmark.results import ComparedTables
from nextview_lab.benchmark.standings import Leaderboard
from nextview_lab.errors import EntryError

MOST_WHOLE_COLUMNS = 7  # of a table with its intervals; the page has them all
NAME_SHARE = 3  # the names of methods take this part of a line at most: a third


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
        "",
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


def print_evaluation(found: Evaluation) -> None:
    """Print the accuracy of the recogniser and the scores of each map.

    The HTML page of the evaluation shows more.
    """
    terminal = Terminal()
    right = numbers(found.accuracy, "n_views", "label", "measure")
    views = int(found.accuracy["n_views"].max())
    lines = {
        "mean of objects": "accuracy",
        "without duplicates": "clean_accuracy",
        "size not known": "shape_accuracy",
    }

    rows = [
        (heading, *(_cell(right[k, "", measure], 3) for k in (1, views)))
        for heading, measure in (lines | {"mean of classes": "class_accuracy"}).items()
        if (1, "", measure) in right
    ]
    head = ("share of right answers", "one view", f"all {views} views")
    tables = [WrittenTable("", "", head, tuple(rows))]

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
    rows = [
        (
            heading,
            *(_cell(scores[name, measure], 3 + (measure == "mse")) for name in names),
        )
        for measure, heading in headings.items()
    ]
    if len(names):
        head = ("mean of objects", *(name.upper() for name in names))
        tables.append(WrittenTable("", "", head, tuple(rows)))
    print_tables(tables)

    for name, why in found.left_out.items():
        terminal.print(f"{name}: {why}")


def _cell(number: Number, digits: int) -> str:
    if not isfinite(number.value):
        return "-"
    low, high = (f"{end:.{digits}f}" for end in (number.low, number.high))
    interval = f" ({low}-{high})" if number.high > number.low else ""
    return f"{number.value:.{digits}f}{interval}"


def print_standings(board: Leaderboard) -> None:
    """Print the tables of a leaderboard.

    Args:
        board: the leaderboard.
    """
    print_tables(board.tables)
    for note in board.notes:
        console.print(note, soft_wrap=True)


def print_tables(tables: Iterable[WrittenTable]) -> None:
    """Print tables, those that are too wide in several parts.

    Args:
        tables: with headings and cells of text.
    """
    terminal = Terminal()
    for one in tables:
        for part in _parts(one, terminal):
            terminal.print(part)


def _parts(one: WrittenTable, terminal: Terminal) -> Iterator[Table]:
    """Divide the columns of a table so that each part fits; the names stand in all of them."""
    short = len(one.headings) > MOST_WHOLE_COLUMNS
    names = [row[0] for row in one.rows]
    columns = [
        [cell.partition(" (")[0] if short else cell for cell in cells]
        for cells in zip(*(row[1:] for row in one.rows), strict=True)
    ]
    longest = max(map(cell_len, [one.headings[0], *names]))
    of_names = min(longest, max(1, terminal.width // NAME_SHARE))
    # a heading breaks at its spaces, and a score nowhere
    widths = [
        max(map(cell_len, [*heading.split(), *cells]))
        for heading, cells in zip(one.headings[1:], columns, strict=True)
    ]

    def part(first: int, last: int) -> Table:
        table = Table(box=box.SIMPLE, pad_edge=False, padding=(0, 1, 0, 0))
        table.title = None if first else one.title
        table.title_justify = "left"
        table.add_column(one.headings[0], width=of_names, overflow="fold")
        for column in range(first, last):
            heading = one.headings[1 + column]
            table.add_column(heading, justify="right", width=widths[column])
        for row, name in enumerate(names):
            table.add_row(name, *(cells[row] for cells in columns[first:last]))
        return table

    unlimited = terminal.options.update(max_width=sys.maxsize)
    first = 0
    while first < len(widths):
        last = first + 1
        while last < len(widths):
            longer = terminal.measure(part(first, last + 1), options=unlimited)
            if longer.maximum > terminal.width:
                break
            last += 1
        yield part(first, last)
        first = last


def print_bop(run: BopRun) -> None:
    """Print what was found, and what was left out.

    Args:
        run: what was found.
    """
    if run.not_known:
        numbers = ", ".join(map(str, run.not_known))
        console.print(
            f"the memory does not know the models {numbers}, so they are never found",
            style="yellow",
            soft_wrap=True,
        )
    _print_left_out(run.left_out)
    for name, count in run.others.items():
        console.print(
            f"{name}: is no model of the dataset, found {number_of(count, 'time')} and not written",
            style="yellow",
            soft_wrap=True,
        )
    terminal = Terminal()
    terminal.print(
        f"{number_of(run.poses, 'pose')} in {number_of(run.images, 'image')},"
        f" {run.seconds:.2f} s an image",
        soft_wrap=True,
    )


def print_real(run: RealRun) -> None:
    """Print what was right in real frames, and what was left out.

    Args:
        run: what was said of them.
    """
    _print_left_out(run.left_out)
    print_tables([real_table(run.rows)])


def _print_left_out(left_out: Mapping[str, Exception]) -> None:
    """Print why frames were left out, by their names."""
    for name, reason in left_out.items():
        console.print(f"left out: {name}: {reason}", style="yellow", soft_wrap=True)
