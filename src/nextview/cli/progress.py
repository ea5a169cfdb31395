"""Show progress on standard error: a bar in a terminal, otherwise lines of text."""

from collections.abc import Iterable, Iterator
from typing import Any

from rich.console import Console
from rich.table import Column
from rich.text import Text

from nextview.cli.exit_status import printable
from nextview.data.progress import in_lines


class Terminal(Console):
    """Console that prints text literally: no markup, and control characters are escaped."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Escape a text; every text passes here, including those in tables."""
        return super().render_str(printable(text), **options)


console = Terminal(stderr=True)


def track(done: Iterable[int], total: int, what: str, /) -> None:
    """Exhaust an iterable of increasing counts and show progress and remaining time.

    Args:
        done: increasing counts of finished items.
        total: final count.
        what: name of the work.
    """
    if console.is_terminal:
        _show_bar(done, total, what)
    else:
        in_lines(done, total, printable(what))


def follow(steps: Iterator[tuple[int, int]], what: str) -> tuple[int, int]:
    """Show the progress of a stage that yields the number of finished items.

    Args:
        steps: pairs of the number of finished items and the total; the first pair comes before any
            work.
        what: name of the work.

    Returns:
        The number of items that were finished before this run, and the total.
    """
    before, total = next(steps)
    track((done for done, _ in steps), total, what)
    return before, total


def _show_bar(done: Iterable[int], total: int, what: str) -> None:
    from rich import progress  # slow to import

    width = Column(no_wrap=True, max_width=24, overflow="ellipsis")
    name = progress.TextColumn("{task.description}", table_column=width, markup=False)
    left = progress.TimeRemainingColumn(elapsed_when_finished=True)
    columns = (name, progress.BarColumn(8), progress.MofNCompleteColumn(), left)
    with progress.Progress(*columns, console=console) as shown:
        task = None
        for n in done:
            if task is None:
                task = shown.add_task(printable(what), total=total, completed=n)
            shown.update(task, completed=n)
