"""``nextview submit`` and ``nextview leaderboard``: what they found, in the terminal."""

from typing import TYPE_CHECKING

from rich import box
from rich.table import Table

from nextview.benchmark.submit import Submitted
from nextview.cli.progress import Terminal, console

if TYPE_CHECKING:
    from nextview.benchmark.standings import (
        Leaderboard,
    )  # pandas, which submit does not need

MOST_WHOLE_COLUMNS = 6  # of a table with its intervals; the page has them all


def print_submitted(run: Submitted) -> None:
    """Print what was run.

    Args:
        run: what was run.
    """
    Terminal().print(str(run), soft_wrap=True)
    if not run.whole:
        console.print(
            "these are not all episodes of the archive: the leaderboard refuses the file",
            style="yellow",
            soft_wrap=True,
        )


def print_leaderboard(board: "Leaderboard") -> None:
    """Print the tables of a leaderboard.

    Args:
        board: the leaderboard.
    """
    terminal = Terminal()
    for one in board.tables:
        table = Table(box=box.SIMPLE, pad_edge=False, padding=(0, 1, 0, 0))
        table.title = one.title
        table.title_justify = "left"
        for heading in one.headings:
            first = heading == "method"
            table.add_column(
                heading, justify="left" if first else "right", no_wrap=first
            )
        wide = len(one.headings) > MOST_WHOLE_COLUMNS
        for row in one.rows:
            table.add_row(*(cell.partition(" (")[0] if wide else cell for cell in row))
        terminal.print(table)
    for note in board.notes:
        console.print(note, soft_wrap=True)
