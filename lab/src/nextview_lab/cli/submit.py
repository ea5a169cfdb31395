"""``nextview-lab submit`` and ``nextview-lab leaderboard``: what they found, in the terminal."""

import sys
from collections.abc import Iterator

from rich import box
from rich.cells import cell_len
from rich.table import Table

from nextview.cli.progress import Terminal, console
from nextview_lab.benchmark.board_page import Leaderboard, WrittenTable
from nextview_lab.benchmark.submit import Submitted

MOST_WHOLE_COLUMNS = 6  # of a table with its intervals; the page has them all
NAME_SHARE = 3  # the names of methods take this part of a line at most: a third


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


def print_leaderboard(board: Leaderboard) -> None:
    """Print the tables of a leaderboard, those that are too wide in several parts.

    Args:
        board: the leaderboard.
    """
    terminal = Terminal()
    for one in board.tables:
        for part in _parts(one, terminal):
            terminal.print(part)
    for note in board.notes:
        console.print(note, soft_wrap=True)


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
