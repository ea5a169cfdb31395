"""Print tables, and what was found in real frames, in the terminal."""

from collections.abc import Iterable

from rich import box
from rich.table import Table

from nextview.cli.progress import Terminal, console
from nextview_lab.benchmark.board_page import WrittenTable
from nextview_lab.benchmark.real import RealRun, real_table


def print_tables(tables: Iterable[WrittenTable]) -> None:
    """Print tables; the cells of one that is too wide have several lines.

    Args:
        tables: with headings and cells of text.
    """
    for one in tables:
        table = Table(box=box.SIMPLE, pad_edge=False, padding=(0, 1, 0, 0))
        table.title = one.title
        table.title_justify = "left"
        for heading in one.headings:
            table.add_column(heading, justify="right", overflow="fold")
        table.columns[0].justify = "left"
        for row in one.rows:
            table.add_row(*row)
        Terminal().print(table)


def print_real(run: RealRun) -> None:
    """Print what was right in real frames, and what was left out.

    Args:
        run: what was said of them.
    """
    for name, reason in run.left_out.items():
        console.print(f"left out: {name}: {reason}", style="yellow", soft_wrap=True)
    print_tables([real_table(run.rows)])
