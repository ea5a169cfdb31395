"""Print tables, and what was found in real frames, in the terminal."""

from collections.abc import Iterable, Mapping

from rich import box
from rich.table import Table

from nextview.checks import number_of
from nextview.cli.progress import Terminal, console
from nextview_lab.benchmark.bop import BopRun
from nextview_lab.benchmark.real import RealRun, real_table
from nextview_lab.benchmark.text_tables import WrittenTable


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
